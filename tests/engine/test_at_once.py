"""Events that follow each other at once: clocks that tick together, and guards that a reset puts at
zero or beyond. Converters at full and at zero duty are of this kind."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj
from hybridjax.orbits import newton

from ..toys import Field, toy


DUTIES = (0.0, 1e-12, 1e-9, 1e-7, 0.5, 1 - 1e-7, 1 - 1e-9, 1.0)
CASES = [(duty, True) for duty in DUTIES] + [(duty, False) for duty in DUTIES[2:]]


class Converter(hj.HybridSystem):
    """x' = 1 - x while on and -x while off; on at whole times, and off a part `duty` later.

    A comparator with a ramp, which each tick sets back, switches off, or a second clock.
    """

    duty: float = hj.parameter(0.5)
    by_ramp: bool = True

    def charts(self):
        def circuit(supply):
            return Field(("x", "ramp"), lambda t, q, u: (supply + u[0] - q[0], 1.0))

        return {"off": circuit(0.0), "on": circuit(1.0)}

    def transitions(self):
        tick = hj.systems.Scheduled(1.0)

        def anew(t, q, u):
            return (q[0], 0.0)

        if self.by_ramp:

            def trip(t, q, u):
                return self.duty - q[1]

        else:
            trip = hj.systems.Scheduled(1.0, 1.0 * self.duty)
        return (
            hj.Transition("trip", "on", "off", trip),
            hj.Transition("tick", "off", "on", tick, reset=anew),
            hj.Transition("tick on", "on", "on", tick, reset=anew),
        )

    def period(self):
        return 1.0


def at_tick(duty):
    """x on the limit cycle where a period begins, in closed form."""
    empty = np.exp(-1)
    rise = np.exp(duty - 1) - empty
    return rise / (1 - np.exp(-1))


@pytest.mark.parametrize("duty, by_ramp", CASES)
def test_a_converter_at_any_duty(duty, by_ramp):
    """Ten periods from rest approach the cycle by a factor of e each, and start where it is on."""
    system = Converter(duty, by_ramp)
    path = hj.simulate(system, "off", (0.0, 0.5), 10.5, time=0.5)
    charging = 1 - np.exp(-10.0)
    exact = at_tick(duty) * charging
    assert_allclose(path.after[-1, 0], exact, atol=1e-9)


@pytest.mark.parametrize("duty, by_ramp", CASES)
def test_the_cycle_of_a_converter_at_any_duty(duty, by_ramp):
    """A comparator that trips within rounding of the tick is refused by name."""
    system = Converter(duty, by_ramp)
    chart = "off" if duty <= 0.5 else "on"
    late = 0.6 if duty == 0.5 else 0.9
    guess = hj.Guess(chart, (0.3, 0.9), time=late)
    if by_ramp and duty > 1 - 1e-8:
        with pytest.raises(
            hj.errors.ComputationError, match="'trip' and 'tick' coincide"
        ):
            hj.find_limit_cycle(system, guess)
        return
    cycle = hj.find_limit_cycle(system, guess)
    time = float(cycle.anchor.t[0])

    def charged(time):
        """x on the cycle while on."""
        above = at_tick(duty) - 1
        return 1 + above * np.exp(-time)

    if chart == "on":
        exact = charged(time)
    else:
        exact = charged(duty) * np.exp(-(time - duty))
    assert_allclose(cycle.state["x"], exact, atol=1e-11)
    assert_allclose(cycle.multipliers, [np.exp(-1)], rtol=1e-9)


BESIDE_FULL = (1 - 2.0**-40, 1 - 2.0**-53, 1.0, 1 + 2.0**-52)


@pytest.mark.parametrize("by_rough_turns", [True, False])
@pytest.mark.parametrize("chart, ramp", [("on", 0.2), ("on", 0.9), ("off", 0.9)])
@pytest.mark.slow
def test_full_duty_is_refused_by_name_from_any_guess(
    chart, ramp, by_rough_turns, monkeypatch
):
    """Also where rounding puts the tick first, which sets the ramp back before the comparator
    trips: beside it, a later tick comes too late for that."""
    if not by_rough_turns:
        no_turn = (None, 0, None)
        monkeypatch.setattr(newton, "_by_rough_turns", lambda map, x: (x, *no_turn))
    guess = hj.Guess(chart, (0.3, ramp), time=0.9)
    for duty in BESIDE_FULL:
        with pytest.raises(hj.errors.ComputationError, match="'trip'.* coincide"):
            hj.find_limit_cycle(Converter(duty), guess)


@pytest.mark.slow
def test_full_duty_is_refused_beside_a_cycle_whose_comparator_never_trips():
    guess = hj.Guess("on", (0.3, 0.2), time=0.9)
    cycle = hj.find_limit_cycle(Converter(1.05), guess)
    failed = hj.find_limit_cycle(Converter(1.0), cycle, throw=False)
    (group,) = failed.simultaneous_events()
    assert set(group.orders) == {("tick on",), ("trip", "tick")}
    duties = np.array([0.95, *BESIDE_FULL, 1.1])
    converters = [Converter(float(x)) for x in duties]
    batch = hj.orbits.find_limit_cycles(converters, cycle)
    beside = [False] * len(BESIDE_FULL)
    assert_array_equal(batch.ok, [True, *beside, True])
    result = jax.jit(
        jax.vmap(lambda x: hj.find_limit_cycle(Converter(x), cycle).result)
    )
    codes = result(jnp.asarray(duties))
    is_found = codes == hj.errors.Result.OK
    not_found = [False] * len(BESIDE_FULL)
    assert_array_equal(is_found, [*not_found, False, True])


@pytest.mark.slow
def test_a_comparator_that_would_trip_right_after_the_tick_is_seen_to_trip_before():
    """On the known cycle its guard is positive by so little that its sign is only rounding."""
    begin = hj.Guess("on", (0.3, 0.2), time=0.9)
    cycle = hj.find_limit_cycle(Converter(1 + 5e-8), begin)

    @jax.jit
    def found(duty):
        near = hj.find_limit_cycle(Converter(duty), cycle)
        return near.anchor.q[0, 0], near.result

    state, result = found(0.93)
    above = at_tick(0.93) - 1
    exact = 1 + above * np.exp(-0.9)
    is_near = state == pytest.approx(exact, abs=1e-10)
    assert result != hj.errors.Result.OK or is_near


def test_schedules_whose_order_is_not_defined():
    """At duty 0, both begin their period at the same time."""
    system = Converter(0.0, by_ramp=False)
    refused = pytest.raises(
        hj.errors.DefinitionError, match="'trip' and 'tick' are scheduled"
    )
    with refused:
        hj.simulate(system, "off", (0.0, 0.5), 3.0, time=0.5)
    with refused:
        hj.find_limit_cycle(system, hj.Guess("off", (0.3, 0.9), time=0.9))


class PeakCurrent(hj.HybridSystem):
    """A coil whose current rises by 1 - i / 10 while on, decays by i / 10 while off; a clock
    switches it on, and a comparator off at a limit."""

    limit: float = hj.parameter(0.5)
    allows: bool = False

    def charts(self):
        def circuit(v):
            return Field(("i",), lambda t, q, u: (v - 0.1 * q[0],))

        return {"off": circuit(0.0), "on": circuit(1.0)}

    def transitions(self):
        below = (lambda t, q, u: q[0] < self.limit) if self.allows else None
        tick = hj.systems.Scheduled(1.0)

        def trip_guard(t, q, u):
            return self.limit - q[0]

        return (
            hj.Transition("trip", "on", "off", trip_guard),
            hj.Transition("tick", "off", "on", tick, enabled=below),
            hj.Transition("tick on", "on", "on", tick),
        )

    def period(self):
        return 1.0


@pytest.mark.parametrize("allows, events", [(False, ["tick", "trip"] * 5), (True, [])])
def test_a_current_above_its_limit_at_the_tick(allows, events):
    """The comparator trips at once, or the tick is not enabled: the current decays either way."""
    path = hj.simulate(PeakCurrent(allows=allows), "off", (2.0,), 5.0, time=0.5)
    assert [e.name for e in path.events] == events
    expected = 2.0 * np.exp(-0.5)
    assert_allclose(path.after[-1], [expected], rtol=1e-9)


def neurons(push):
    """Two neurons, of which each spike pushes the other one. In `x`, both are set back."""

    def pulse(t, q, u):
        return (0.0, q[1] + push)

    def other(t, q, u):
        return (q[0] + push, 0.0)

    def rest_rates(t, q, u):
        return (1.5 - q[0], 1.4 - q[1])

    charts = {"rest": Field(("x", "y"), rest_rates)}

    def x_guard(t, q, u):
        return 1 - q[0]

    def y_guard(t, q, u):
        return 1 - q[1]

    return toy(
        charts,
        [
            hj.Transition("X", "rest", "rest", x_guard, reset=pulse),
            hj.Transition("Y", "rest", "rest", y_guard, reset=other),
        ],
    )


@pytest.mark.parametrize("push", [0.3, 0.8])
def test_a_spike_that_pushes_another_neuron_over_its_threshold(push):
    """Also to above where it would come to rest, so that it moves back from there. By hand: x
    spikes first, y at once, and leaves (push, 0)."""
    system = neurons(push)
    guess = hj.Guess("rest", (push + 0.05, 0.1))
    cycle = hj.find_limit_cycle(system, guess)
    names = [system.transitions()[k].name for k in cycle.event_sequence]
    assert names == ["X", "Y"]
    period = np.log((1.5 - push) / 0.5)
    assert_allclose(cycle.period, period, rtol=1e-10)
    assert len(cycle.multipliers) == 0  # every neighbor is set back to the same state
    assert cycle.simultaneous_events() == []


class Kicked(hj.HybridSystem):
    """x decays, a clock kicks it by 1, and where it is then above 1.2 it falls at once."""

    rate: float = hj.parameter(0.7)

    def charts(self):
        def decay_rates(t, q, u):
            return (u[0] - self.rate * q[0],)

        decay = Field(("x",), decay_rates)

        def ready_rates(t, q, u):
            return (u[0] + 1.0 - self.rate * q[0],)

        ready = Field(("x",), ready_rates)
        return {"calm": decay, "kicked": ready}

    def transitions(self):
        def kick(t, q, u):
            return (q[0] + 1.0,)

        def halve(t, q, u):
            return (0.4 * q[0] ** 2,)

        def halve_guard(t, q, u):
            return 1.2 - q[0]

        return (
            hj.Transition(
                "kick", "calm", "kicked", hj.systems.Scheduled(1.0), reset=kick
            ),
            hj.Transition("halve", "kicked", "calm", halve_guard, reset=halve),
        )

    def period(self):
        return 1.0


@pytest.mark.slow
def test_derivatives_across_an_event_at_once():
    """Of the map x -> (1 + x exp(-rate))^2 0.4 between kicks, and of its fixed point."""
    system = Kicked()
    calm = hj.Guess("calm", (0.5,), time=0.5)
    cycle = hj.find_limit_cycle(system, calm)
    start = float(cycle.anchor.q[0, 0])
    low = np.exp(-0.5 * 0.7) * start
    low_after = np.exp(-0.5 * 0.7) * 0.4
    expected = low_after * (1 + low) ** 2
    assert_allclose(cycle.state["x"], expected, rtol=1e-11)
    multiplier = 0.8 * (1 + low) * np.exp(-0.7)
    assert_allclose(cycle.multipliers, [multiplier], rtol=1e-9)
    ldtp = hj.linearize(cycle, hj.ClockPhase(3, 0.3))
    assert_allclose(ldtp.multipliers, [multiplier], rtol=1e-9)

    def at(rate):
        kicked = hj.find_limit_cycle(Kicked(rate), cycle)
        return kicked.anchor.q[0, 0]

    later = float(at(0.7 + 1e-5))
    earlier = float(at(0.7 - 1e-5))
    by_steps = (later - earlier) / 2e-5
    slope = jax.grad(at)(jnp.asarray(0.7))
    assert_allclose(slope, by_steps, rtol=1e-7)
    program = jax.jit(jax.grad(at))
    measured = program(jnp.asarray(0.7))
    assert_allclose(measured, by_steps, rtol=1e-7)


def test_events_that_take_each_others_place_at_once():
    """A relay whose thresholds are in the wrong order."""

    def rates(t, q, u):
        return (1.0,)

    def off_rates(t, q, u):
        return (-1.0,)

    fields = {
        "on": Field(("x",), rates),
        "off": Field(("x",), off_rates),
    }

    def up_guard(t, q, u):
        return 0.5 - q[0]

    def down_guard(t, q, u):
        return q[0] - 0.9

    relay = toy(
        fields,
        [
            hj.Transition("up", "on", "off", up_guard),
            hj.Transition("down", "off", "on", down_guard),
        ],
    )
    with pytest.raises(hj.errors.ComputationError, match="events accumulate"):
        hj.simulate(relay, "on", (0.0,), 2.0)


def test_a_guard_that_both_charts_have_happens_once():
    """x rises through zero once; a clock changes the chart, in which it has the same guard."""
    fields = {name: Field(("x",), lambda t, q, u: (1.0,)) for name in ("day", "night")}

    def cross(t, q, u):
        return q[0]

    system = toy(
        fields,
        [
            hj.Transition("by day", "day", "day", cross, "rising"),
            hj.Transition("by night", "night", "night", cross, "rising"),
            hj.Transition("dusk", "day", "night", hj.systems.Scheduled(1.0)),
            hj.Transition("dawn", "night", "day", hj.systems.Scheduled(1.0)),
        ],
        period=2.0,
    )
    path = hj.simulate(system, "day", (-0.5,), 3.3)
    names = [e.name for e in path.events]
    assert names == ["by day", "dusk", "dawn", "dusk"]


def test_a_turn_cannot_begin_between_events_at_once():
    """Right after the spike of x that y follows at once; that of y may begin a turn."""
    guess = hj.Guess("rest", (0.4, 0.1))
    with pytest.raises(
        hj.errors.ComputationError, match="event .Y. coincides with .X."
    ):
        hj.find_limit_cycle(neurons(0.3), guess, section=hj.AtEvent("X"))
    cycle = hj.find_limit_cycle(neurons(0.3), guess, section=hj.AtEvent("Y"))
    assert_allclose(cycle.period, np.log(1.2 / 0.5), rtol=1e-10)


def test_programs_refuse_events_that_coincide():
    """Close to full duty, where the comparator trips right before the tick."""
    guess = hj.Guess("on", (0.9, 0.9), time=0.9)
    cycle = hj.find_limit_cycle(Converter(0.95), guess)
    result = jax.jit(
        jax.vmap(lambda x: hj.find_limit_cycle(Converter(x), cycle).result)
    )
    values = jnp.array([0.95, 0.99, 1 - 1e-10])
    measured = result(values)
    assert_array_equal(
        measured,
        [hj.errors.Result.OK, hj.errors.Result.OK, hj.errors.Result.SIMULTANEOUS],
    )


def test_experiments_near_full_and_zero_duty():
    """The states of the converter are linear between events at fixed times, so that deviations
    decay by e each period; with a ramp, no perturbation of x moves an event."""
    for duty in (1e-9, 1 - 1e-7):
        for by_ramp in (True, False):
            chart = "off" if duty < 0.5 else "on"
            guess = hj.Guess(chart, (0.3, 0.9), time=0.9)
            cycle = hj.find_limit_cycle(Converter(duty, by_ramp), guess)
            ldtp = hj.linearize(cycle, hj.ClockPhase(4, 0.3), "x")
            assert_allclose(ldtp.multipliers, [np.exp(-1)], rtol=1e-9)


class Beat(hj.HybridSystem):
    """x decays, and a pacemaker kicks it each unit of time. Where it is then above 1.2 it is set
    back at once, from where it would also decay by itself."""

    jump: float = hj.parameter(0.5)

    def charts(self):
        def rates(t, q, u):
            return (u[0] - 0.7 * q[0], 1.0)

        return {"calm": Field(("x", "p"), rates)}

    def transitions(self):
        def kick(t, q, u):
            return (q[0] + self.jump, 0.0)

        def set_back(t, q, u):
            return (0.4 * q[0] ** 2, q[1])

        return (
            hj.Transition("kick", "calm", "calm", lambda t, q, u: 1 - q[1], reset=kick),
            hj.Transition(
                "set back", "calm", "calm", lambda t, q, u: 1.2 - q[0], reset=set_back
            ),
        )


LIMIT = 1.2 * (1 - np.exp(-0.7))  # the jump from which on x is set back
COINCIDES = "event 'set back' coincides with"


def beating():
    """The cycle without the second event, by a section at the first one."""
    guess = hj.Guess("calm", (0.9, 0.02))
    return hj.find_limit_cycle(Beat(), guess, section=hj.AtEvent("kick"))


@pytest.mark.slow
def test_an_event_at_once_that_begins_beside_the_known_cycle_is_not_missed():
    """Turns begin right after the kick: they would not have the event that it brings about."""
    cycle = beating()
    for _ in range(3):  # (by a search, and by the known itinerary)
        with pytest.raises(hj.errors.ComputationError, match=COINCIDES):
            hj.find_limit_cycle(Beat(0.8), cycle)
    jumps = np.linspace(0.5, 0.9, 9)
    exists = jumps < LIMIT
    beats = [Beat(float(x)) for x in jumps]
    found = hj.orbits.find_limit_cycles(beats, cycle)
    assert_array_equal(found.ok, exists)
    assert_array_equal(np.isnan(found.period), ~exists)
    swept = hj.sweep(Beat(), {"jump": jumps.tolist()}, guess=cycle)
    assert_array_equal(swept.result == hj.errors.Result.OK, exists)
    branch = hj.continuation(cycle, "jump", (0.5, 0.9))
    assert_allclose(branch.values.max(), LIMIT, rtol=1e-3)
    assert "'set back' begins to happen at once after 'kick'" in str(branch)
    result = jax.jit(jax.vmap(lambda x: hj.find_limit_cycle(Beat(x), cycle).result))
    codes = result(jnp.asarray(jumps))
    is_found = codes == hj.errors.Result.OK
    assert_array_equal(is_found, exists)


@pytest.mark.parametrize("with_another_section", [False, True])
@pytest.mark.slow
def test_experiments_do_not_miss_an_event_at_once_on_a_section(with_another_section):
    """A push of 0.1 leaves x below 1.2 after the next kick, and one of 0.3 does not."""
    cycle = beating()
    sections = (hj.AtEvent("kick"),)
    if with_another_section:
        sections += (hj.Crossing("p", "rising", 0.45),)
    N = len(sections)
    pushes = np.array([0.1, 0.3])
    u = np.zeros((2, 24 * N, 1))
    u[:, 20 * N : 21 * N, 0] = pushes[:, None]
    data = hj.run_experiments(cycle, sections, u, ["x"], discard=2)
    assert_array_equal(data.ok, [True, False])
    decay = np.exp(-0.7)
    off = pushes[0] / 0.7 * (1 - decay)
    after = data.y[0, 20 * N :: N, 0]
    expected = [0.0, off, off * decay]
    assert_allclose(after[:3], expected, atol=1e-8)
    response = hj.experiments.response_function(cycle, sections, ["x"])
    order = hj.errors.Result.EVENT_ORDER
    found = response(u[:, 18 * N :])
    assert_array_equal(found.result, [0, order])
    none = np.zeros((1, 4 * N, 1))
    other = response(none, system=Beat(0.8))
    assert_array_equal(other.result, [order])
    returns = hj.sections.section_map(cycle, sections, 0, 0)
    begin = np.asarray(returns.fixed_point)
    end = returns(begin, u=pushes[:1]).q[0]
    assert_allclose(end, begin[0] + off, atol=1e-9)
    for start, push in ((begin, 0.3), (np.array([1.3, 0.0]), 0.0)):
        with pytest.raises(hj.errors.ComputationError, match="events came in another"):
            returns(start, u=np.array([push]))


def test_a_section_at_an_event_that_another_one_follows_at_once_is_refused():
    guess = hj.Guess("calm", (0.5,), time=0.5)
    cycle = hj.find_limit_cycle(Kicked(), guess)
    for call in (hj.linearize, hj.experiments.response_function):
        with pytest.raises(
            hj.errors.ComputationError,
            match="'halve' coincides with section 0 .after kick.",
        ):
            call(cycle, hj.AtEvent("kick"), ["x"])
