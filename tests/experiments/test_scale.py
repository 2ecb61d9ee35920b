"""A state that rests: experiments take the sizes of states from their limit cycle."""

import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

import hybridjax as hj

from ..toys import Field


class Resting(hj.HybridSystem):
    """A driven oscillator, and beside it a state w that only rounding errors move from zero."""

    damping: Float[Array, ""] = hj.parameter(1.0)
    inputs = ("force",)

    def charts(self):
        twice = 2 * self.damping

        def field(t, q, u):
            (x, v, w), c = q, jnp.cos(3 * t)
            nothing = (1 + 0.1 * c) * 3 - 3 - 0.3 * c
            return v, c - 4 * x - 0.5 * twice * v + u[0], nothing - w

        return {"all": Field(("x", "v", "w"), field)}

    def period(self):
        return 2 * np.pi / 3

    def guess(self):
        return hj.Guess("all", (0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def resting():
    return hj.find_limit_cycle(Resting(), scale={"w": 1.0})


def test_experiments_judge_errors_by_the_sizes_of_the_cycle(resting):
    family = hj.ClockPhase(4)
    design = hj.Design.from_lines([[0.25], [0.75]], n_sections=4, periods=4)
    data = hj.run_experiments(resting, family, design, ("x", "w"))
    assert data.summary() == "2/2 ok" and np.all(data.error < 1e-8)
    model = hj.linearize(resting, family, ("x", "w"))  # the system is linear
    np.testing.assert_allclose(
        data.y, hj.experiments.simulate_experiments(model, design).y, atol=1e-9
    )
    scales = hj.response_function(resting, family, "x").stepping.scales
    sizes = [float(resting.period), *(resting.scale[name] for name in "xvw")]
    np.testing.assert_array_equal(scales, np.tile(sizes, (4, 1)))
    assert sizes[-1] == 1.0
