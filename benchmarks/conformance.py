"""Derivatives of flows through events, against closed forms and scipy's own event loop.

    python benchmarks/conformance.py rows            systems on which libraries fail, closed forms
    python benchmarks/conformance.py peers           rows by scipy, heyoka and diffrax, with times
    python benchmarks/conformance.py many            many bouncing balls beside DOP853 in C
    python benchmarks/conformance.py random          random piecewise systems against scipy
    python benchmarks/conformance.py random --count 100
    python benchmarks/conformance.py speed           a gradient after ten bounces
    python benchmarks/conformance.py memory          reverse mode through 1000 events

Prints `name.metric value` lines. `random` draws piecewise polynomial systems with two charts, four
transitions, linear resets and guards that may depend on the time. Its other half (`scipy_flow`)
shares no code with the package: solve_ivp with its own events, and variational equations with
saltation matrices.
"""

import argparse
import functools as ft
import resource
import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from peers import flows, jaxonomy_flows
from peers.c_peer import bounces
from peers.errors import Unavailable
from scipy.integrate import solve_ivp

import hybridjax as hj


def show(name: str, value: object) -> None:
    text = f"{value:.3g}" if isinstance(value, float) else str(value)
    print(f"conformance.{name} {text}", flush=True)


# Rows with closed forms.


class Given(hj.Chart):
    """A chart with a field that is given."""

    function: object
    states: tuple[str, ...]

    def field(self, t, q, u):
        return self.function(t, q)


def Chart(function, states):  # noqa: N802 (it makes one)
    return Given(function=function, states=states)


class Ramp(hj.HybridSystem):
    """Rises with the rate 1 until tau (restated from issue 729 of diffrax)."""

    inputs = ()
    tau: hj.Parameter = hj.parameter(0.6)

    def charts(self):
        return {
            "up": Chart(lambda t, q: (0.0 * t + 1.0,), ("y",)),
            "flat": Chart(lambda t, q: (0.0 * t,), ("y",)),
        }

    def transitions(self):
        return [hj.Transition("end", "up", "flat", lambda t, q, u: self.tau - t)]


class Saw(hj.HybridSystem):
    """Rises with the rate 1, and falls to 0 at p: a state triggers an event that changes it, as in
    pull request 3258 of AMICI."""

    inputs = ()
    p: hj.Parameter = hj.parameter(0.7)

    def charts(self):
        return {"up": Chart(lambda t, q: (0.0 * t + 1.0,), ("y",))}

    def transitions(self):
        def fall(t, q, u):
            return (0.0 * q[0],)

        return [
            hj.Transition("fall", "up", "up", lambda t, q, u: self.p - q[0], reset=fall)
        ]


class Ball(hj.HybridSystem):
    """A bouncing ball."""

    inputs = ()
    g: hj.Parameter = hj.parameter(9.81)
    e: hj.Parameter = hj.parameter(0.7)

    def charts(self):
        return {"air": Chart(lambda t, q: (q[1], -self.g), ("y", "v"))}

    def transitions(self):
        def bounce(t, q, u):
            return 0.0 * q[0], -self.e * q[1]

        return [
            hj.Transition("bounce", "air", "air", lambda t, q, u: q[0], reset=bounce)
        ]


class Dragged(hj.HybridSystem):
    """A ball that bounces with drag."""

    inputs = ()
    g: hj.Parameter = hj.parameter(9.81)
    e: hj.Parameter = hj.parameter(0.9)
    drag: hj.Parameter = hj.parameter(0.1)

    def charts(self):
        def fall(t, q):
            return q[1], -self.g - self.drag * q[1]

        return {"air": Chart(fall, ("y", "v"))}

    def transitions(self):
        def bounce(t, q, u):
            return 0.0 * q[0], -self.e * q[1]

        return [
            hj.Transition("bounce", "air", "air", lambda t, q, u: q[0], reset=bounce)
        ]


class Oscillator(hj.HybridSystem):
    """A pendulum of small angle with a stop."""

    inputs = ()
    w: hj.Parameter = hj.parameter(2.0)
    s: hj.Parameter = hj.parameter(0.5)
    e: hj.Parameter = hj.parameter(0.8)

    def charts(self):
        return {"free": Chart(lambda t, q: (q[1], -(self.w**2) * q[0]), ("x", "v"))}

    def transitions(self):
        def turn(t, q, u):
            return q[0], -self.e * q[1]

        return [
            hj.Transition(
                "stop", "free", "free", lambda t, q, u: q[0] + self.s, reset=turn
            )
        ]


class Thermostat(hj.HybridSystem):
    """Heating that is switched."""

    inputs = ()
    a: hj.Parameter = hj.parameter(0.5)
    low: hj.Parameter = hj.parameter(18.0)
    high: hj.Parameter = hj.parameter(22.0)
    heat: hj.Parameter = hj.parameter(30.0)

    def charts(self):
        return {
            "on": Chart(lambda t, q: (self.a * (self.heat - q[0]),), ("T",)),
            "off": Chart(lambda t, q: (-self.a * q[0],), ("T",)),
        }

    def transitions(self):
        return [
            hj.Transition("switch off", "on", "off", lambda t, q, u: self.high - q[0]),
            hj.Transition("switch on", "off", "on", lambda t, q, u: q[0] - self.low),
        ]


class Moving(hj.HybridSystem):
    """A decay that jumps by 1 where it meets the line c t."""

    inputs = ()
    c: hj.Parameter = hj.parameter(0.5)

    def charts(self):
        return {"down": Chart(lambda t, q: (-q[0],), ("x",))}

    def transitions(self):
        def jump(t, q, u):
            return (q[0] + 1.0,)

        return [
            hj.Transition(
                "meet", "down", "down", lambda t, q, u: q[0] - self.c * t, reset=jump
            )
        ]


def ramp(tau):
    return hj.flow(Ramp(tau=tau), hj.Guess("up", (0.0,)), 2.0).state[0]


def first_fall(p):
    return hj.flow(Saw(p=p), hj.Guess("up", (0.0,)), "fall", within=3.0).t


def saw(p):
    return hj.flow(Saw(p=p), hj.Guess("up", (0.0,)), 1.0).state[0]


def third_bounce(height, g, e):
    start = hj.Guess("air", (height, 0.0))
    return hj.flow(Ball(g=g, e=e), start, events=3, within=9.0).t


def third_bounce_exactly(height, g, e):
    return jnp.sqrt(2 * height / g) * (1 + 2 * e + 2 * e**2)


def swing(w, s, e):
    start = hj.Guess("free", (1.0, 0.0))
    return hj.flow(Oscillator(w=w, s=s, e=e), start, 2.5).state[0]


def swing_exactly(w, s, e):
    """After the first stop, before the second."""
    first = jnp.arccos(-s) / w
    speed = e * w * jnp.sin(w * first)
    left = 2.5 - first
    return -s * jnp.cos(w * left) + speed / w * jnp.sin(w * left)


def fifth_switch(a, low, high, heat):
    system = Thermostat(a=a, low=low, high=high, heat=heat)
    return hj.flow(system, hj.Guess("on", (20.0,)), events=5, within=50.0).t


def fifth_switch_exactly(a, low, high, heat):
    def rise(x):
        return jnp.log((heat - x) / (heat - high)) / a

    return rise(20.0) + 2 * rise(low) + 2 * jnp.log(high / low) / a


def after_meeting(c):
    return hj.flow(Moving(c=c), hj.Guess("down", (1.0,)), 1.0).state[0]


def after_meeting_exactly(c):
    t = 0.8
    for _ in range(60):
        t = t - (jnp.exp(-t) - c * t) / (-jnp.exp(-t) - c)
    return (jnp.exp(-t) + 1.0) * jnp.exp(t - 1.0)


ROWS = (
    ("ramp", ramp, lambda tau: tau, (0.6,)),
    ("time of a reset", first_fall, lambda p: p, (0.7,)),
    ("after one reset", saw, lambda p: 1.0 - p, (0.7,)),
    ("after two resets", saw, lambda p: 1.0 - 2 * p, (0.4,)),
    ("after eleven resets", saw, lambda p: 1.0 - 11 * p, (0.09,)),
    ("third bounce", third_bounce, third_bounce_exactly, (1.0, 9.81, 0.7)),
    ("stop", swing, swing_exactly, (2.0, 0.5, 0.8)),
    ("thermostat", fifth_switch, fifth_switch_exactly, (0.5, 18.0, 22.0, 30.0)),
    ("moving guard", after_meeting, after_meeting_exactly, (0.5,)),
)


PEER_ROWS = {
    "ramp": (ramp, lambda tau: tau, (0.6,)),
    "after_eleven_resets": (saw, lambda p: 1.0 - 11 * p, (0.09,)),
    "third_bounce": (
        lambda g, e: third_bounce(1.0, g, e),
        lambda g, e: third_bounce_exactly(1.0, g, e),
        (9.81, 0.7),
    ),
    "stop": (swing, swing_exactly, (2.0, 0.5, 0.8)),
    "thermostat": (fifth_switch, fifth_switch_exactly, (0.5, 18.0, 22.0, 30.0)),
    "moving_guard": (after_meeting, after_meeting_exactly, (0.5,)),
}
"""Rows by their parameters alone, as `peers.flows.ROWS` has them."""


def rows(_) -> None:
    """Errors of values, first derivatives (forward and reverse) and second ones."""
    for name, flow, exact, point in ROWS:
        own = jax.jit(lambda *p, flow=flow: orders(flow, p))(*point)
        true = orders(exact, point)
        label = name.replace(" ", "_")
        for order in ("value", "forward", "reverse", "second"):
            apart = jax.tree_util.tree_map(
                lambda x, y: float(jnp.max(jnp.abs(x - y))), own[order], true[order]
            )
            show(f"rows.{label}.{order}", max(jax.tree_util.tree_leaves(apart)))


def orders(function, point) -> dict:
    """The value of a function of numbers, and its derivatives."""
    every = tuple(range(len(point)))
    return dict(
        value=function(*point),
        forward=jax.jacfwd(function, every)(*point),
        reverse=jax.jacrev(function, every)(*point),
        second=jax.jacfwd(jax.jacrev(function, every), every)(*point),
    )


def peers(options) -> None:
    """Errors of gradients by the parameters, and CPU seconds of the first call and of later ones:
    of `flow` inside of `jit`, of scipy with differences, of heyoka with variational equations and
    saltation matrices, and of jaxonomy; and the ramp by diffrax."""
    for name in flows.ROWS:
        _, exact, given = PEER_ROWS[name]
        true = np.array(jax.grad(exact, tuple(range(len(given))))(*given))
        for peer, run in _runs(name, options.jaxonomy).items():
            label = f"peers.{name}.{peer}"
            try:
                found, first, later = run()
            except Unavailable as problem:
                show(label, problem)
                continue
            show(f"{label}.error", float(np.abs(found - true).max()))
            show(f"{label}.first", first)
            show(f"{label}.again", later)
    for label, switched in {"two_fields": False, "switched_field": True}.items():
        run = ft.partial(diffrax_ramp, switched)
        gradient, first, later = flows.timed(run, np.array([0.6]))
        show(f"peers.ramp.diffrax_{label}", float(gradient))
        show(f"peers.ramp.diffrax_{label}.first", first)
        show(f"peers.ramp.diffrax_{label}.again", later)


def _runs(name: str, jaxonomy: str) -> dict:
    """For each library, a function that measures the gradient of a row, as `flows.timed`."""
    row = flows.ROWS[name]
    flow, _, given = PEER_ROWS[name]
    point = np.array(given)

    def own():
        program = jax.jit(jax.grad(flow, tuple(range(len(given)))))
        return lambda p: program(*p)

    def by_scipy():
        return flows.scipy_gradient(row)

    def by_heyoka():
        return flows.heyoka_gradient(row, len(given))

    return {
        "hybridjax": lambda: flows.timed(own, point),
        "scipy": lambda: flows.timed(by_scipy, point),
        "heyoka": lambda: flows.timed(by_heyoka, point),
        "jaxonomy": lambda: jaxonomy_flows.run(name, given, jaxonomy),
    }


def diffrax_ramp(switched: bool):
    """A gradient by two solves of diffrax, the first of which ends with an event; with a field for
    each, or, as in issue 729, with one that is switched by the time."""
    import diffrax
    import optimistix

    def value(tau):
        def solve(rate, begin, y, event):
            def field(t, y, args):
                own = jnp.where(t < tau, 1.0, 0.0) if switched else rate
                return own + 0.0 * y

            return diffrax.diffeqsolve(
                diffrax.ODETerm(field),
                diffrax.Tsit5(),
                begin,
                2.0,
                None,
                y,
                event=event,
                stepsize_controller=diffrax.PIDController(rtol=1e-10, atol=1e-10),
            )

        find = optimistix.Newton(rtol=1e-10, atol=1e-10)
        event = diffrax.Event(lambda t, y, args, **_: tau - t, find)
        first = solve(1.0, 0.0, jnp.zeros(()), event)
        last = solve(0.0, first.ts[-1], first.ys[-1], None)
        return last.ys[-1]

    gradient = jax.jit(jax.grad(value))
    return lambda point: gradient(point[0])


def many(options) -> None:
    """Balls that bounce ten times: CPU seconds of `flow`, and of its reverse mode inside of `jit`,
    by those of DOP853 in C at the same tolerance, and errors of the times."""
    loop = bounces.setup()
    heights = np.linspace(0.5, 2.0, options.starts or 100_000)
    starts = np.stack([heights, 0 * heights], axis=1)
    numbers = 9.81, 0.9, 0.1
    settings = hj.orbits.Settings(rtol=options.tolerance)
    ten = dict(events=10, within=20.0, settings=settings)

    def flow():
        found = hj.flow(Dragged(*numbers), hj.Guess("air", starts), **ten)
        return jax.block_until_ready(found.t)

    @jax.jit
    def gradient(starts, numbers):
        def loss(starts, numbers):
            found = hj.flow(
                Dragged(*numbers), hj.Guess("air", starts), max_steps=64, **ten
            )
            return jnp.sum(found.t**2 + found.state[:, 1] ** 2)

        return jax.grad(loss, (0, 1))(starts, numbers)

    def reverse():
        return jax.block_until_ready(gradient(starts, jnp.array(numbers)))

    def in_c(tolerance=options.tolerance):
        return bounces.run(heights, 10, numbers, tolerance, loop)

    accurate, *_ = in_c(1e-14)
    show("many.flow.first", again(flow, 1))
    show("many.reverse.first", again(reverse, 1))
    seconds = again(in_c, 5)
    show("many.c.seconds", seconds)
    show("many.c.error", float(np.abs(in_c()[0] - accurate).max()))
    show("many.flow.error", float(np.abs(np.asarray(flow()) - accurate).max()))
    show("many.flow.by_c", again(flow, 2) / seconds)
    show("many.reverse.by_c", again(reverse, 2) / seconds)


def memory(options) -> None:
    """Balls that bounce 1000 times without loss: peak memory of the process during the gradient by
    starts and parameters, above its peak before, and errors of the gradient."""
    heights = np.linspace(0.5, 2.0, options.starts or 10_000)
    starts = np.stack([heights, 0 * heights], axis=1)
    numbers = jnp.array([9.81, 1.0])

    @jax.jit
    def gradient(starts, numbers):
        def total(starts, numbers):
            g, e = numbers
            start = hj.Guess("air", starts)
            thousand = dict(events=1000, within=2000.0, max_steps=4096)
            return jnp.mean(hj.flow(Ball(g=g, e=e), start, **thousand).t)

        return jax.grad(total, (0, 1))(starts, numbers)

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    begin = time.process_time()
    _, (by_g, by_e) = jax.block_until_ready(gradient(starts, numbers))
    seconds = time.process_time() - begin
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    show("memory.gigabytes", (peak - before) * 1024 / 1e9)
    show("memory.seconds", seconds)
    # (The last of 1000 bounces comes at 1 + 2 (e + ... + e^999) times the time of the first.)
    first = np.sqrt(2 * heights / 9.81)
    by_g_exactly = np.mean(-0.5 * 1999 * first) / 9.81
    by_e_exactly = np.mean(first) * 999 * 1000
    show("memory.error.by_g", abs(float(by_g) / by_g_exactly - 1))
    show("memory.error.by_e", abs(float(by_e) / by_e_exactly - 1))


# Random systems.

STATES = 2
DURATION = 2.0
# Charts that the transitions leave, and to which they lead.
SOURCES = (0, 0, 1, 1)
TARGETS = (1, 0, 0, 1)
MOST_EVENTS = 12


class Numbers(NamedTuple):
    """All numbers of a random system."""

    matrix: np.ndarray
    """(charts, 2, 2)"""
    square: np.ndarray
    """(charts, 2, 3): coefficients of x^2, x y and y^2."""
    constant: np.ndarray
    wave: np.ndarray
    """(charts, 2): of sin(3 t)."""
    normal: np.ndarray
    """(transitions, 2): gradients of guards."""
    level: np.ndarray
    drift: np.ndarray
    reset: np.ndarray
    """(transitions, 2, 2)"""
    shift: np.ndarray


def draw(rng: np.random.Generator) -> tuple[Numbers, np.ndarray]:
    """A random system, and a start in its first chart."""
    numbers = Numbers(
        matrix=rng.normal(0, 1.0, (2, 2, 2)),
        square=rng.normal(0, 0.2, (2, 2, 3)),
        constant=rng.normal(0, 1.0, (2, 2)),
        wave=rng.normal(0, 1.0, (2, 2)),
        normal=rng.normal(0, 1.0, (4, 2)),
        level=rng.uniform(0.3, 1.5, 4),
        drift=rng.normal(0, 0.2, 4),
        reset=rng.normal(0, 0.5, (4, 2, 2)),
        shift=rng.normal(0, 0.3, (4, 2)),
    )
    return numbers, rng.normal(0, 0.2, 2)


def field(numbers, a, t, q, math):
    x, y = q[0], q[1]
    square = math.stack([x * x, x * y, y * y])
    wave = numbers.wave[a] * math.sin(3 * t)
    return (
        numbers.matrix[a] @ q + numbers.square[a] @ square + numbers.constant[a] + wave
    )


def guard(numbers, g, t, q):
    """Falls through zero at the event."""
    return numbers.normal[g] @ q + numbers.level[g] + numbers.drift[g] * t


class Random(hj.HybridSystem):
    inputs = ()
    numbers: Numbers

    def charts(self):
        def of_chart(a):
            return Chart(lambda t, q: field(self.numbers, a, t, q, jnp), ("x", "y"))

        return {"first": of_chart(0), "second": of_chart(1)}

    def transitions(self):
        names = tuple(self.charts())

        def of(g):
            def falls(t, q, u):
                return guard(self.numbers, g, t, q)

            def reset(t, q, u):
                return self.numbers.reset[g] @ q + self.numbers.shift[g]

            ends = names[SOURCES[g]], names[TARGETS[g]]
            return hj.Transition(f"event {g}", *ends, falls, reset=reset)

        return [of(g) for g in range(4)]


class Found(NamedTuple):
    """A flow, with derivatives of the end by the start and by all numbers in one direction."""

    events: list
    times: np.ndarray
    state: np.ndarray
    by_start: np.ndarray
    along: np.ndarray


def scipy_flow(numbers: Numbers, start: np.ndarray, by: Numbers) -> Found | None:
    """By solve_ivp, its events, variational equations and saltation matrices, with derivatives of
    the functions by complex steps; None where a guard may have been touched or events crowd."""
    tiny = 1e-30
    moved = Numbers(*(x + 1j * tiny * d for x, d in zip(numbers, by, strict=True)))

    def along_field(a, t, q, columns):
        rates = np.empty_like(columns)
        for k in range(STATES):
            rates[:, k] = (
                field(numbers, a, t, q + 1j * tiny * columns[:, k], np).imag / tiny
            )
        aside = q + 1j * tiny * columns[:, -1]
        rates[:, -1] = field(moved, a, t, aside, np).imag / tiny
        return rates

    def by_saltation(g, t, q, columns):
        a, b = SOURCES[g], TARGETS[g]
        f = field(numbers, a, t, q, np)
        rate = numbers.normal[g] @ f + numbers.drift[g]
        after = numbers.reset[g] @ q + numbers.shift[g]
        later = field(numbers, b, t, after, np)
        new = np.empty_like(columns)
        for k in range(STATES + 1):
            own = moved if k == STATES else numbers
            aside = q + 1j * tiny * columns[:, k]
            delay = -(guard(own, g, t, aside)).imag / tiny / rate
            at_event = q + 1j * tiny * (columns[:, k] + f * delay)
            new[:, k] = (
                own.reset[g] @ at_event + own.shift[g]
            ).imag / tiny - later * delay
        return after, new

    def flow(a):
        def rates(t, z):
            columns = z[STATES:].reshape(STATES, STATES + 1)
            own = field(numbers, a, t, z[:STATES], np)
            return np.concatenate([own, along_field(a, t, z[:STATES], columns).ravel()])

        return rates

    t, a, q = 0.0, 0, start
    columns = np.column_stack([np.eye(STATES), np.zeros(STATES)])
    events, times = [], []
    while t < DURATION:
        own = [g for g in range(4) if SOURCES[g] == a]
        armed = [guard(numbers, g, t, q) > 1e-9 for g in own]
        if not all(armed):
            return None

        z = np.concatenate([q, columns.ravel()])
        found = solve_ivp(
            flow(a),
            (t, DURATION),
            z,
            method="DOP853",
            rtol=1e-12,
            atol=1e-13,
            events=[_crossing(numbers, g) for g in own],
            max_step=0.02,
        )
        if not found.success or np.abs(found.y[:STATES]).max() > 50:
            return None
        lowest = [min(guard(numbers, g, t, x) for t, x in _path(found)) for g in own]
        t = found.t[-1]
        q = found.y[:STATES, -1]
        columns = found.y[STATES:, -1].reshape(STATES, STATES + 1)
        if found.status == 0:
            if min(lowest) < 1e-4:
                return None
            break
        (k,) = (j for j, x in enumerate(found.t_events) if len(x))
        if min(x for j, x in enumerate(lowest) if j != k) < 1e-4:
            return None
        g = own[k]
        f = field(numbers, a, t, q, np)
        if numbers.normal[g] @ f + numbers.drift[g] > -1e-2:
            return None
        events.append(g)
        times.append(t)
        if len(events) > MOST_EVENTS:
            return None
        q, columns = by_saltation(g, t, q, columns)
        a = TARGETS[g]
    return Found(events, np.array(times), q, columns[:, :STATES], columns[:, -1])


def _crossing(numbers, g):
    """The event of a guard, for solve_ivp."""

    def value(t, z):
        return guard(numbers, g, t, z[:STATES])

    value.terminal = True
    value.direction = -1
    return value


def _path(found):
    return zip(found.t, found.y[:STATES].T, strict=True)


def random(options) -> None:
    """How many of all random systems are right, refused by a code, and wrong."""
    rng = np.random.default_rng(options.seed)
    counts = dict(right=0, refused=0, wrong=0, left_out=0)
    worst = 0.0

    @jax.jit
    def one(numbers, start, by):
        def of_start(start):
            return hj.flow(Random(numbers), hj.Guess("first", start), DURATION)

        def along(x):
            moved = jax.tree_util.tree_map(lambda n, d: n + x * d, numbers, by)
            return hj.flow(Random(moved), hj.Guess("first", start), DURATION).state

        found = of_start(start)
        by_start = jax.jacfwd(lambda x: of_start(x).state)(start)
        reverse = jax.jacrev(lambda x: of_start(x).state)(start)
        by_all = jax.jacfwd(along)(0.0)
        times = found.event_times, found.event_index
        return found.result, *times, found.state, by_start, reverse, by_all

    while counts["right"] + counts["refused"] + counts["wrong"] < options.count:
        numbers, start = draw(rng)
        by = Numbers(*(rng.normal(0, 1, x.shape) for x in numbers))
        true = scipy_flow(numbers, start, by)
        if true is None or not true.events:
            counts["left_out"] += 1
            continue
        code, times, index, state, by_start, reverse, along = map(
            np.asarray, one(numbers, start, by)
        )
        if code != 0:
            counts["refused"] += 1
            show("random.refused", hj.errors.Result(int(code)).name)
            continue
        count = len(true.events)
        same = index[:count].tolist() == true.events and (index[count:] < 0).all()
        pairs = [
            (times[:count], true.times),
            (state, true.state),
            (by_start, true.by_start),
            (reverse, true.by_start),
            (along, true.along),
        ]
        if same:
            error = max(
                float(np.max(np.abs(x - y))) / (1 + float(np.max(np.abs(y))))
                for x, y in pairs
            )
            worst = max(worst, error)
        if same and error < 1e-7:
            counts["right"] += 1
        else:
            counts["wrong"] += 1
            print(
                "wrong",
                index[:count],
                true.events,
                [np.abs(x - y).max() for x, y in pairs],
            )
    for name, count in counts.items():
        show(f"random.{name}", count)
    show("random.worst_error_of_right", worst)


# Speed.


def speed(_) -> None:
    """CPU seconds of the gradient of a loss after ten bounces, by the start and two parameters;
    `quick`: by XLA's older generator of code (docs/how-to/speed-up.md)."""

    def loss(height, g, e):
        start = hj.Guess("air", (height, 0.0))
        found = hj.flow(Ball(g=g, e=e), start, events=10, within=20.0)
        return found.t**2 + found.state[1] ** 2

    point = 1.0, 9.81, 0.9
    older = {"xla_cpu_use_fusion_emitters": False}
    for name, options in {"gradient": None, "quick": older}.items():
        jax.clear_caches()
        gradient = jax.jit(jax.grad(loss, (0, 1, 2)), compiler_options=options)
        call = ft.partial(of_program, gradient, point)
        show(f"speed.{name}.first", again(call, 1))
        show(f"speed.{name}.again", again(call))
    program = jax.jit(loss)
    of_program(program, point)
    show("speed.value.again", again(ft.partial(of_program, program, point)))

    def differences():
        return [scipy_bounces(1.0 + h) for h in (1e-6, -1e-6)]

    show("speed.differences_of_scipy.one_parameter", again(differences, 3))


def of_program(program, point):
    return jax.block_until_ready(program(*point))


def again(function, repeat: int = 20) -> float:
    """Least CPU seconds of several calls."""
    seconds = []
    for _ in range(repeat):
        begin = time.process_time()
        function()
        seconds.append(time.process_time() - begin)
    return min(seconds)


def scipy_bounces(height: float) -> float:
    def ground(t, q):
        return q[0]

    ground.terminal = True
    ground.direction = -1
    t, q = 0.0, np.array([height, 0.0])
    for _ in range(10):
        options = dict(method="DOP853", rtol=1e-12, atol=1e-14, events=ground)
        found = solve_ivp(lambda t, q: [q[1], -9.81], (t, 20.0), q, **options)
        t = found.t[-1]
        q = np.array([0.0, -0.9 * found.y[1, -1]])
    return t


PARTS = ("rows", "peers", "many", "memory", "random", "speed")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jaxonomy", default="python", help="its interpreter")
    parser.add_argument("--starts", type=int, help="of `many` and `memory`")
    parser.add_argument("--tolerance", type=float, default=1e-12)
    options = parser.parse_args()
    hj.enable_x64()
    globals()[options.part](options)


if __name__ == "__main__":
    main()
