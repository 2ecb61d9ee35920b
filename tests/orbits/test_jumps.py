"""A field that jumps on the cycle is refused with its line; a continuous one is not."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj


hj.enable_x64()
RISES = hj.Crossing("x", "rising", value=0.3)


class Turning(hj.Chart):
    states = ("x", "v")
    further: Callable

    def field(self, t, q, u):
        x, v = q
        return v, (1 - x**2) * v - x + self.further(x) + u[0]


class Turns(hj.HybridSystem):
    further: Callable = eqx.field(static=True)

    def charts(self):
        return {"on": Turning(self.further)}

    def guess(self):
        return hj.Guess("on", (2.0, 0.0))


@pytest.mark.parametrize(
    "further",
    [
        lambda x: 0.01 * jnp.mod(x, 1.0),
        pytest.param(lambda x: 0.01 * jnp.sign(x - 0.1), marks=pytest.mark.slow),
        pytest.param(lambda x: jnp.where(x > 0.7, 0.01, -0.01), marks=pytest.mark.slow),
        pytest.param(lambda x: jnp.arange(9.0)[(x + 3).astype(int)] / 100, marks=pytest.mark.slow),
    ],
)
def test_a_jump_is_refused(further):
    with pytest.raises(
        hj.HybridJaxError, match=r"a field that jumps|jumps by 0\.0.*test_jumps.py:\d"
    ):
        hj.find_limit_cycle(Turns(further), section=RISES)


@pytest.mark.parametrize(
    ("further", "same"),
    [
        pytest.param(
            lambda x: jnp.where(x > 0, 0.1 * x, 0.0),
            lambda x: jnp.maximum(0.1 * x, 0.0),
            marks=pytest.mark.slow,
        ),
        (
            lambda x: jnp.where(x != 0, jnp.sin(x) / jnp.where(x != 0, x, 1.0), 1.0),
            lambda x: jnp.sinc(x / jnp.pi),
        ),
    ],
)
def test_a_continuous_field_is_not(further, same):
    a, b = (hj.find_limit_cycle(Turns(f), section=RISES) for f in (further, same))
    np.testing.assert_allclose(a.multipliers, b.multipliers, rtol=1e-6)


class Switched(Turns):
    """A relay of a height that is zero in the first system."""

    height: hj.Parameter = hj.parameter(0.0)

    def charts(self):
        return {"on": Turning(lambda x: self.height * jnp.mod(x, 1.0))}


@pytest.mark.slow
def test_a_jump_beside_a_cycle_without_one_is_refused():
    first = hj.find_limit_cycle(Switched(None), section=RISES)
    with pytest.raises(hj.DefinitionError, match="jumps by .*test_jumps.py"):
        hj.continuation(first, "height", (0.0, 0.01))
