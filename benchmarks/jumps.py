"""Random systems that jump, use the time or have pulses: each is right or refused, none silently
wrong.

    python benchmarks/jumps.py                        # 2000 systems, an hour of the processor
    python benchmarks/jumps.py --draws 100 --seed 3 --verbose

A system is an oscillator (driven by a clock, free, one that fires and is reset, or both) with a
term in its field, the gain of its input, its guard, its reset, a predicate or an output. The truth
is an integration by scipy's DOP853 from one edge of the term to the next, between which the term is
held smooth, with derivatives by central differences. Compared are the cycle over three periods, its
multipliers, C and (with a clock) B of a linearization, and the end of a simulation off the cycle.
"""

import argparse
import collections
import functools as ft
import sys
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import hybridjax as hj


# Relative errors above this are wrong. Central differences by this step are accurate to 1e-7.
WRONG, STEP = 1e-5, 1e-4
CLOCK = 1.3
# A narrow term begins and ends so many of its widths beside its middle.
NARROW = 30.0
TABLE = np.array([0.3, -0.2, 0.9, 0.1, -0.5])


class Kind(NamedTuple):
    """A function of a number h, and the same for scipy with its decision m = floor(h) held."""

    jax: Any
    held: Any
    sides: bool = False
    """Whether it decides only between h < 0 (m = -1) and h > 0 (m = 0)."""


@jax.custom_jvp
def relay(h):
    return jnp.where(h > 0, 1.0, 0.0)


relay.defjvp(lambda x, dx: (relay(*x), 0.0 * dx[0]))


def counted(h):
    return jax.lax.while_loop(lambda k: k < h, lambda k: k + 1.0, -3.0)


def scanned(h):
    add = lambda total, x: (total + jnp.where(h > x, 1.0, 0.0), None)  # noqa: E731
    return jax.lax.scan(add, 0.0, jnp.arange(-1.0, 2.0))[0]


def pair(h):
    return jnp.stack([h, 0.0 * h])


entries = jnp.asarray(TABLE)
grid = jnp.arange(-1.0, 3.0)
entry = lambda h, m: TABLE[int(np.clip(m + 2, 0, 4))]  # noqa: E731
branch = lambda h: jnp.clip(jnp.floor(h) + 2, 0, 4).astype(int)  # noqa: E731
unit = lambda h: (pair(h) / jnp.linalg.norm(pair(h)))[0]  # noqa: E731
turned = lambda h, m: np.arctan(-h) + (np.pi if m >= 0 else -np.pi)  # noqa: E731
# By what the function decides: the sign, as +-1 or as 0 and 1, or the floor; the held functions.
SIGN = {
    "sign": jnp.sign,
    "copysign": lambda h: jnp.copysign(1.0, h),
    "quotient": lambda h: h / jnp.abs(h),
    "quotient of a root": lambda h: h / jnp.sqrt(h * h),
    "unit vector": unit,
    "steep": lambda h: jnp.tanh(1e30 * h),
    "vmap": lambda h: jax.vmap(lambda k: jnp.sign(h) * k)(jnp.ones(2)).sum() / 2,
}
SIDE = {
    "where": lambda h: jnp.where(h > 0, 1.0, 0.0),
    "where not": lambda h: jnp.where(~(h < 0), 1.0, 0.0),
    "comparison": lambda h: (h >= 0) * 1.0,
    "heaviside": lambda h: jnp.heaviside(h, 0.5),
    "cond": lambda h: jax.lax.cond(h > 0, lambda: 1.0, lambda: 0.0),
    "own derivative": relay,
    "jit": jax.jit(lambda h: jnp.where(h > 0, 1.0, 0.0)),
    "steep sigmoid": lambda h: jax.nn.sigmoid(1e12 * h),
    "less steep": lambda h: jax.nn.sigmoid(1e10 * h),
    "sharp exponential": lambda h: jnp.exp(-jnp.exp(jnp.clip(-1e15 * h, -700, 5))),
    "power zero": lambda h: jnp.maximum(h, 0.0) ** 0.0 * (h > 0),
    "sort": lambda h: jnp.sign(jnp.sort(pair(h))[1]),
    "median": lambda h: jnp.heaviside(jnp.median(jnp.stack([h, h, h])), 0.0),
    "is negative": lambda h: 1.0 - jnp.signbit(h),
    "nan to number": lambda h: jnp.nan_to_num(jnp.sqrt(h) * 0.0 + 1.0),
}
FLOOR = {
    "floor": jnp.floor,
    "round": lambda h: jnp.round(h - 0.5),
    "floor division": lambda h: h // 1.0,
    "ceil": lambda h: jnp.ceil(h) - 1.0,
}
OTHERS = {
    "where with values": Kind(
        lambda h: jnp.where(h > 0, jnp.cos(h), -0.3 * h),
        lambda h, m: np.cos(h) if m >= 0 else -0.3 * h,
        True,
    ),
    "comparison of two": Kind(
        lambda h: 1.0 * ((h > 0) & (h < 1)), lambda h, m: float(m == 0)
    ),
    "mod": Kind(lambda h: jnp.mod(h, 1.0), lambda h, m: h - m),
    "fmod": Kind(lambda h: jnp.fmod(h, 1.0), lambda h, m: h - m - (m < 0)),
    "integer": Kind(lambda h: h.astype(int) * 1.0, lambda h, m: m + (m < 0)),
    "table": Kind(lambda h: entries[jnp.searchsorted(grid, h)], entry),
    "digitize": Kind(lambda h: entries[jnp.digitize(h, grid)], entry),
    "switch": Kind(
        lambda h: jax.lax.switch(branch(h), [lambda k=k: entries[k] for k in range(5)]),
        entry,
    ),
    "select": Kind(
        lambda h: jnp.select([h < 0, h < 1], [0.0, 1.0], 0.0),
        lambda h, m: float(m == 0),
    ),
    "argmax": Kind(
        lambda h: entries[jnp.argmax(pair(h)[::-1])],
        lambda h, m: TABLE[int(m >= 0)],
        True,
    ),
    "argsort": Kind(
        lambda h: entries[jnp.argsort(pair(h))[0]],
        lambda h, m: TABLE[int(m >= 0)],
        True,
    ),
    "while": Kind(counted, lambda h, m: np.maximum(m + 1.0, -3.0)),
    "scan": Kind(scanned, lambda h, m: np.clip(m + 2.0, 0, 3)),
    "arctan of a pole": Kind(
        lambda h: jnp.arctan(1 / h),
        lambda h, m: np.arctan2(1, h) - (0 if m >= 0 else np.pi),
        True,
    ),
    "arctan2": Kind(lambda h: jnp.arctan2(h, -1.0), turned, True),
    "angle": Kind(lambda h: jnp.angle(-1 + 1j * h), turned, True),
    "complex logarithm": Kind(lambda h: jnp.log(-1 + 1j * h).imag, turned, True),
    "relu": Kind(jax.nn.relu, lambda h, m: h * (m >= 0), True),
    "abs": Kind(jnp.abs, lambda h, m: h * (1 if m >= 0 else -1), True),
    "clip": Kind(
        lambda h: jnp.clip(h, 0.0, 1.0), lambda h, m: h if m == 0 else float(m > 0)
    ),
    "triangle": Kind(
        lambda h: jnp.abs(jnp.mod(h, 2.0) - 1.0),
        lambda h, m: h - m if m % 2 else 1 - h + m,
    ),
    "smooth": Kind(jnp.tanh, lambda h, m: np.tanh(h), True),
    "rather steep": Kind(
        lambda h: jnp.tanh(50 * h), lambda h, m: np.tanh(50 * h), True
    ),
}
KINDS = {
    **{
        name: Kind(f, lambda h, m: 2.0 * (m >= 0) - 1.0, True)
        for name, f in SIGN.items()
    },
    **{name: Kind(f, lambda h, m: float(m >= 0), True) for name, f in SIDE.items()},
    **{name: Kind(f, lambda h, m: m) for name, f in FLOOR.items()},
    **OTHERS,
}
ARGUMENTS = "state rate product clock phase ramp pulse bump box".split()
PLACES = {
    "driven": "field gain output",
    "free": "field gain output",
    "fires": "field gain guard reset output enabled",
    "driven and fires": "field gain guard reset output enabled",
}


class Form(NamedTuple):
    """All of a system but its numbers."""

    base: str
    place: str
    argument: str
    kind: str


class Numbers(NamedTuple):
    amount: Any
    slope: Any
    level: Any
    width: Any
    ratio: Any
    """Of the period of the term to that of the clock."""
    shape: Any
    """Numbers of the oscillator."""


# The system, for JAX and for scipy. `whole` is the number of half turns of the term's own clock.


def half_turns(x, t):
    return 2 * (t / (CLOCK * x.ratio) + x.level)


def argument(form, x, t, q, whole, lib):
    """The argument h of the term."""
    since = half_turns(x, t) / 2 - whole // 2
    match form.argument:
        case "state":
            return x.slope * (q[0] - x.level)
        case "rate":
            return x.slope * (q[1] - x.level)
        case "product":
            return x.slope * (q[0] * q[1] - x.level)
        case "clock":
            return x.slope * (lib.sin(2 * lib.pi * t / (CLOCK * x.ratio)) - x.level)
        case "phase":
            return x.slope * (since - 0.5 - 0.4 * x.level)
        case "ramp":
            return t / (CLOCK * x.ratio) - 0.5 * x.level
        case "pulse":
            return (since - 0.5) / x.width
        case "bump":
            return (q[0] - x.level) / x.width
        case "box":
            return 1 - (since - 0.5) * (2 * (whole % 2) - 1) / x.width


def field_of(form, x, t, q, u, value, lib):
    a, b, c, d = x.shape
    force = (
        d * lib.cos(2 * lib.pi * t / CLOCK) if form.base.startswith("driven") else 0.0
    )
    push = (value if form.place == "field" else 0.0) + u * (
        1 + (value if form.place == "gain" else 0.0)
    )
    if form.base == "driven":
        rate = -(3 + a) * q[0] - (0.7 + 0.3 * b) * q[1] - 0.3 * c * q[0] ** 3
        return q[1], rate + force + push
    if form.base == "free":
        return q[1], (1 + 0.3 * b) * (1 - q[0] ** 2) * q[1] - (1 + 0.3 * a) * q[
            0
        ] + push
    rate = 1.6 + 0.2 * a - q[0] - 0.3 * q[1] + 0.3 * force + push
    return rate, -(0.5 + 0.2 * b) * q[1] + 0.1 * c * q[0]


def guard_of(form, q, value):
    return 1.0 + (0.1 * value if form.place == "guard" else 0.0) - q[0]


def reset_of(form, q, value):
    return 0.1 * q[1], q[1] + 0.5 + (value if form.place == "reset" else 0.0)


class On(hj.Chart):
    states = ("x", "y")
    form: Form = eqx.field(static=True)
    x: Numbers

    def field(self, t, q, u):
        return field_of(
            self.form, self.x, t, q, u[0], term(self, t, q, "field gain"), jnp
        )


class Jumping(hj.HybridSystem):
    form: Form = eqx.field(static=True)
    x: Numbers

    def charts(self):
        return {"on": On(self.form, self.x)}

    def period(self):
        return CLOCK if self.form.base.startswith("driven") else None

    def transitions(self):
        f = self.form
        guard = lambda t, q, u: guard_of(f, q, term(self, t, q, "guard"))  # noqa: E731
        reset = lambda t, q, u: reset_of(f, q, term(self, t, q, "reset"))  # noqa: E731
        enabled = (
            (lambda t, q, u: term(self, t, q, "enabled") <= 0)
            if f.place == "enabled"
            else None
        )
        events = [hj.Transition("fire", "on", "on", guard, "falling", reset, enabled)]
        return events if "fires" in f.base else []

    def outputs(self):
        return [hj.Output("z", lambda t, q, u: q[0] * (1 + term(self, t, q, "output")))]


def term(system, t, q, places):
    form, x = system.form, system.x
    if form.place not in places:
        return 0.0
    h = argument(form, x, t, q, jnp.floor(half_turns(x, t)), jnp)
    if form.argument in ("pulse", "bump"):
        return x.amount * jnp.exp(-h * h)
    return x.amount * KINDS[form.kind].jax(jnp.asarray(h))


class Excluded(Exception):
    """A system that scipy cannot decide."""


class Held(NamedTuple):
    """What is held between two edges."""

    turns: Any
    floor: Any
    zone: Any
    """Of a narrow term: far before its middle (-2), before (-1), after (0), far after (1)."""
    armed: bool


class Truth:
    """The same system by scipy."""

    def __init__(self, form: Form, x: Numbers):
        self.form, self.x, self.kind = form, x, KINDS[form.kind]
        self.fires, self.narrow = (
            "fires" in form.base,
            form.argument in ("pulse", "bump", "box"),
        )
        self.longest = 0.04

    def number(self, t, q, held):
        return argument(self.form, self.x, t, q, held.turns, np)

    def middle(self, t, q, held):
        """The distance from the middle of a narrow term, in its widths."""
        h = self.number(t, q, held)
        return (
            (1 - h) * (2 * (held.turns % 2) - 1) if self.form.argument == "box" else h
        )

    def value(self, t, q, held):
        """The term; far from its middle, as it would be if that were not near."""
        h, is_far = self.number(t, q, held), held.zone in (-2, 1)
        if self.form.argument in ("pulse", "bump"):
            return self.x.amount * (0.0 if is_far else np.exp(-h * h))
        h = np.minimum(h, 1 - NARROW) if self.narrow and is_far else h
        return self.x.amount * self.kind.held(h, held.floor)

    def decide(self, t, q, armed):
        held = Held(np.floor(half_turns(self.x, t)), 0, 0, armed)
        h = self.number(t, q, held)
        floor = (0 if h >= 0 else -1) if self.kind.sides else int(np.floor(h))
        z = self.middle(t, q, held) if self.narrow else 0.0
        zone = int(z >= 0) - 1 + int(z >= NARROW) - int(z < -NARROW)
        return held._replace(floor=floor, zone=zone)

    def field(self, t, q, u, held):
        return np.array(
            field_of(self.form, self.x, t, q, u, self.value(t, q, held), np)
        )

    def output(self, t, held, q):
        return q[0] * (
            1 + (self.value(t, q, held) if self.form.place == "output" else 0.0)
        )

    def edges(self, held):
        """Functions that fall through zero where a decision ends; the last is the guard."""
        ends = [lambda t, q: held.turns + 1 - half_turns(self.x, t)]
        if self.form.argument not in ("pulse", "bump"):
            low, high = (held.floor, held.floor + 1)
            if self.kind.sides:
                low, high = (-np.inf, 0) if held.floor < 0 else (0, np.inf)
            ends += [
                lambda t, q, side=side, x=x: side * (self.number(t, q, held) - x)
                for side, x in ((1, low), (-1, high))
                if np.isfinite(x)
            ]
        if self.narrow:
            levels = {
                -2: (None, -NARROW),
                -1: (-NARROW, 0),
                0: (0, NARROW),
                1: (NARROW, None),
            }
            ends += [
                lambda t, q, side=side, x=x: side * (self.middle(t, q, held) - x)
                for side, x in zip((1, -1), levels[held.zone], strict=True)
                if x is not None
            ]
        if self.fires:
            sign = 1 if held.armed else -1
            ends.append(
                lambda t, q: sign * guard_of(self.form, q, self.value(t, q, held))
            )
        for end in ends:
            end.terminal, end.direction = True, -1.0
        return ends

    def flow(self, t, q, end, u=0.0):
        """The state at the time `end`."""
        held = self.decide(t, q, True)
        if self.fires and guard_of(self.form, q, self.value(t, q, held)) < 0:
            held = held._replace(armed=False)
        for _ in range(400):
            if end - t < 1e-13:
                return q
            rate = (
                abs(self.field(t, q, u, held)[0])
                if self.form.argument == "bump"
                else 1.0
            )
            within = self.narrow and held.zone in (-1, 0)
            longest = 0.5 * self.x.width / (rate + 1e-3) if within else self.longest
            options: Any = dict(method="DOP853", rtol=1e-11, atol=1e-13)
            f, stop = lambda t, q: self.field(t, q, u, held), min(t + 1e-10, end)  # noqa: B023
            run = solve_ivp(f, (t, stop), q, **options)  # leaves the edge behind
            t, q, ends = stop, run.y[:, -1], self.edges(held)
            if any(x(t, q) < 0 for x in ends):
                raise Excluded("slides or grazes")
            run = solve_ivp(f, (t, end), q, max_step=longest, events=ends, **options)
            t, q = run.t[-1], run.y[:, -1]
            if run.status == 0:
                return q
            if run.status < 0 or not np.all(np.isfinite(q)):
                raise Excluded("scipy fails")
            k = next(k for k, x in enumerate(run.t_events) if len(x))
            if abs(ends[k](t + 1e-7, q + 1e-7 * f(t, q)) - ends[k](t, q)) < 1e-9:
                raise Excluded("grazes")
            armed = held.armed
            if self.fires and k == len(ends) - 1:
                value = self.value(t, q, held)
                if armed and (self.form.place != "enabled" or value <= 0):
                    q = np.array(reset_of(self.form, q, value))
                else:
                    armed = not armed
            held = self.decide(t + 1e-9, q + 1e-9 * f(t, q), armed)
        raise Excluded("slides")

    def jacobian(self, t, q, end, by_input=False):
        if by_input:
            return (self.flow(t, q, end, STEP) - self.flow(t, q, end, -STEP)) / (
                2 * STEP
            )
        ends = [
            [self.flow(t, q + sign * d, end) for sign in (1, -1)]
            for d in STEP * np.eye(2)
        ]
        return np.stack([(a - b) / (2 * STEP) for a, b in ends], axis=1)


def draw(seed: int, k: int, per_form: int) -> tuple[Form, Numbers]:
    rng = np.random.default_rng([seed, k // per_form])
    base = str(rng.choice(list(PLACES)))
    name = str(rng.choice(ARGUMENTS, p=np.array([4, 2, 2, 2, 2, 2, 3, 2, 2]) / 21))
    kinds = {
        "ramp": ["mod", "triangle", "floor", "round"],
        "pulse": ["smooth"],
        "bump": ["smooth"],
    }
    form = Form(
        base,
        str(rng.choice(PLACES[base].split())),
        name,
        str(rng.choice(kinds.get(name, [*KINDS]))),
    )
    rng = np.random.default_rng([seed, k, 1])
    numbers = Numbers(
        float(rng.choice([-1, 1]) * 10 ** rng.uniform(-3, 0)),
        float(rng.choice([-1, 1]) * 10 ** rng.uniform(-0.3, 0.7)),
        float(rng.uniform(-0.7, 0.9)),
        float(10 ** rng.uniform(-4, -1)),
        float(
            1.0
            if rng.random() < 0.7
            else rng.choice([2.0, 3.0, 1.5, 0.5, np.sqrt(2), 0.7])
        ),
        rng.uniform(-1, 1, 4) + np.array([0, 0, 1, 1.5]),
    )
    return form, numbers


def far(a, b) -> float:
    a, b = np.asarray(a), np.asarray(b)
    return (
        float(np.max(np.abs(a - b) / (1 + np.abs(b))))
        if np.all(np.isfinite(a))
        else np.inf
    )


def verdicts(form: Form, x: Numbers) -> dict[str, Any]:
    """By name: the relative error, the refusal, or why the truth is not known."""
    system, truth = Jumping(form, Numbers(*map(jnp.asarray, x))), Truth(form, x)
    has_clock, fires = form.base.startswith("driven"), "fires" in form.base
    begin = hj.Guess("on", (0.5, 0.6) if fires else (1.9, -0.3), 0.05)
    options: dict[str, Any] = {}
    if not has_clock:
        crossing = hj.Crossing("x", "rising", value=0.2)
        options["section"] = hj.AtEvent("fire") if fires else crossing
    said: dict[str, Any] = {}

    def check(name, answer, judge):
        try:
            said[name] = answer()
        except (hj.errors.DefinitionError, hj.errors.ComputationError) as error:
            return {name: f"refused: {error}"}
        try:
            error = judge(said[name])
            if error > WRONG:  # (two edges within a step of scipy's cancel)
                truth.longest = 0.004
                error = judge(said[name])
            return {name: error}
        except Excluded as reason:
            return {name: f"excluded: {reason}"}

    def of_cycle(cycle):
        if (
            form.argument in ("clock", "phase", "ramp", "pulse", "box")
            and not has_clock
        ):
            return np.inf  # it needs a clock
        t, q, period = (
            float(cycle.anchor.t[0]),
            np.asarray(cycle.anchor.q[:, 0]),
            float(cycle.period),
        )
        if not has_clock:  # away from the event at which the cycle begins
            t, q = t + 0.2 * period, truth.flow(t, q, t + 0.2 * period)
        states = [q]
        for k in range(3):
            states.append(truth.flow(t + k * period, states[-1], t + (k + 1) * period))
        values = np.linalg.eigvals(truth.jacobian(t, q, t + period))
        if not has_clock:
            values = np.delete(values, np.argmin(np.abs(values - 1)))
        mine = np.asarray(cycle.multipliers)
        mine = np.concatenate([mine, np.zeros(len(values) - len(mine))])
        return max(
            min(far(mine, values), far(mine, values[::-1])), far(states[1:], [q] * 3)
        )

    def of_model(model):
        lanes, errors = (
            hj.sections.place_sections(said["cycle"], hj.ClockPhase(3)).lanes,
            [],
        )
        t, period = np.asarray(lanes.t), float(said["cycle"].period)
        for n, q in enumerate(np.asarray(lanes.q).T):
            held, end = (
                truth.decide(t[n], q, True),
                t[n + 1] if n < 2 else t[0] + period,
            )
            at = ft.partial(truth.output, t[n], held)
            C = [(at(q + d) - at(q - d)) / 2e-6 for d in 1e-6 * np.eye(2)]
            errors.append(far(np.asarray(model.C[n])[1], C))
            if has_clock:
                errors.append(far(model.B[n][:, 0], truth.jacobian(t[n], q, end, True)))
        return max(errors)

    def of_run(run):
        end = truth.flow(0.05, 1.1 * np.asarray(begin.state), float(run.t[-1]), 0.1)
        return far(run.after[-1][:2], end)

    find = lambda: hj.find_limit_cycle(system, begin, settle=10.0, **options)  # noqa: E731
    result = check("cycle", find, of_cycle)
    if "cycle" in said:

        def model():
            return hj.linearize(said["cycle"], hj.ClockPhase(3), outputs=("x", "z"))

        result |= check("model", model, of_model)
    start = tuple(1.1 * np.asarray(begin.state))
    run = lambda: hj.simulate(system, "on", start, 2.2 * CLOCK, time=0.05, input=0.1)  # noqa: E731
    return result | check("run", run, of_run)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=2000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--per-form", type=int, default=10, help="systems of each form")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--verbose", action="store_true")
    options = parser.parse_args()
    hj.enable_x64()
    counts: dict[str, collections.Counter] = collections.defaultdict(
        collections.Counter
    )
    for k in range(options.first, options.first + options.draws):
        form, numbers = draw(options.seed, k, options.per_form)
        for name, x in verdicts(form, numbers).items():
            word = (
                x.partition(":")[0]
                if isinstance(x, str)
                else "right"
                if x <= WRONG
                else "WRONG"
            )
            counts[name][word] += 1
            if options.verbose or word == "WRONG":
                print(
                    k,
                    *form,
                    name,
                    str(x)[:150].replace("\n", " "),
                    sep=" | ",
                    flush=True,
                )
    for name, x in counts.items():
        print(f"{name}: " + ", ".join(f"{n} {word}" for word, n in sorted(x.items())))
    silent = sum(x["WRONG"] for x in counts.values())
    print(f"{silent} silently wrong")
    return bool(silent)


if __name__ == "__main__":
    sys.exit(main())
