"""Events that coincide: found on cycles, in sweeps, along branches, and with schedules."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj

from ..toys import Field, toy
from .test_explain import BALLS, Balls


# x and y relax to 1, and are set back to 0 together at the level 1/2.
def rates(t, q, u):
    return (1.0 - q[0], 1.0 - q[1])


def x_guard(t, q, u):
    return q[0] - 0.5


def y_guard(t, q, u):
    return q[1] - 0.5


PAIR = toy(
    {"a": Field(("x", "y"), rates)},
    [
        hj.Transition(
            "x",
            "a",
            "a",
            x_guard,
            "rising",
            lambda t, q, u: (0.5 * (q[1] - 0.5), q[1]),
        ),
        hj.Transition(
            "y",
            "a",
            "a",
            y_guard,
            "rising",
            lambda t, q, u: (q[0], 0.0),
        ),
    ],
)


def ticked(height=1.0, other=0.0):
    """A saw-tooth that is set back when it comes to `height`, and by a clock at whole times."""

    def back(t, q, u):
        return (0.2,)

    def full_guard(t, q, u):
        return q[0] - height

    transitions = [
        hj.Transition("full", "a", "a", full_guard, "rising", back),
        hj.Transition("tick", "a", "a", hj.systems.Scheduled(1.0), reset=back),
    ]
    if other:
        transitions.append(
            hj.Transition(
                "tock", "a", "a", hj.systems.Scheduled(0.5, other), reset=back
            )
        )

    def rates(t, q, u):
        no_wave = 0.0 * jnp.sin(t)
        return (1.0 - 0.1 * q[0] + no_wave,)

    charts = {"a": Field(("x",), rates)}
    return toy(charts, transitions, period=1.0)


def race():
    """x and y rise to 1 together; the other goes on at its own speed when one is there. Both fall
    then, until the clock starts them again."""
    speeds = {
        "a": (1.0, 1.0),
        "x first": (1.0, 2.0),
        "y first": (3.0, 1.0),
        "c": (-4.0, -5.0),
    }
    charts = {
        name: Field(("x", "y"), lambda t, q, u, speed=speed: speed)
        for name, speed in speeds.items()
    }
    x, y = (lambda t, q, u, k=k: q[k] - 1.0 for k in range(2))

    def again(t, q, u):
        x = 0.5 + 0.1 * (q[0] + 1.0)
        y = 0.5 + 0.1 * (q[1] + 1.5)
        return (x, y)

    transitions = (
        hj.Transition("x", "a", "x first", x, "rising"),
        hj.Transition("y", "a", "y first", y, "rising"),
        hj.Transition("y second", "x first", "c", y, "rising"),
        hj.Transition("x second", "y first", "c", x, "rising"),
        hj.Transition("start", "c", "a", hj.systems.Scheduled(1.0), reset=again),
    )
    return toy(charts, transitions, period=1.0)


def test_derivatives_of_both_orders():
    """By hand: x is at 1 at the time -dx, or -(dx + 2 dy) / 3 if y was there first; and so on."""
    guess = hj.Guess("a", (0.6, 0.6), 0.1)
    cycle = hj.find_limit_cycle(race(), guess, throw=False)
    assert cycle.result == hj.errors.Result.SIMULTANEOUS
    (found,) = cycle.simultaneous_events()
    assert found.time % 1.0 == pytest.approx(0.5)
    assert not found.commute
    exact = {
        ("x", "y second"): np.array([[-1.5, -2.5], [-2.5, -2.5]]),
        ("y", "x second"): np.array(
            [
                [-4 / 3, -8 / 3],
                [-2.0, -3.0],
            ]
        ),
    }
    assert set(found.orders) == set(exact)
    for order, derivative in zip(found.orders, found.derivatives, strict=True):
        assert_allclose(derivative, exact[order], atol=1e-12)


def test_an_event_that_coincides_with_the_one_at_the_anchor():
    with pytest.raises(
        hj.errors.ComputationError, match="'y' coincides with 'x', its beginning"
    ):
        guess = hj.Guess("a", (0.1, 0.1))
        hj.find_limit_cycle(PAIR, guess, section=hj.AtEvent("x"))


@pytest.mark.slow
def test_cycles_of_a_sweep_and_of_a_branch_on_which_events_coincide():
    """Clocks of their own, whose events commute, and such that do not."""
    couplings = jnp.array([0.0, 0.2, 0.4])
    systems = eqx.filter_vmap(lambda c: Balls(coupling=c))(couplings)
    begin = hj.find_limit_cycle(Balls(), BALLS)
    found = hj.orbits.find_limit_cycles(systems, begin)
    ok = hj.errors.Result.OK
    not_ok = hj.errors.Result.SIMULTANEOUS
    assert_array_equal(found.result, [ok, not_ok, not_ok])
    branch = hj.continuation(begin, "coupling", (0.0, 0.1), step=0.5)
    assert branch.cycles.result[0] == ok
    assert (branch.cycles.result[1:] == not_ok).all()


@pytest.mark.slow
def test_an_event_that_coincides_with_a_schedule():
    """Without the clock, it would be full at the time 1: which of the two sets it back?"""
    height = 10 - 9.8 * np.exp(-0.1)
    with pytest.raises(
        hj.errors.ComputationError, match="'full' and 'tick' coincide|'tick' and 'full'"
    ):
        guess = hj.Guess("a", (0.5,), 0.3)
        hj.find_limit_cycle(ticked(height), guess)


class Filled(hj.HybridSystem):
    """x rises at the speed 1 from 0.2 at the time 0.3, until it is full or the clock ticks at 1."""

    height: hj.Parameter = hj.parameter(0.8)

    def charts(self):
        return {
            "up": Field(("x",), lambda t, q, u: (1.0,)),
            "down": Field(("x",), lambda t, q, u: (-q[0],)),
        }

    def transitions(self):
        tick = hj.systems.Scheduled(1.0)
        start = hj.systems.Scheduled(1.0, offset=0.3)
        return (
            hj.Transition("full", "up", "down", lambda t, q, u: self.height - q[0]),
            hj.Transition("tick", "up", "down", tick, reset=lambda t, q, u: (0.0,)),
            hj.Transition("start", "down", "up", start, reset=lambda t, q, u: (0.2,)),
        )

    def period(self):
        return 1.0


class Clocks(hj.HybridSystem):
    """x decays, and is changed by two clocks, which tick together once in a period."""

    rate: hj.Parameter = hj.parameter(1.0)

    def charts(self):
        return {"a": Field(("x",), lambda t, q, u: (-self.rate * q[0],))}

    def transitions(self):
        third = hj.systems.Scheduled(1 / 3)
        half = hj.systems.Scheduled(1 / 2)
        return (
            hj.Transition("add", "a", "a", third, reset=lambda t, q, u: (q[0] + 1,)),
            hj.Transition("halve", "a", "a", half, reset=lambda t, q, u: (q[0] / 2,)),
        )

    def period(self):
        return 1.0


def results_of_all_searches(system, guess, value):
    """The result for one value of the parameter of a class, by the way to find the cycle."""
    known = hj.find_limit_cycle(system(), guess)

    @jax.jit
    def in_program(value):
        return hj.find_limit_cycle(system(value), known, throw=False).result

    def in_sweep(values):
        systems = eqx.filter_vmap(system)(jnp.array(values))
        return hj.orbits.find_limit_cycles(systems, known).result[0]

    def repeated():
        return hj.find_limit_cycle(system(value), known, throw=False).result

    results = {
        "single": hj.find_limit_cycle(system(value), guess, throw=False).result,
        "repeated": [repeated() for _ in range(4)][-1],
        "in a program": in_program(value),
        "small sweep": in_sweep([value, 0.7]),
        "large sweep": in_sweep([value, *np.linspace(0.6, 0.8, 260)]),
    }
    return {name: int(result) for name, result in results.items()}


@pytest.mark.slow
def test_an_event_in_place_of_a_schedule_is_found_by_all_searches():
    """x would be full 1e-10 before the tick: beside the cycle, the clock may empty it instead."""
    guess = hj.Guess("up", (0.4,), time=0.5)
    found = results_of_all_searches(Filled, guess, 0.9 - 1e-10)
    together = int(hj.errors.Result.SIMULTANEOUS)
    assert found == dict.fromkeys(found, together)
    early = hj.find_limit_cycle(Filled(0.9 - 1e-7), guess)
    assert early.event_sequence == (0, 2)


@pytest.mark.slow
def test_clocks_that_tick_together_are_accepted_by_all_searches():
    guess = hj.Guess("a", (1.0,), time=0.9)
    found = results_of_all_searches(Clocks, guess, 0.9)
    ok = int(hj.errors.Result.OK)
    assert found == dict.fromkeys(found, ok)


def test_two_schedules_for_one_time():
    with pytest.raises(
        hj.errors.DefinitionError, match="'tick' and 'tock' are scheduled for the same"
    ):
        guess = hj.Guess("a", (0.5,), 0.3)
        hj.find_limit_cycle(ticked(other=0.5), guess)
