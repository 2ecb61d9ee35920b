"""Gradients through whole experiments of the lossy hopper, by its parameters and by the input."""

import functools as ft

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj
from hybridjax.engine.settings import Settings
from hybridjax.experiments.plan import make_plan
from hybridjax.experiments.response import course, flow_batch

from ..conftest import APEX, OUTPUTS


PARAMETERS = ("m", "M", "k", "b", "l0", "a", "g")
SETTINGS = Settings(1e-12, 1e-12, 1024, np.ones((2, 4)))
N = 4


@pytest.fixture(scope="module", params=["isochron", "kinematic"])
def experiment(request, lossy_cycle):
    """A function (parameters, inputs (n, nu)) -> (outputs, result) of one experiment."""
    family = {
        "isochron": hj.ClockPhase(N, anchor=APEX),
        "kinematic": hj.KinematicPhase(
            N, position="yM", velocity="vM", center=(1.9, 0.0), scale=(0.3, 1.9), anchor=APEX
        ),
    }[request.param]
    placed = hj.place_sections(lossy_cycle, family)
    plan = make_plan(placed, SETTINGS, 1e-11, np.ones((N, 5)))
    start = jnp.concatenate([placed.lanes.t[None], placed.lanes.q])[:, :1]

    def run(x, u):
        pick = lambda s: [getattr(s, name) for name in PARAMETERS]  # noqa: E731
        system = eqx.tree_at(pick, lossy_cycle.system, list(x))
        other = eqx.tree_at(lambda p: p.cycle.system, placed, system)
        response = flow_batch(course(other, OUTPUTS), plan, start, u[None], SETTINGS)
        return response.y[0], response.result[0]

    return run


@pytest.fixture(scope="module")
def parameters(lossy_cycle):
    return jnp.stack([getattr(lossy_cycle.system, name) for name in PARAMETERS])


def inputs(cycles):
    return 0.1 * jnp.asarray(np.random.default_rng(0).standard_normal((cycles * N, 1)))


def loss(experiment, x, u):
    y, result = experiment(x, u)
    return jnp.sum(y**2), result


def central(f, x, e=1e-4):
    steps = e * np.eye(len(x))
    return np.array([(f(x + d) - f(x - d)) / (2 * e) for d in steps])


@pytest.mark.slow
def test_reverse_and_forward_mode_agree_with_differences(experiment, parameters):
    u = inputs(3)
    f = ft.partial(loss, experiment)
    value = jax.jit(f)
    assert value(parameters, u)[1] == hj.Result.OK
    (by_x, by_u), _ = jax.jit(jax.grad(f, argnums=(0, 1), has_aux=True))(parameters, u)
    forward, _ = jax.jit(jax.jacfwd(f, has_aux=True))(parameters, u)
    np.testing.assert_allclose(forward, by_x, rtol=1e-9)
    true = central(lambda x: value(x, u)[0], parameters)
    np.testing.assert_allclose(by_x, true, rtol=1e-6, atol=1e-6 * np.abs(true).max())
    true = central(lambda v: value(parameters, v[:, None])[0], u[:, 0])
    np.testing.assert_allclose(by_u[:, 0], true, rtol=1e-6, atol=1e-6 * np.abs(true).max())
