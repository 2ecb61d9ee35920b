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
    lanes = start_lanes(s, np.array([t]), np.zeros(1, np.int32), q[:, None])
    target = until(np.array([end]))
    sizes = np.ones((len(s.charts), s.d))
    settings = Settings(1e-12, 1e-12, 2000, sizes)
    done = move(
        s, lanes, u[:, None], target, settings, options=Options(True, tangents=True)
    )
    moved = done.moved.lanes
    return np.concatenate([moved.t, moved.q[:, 0]]), lanes, target, done


@pytest.mark.parametrize("name", slow_but(STRUCTURES, ("ladder",)))
def test_jacobians_are_the_slopes_of_the_flow(name):
    """By the time, the state and the input at the start, through events and schedules; charts'
    fields and guards depend on time, and resets on the input."""
    sample = jax.tree_util.tree_map(np.asarray, draw(name, 1))
    s = Structure(from_host(Random(STRUCTURES[name][0], sample.charts, sample.arrows)))
    x = np.concatenate([[sample.start.t], np.zeros(s.d), np.zeros(s.nu)])
    x[1 : 1 + len(sample.start.q)] = sample.start.q
    end = sample.start.t + 3.0

    def run(x):
        return flow(s, x[0], x[1 : 1 + s.d], x[1 + s.d :], end)

    with unchecked_host():
        _, lanes, target, done = run(x)
        exact = chain(s, lanes, target, done.tape, of_states=False)[0][0]
        codes = done.tape.code[:, 0]
        for k in range(len(x)):
            if 1 + s.dims[0] <= k < 1 + s.d:
                continue  # no state of the first chart
            ends = []
            for sign in (1, -1):
                after, *_, other = run(x + sign * STEP * (np.arange(len(x)) == k))
                happened = other.tape.code[:, 0]
                assert_array_equal(happened[happened >= 0], codes[codes >= 0])
                ends.append(after)
            slope = (ends[0] - ends[1]) / (2 * STEP)
            size = 1 + np.abs(slope).max()
            assert_allclose(exact[:, k] / size, slope / size, atol=1e-6, err_msg=str(k))
    assert (codes >= 0).any()
