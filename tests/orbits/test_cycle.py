"""Limit cycles: stable and unstable, clocked and autonomous, and none."""

import equinox as eqx
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj
from hybridjax.orbits.linear_flow import begin_later, last_turn

from ..toys import Field, Switched, toy


FALL = hj.Crossing("v", "falling")
# mu: amplitude, period, multiplier; from an integration in 34 digits.
VANDERPOL = {
    0.5: (2.00248793044711, 6.38067580177359, 0.0391769202592733),
    1.0: (2.00861986087484, 6.66328685932313, 8.59695063603805e-4),
    3.0: (2.02330414168221, 8.85909549971992, 6.98947562607979e-16),
}


def vanderpol(mu, guess=None, section=FALL, **options):
    guess = None if guess is None else hj.Guess("oscillation", guess)
    system = hj.models.VanDerPol(mu=mu)
    return hj.find_limit_cycle(system, guess, section=section, **options)


def test_the_hopper_and_its_events(reference, hopper_cycle):
    data = reference("limit_cycle")
    half = data["state_clock_half"]
    state = hopper_cycle.anchor.q[:2, 0]
    assert_allclose(state, half, atol=1e-10)
    assert hopper_cycle.result == hj.errors.Result.OK
    assert hopper_cycle.is_stable
    assert hopper_cycle.period == 1.0
    assert hopper_cycle.residual < 1e-12
    liftoff, touchdown = hopper_cycle.trajectory().events
    assert liftoff.name == "liftoff"
    assert touchdown.name == "touchdown"
    assert_allclose(liftoff.time % 1, data["liftoff_clock"], atol=1e-10)
    assert_allclose(touchdown.time % 1, data["touchdown_clock"], atol=1e-10)
    for event in (liftoff, touchdown):
        for x, when in ((event.before, "pre"), (event.after, "post")):
            expected = data[f"{event.name}_{when}"]
            assert_allclose(list(x.values()), expected, atol=1e-10)
    (before, _), (after, _) = map(
        last_turn, (hopper_cycle, begin_later(hopper_cycle, 2))
    )
    later = before.t[:2] + 1.0
    assert_array_equal(after.t, np.append(before.t[2:], later))
    text = repr(hopper_cycle)
    assert "liftoff, touchdown" in text
    assert "-0.248983335+0.699333252j" in text


def test_a_cycle_can_be_donated(hopper_cycle):
    """No buffer is in it twice: XLA refuses to write over one twice."""
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    moved = eqx.filter_jit(
        lambda c: eqx.tree_at(lambda c: c.period, c, 1.0), donate="all"
    )(cycle)
    assert_array_equal(moved.multipliers, hopper_cycle.multipliers)


def test_the_lossy_hopper(lossy_cycle):
    state = [1.87978886663710, 1.75832736962547]
    found = lossy_cycle.anchor.q[:2, 0]
    assert_allclose(found, state, atol=1e-10)
    multiplier = -0.317897006349938 + 0.694628822735891j
    assert_allclose(lossy_cycle.multipliers[0], multiplier, atol=1e-9)
    events = [e.time % 1 for e in lossy_cycle.trajectory().events]
    assert_allclose(events, [0.522453086774101, 0.332748511553392], atol=1e-10)


@pytest.mark.slow
def test_the_two_legged_bar():
    bar_cycle = hj.find_limit_cycle(hj.models.TwoLeggedBar())
    state = [
        0.400516754055274,
        -0.764126541534894,
        -0.00728487463290610,
        0.399159213578728,
    ]
    assert_allclose(bar_cycle.anchor.q[:, 0], state, atol=1e-9)
    first = -0.153520955429110 + 0.361043052961495j
    second = 0.151655665357578 + 0.227749294883360j
    truth = [first, np.conj(first), second, np.conj(second)]
    assert_allclose(bar_cycle.multipliers, truth, atol=1e-9)
    events = bar_cycle.trajectory().events
    names = ", ".join(e.name.split(" (")[0] for e in events)
    assert names == "front lifts, hind lifts, front lands, hind lands"
    times = [0.485372036855771, 0.520707713616307, 0.745498454894426, 0.759897208341559]
    assert_allclose([e.time for e in events], times, atol=1e-9)
    landed = [
        0.788200918259240,
        -1.71180954225949,
        -0.0243713338437363,
        -0.268770117871700,
    ]
    after = list(events[3].after.values())
    assert_allclose(after, landed, atol=1e-9)


@pytest.mark.parametrize(
    "mu", [-0.5, 3.0, *(pytest.param(x, marks=pytest.mark.slow) for x in (0.5, 1.0))]
)
def test_van_der_pol(mu):
    """In reversed time, mu -> -mu, the cycle is the same and its multiplier the reciprocal."""
    amplitude, period, multiplier = VANDERPOL[abs(mu)]
    start = (2.0, 0.0) if mu < 0 else None
    cycle = vanderpol(mu, start)
    at_rest = [amplitude, 0.0]
    assert_allclose(cycle.anchor.q[:, 0], at_rest, atol=1e-9)
    assert_allclose(cycle.period, period, atol=1e-9)
    expected = [multiplier ** np.sign(mu)]
    assert_allclose(cycle.multipliers, expected, rtol=1e-7, atol=0)
    assert not cycle.clocked
    assert cycle.event_sequence == ()
    assert cycle.is_stable == (mu > 0)


@pytest.mark.slow
def test_a_guess_where_the_states_are_fast_leads_to_a_slow_cycle():
    """v' = 1 + v^2 from -1 to 1e5, in the time atan(1e5) + pi/4; at the guess a millionth of it."""

    def square_rates(t, q, u):
        return (1 + q[0] ** 2,)

    square = Field(("v",), square_rates)

    def spike(t, q, u):
        return q[0] - 1e5

    def again(t, q, u):
        return (-1.0,)

    event = hj.Transition("spike", "a", "a", spike, "rising", again)
    guess = hj.Guess("a", (9e4,))
    section = hj.AtEvent("spike")
    system = toy({"a": square}, [event])
    cycle = hj.find_limit_cycle(system, guess, section=section)
    expected = np.arctan(1e5) + np.pi / 4
    assert_allclose(cycle.period, expected, rtol=1e-9)


def test_a_default_section_that_is_missed_is_replaced():
    """No cycle of van der Pol's oscillator comes to y = 30."""
    assert_allclose(
        vanderpol(1.0, (0.0, 30.0)).period, vanderpol(1.0, (2.0, 0.0)).period
    )


@pytest.mark.slow
def test_a_default_section_is_not_replaced_by_one_at_an_event():
    """A Schmitt trigger with the levels 1 and -1, supplied by 2 and -2: its period is 2 ln 3."""
    charts = {
        name: Field(("v",), lambda t, q, u, supply=supply: (supply - q[0],))
        for name, supply in (("up", 2.0), ("down", -2.0))
    }

    def top_guard(t, q, u):
        return q[0] - 1

    top = hj.Transition("top", "up", "down", top_guard, "rising")

    def bottom_guard(t, q, u):
        return q[0] + 1

    bottom = hj.Transition("bottom", "down", "up", bottom_guard)
    system = toy(charts, [top, bottom])
    guess = hj.Guess("down", (40.0,))
    cycle = hj.find_limit_cycle(system, guess)
    assert_allclose(cycle.period, 2 * np.log(3), rtol=1e-10)


@pytest.mark.slow
def test_a_plane_that_turns_meet_twice_is_replaced_by_an_event():
    """Two cells with the drive 1.3 that spike at 1 and then push the other one back by 0.1: in half
    a period e = exp(-T/2) solves 1.3 e^2 + 0.1 e = 0.3."""

    def cells_rates(t, q, u):
        return (1.3 - q[0], 1.3 - q[1])

    cells = Field(("x", "y"), cells_rates)

    def spike_x_guard(t, q, u):
        return q[0] - 1

    def spike_y_guard(t, q, u):
        return q[1] - 1

    spikes = [
        hj.Transition(
            "spike x",
            "cells",
            "cells",
            spike_x_guard,
            "rising",
            lambda t, q, u: (0.0, q[1] - 0.1),
        ),
        hj.Transition(
            "spike y",
            "cells",
            "cells",
            spike_y_guard,
            "rising",
            lambda t, q, u: (q[0] - 0.1, 0.0),
        ),
    ]
    system = toy({"cells": cells}, spikes)
    guess = hj.Guess("cells", (0, 0.5))
    cycle = hj.find_limit_cycle(system, guess)
    product = 4 * 1.3 * 0.3
    root = np.sqrt(0.1**2 + product)
    half = np.log(2 * 1.3 / (root - 0.1))
    assert_allclose(cycle.period, 2 * half, rtol=1e-10)


@pytest.mark.slow
def test_a_flow_that_comes_to_rest_is_no_cycle():
    def charging_rates(t, q, u):
        return (2.0 - q[0],)

    charging = Field(("v",), charging_rates)

    def top_guard(t, q, u):
        return q[0] - 1

    top = hj.Transition("top", "a", "a", top_guard, "rising")
    with pytest.raises(hj.errors.ComputationError, match="beyond the guard of 'top'"):
        system = toy({"a": charging}, [top])
        hj.find_limit_cycle(system, hj.Guess("a", (1.5,)))
    with pytest.raises(
        hj.errors.ComputationError, match="leads to an equilibrium of chart"
    ):
        vanderpol(-2.5, (0.1, 0.1))

    # (Neither is a state that drifts away, nor slow motion.)
    def drift_rates(t, q, u):
        return (1.0 + 0 * q[0],)

    drift = Field(("v",), drift_rates)
    missed = "was not crossed within .* start lies beyond the guard of 'top'"
    with pytest.raises(hj.errors.ComputationError, match=missed):
        system = toy({"a": drift}, [top])
        hj.find_limit_cycle(system, hj.Guess("a", (1.5,)))
    far = hj.Crossing("x", "falling", value=10.0)
    with pytest.raises(hj.errors.ComputationError, match="Allow more time than 1, by"):
        vanderpol(1000.0, (2.0, 0.0), section=far, max_period=1.0)


def test_a_conservative_system_has_a_family_of_cycles(amplitude=7.3):
    cycle = vanderpol(0.0, (amplitude, 0.0), throw=False)
    assert cycle.result == hj.errors.Result.SINGULAR
    assert_allclose(cycle.anchor.q[0, 0], amplitude, rtol=1e-8)
    assert_allclose(cycle.period, 2 * np.pi, rtol=1e-9)


@pytest.mark.slow
def test_an_equilibrium_is_no_cycle():
    """Below the unstable cycle of mu < 0 all spirals into the origin."""
    with pytest.raises(hj.errors.ComputationError, match="ended in an equilibrium"):
        vanderpol(-0.5, (0.1, 0.0))
    with pytest.raises(hj.errors.ComputationError, match="starts at an equilibrium"):
        vanderpol(-0.5, (0.0, 0.0))
    far = hj.Crossing("x", "falling", value=10.0)
    with pytest.raises(
        hj.errors.ComputationError,
        match=r"looking for the section \(x falling\) failed",
    ):
        vanderpol(1.0, section=far, max_period=20.0)
    still = vanderpol(-0.5, (0.1, 0.0), throw=False)

    def linearize():
        return hj.linearize(still, far)

    for use in (
        still.responses,
        linearize,
        lambda: still.multipliers,
        lambda: still.htf(0.1),
    ):
        with pytest.raises(
            hj.errors.DefinitionError, match="search for this cycle failed"
        ):
            use()


def test_a_lossy_ball_has_no_cycle():
    ball = hj.models.BouncingBall(restitution=0.7)
    with pytest.raises(
        hj.errors.ComputationError, match="no limit cycle of BouncingBall|accumulate"
    ):
        hj.find_limit_cycle(
            ball, hj.Guess("fall", (1.0, 0.0)), section=hj.AtEvent("bounce"), settle=5.0
        )


def test_scheduled_events():
    system = Switched(duty=0.3)
    cycle = hj.find_limit_cycle(system)
    grow = np.exp(0.5)  # from the middle of the stay in `off` to its end, backwards
    expected = system.exact() * grow
    assert_allclose(cycle.anchor.q[0, 0], expected, rtol=1e-11)
    assert_allclose(cycle.multipliers, [np.exp(-1.0)], atol=1e-11)
    # Sections at the very instants of the switches: the state after the switch, each just once.
    placed = hj.sections.place_sections(cycle, hj.ClockPhase(10))
    on = np.arange(10) < 3
    assert_array_equal(placed.lanes.chart, np.where(on, 0, 1))
    height = placed.lanes.q[0, 0]
    assert_allclose(height, system.exact(), rtol=1e-11)
    ldtp = hj.linearize(cycle, placed)
    decay = np.exp(-0.1)
    assert_allclose(ldtp.A[:, 0, 0], decay, rtol=1e-11)
    expected_push = on * (1 - np.exp(-0.1))
    assert_allclose(ldtp.B[:, 0, 0], expected_push, atol=1e-12)


@pytest.mark.slow
def test_an_event_may_pass_the_phase_at_which_a_guess_begins(hopper_cycle):
    """Liftoff is later than t = 0.5 s for k > 13.53, so the hopper is in another chart then."""
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper(k=14.5), hopper_cycle)
    settled = hj.find_limit_cycle(hj.models.VerticalHopper(k=14.5), settle=60.0)
    assert_allclose(cycle.multipliers, settled.multipliers, rtol=1e-9)


def test_damped_steps_reach_a_cycle_that_newtons_method_misses():
    """The juggler's unstable cycle; its trace and that of the stable one have the mean 1 + e^2."""
    juggler = hj.models.PaddleJuggler()
    guess = hj.Guess("fall", (1.3, -1.0), 0.56)
    cycle = hj.find_limit_cycle(juggler, guess)
    e = juggler.restitution
    stable = hj.find_limit_cycle(juggler)
    assert_allclose(np.prod(cycle.multipliers), e**2, rtol=1e-9)
    traces = sum(np.sum(x.multipliers) for x in (cycle, stable))
    assert_allclose(traces, 2 * (1 + e**2), rtol=1e-9)
    assert stable.is_stable
    assert not cycle.is_stable
    assert ": ok, unstable)" in str(cycle)
    assert ": ok)" in str(stable)
