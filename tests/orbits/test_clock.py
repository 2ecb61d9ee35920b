"""Functions of time need a clock, and the period that it states."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj

from ..toys import Field, toy


class Unclocked(hj.models.PaddleJuggler):
    def period(self):
        return None


class WrongPaddle(hj.models.PaddleJuggler):
    def period(self):
        return 1.1


def pulse(t):
    phase = (t / 2 + 0.2) % 1.0 - 0.5
    return jnp.exp(-((phase / 1e-3) ** 2))


def fall_rates(t, q, u):
    return (pulse(t) - q[0],)


KICKED = toy({"fall": Field(("x",), fall_rates)}, period=1.0)


@pytest.mark.parametrize(
    "system, state, message",
    [
        (
            Unclocked(),
            (0.1, 4.7),
            "guard .*'impact' .* on t, but Unclocked states no period",
        ),
        (WrongPaddle(), (0.1, 4.7), "guard of 'impact' does not have the period 1.1"),
        (KICKED, (0.0,), "field .*does not have the period 1"),
    ],
)
def test_another_period_or_none(system, state, message):
    with pytest.raises(hj.errors.DefinitionError, match=message):
        hj.find_limit_cycle(system, hj.Guess("fall", state, 0.1))


@pytest.mark.slow
def test_a_period_that_does_not_follow_a_parameter():
    fixed = type("Fixed", (hj.models.Duffing,), {"period": lambda self: 4 * np.pi})
    with pytest.raises(
        hj.errors.DefinitionError, match="does not have the period 12.5664 that Fixed"
    ):
        hj.continuation(hj.find_limit_cycle(fixed()), "rate", (0.5, 0.51))

    def every(self):
        return hj.systems.Scheduled(20 * np.pi * self.damping, 1.0)

    tick = {
        "transitions": lambda self: [hj.Transition("tick", "line", "line", every(self))]
    }
    ticks = type("Ticks", (hj.models.Duffing,), tick)
    with pytest.raises(
        hj.errors.DefinitionError,
        match="the schedule of 'tick' must divide the clock's",
    ):
        hj.orbits.find_limit_cycles(
            [ticks(), ticks(damping=0.11)], hj.find_limit_cycle(ticks())
        )


@pytest.mark.slow
def test_a_force_that_jumps_with_the_clock():
    """The cycle of x' = -x + (1, then 0, for half a period each), by hand."""

    def force(t):
        return jnp.where(t % 1.0 < 0.5, 1.0, 0.0)

    def rates(t, q, u):
        return (-q[0] + force(t),)

    charts = {"a": Field(("x",), rates)}
    square = toy(
        charts, [hj.Transition("half", "a", "a", hj.systems.Scheduled(0.5))], period=1.0
    )
    guess = hj.Guess("a", (0.3,), 0.25)
    cycle = hj.find_limit_cycle(square, guess)
    before = 1 - np.exp(-0.5)
    rise = before * np.exp(-0.5)
    x = rise / (1 - np.exp(-1.0))
    decay = np.exp(-0.25)
    expected = 1 + (x - 1) * decay
    assert_allclose(cycle.state["x"], expected, rtol=1e-6)
    largest = 1 / (1 + np.exp(-0.5))
    assert_allclose(cycle.settings.scale, largest, rtol=1e-3)
