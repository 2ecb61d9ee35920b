"""Functions of time need a clock, and the period that it states."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj

from ..toys import Field


class Oscillator(hj.HybridSystem):
    """Van der Pol's oscillator with a force that is a function of (t, x)."""

    force: object = eqx.field(static=True)

    def charts(self):
        def field(t, q, u):
            x, v = q
            return v, (1 - x**2) * v - x + self.force(t, x)

        return {"a": Field(("x", "v"), field)}


class Kicked(Oscillator):
    def charts(self):
        return {"a": Field(("x",), lambda t, q, u: (self.force(t, q) - q[0],))}

    def period(self):
        return 1.0


class Unclocked(hj.models.PaddleJuggler):
    def period(self):
        return None


class WrongPaddle(hj.models.PaddleJuggler):
    def period(self):
        return 1.1


def find(system, x=2.0, v=0.0):
    return hj.find_limit_cycle(system, hj.Guess("a", (x, v)))


def test_a_forgotten_period_of_the_field():
    with pytest.raises(hj.DefinitionError, match="field of chart 'a' depends on t, .* no period"):
        find(Oscillator(lambda t, x: 0.5 * jnp.cos(1.3 * t)))


def test_guards():
    messages = {
        Unclocked: "guard .*'impact' .* depends on t, but Unclocked states no period",
        WrongPaddle: "guard of 'impact' does not have the period 1.1",
    }
    for system, message in messages.items():
        with pytest.raises(hj.DefinitionError, match=message):
            hj.find_limit_cycle(system(), hj.Guess("fall", (0.1, 4.7), 0.1))


def test_pulses_of_another_period():
    pulse = lambda t, x: jnp.exp(-((((t / 2 + 0.2) % 1.0 - 0.5) / 1e-3) ** 2))  # noqa: E731
    with pytest.raises(hj.DefinitionError, match="does not have the period 1"):
        hj.find_limit_cycle(Kicked(pulse), hj.Guess("a", (0.0,)))


def test_a_force_that_jumps_with_the_clock():
    """The cycle of x' = -x + (1, then 0, for half a period each), by hand."""

    class Square(hj.HybridSystem):
        def charts(self):
            force = lambda t: jnp.where(t % 1.0 < 0.5, 1.0, 0.0)  # noqa: E731
            return {"a": Field(("x",), lambda t, q, u: (-q[0] + force(t),))}

        def transitions(self):
            return (hj.Transition("half", "a", "a", hj.Scheduled(0.5)),)

        def period(self):
            return 1.0

    cycle = hj.find_limit_cycle(Square(), hj.Guess("a", (0.3,), 0.25))
    x = (1 - np.exp(-0.5)) * np.exp(-0.5) / (1 - np.exp(-1.0))
    x = 1 + (x - 1) * np.exp(-0.25)
    np.testing.assert_allclose(cycle.state["x"], x, rtol=1e-6)
