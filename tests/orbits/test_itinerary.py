"""Cycles that follow the itinerary of a known one: as the search finds them, or not at all."""

import collections
import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj
from hybridjax._core import compilation
from hybridjax.orbits import batches, find, limit_cycles, near
from hybridjax.orbits.repeat import Maps, Plan, correct, leaves_of, on_device

from ..toys import Field


class Free(hj.Chart):
    states = ("x", "v")
    system: hj.HybridSystem

    def field(self, t, q, u):
        x, v = q
        s = self.system
        push = s.drive * jnp.cos(s.rate * t)
        spring = -x - s.damping * v
        return v, spring + push + u[0]


class Rebound(hj.HybridSystem):
    """A mass on a spring, driven by a clock, beside a stop at x = 1."""

    drive: hj.Parameter = hj.parameter(0.3)
    damping: hj.Parameter = hj.parameter(0.4)
    restitution: hj.Parameter = hj.parameter(0.6)
    rate: hj.Parameter = hj.parameter(1.3)

    def charts(self):
        return {"free": Free(self)}

    def transitions(self):
        def bounce(t, q, u):
            return q[0], -self.restitution * q[1]

        def stop(t, q, u):
            return q[0] - 1

        return [hj.Transition("bounce", "free", "free", stop, "rising", bounce)]

    def period(self):
        return 2 * jnp.pi / self.rate

    def guess(self):
        return hj.Guess("free", (0.3, 0.0))


class Circuit(hj.Chart):
    states = ("x",)
    on: float

    def field(self, t, q, u):
        return (self.on - q[0],)


class Pulses(hj.HybridSystem):
    """A capacitor that is charged from one tick to the next."""

    rise: hj.Parameter = hj.parameter(0.0)
    fall: hj.Parameter = hj.parameter(0.4)

    def charts(self):
        return {"off": Circuit(0.0), "on": Circuit(1.0)}

    def transitions(self):
        up = hj.systems.Scheduled(1.0, self.rise)
        down = hj.systems.Scheduled(1.0, self.fall)
        return [
            hj.Transition("up", "off", "on", up),
            hj.Transition("down", "on", "off", down),
        ]

    def period(self):
        return 1.0

    def guess(self):
        return hj.Guess("off", (0.4,), time=0.0)


@pytest.fixture(scope="module")
def free():
    return hj.find_limit_cycle(Rebound())


@pytest.fixture
def compiled(monkeypatch):
    """Calls follow itineraries from the first one on."""
    monkeypatch.setattr(near, "_WORTH_COMPILING", 0.0)


def amplitude(drive):
    """Of the free motion, in closed form."""
    impedance = np.hypot(1 - 1.3**2, 0.4 * 1.3)
    return drive / impedance


def damping_of_a_turn():
    """The product of the multipliers without a rebound: exp(-damping T)."""
    return np.exp(-0.4 * 2 * np.pi / 1.3)


def test_a_repeated_cycle_is_that_of_the_closed_form(free, compiled):
    cycle = hj.find_limit_cycle(Rebound(drive=0.5), free)
    _, _, states = cycle.trajectory().dense(64)
    largest = np.max(states[:, 0])
    assert_allclose(largest, amplitude(0.5), rtol=1e-3)
    product = np.prod(cycle.multipliers).real
    assert_allclose(product, damping_of_a_turn(), rtol=0, atol=1e-11)


def test_an_event_that_is_new_goes_to_the_search(free, compiled):
    assert amplitude(2.0) > 1, "the free motion would reach the stop"
    cycle = hj.find_limit_cycle(Rebound(drive=2.0), free)
    names = [cycle.structure.transitions[k].name for k in cycle.event_sequence]
    assert names == ["bounce"]
    # The rebound keeps the product of the multipliers, less the squared restitution.
    product = np.prod(cycle.multipliers).real
    expected = 0.6**2 * damping_of_a_turn()
    assert_allclose(product, expected, rtol=0, atol=1e-9)


def test_an_event_that_is_new_is_a_code_inside_of_programs(free):
    @jax.jit
    def result(drive):
        return hj.find_limit_cycle(Rebound(drive=drive), free).result

    assert result(0.5) == hj.errors.Result.OK
    assert result(2.0) == hj.errors.Result.EVENT_ORDER


def test_an_event_in_the_last_step_of_a_turn_is_noticed():
    """Also if the guard is positive again where the turn ends."""
    gain = amplitude(1.0)
    quadrature = 0.4 * 1.3
    in_phase = 1 - 1.3**2
    peak = np.arctan2(quadrature, in_phase) / 1.3
    after = hj.Guess("free", (0.9, -0.1), time=peak + 0.1)
    known = hj.find_limit_cycle(Rebound(drive=0.99 / gain), after)

    @jax.jit
    def result(drive):
        return hj.find_limit_cycle(Rebound(drive=drive), known).result

    assert result(0.9999 / gain) == hj.errors.Result.OK
    assert result(1.0005 / gain) == hj.errors.Result.EVENT_ORDER


@pytest.mark.slow
def test_gradients_inside_of_programs_are_differences():
    """By the field's parameters, and by the rate of the clock, which sets the period. (With the
    rebound, multipliers depend on the state, too.)"""
    bouncing = hj.find_limit_cycle(Rebound(drive=2.0))
    assert bouncing.event_sequence

    def state(drive, damping, rate):
        system = Rebound(drive=drive, damping=damping, rate=rate)
        cycle = hj.find_limit_cycle(system, bouncing)
        monodromy = jnp.linalg.multi_dot(cycle.factors[::-1])
        return cycle.anchor.q[0, 0] + jnp.trace(monodromy)

    value = jax.jit(state)
    at = np.array([2.0, 0.4, 1.3])
    h = 1e-4
    of_state = jax.grad(state, argnums=(0, 1, 2))
    gradient = jax.jit(of_state)(*at)
    for slope, step in zip(gradient, h * np.eye(3), strict=True):
        above = at + step
        below = at - step
        change = value(*above) - value(*below)
        difference = change / (2 * h)
        assert_allclose(slope, difference, rtol=1e-6)
    jacobian = jax.jacfwd(state, argnums=(0, 1, 2))
    forwards = jax.jit(jacobian)(*at)
    assert_allclose(forwards, gradient, rtol=1e-10)


@pytest.mark.slow  # (it compiles three programs)
def test_repeated_gradients_outside_of_programs_are_those_of_the_search(monkeypatch):
    """Also where the cycle leaves the route of the known one."""
    known = hj.find_limit_cycle(Rebound(drive=2.0))
    family = hj.ClockPhase(3)

    def coefficient(drive, damping):
        cycle = hj.find_limit_cycle(Rebound(drive=drive, damping=damping), known)
        model = hj.linearize(cycle, family, ("x",))
        coefficients = model.characteristic_polynomial()
        return coefficients[1] + model.B[0, 0, 0]

    gradient = jax.grad(coefficient, argnums=(0, 1))
    drives = 2.0, 2.001, 0.5
    searched = [gradient(drive, 0.4) for drive in drives]
    monkeypatch.setattr(near, "_DERIVATIVES_WORTH_COMPILING", 0)
    for drive, expected in zip(drives, searched, strict=True):
        assert_allclose(gradient(drive, 0.4), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_systems_on_several_routes_are_those_of_single_searches(monkeypatch):
    """Where the clock's phase of the anchor lies in stance for some, in flight for others."""
    monkeypatch.setattr(limit_cycles, "WORTH_COMPILING", 1)
    # (No system is left to the search side by side, which would hide faults of routes.)
    monkeypatch.setattr(batches.Tiles, "solve", None)
    stiffness = np.linspace(8, 13, 8)
    damping = np.linspace(3, 7, 8)
    k, b = np.meshgrid(stiffness, damping)
    make = eqx.filter_vmap(lambda k, b: hj.models.VerticalHopper(k=k, b=b))
    all_k = jnp.asarray(k.ravel())
    all_b = jnp.asarray(b.ravel())
    systems = make(all_k, all_b)
    guess = hj.find_limit_cycle(hj.models.VerticalHopper())
    cycles = hj.orbits.find_limit_cycles(systems, guess)
    assert cycles.ok.all()
    charts = np.asarray(cycles.anchor.chart)[:, 0]
    assert len(np.unique(charts)) == 2
    for i in (0, 7, 20, 63, int(np.argmin(charts))):
        alone = hj.find_limit_cycle(cycles[i].system)
        found = cycles.multipliers[i][: len(alone.multipliers)]
        expected = np.sort(alone.multipliers)
        assert np.allclose(np.sort(found), expected, atol=1e-8)


@pytest.mark.slow
def test_small_sweeps_follow_the_itinerary_after_long_searches(free, monkeypatch):
    """They are searched at first, since compiling takes longer than a few searches. A search that
    takes too long is given up."""
    drives = [0.25, 0.3, 0.35]
    systems = [Rebound(drive=x) for x in drives]
    monkeypatch.setattr(limit_cycles, "_searching", collections.defaultdict(float))
    searched = hj.orbits.find_limit_cycles(systems, free)
    assert sum(limit_cycles._searching.values()) > 0, "they were not searched"

    def followed():
        return hj.orbits.find_limit_cycles(systems, free)

    monkeypatch.setattr(compilation, "WORTH_COMPILING", 1e-9)
    after_long_searches = followed()
    monkeypatch.setattr(limit_cycles, "_searching", collections.defaultdict(float))
    given_up = followed()

    for cycles in (searched, after_long_searches, given_up):
        assert cycles.ok.all()
        assert_allclose(cycles.anchor.q, searched.anchor.q, rtol=1e-8)


def test_programs_of_many_systems_factorize_nothing(free):
    """XLA's pool would deadlock on LAPACK's calls for many matrices at once."""
    route = near.route_near(free)
    leaves = tuple(np.repeat(np.asarray(x)[None], 4, 0) for x in leaves_of(free.system))
    periods = np.full(4, float(free.period))
    times = np.zeros(4), periods
    q = np.repeat(route.map.anchor.q.T, 4, axis=0)
    ends = np.repeat(route.first.ends[None], 4, axis=0)
    map = on_device(route.map)
    plan = Plan.of(route.first)

    def program(leaves, t, expected, q, ends):
        return correct(Maps(map, leaves, t, expected), plan, q, ends)

    compiled = jax.jit(program)
    lowered = compiled.lower(leaves, *times, q, ends)
    text = lowered.as_text()
    assert "while" in text
    assert "@lapack_" not in text


@pytest.mark.slow
def test_the_route_itself_leads_to_the_papers_hopper(compiled, monkeypatch):
    """With independent digits of the multipliers; the search would be an error."""
    guess = hj.find_limit_cycle(hj.models.VerticalHopper(k=10.05))
    monkeypatch.setattr(find, "_solution", None)
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper(), guess)
    true = -0.24898333 + 0.69933325j
    values = cycle.multipliers
    assert_allclose(values[np.argmax(values.imag)], true, atol=1e-8)


@pytest.mark.slow
def test_a_tick_that_leaves_the_turn_is_noticed(compiled):
    """The turn ends with the tick `up`, which comes later than the turn in other systems."""
    known = hj.find_limit_cycle(Pulses())
    cycle = hj.find_limit_cycle(Pulses(rise=0.05), known)
    path = cycle.trajectory()
    after = np.flatnonzero(path.event == 0)[0]
    # In closed form, the charge with which a pulse of 0.35 begins.
    later = 1 - np.exp(-0.35)
    rise = np.exp(-0.65) * later
    begin = rise / (1 - np.exp(-1.0))
    error = abs(path.after[after, 0] - begin)
    assert error < 1e-10


class Stop(Rebound):
    """The stop throws back only what is fast enough, and lets the rest pass."""

    least: hj.Parameter = hj.parameter(0.1)

    def transitions(self):
        (bounce,) = super().transitions()

        def is_fast(t, q, u):
            return q[1] > self.least

        return [dataclasses.replace(bounce, enabled=is_fast)]


@pytest.mark.slow
def test_an_event_whose_predicate_fails_beside_the_known_cycle_is_noticed(compiled):
    known = hj.find_limit_cycle(Stop(drive=2.0))
    fastest = known.trajectory()("v")[1].max()

    @jax.jit
    def result(least):
        return hj.find_limit_cycle(Stop(drive=2.0, least=least), known).result

    assert result(0.2) == hj.errors.Result.OK
    assert result(2 * fastest) == hj.errors.Result.EVENT_ORDER
    passing = hj.find_limit_cycle(Stop(drive=2.0, least=2 * fastest), known)
    assert passing.event_sequence == ()
    _, _, states = passing.trajectory().dense(64)
    largest = np.max(states[:, 0])
    assert_allclose(largest, amplitude(2.0), rtol=1e-3)


class Falling(hj.Chart):
    states = ("x",)

    def field(self, t, q, u):
        return (-1.0,)


class Thrown(hj.Chart):
    states = ("y", "v")
    pull: float

    def field(self, t, q, u):
        return q[1], self.pull


class Thrower(hj.HybridSystem):
    """A weight falls to zero, and throws another one from y = -0.2, below the floor y = 0.

    The event "floor" happens at once if this one moves down, otherwise when it comes back.
    """

    speed: hj.Parameter = hj.parameter(0.0)
    pull: hj.Parameter = hj.parameter(-0.5)

    def charts(self):
        return {"falling": Falling(), "thrown": Thrown(self.pull)}

    def transitions(self):
        def height(t, q, u):
            return q[0]

        def depth_of_ceiling(t, q, u):
            return 1 - q[0]

        def throw(t, q, u):
            return -0.2, self.speed

        def begin(t, q, u):
            return (1.0,)

        return [
            hj.Transition("throw", "falling", "thrown", height, reset=throw),
            hj.Transition("floor", "thrown", "falling", height, reset=begin),
            hj.Transition("top", "thrown", "falling", depth_of_ceiling, reset=begin),
        ]

    def guess(self):
        return hj.Guess("falling", (0.9,))


@pytest.mark.slow
def test_a_guard_beyond_which_a_reset_leads_is_due_at_once_only_if_it_falls():
    """From one cycle to the other, in both directions, and with the pull upwards: there the weight
    that begins upwards reaches the ceiling at y = 1, and the other one never does."""
    down = hj.find_limit_cycle(Thrower(speed=-0.5))
    up = hj.find_limit_cycle(Thrower(speed=0.1, pull=2.0))
    assert_allclose(down.period, 1, rtol=1e-12)
    # The height is reached at 0.1 t + t^2 = 1.2.
    root = np.sqrt(0.05**2 + 1.2)
    expected = 1 - 0.05 + root
    assert_allclose(up.period, expected, rtol=1e-9)

    @jax.jit
    def below(speed):
        cycle = hj.find_limit_cycle(Thrower(speed=speed), down)
        return cycle.period, cycle.result

    @jax.jit
    def above(speed):
        cycle = hj.find_limit_cycle(Thrower(speed=speed, pull=2.0), up)
        return cycle.period, cycle.result

    expected_below = (1, hj.errors.Result.OK)
    assert_allclose(below(-0.4), expected_below)
    assert below(1.0)[1] == hj.errors.Result.EVENT_ORDER
    rise = -0.025 + np.sqrt(0.025**2 + 1.2)
    expected_above = (1 + rise, hj.errors.Result.OK)
    assert_allclose(above(0.05), expected_above)
    assert above(-0.05)[1] == hj.errors.Result.EVENT_ORDER


class Marked(hj.HybridSystem):
    """Falls from y = 2 to 1 at a rate, past two marks without effect, and is lifted again."""

    rate: hj.Parameter = hj.parameter(1.0)

    def charts(self):
        return {"on": Field(("y",), lambda t, q, u: (-self.rate * q[0],))}

    def transitions(self):
        def at(height):
            return lambda t, q, u: q[0] - height

        return [
            hj.Transition("first mark", "on", "on", at(1.7)),
            hj.Transition("second mark", "on", "on", at(1.3)),
            hj.Transition("lift", "on", "on", at(1.0), reset=lambda t, q, u: (2.0,)),
        ]

    def guess(self):
        return hj.Guess("on", (1.9,))


@pytest.mark.slow
def test_guards_that_have_fallen_in_the_same_chart_are_not_due_again():
    """Beside a known cycle, a mark that is past is negative and falls, but its event is over."""
    cycle = hj.find_limit_cycle(Marked())

    @jax.jit
    def beside(rate):
        found = hj.find_limit_cycle(Marked(rate=rate), cycle)
        return found.period, found.result

    expected = (np.log(2) / 1.1, hj.errors.Result.OK)
    assert_allclose(beside(1.1), expected, rtol=1e-9)


class Detuned(Free):
    def field(self, t, q, u):
        x, v = q
        s = self.system
        rate = s.rate + s.detuned
        push = s.drive * jnp.cos(rate * t)
        return v, -x - s.damping * v + push


class Driven(Rebound):
    """The drive may have a rate that is not that of the clock."""

    detuned: hj.Parameter = hj.parameter(0.0)

    def charts(self):
        return {"free": Detuned(self)}


@pytest.mark.slow
def test_a_drive_without_the_period_of_the_clock_is_refused_at_every_door(compiled):
    known = hj.find_limit_cycle(Driven())
    with pytest.raises(hj.errors.DefinitionError, match="does not have the period"):
        hj.find_limit_cycle(Driven(detuned=0.01), known)
    systems = eqx.filter_vmap(lambda x: Driven(detuned=x))(
        jnp.where(jnp.arange(260) == 3, 0.01, 0.0)
    )
    with pytest.raises(hj.errors.DefinitionError, match="does not have the period"):
        hj.orbits.find_limit_cycles(systems, known)

    @jax.jit
    def result(detuned):
        return hj.find_limit_cycle(Driven(detuned=detuned), known).result

    assert result(0.0) == hj.errors.Result.OK
    assert result(0.01) == hj.errors.Result.NOT_VERIFIED


@pytest.mark.slow
def test_a_lane_without_a_cycle_has_no_derivative(free):
    """In reverse mode. The others keep theirs: that of x(0) in closed form."""

    def begin(drive):
        rebound = hj.find_limit_cycle(Rebound(drive=drive), free)
        return rebound.anchor.q[0, 0]

    drives = jnp.array([0.3, jnp.nan, 0.4])
    values = jax.vmap(jax.grad(begin))(drives)
    assert np.isnan(values[1])
    response = 1 / (1 - 1.3**2 + 0.4j * 1.3)
    expected = np.real(response)
    assert_allclose(values[::2], [expected, expected], rtol=1e-8)


class Decay(hj.Chart):
    states = ("x",)

    def field(self, t, q, u):
        return (-q[0],)


class Doses(hj.HybridSystem):
    """A dose of 1 in each period, unless there is more than `most` of it already."""

    most: hj.Parameter = hj.parameter(2.0)

    def charts(self):
        return {"blood": Decay()}

    def transitions(self):
        def dose(t, q, u):
            return (q[0] + 1,)

        def is_little(t, q, u):
            return q[0] < self.most

        tick = hj.systems.Scheduled(1.0, 0.2)
        return [
            hj.Transition("dose", "blood", "blood", tick, reset=dose, enabled=is_little)
        ]

    def period(self):
        return 1.0

    def guess(self):
        return hj.Guess("blood", (0.5,), time=0.0)


@pytest.mark.slow
def test_a_step_to_where_other_events_happen_ends_no_search_in_a_program():
    """Before each dose 1 / (e - 1) is left. If that is too much for a dose, no cycle has the
    period of the clock, and Newton's method steps from no dose to one and back."""
    known = hj.find_limit_cycle(Doses())
    left = 1 / (np.e - 1)

    @jax.jit
    def result(most):
        return hj.find_limit_cycle(Doses(most=most), known).result

    assert result(1.01 * left) == hj.errors.Result.OK
    assert result(0.99 * left) == hj.errors.Result.NOT_CONVERGED


class Window(hj.HybridSystem):
    """x follows a clocked drive, and falls where it rises through 1, where alone it may."""

    size: hj.Parameter = hj.parameter(0.5)

    def charts(self):
        def rate(t, q, u):
            wave = 1 + jnp.sin(2 * jnp.pi * t)
            return (self.size * wave - q[0],)

        return {"follows": Field(("x",), rate)}

    def transitions(self):
        def fall(t, q, u):
            return (q[0] - 0.5,)

        def is_near(t, q, u):
            return jnp.abs(q[0] - 1) < 1e-3

        return [
            hj.Transition(
                "fall",
                "follows",
                "follows",
                lambda t, q, u: 1 - q[0],
                reset=fall,
                enabled=is_near,
            )
        ]

    def period(self):
        return 1.0


@pytest.mark.slow
def test_an_event_whose_predicate_holds_only_where_it_happens_is_seen():
    """Not at the ends of a step, but at the zero of the guard within."""
    guess = hj.Guess("follows", (0.5,))
    cycle = hj.find_limit_cycle(Window(), guess)
    sizes = np.linspace(0.5, 1.1, 13)
    square = 1 + 4 * np.pi**2
    ripple = 1 / np.sqrt(square)
    has_no_event = sizes * (1 + ripple) < 1
    result = jax.jit(
        jax.vmap(lambda size: hj.find_limit_cycle(Window(size), cycle).result)
    )
    codes = result(jnp.asarray(sizes))
    found = codes == hj.errors.Result.OK
    np.testing.assert_array_equal(found, has_no_event)
    for _ in range(4):  # (by a search, and by the known itinerary)
        beside = hj.find_limit_cycle(Window(1.0), cycle, throw=False)
        assert beside.result != hj.errors.Result.OK or beside.event_sequence


@pytest.mark.slow
def test_a_guard_that_a_reset_puts_on_its_zero_is_not_about_to_fall(monkeypatch):
    """The compass walker's guard is zero after heelstrike, but for rounding of either sign, and
    falls. On the cycles of its neighbors it has not passed its zero again."""
    monkeypatch.setattr(limit_cycles, "WORTH_COMPILING", 1)
    # (Systems that seem to leave the itinerary would be searched.)
    monkeypatch.setattr(batches.Tiles, "solve", None)
    monkeypatch.setattr(limit_cycles, "_search", None)
    hips = np.linspace(9.5, 10.5, 6)
    legs = np.linspace(4.9, 5.1, 6)
    hip, leg = np.meshgrid(hips, legs)
    make = eqx.filter_vmap(lambda mH, m: hj.models.CompassGait(mH=mH, m=m))
    all_hips = jnp.asarray(hip.ravel())
    all_legs = jnp.asarray(leg.ravel())
    systems = make(all_hips, all_legs)

    guess = hj.find_limit_cycle(hj.models.CompassGait())
    cycles = hj.orbits.find_limit_cycles(systems, guess)

    assert cycles.ok.all()
    alone = hj.find_limit_cycle(cycles[0].system)
    assert_allclose(cycles.period[0], alone.period, rtol=1e-9)
