"""Jacobians that the host multiplies, against differences of its flow."""

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from hybridjax._core.executor import from_host
from hybridjax.engine.lanes import start_lanes
from hybridjax.engine.move import Options, move
from hybridjax.engine.replay import chain
from hybridjax.engine.settings import Settings
from hybridjax.engine.target import until
from hybridjax.systems.structure import Structure

from ..conftest import unchecked_host
from ..fuzz.drawing import STRUCTURES, draw
from ..fuzz.structures import Random
from .test_executors import slow_but


STEP = 1e-6


def flow(s, t, q, u, end):
    """(t, q) at the end, the lanes at the start, the target and the tape."""
    charts = np.zeros(1, np.int32)
    times = np.array([t])
    lanes = start_lanes(s, times, charts, q[:, None])
    target = until(np.array([end]))
    sizes = np.ones((len(s.charts), s.d))
    settings = Settings(1e-12, 1e-12, 2000, sizes)
    options = Options(True, tangents=True)
    inputs = u[:, None]
    done = move(s, lanes, inputs, target, settings, options=options)
    moved = done.moved.lanes
    state = moved.q[:, 0]
    after = np.concatenate([moved.t, state])
    return after, lanes, target, done


def events_of(done):
    codes = done.tape.code[:, 0]
    return codes[codes >= 0]


@pytest.mark.parametrize("name", slow_but(STRUCTURES, ("ladder",)))
def test_jacobians_are_the_slopes_of_the_flow(name):
    """By the time, the state and the input at the start, through events and schedules; charts'
    fields and guards depend on time, and resets on the input."""
    sample = jax.tree_util.tree_map(np.asarray, draw(name, 1))
    plan = STRUCTURES[name][0]
    system = Random(plan, sample.charts, sample.arrows)
    s = Structure(from_host(system))
    # x holds the time, the states (padded) and the inputs at the start.
    x = np.zeros(1 + s.d + s.nu)
    x[0] = sample.start.t
    used = slice(1, 1 + len(sample.start.q))
    x[used] = sample.start.q
    end = sample.start.t + 3.0

    def run(x):
        q = x[1 : 1 + s.d]
        u = x[1 + s.d :]
        return flow(s, x[0], q, u, end)

    states = range(1, 1 + s.dims[0])
    inputs = range(1 + s.d, len(x))
    with unchecked_host():
        _, lanes, target, done = run(x)
        found = chain(s, lanes, target, done.tape, of_states=False)
        jacobian = found[0][0]
        events = events_of(done)
        assert len(events) > 0
        for k in (0, *states, *inputs):
            step = np.zeros(len(x))
            step[k] = STEP
            above, *_, done_above = run(x + step)
            below, *_, done_below = run(x - step)
            assert_array_equal(events_of(done_above), events)
            assert_array_equal(events_of(done_below), events)
            slope = (above - below) / (2 * STEP)
            tolerance = 1e-6 * (1 + np.abs(slope).max())
            assert_allclose(
                jacobian[:, k], slope, rtol=0, atol=tolerance, err_msg=f"by x[{k}]"
            )
