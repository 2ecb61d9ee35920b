"""Multipliers that are all but zero, against closed forms and Liouville's formula."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import hybridjax as hj

from ..toys import Field


RATES = np.array([0.5, 45.0, 120.0])


class Decaying(hj.HybridSystem):
    """A forced linear system whose modes, mixed with each other, decay at `RATES`."""

    def charts(self):
        modes = np.array([[1.0, 0.4, 0.2], [-0.3, 1.0, 0.5], [0.1, -0.6, 1.0]])
        A = jnp.asarray(modes @ np.diag(-RATES) @ np.linalg.inv(modes))
        force = jnp.array([1.0, 2.0, 3.0])
        field = lambda t, q, u: A @ q + force * jnp.cos(2 * jnp.pi * t)  # noqa: E731
        return {"a": Field(("x", "y", "z"), field)}

    def period(self):
        return 1.0


class FitzHughNagumo(hj.HybridSystem):
    eps: hj.Parameter = hj.parameter(0.01)

    def charts(self):
        def field(t, q, u):
            v, w = q
            return (v - v**3 / 3 - w + 0.5 + u[0]) / self.eps, v + 0.7 - 0.8 * w

        return {"a": Field(("v", "w"), field)}


def liouville(eps):
    """The cycle's w where v rises through 0, and the logarithm of its multiplier: the divergence,
    integrated over one period. By scipy's Radau."""

    def field(t, z):
        v, w, _ = z
        return (v - v**3 / 3 - w + 0.5) / eps, v + 0.7 - 0.8 * w, (1 - v**2) / eps - 0.8

    def jacobian(t, z):
        v = z[0]
        return [[(1 - v**2) / eps, -1 / eps, 0], [1, -0.8, 0], [-2 * v / eps, 0, 0]]

    rising = lambda t, z: z[0]  # noqa: E731
    rising.direction = 1
    found = solve_ivp(
        field, (0, 9), [0.0, -0.177, 0.0], "Radau",
        jac=jacobian, rtol=1e-11, atol=1e-13, events=rising,
    )  # fmt: skip
    last, end = found.y_events[0][-2:]
    return end[1], end[2] - last[2]


def relaxation(eps, w):
    return hj.find_limit_cycle(
        FitzHughNagumo(eps),
        hj.Guess("a", (0.0, w)),
        section=hj.Crossing("v", "rising"),
        max_period=10.0,
        settings=hj.Settings(max_steps=20_000),
    )


def test_modes_that_decay_fast_beside_one_that_does_not():
    cycle = hj.find_limit_cycle(Decaying(), hj.Guess("a", (0.1, 0.2, 0.3)))
    np.testing.assert_allclose(cycle.multipliers, np.exp(-RATES), rtol=1e-10, atol=0)
    found = hj.linearize(cycle, hj.ClockPhase(16)).multipliers
    np.testing.assert_allclose(found, np.exp(-RATES), rtol=1e-8, atol=0)


@pytest.mark.slow
def test_a_relaxation_oscillation():
    """Its multiplier of 2e-134 is positive, as that of any planar flow."""
    w, logarithm = liouville(0.01)
    cycle = relaxation(0.01, w)
    np.testing.assert_allclose(cycle.multipliers, [np.exp(logarithm)], rtol=1e-6, atol=0)
    phase = hj.KinematicPhase(
        4, position="v", velocity="w", center=(0.0, 0.5), scale=(1.0, 0.5)
    )  # fmt: skip
    found = hj.linearize(cycle, phase).multipliers
    np.testing.assert_allclose(found, [np.exp(logarithm)], rtol=1e-6, atol=0)
