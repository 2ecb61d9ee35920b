"""Gradients through whole experiments of the lossy hopper, by its parameters and by the input."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj

from ..conftest import APEX, KINEMATIC, OUTPUTS


N = 4
FAMILIES = {
    "isochron": hj.ClockPhase(N, anchor=APEX),
    "kinematic": dataclasses.replace(KINEMATIC, n_sections=N),
}


def pick(hopper):
    return [getattr(hopper, name) for name in ("m", "M", "k", "b", "l0", "a", "g")]


def central(f, x, e=1e-4):
    steps = e * np.eye(len(x))
    return np.array([(f(x + d) - f(x - d)) / (2 * e) for d in steps])


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_reverse_and_forward_mode_agree_with_differences(family, lossy_cycle):
    response = hj.response_function(lossy_cycle, FAMILIES[family], OUTPUTS, accuracy=1e-11)
    parameters = jnp.stack(pick(lossy_cycle.system))
    u = 0.1 * jnp.asarray(np.random.default_rng(0).standard_normal(3 * N))

    def loss(x, u):
        system = eqx.tree_at(pick, lossy_cycle.system, list(x))
        found = response(u[None, :, None], system=system)
        return jnp.sum(found.y**2), found.result[0]

    value = jax.jit(loss)
    assert value(parameters, u)[1] == hj.Result.OK
    (by_x, by_u), _ = jax.jit(jax.grad(loss, argnums=(0, 1), has_aux=True))(parameters, u)
    forward, _ = jax.jit(jax.jacfwd(loss, has_aux=True))(parameters, u)
    np.testing.assert_allclose(forward, by_x, rtol=1e-9)
    true = central(lambda x: value(x, u)[0], parameters)
    np.testing.assert_allclose(by_x, true, rtol=1e-6, atol=1e-6 * np.abs(true).max())
    true = central(lambda u: value(parameters, u)[0], u)
    np.testing.assert_allclose(by_u, true, rtol=1e-6, atol=1e-6 * np.abs(true).max())
