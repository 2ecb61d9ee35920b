"""Experiments along a table of legs and events: lanes that do not follow it say so."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

import hybridjax as hj
from hybridjax._core.compilation import Program
from hybridjax.experiments.passage import program
from hybridjax.experiments.response import flow_batch
from hybridjax.experiments.rows import tables
from hybridjax.experiments.run import RunOptions, prepare

from ..conftest import APEX


FAMILY = hj.KinematicPhase(16, "yM", "vM", (1.9, 0.0), (0.3, 1.9), anchor=APEX)
EXPERIMENTS = 24
CYCLES = 5


@pytest.fixture(scope="module")
def campaign():
    """Experiments of the hopper with forces of all sizes: in the last, events change places with
    sections."""
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    sizes = np.linspace(0.005, 0.3, EXPERIMENTS)[:, None, None]
    rng = np.random.default_rng(1)
    draws = rng.normal(size=(EXPERIMENTS, 16 * CYCLES, 1))
    u = sizes * draws
    return prepare(cycle, FAMILY, u, ("yM", "vM"), RunOptions(discard=0))


@pytest.fixture(scope="module")
def responses(campaign):
    """By the search; along the table near the cycle; and along that for other experiments."""
    u = campaign.inputs.part(slice(0, EXPERIMENTS))
    begin = np.asarray(campaign.placed.section_zero)
    start = np.tile(begin[:, None], EXPERIMENTS)
    arguments = campaign._arguments(u, start, slice(0, EXPERIMENTS))
    made = tables(campaign.placed, campaign.stepping.plan)
    assert made is not None
    along = [
        program(*arguments, table.form, table.rows, np.int32(table.count))
        for table in (made.near, made.far)
    ]
    return Program(flow_batch, loops=False)(*arguments), *along


def test_lanes_that_leave_the_table_say_so(campaign, responses):
    """What follows the table is as accurate as planned; some lanes leave it, and some do not."""
    searched, *along = responses
    magnitude = np.abs(np.asarray(searched.y))
    sizes = magnitude.max(axis=(0, 1))
    for part, left in along:
        searched_y = np.asarray(searched.y)
        difference = np.asarray(part.y) - searched_y
        error = np.abs(difference) / sizes
        follows = ~np.asarray(left)
        assert 0 < follows.sum() < EXPERIMENTS
        assert (np.asarray(searched.result)[follows] == 0).all()
        assert error[follows].max() < 2 * campaign.stepping.accuracy


def test_an_event_may_change_places_with_a_section(responses):
    """With rows for an event in the intervals beside its own, and shorter steps, fewer leave."""
    _, (_, near), (_, far) = responses
    far_alone = np.asarray(far) & ~np.asarray(near)
    assert not far_alone.any()
    far_count = np.asarray(far).sum()
    assert far_count < np.asarray(near).sum()


@pytest.mark.slow
def test_experiments_that_leave_the_table_are_run_again(campaign, responses):
    """`run` returns what a search finds, whatever the table can follow."""
    searched = responses[0]
    data = campaign.run()
    on_cycle = np.resize(data.cycle_outputs, data.y.shape[1:])
    y = data.y + on_cycle
    assert_array_equal(data.result, searched.result)
    magnitude = np.abs(np.asarray(searched.y))
    sizes = magnitude.max(axis=(0, 1))
    apart = np.abs(y - searched.y) / sizes
    error = np.nanmax(apart)
    assert error < 2e-9


def test_other_inputs_and_parameters_compile_nothing(campaign):
    """Inputs, rows, steps and parameters are arguments of one program."""
    from hybridjax._core import compilation

    campaign.run()
    count = len(compilation._by_text)
    other = hj.find_limit_cycle(hj.models.VerticalHopper(k=10.5))
    none = jnp.zeros((EXPERIMENTS, 16 * CYCLES, 1))
    u = none + 1e-3
    hj.run_experiments(other, FAMILY, u, ("yM", "vM"), discard=0)
    assert len(compilation._by_text) == count
