"""Guards that turn many times while the states hardly change: step control must look at them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import hybridjax as hj


class Straight(hj.Chart):
    states = ("x",)

    def field(self, t, q, u):
        return (1.0,)


class Sine(hj.HybridSystem):
    rate: hj.Parameter = hj.parameter(10.0)

    def charts(self):
        return {"line": Straight()}

    def transitions(self):
        return [hj.Transition("fall", "line", "line", lambda t, q, u: jnp.sin(self.rate * q[0]))]


@pytest.mark.parametrize("rate", [10.0, 23.0, 37.0, 61.0])
def test_every_turn_of_a_fast_guard_is_seen(rate):
    run = hj.simulate(Sine(rate=rate), "line", (0.1,), 9.9)
    k = np.arange(1000)
    falls = (2 * k + 1) * np.pi / rate - 0.1
    falls = falls[(falls > 0) & (falls < 9.9)]
    np.testing.assert_allclose([event.time for event in run.events], falls, atol=1e-12)


class Falling(hj.Chart):
    states = ("y", "v")

    def field(self, t, q, u):
        return q[1], -9.81


class ShakingTable(hj.HybridSystem):
    """A ball on a table that shakes ten times as fast as the ball bounces."""

    def table(self, t):
        return 0.02 * jnp.sin(20 * jnp.pi * t)

    def charts(self):
        return {"fall": Falling()}

    def transitions(self):
        def hit(t, q, u):
            return q[0], -0.7 * q[1] + 1.7 * jax.grad(self.table)(t)

        return [
            hj.Transition("hit", "fall", "fall", lambda t, q, u: q[0] - self.table(t), reset=hit)
        ]


def _table(t):
    return 0.02 * np.sin(20 * np.pi * t)


def _impacts(y, v, end):
    """Impacts by dense sampling of the closed form and bisection."""
    t, times = 0.0, []
    while True:
        gap = lambda s, t=t, y=y, v=v: y + v * s - 4.905 * s**2 - _table(t + s)  # noqa: E731
        s = np.linspace(1e-6, 2.0, 200_001)
        first = s[np.flatnonzero((gap(s[:-1]) > 0) & (gap(s[1:]) <= 0))[0]]
        s = brentq(gap, first, first + 1.1e-5, xtol=1e-15)
        y, v, t = y + v * s - 4.905 * s**2, v - 9.81 * s, t + s
        if t > end:
            return times
        times.append(t)
        v = -0.7 * v + 1.7 * 0.4 * np.pi * np.cos(20 * np.pi * t)


def test_a_ball_on_a_shaking_table():
    run = hj.simulate(ShakingTable(), "fall", (0.2, 4.5), 2.2)
    np.testing.assert_allclose(
        [event.time for event in run.events], _impacts(0.2, 4.5, 2.2), atol=1e-9
    )
