"""One source, two executors: the host and XLA agree, and the host compiles users' functions only."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj
from hybridjax._core.compilation import compile
from hybridjax._core.compilation.compile import quick_jit
from hybridjax._core.executor import Definition, from_host, on_host, to_host
from hybridjax.engine.events import start_lanes
from hybridjax.engine.jacobian import flow_jacobian
from hybridjax.engine.move import record
from hybridjax.engine.settings import Settings
from hybridjax.engine.tape import IDLE
from hybridjax.engine.target import until
from hybridjax.systems.structure import Structure

from ..conftest import KINEMATIC, OUTPUTS, no_compilation, unchecked_host
from ..fuzz.drawing import STRUCTURES, draw
from ..fuzz.structures import Random


def flow(system, t, chart, q, u, end, settings):
    """A recorded flow of one lane (of either executor's arrays)."""
    return record(
        Structure(system), start_lanes(Structure(system), t, chart, q), u, until(end), settings
    )


compiled_flow = quick_jit(flow)


def agree(system, chart, state, u, begin, duration):
    """Both executors decide the same, and their tapes are the same to rounding."""
    s = Structure(system)
    q = np.zeros((s.d, 1))
    q[: len(state), 0] = state
    start = np.array([begin], float), np.array([chart], np.int32), q
    settings = Settings(1e-9, 1e-9, max_steps=400)
    arguments = (*start, np.reshape(u, (s.nu, 1)), start[0] + duration, settings)
    with unchecked_host():
        host = flow(system, *to_host(arguments))
    assert all(on_host(x) for x in jax.tree_util.tree_leaves(host))
    xla = compiled_flow(system, *from_host(arguments))
    np.testing.assert_array_equal(host.moved.result, xla.moved.result)
    assert np.sum(host.tape.code != IDLE) > 2
    for name in ("code", "chart"):
        np.testing.assert_array_equal(getattr(host.tape, name), getattr(xla.tape, name))
    # Steps amplify the rounding errors of their error estimates.
    np.testing.assert_allclose(host.moved.lanes.t, xla.moved.lanes.t, rtol=1e-12)
    size = 1 + np.abs(xla.moved.lanes.q)
    np.testing.assert_allclose(host.moved.lanes.q / size, xla.moved.lanes.q / size, atol=1e-9)


@pytest.mark.parametrize("name", sorted(hj.models.__all__))
def test_both_agree_on_the_gallery(name):
    system = getattr(hj.models, name)()
    guess = system.guess()
    if guess is None:
        pytest.skip("has no guess of its own")
    period = system.period()
    chart = Structure(system).chart_index(guess.chart)
    duration = 2.0 if period is None else 1.5 * float(period)
    u = np.zeros(len(system.inputs))
    agree(system, chart, np.asarray(guess.state), u, float(guess.time), duration)


@pytest.mark.parametrize("name", sorted(STRUCTURES))
def test_both_agree_on_random_systems(name):
    plan = STRUCTURES[name][0]
    for number in range(2):
        sample = jax.tree_util.tree_map(np.asarray, draw(name, number))
        start = sample.start
        system = from_host(Random(plan, sample.charts, sample.arrows))
        agree(system, 0, start.q, start.u, start.t, 2.0)
