"""Cycles, section maps and linearizations of many systems under `jax.vmap`."""

import functools as ft

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj

from ..conftest import APEX


SECTIONS = hj.ClockPhase(4, anchor=APEX)
STIFFNESS = jnp.array([[9.8, 10.0], [10.1, 10.3]])


def analyze(lossy_cycle, k):
    """Numbers of the lossy hopper with stiffness k: states, A, B, a section map, a mean."""
    hopper = eqx.tree_at(lambda s: s.k, lossy_cycle.system, k)
    cycle = hj.find_limit_cycle(hopper, lossy_cycle)
    placed = hj.sections.place_sections(cycle, SECTIONS)
    ldtp = hj.linearize(cycle, placed, outputs="yM")
    P = hj.sections.section_map(cycle, placed, 1, 3)
    push = 1e-3 * (P.fixed_point != 0)
    arrival = P(P.fixed_point + push, 0.1)
    return {
        "result": cycle.result,
        "states": placed.lanes.q,
        "monodromy": ldtp.monodromy(0)[:4, :4],
        "B": ldtp.B,
        "arrival": arrival.q,
    }


@pytest.mark.slow
def test_many_systems_side_by_side(lossy_cycle):
    """Nested maps over systems equal a loop over them."""
    one = ft.partial(analyze, lossy_cycle)
    loop = jax.jit(one)
    mapped = jax.jit(jax.vmap(jax.vmap(one)))(STIFFNESS)
    for index in np.ndindex(*STIFFNESS.shape):
        alone = loop(STIFFNESS[index])
        assert alone["result"] == hj.errors.Result.OK
        for name, value in alone.items():
            assert_allclose(mapped[name][index], value, atol=1e-9, err_msg=name)
