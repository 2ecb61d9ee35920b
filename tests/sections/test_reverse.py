"""From parameters to a loss by reverse mode, through the cycle, its event and the linearization."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj
from hybridjax._core.compilation import compiler_options


# Compiled in a third of the time, to slower programs.
QUICK = compiler_options()


@pytest.mark.slow
def test_the_trace_of_the_jugglers_monodromy():
    """Beside the gradient of its closed form (Holmes 1982)."""
    juggler = hj.models.PaddleJuggler()
    cycle = hj.find_limit_cycle(juggler)

    def trace(system):
        found = hj.find_limit_cycle(system, cycle)
        return jnp.trace(hj.linearize(found, hj.ClockPhase(2)).monodromy())

    def exact(system):
        return jnp.sum(system.exact()[3]).real

    gradient = eqx.filter_jit(eqx.filter_grad(trace), compiler_options=QUICK)(juggler)
    expected = eqx.filter_grad(exact)(juggler)
    for name in ("A", "T", "g", "restitution"):
        slope, true = getattr(gradient, name), getattr(expected, name)
        np.testing.assert_allclose(slope, true, rtol=1e-9, err_msg=name)
