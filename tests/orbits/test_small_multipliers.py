"""Multipliers that are all but zero, against closed forms."""

import jax.numpy as jnp
import numpy as np

import hybridjax as hj

from ..toys import Field


RATES = np.array([0.5, 20.0, 45.0])


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


def test_modes_that_decay_fast_beside_one_that_does_not():
    cycle = hj.find_limit_cycle(Decaying(), hj.Guess("a", (0.1, 0.2, 0.3)))
    np.testing.assert_allclose(cycle.multipliers, np.exp(-RATES), rtol=1e-10, atol=0)
    found = hj.linearize(cycle, hj.ClockPhase(8)).multipliers
    np.testing.assert_allclose(found, np.exp(-RATES), rtol=1e-8, atol=0)
