"""Cycles that are not what they seem to be are refused, never used."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj

from ..toys import Field, Toys, toy


def kicked(beat=1.0, schedule=0.0):
    """x' = -x, and x grows by 1 each time the cosine falls, or at scheduled times."""

    def guard(t, q, u):
        return jnp.cos(2 * jnp.pi * t)

    guard = hj.systems.Scheduled(schedule, 0.1) if schedule else guard

    def kick_reset(t, q, u):
        return (q[0] + 1.0,)

    kick = hj.Transition("kick", "a", "a", guard, reset=kick_reset)

    def rates(t, q, u):
        no_wave = 0.0 * jnp.sin(t)
        return (-q[0] + no_wave + u[0],)

    charts = {"a": Field(("x",), rates)}
    return toy(charts, [kick], beat)


BEAT = kicked(schedule=1.0)


@pytest.mark.parametrize("size", [1e300, 1e100])
def test_a_guess_that_is_far_too_large_leads_to_the_same_cycle(size):
    cycle = hj.find_limit_cycle(BEAT, hj.Guess("a", (size,)))
    passed = 1 - np.exp(-1)
    expected = np.exp(-0.9) / passed
    assert_allclose(cycle.state["x"], expected, rtol=1e-12)


@pytest.mark.parametrize(
    "system, guess, options, message",
    [
        (
            kicked(),
            (1 / np.expm1(1), 0.25),
            {},
            "event 'kick' coincides with the beginning",
        ),
        (kicked(beat=2.0, schedule=3.0), (0.3,), {}, "schedule of 'kick' must divide"),
        (BEAT, (0.6,), {"multiplicity": 2}, "closes sooner than after the 2 periods"),
    ],
)
def test_what_is_no_cycle(system, guess, options, message):
    x, *time = guess
    with pytest.raises(hj.errors.HybridJaxError, match=message):
        hj.find_limit_cycle(system, hj.Guess("a", (x,), *time), **options)


@pytest.mark.slow
def test_a_cycle_that_closes_sooner_is_none_of_two_periods_in_programs_either():
    """Of the logistic map, of which each period of a clock makes a step."""

    def make(r):
        def grow(t, q, u):
            return (r * q[0] * (1 - q[0]),)

        def rates(t, q, u):
            return (0.0 * jnp.sin(2 * jnp.pi * t),)

        still = {"a": Field(("x",), rates)}
        return (
            still,
            [hj.Transition("grow", "a", "a", hj.systems.Scheduled(1, 0.5), reset=grow)],
            1.0,
        )

    system = Toys(make, [3.2])
    guess = hj.Guess("a", (0.8,))
    cycle = hj.find_limit_cycle(system, guess, multiplicity=2)
    result = jax.jit(lambda r: hj.find_limit_cycle(Toys(make, r), cycle).result)
    measured = [result(np.array([r])) for r in (3.3, 2.8)]
    assert measured == [
        hj.errors.Result.OK,
        hj.errors.Result.EXTRA_TURNS,
    ]


def test_outputs_of_a_call_have_the_period_of_the_clock():
    cycle = hj.find_limit_cycle(BEAT, hj.Guess("a", (0.6,)))
    for value in (
        lambda t, q, u: jnp.cos(1.3 * t),
        lambda t, q, u: u[0] * jnp.cos(1.3 * t),
    ):
        with pytest.raises(
            hj.errors.DefinitionError, match="output 'z' does not have the period 1"
        ):
            output = hj.Output("z", value)
            hj.linearize(cycle, hj.ClockPhase(4), output)


def test_a_ball_does_not_fall_through_the_floor():
    ball = hj.models.BouncingBall(restitution=0.0)
    path = hj.simulate(ball, "fall", (1.0, 0.0), 2.0, throw=False)
    assert path.result == hj.errors.Result.GUARD_PASSED
    assert len(path.events) == 1


def test_a_cycle_of_another_kind_is_no_guess(hopper_cycle):
    refused = pytest.raises(
        hj.errors.DefinitionError, match=r"charts and states: \(2, 4\) and \(1, 2\)"
    )
    juggler = hj.models.PaddleJuggler()
    with refused:
        hj.find_limit_cycle(juggler, hopper_cycle)
    with refused:
        hj.sweep(juggler, {"restitution": [0.7, 0.8]}, guess=hopper_cycle)
    with refused:
        data = hj.fitting.ObservedCycle(hj.ClockPhase(1), period=1.0)
        hj.fit_model(juggler, data, "g", guess=hopper_cycle)


def test_a_cycle_as_the_guess_begins_at_the_same_phase(hopper_cycle):
    """Of the clock of the other system."""
    slower = hj.models.VerticalHopper(omega=2 * jnp.pi / 1.05)
    cycle = hj.find_limit_cycle(slower, hopper_cycle)
    assert_allclose(cycle.anchor.t, 1.05 * hopper_cycle.anchor.t, rtol=1e-14)
    assert cycle.result == hj.errors.Result.OK
    assert cycle.event_sequence == hopper_cycle.event_sequence


def test_a_guess_that_is_far_too_large_in_one_state_leads_to_the_same_accuracy(
    hopper_cycle,
):
    """States were small beside the guess, and errors relative to that: 1e-3 in multipliers."""
    system = hj.models.VerticalHopper()
    guess = hj.Guess("stance", (2e6, 1.9e6), 0.5)
    far = hj.find_limit_cycle(system, guess)
    assert_allclose(far.multipliers, hopper_cycle.multipliers, rtol=1e-9)


@pytest.mark.slow
def test_failed_cycles_of_a_sweep_have_no_period():
    """Oscillators with the energy x^2 + v^2 = mu, which have no cycle for negative mu."""

    def make(mu):
        def field(t, q, u):
            rate = mu - q[0] ** 2 - q[1] ** 2
            x_rate = rate * q[0] + q[1]
            y_rate = rate * q[1] - q[0]
            return x_rate, y_rate

        return {"a": Field(("x", "v"), field)}, ()

    section = hj.Crossing("x", "falling")
    guess = hj.Guess("a", (0.1, 1.0))
    cycle = hj.find_limit_cycle(Toys(make, [1.0]), guess, section=section)
    systems = [Toys(make, [mu]) for mu in (1.0, -1.0)]
    found = hj.orbits.find_limit_cycles(systems, cycle)
    assert_array_equal(found.ok, [True, False])
    expected = [2 * np.pi, np.nan]
    assert_allclose(found.period, expected, rtol=1e-8)


def oscillator(force):
    """Van der Pol's oscillator with a further force."""

    def field(t, q, u):
        damping = (1 - q[0] ** 2) * q[1]
        acceleration = damping - q[0] + force(t, q)
        return q[1], acceleration

    return toy({"a": Field(("x", "v"), field)})


@pytest.mark.parametrize(
    "force", [lambda t, q: 0.0 * t, lambda t, q: 0 * jnp.sin(t) * q[0]]
)
def test_time_times_zero_is_no_clock(force):
    guess = hj.Guess("a", (2.0, 0.0))
    cycle = hj.find_limit_cycle(oscillator(force), guess)
    assert_allclose(cycle.period, 6.663286859, rtol=1e-8)


@pytest.mark.parametrize(
    "force",
    [
        lambda t, q: 0.1 * q[0].astype(jnp.float32),
        lambda t, q: 0.1 * jax.jit(lambda x: jnp.sin(x.astype(jnp.float32)))(q[0]),
    ],
)
def test_a_field_in_float32_is_named(force):
    with pytest.raises(
        hj.errors.DefinitionError, match="field of chart 'a' is computed in float32"
    ):
        guess = hj.Guess("a", (2.0, 0.0))
        hj.find_limit_cycle(oscillator(force), guess)


def test_constants_in_float32_are_exact():
    guess = hj.Guess("a", (2.0, 0.0))
    system = oscillator(lambda t, q: jnp.float32(0.0) * q[0])
    cycle = hj.find_limit_cycle(system, guess)
    assert_allclose(cycle.period, 6.663286859, rtol=1e-8)


@pytest.mark.slow
def test_zeno_is_named_although_newton_went_elsewhere():
    """Two tanks with one hose, which goes to the tank that falls to 1: they lose 0.25 together, so
    that the hose has to be in both within a finite time."""
    fields = {"first": (0.25, -0.5), "second": (-0.5, 0.25)}
    charts = {
        name: Field(("x", "y"), lambda t, q, u, rates=rates: rates)
        for name, rates in fields.items()
    }

    def y_low_guard(t, q, u):
        return q[1] - 1

    def x_low_guard(t, q, u):
        return q[0] - 1

    events = [
        hj.Transition("y low", "first", "second", y_low_guard),
        hj.Transition("x low", "second", "first", x_low_guard),
    ]
    with pytest.raises(hj.errors.ComputationError, match="accumulate in finite time"):
        guess = hj.Guess("first", (1.5, 1.5))
        hj.find_limit_cycle(toy(charts, events), guess)
