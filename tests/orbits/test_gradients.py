"""What is seen on a cycle has the derivatives of the cycle."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj

from ..conftest import APEX


@pytest.mark.slow
def test_the_multipliers_of_the_hopper_by_its_parameters(hopper_cycle):
    """Against independent digits; m, M, k, b, l0, a, g for the positive imaginary part."""
    true = {
        "m": -0.0824974078 - 0.0323664570j,
        "M": 0.2607460076 + 0.3114094110j,
        "k": -0.0368909415 - 0.0622806965j,
        "b": -0.0580410737 + 0.0358755413j,
        "l0": 0.0,
        "a": 0.0110060088 - 0.0073511553j,
        "g": -0.1100600879 + 0.0735115530j,
    }

    def multiplier(hopper):
        cycle = hj.find_limit_cycle(hopper, hopper_cycle)
        monodromy = hj.linearize(cycle, hj.ClockPhase(8, anchor=APEX), outputs="yM").monodromy(5)
        trace = jnp.trace(monodromy)
        determinant = (trace**2 - jnp.trace(monodromy @ monodromy)) / 2
        return jnp.stack([trace / 2, jnp.sqrt(determinant - trace**2 / 4)])

    slopes = eqx.filter_jit(eqx.filter_jacfwd(multiplier))(hopper_cycle.system)
    for name, value in true.items():
        assert complex(*np.asarray(getattr(slopes, name))) == pytest.approx(value, abs=1e-9), name
