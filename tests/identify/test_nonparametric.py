"""Non-parametric HTFs: exact identification without noise, failed experiments, bad data."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj

from ..linear.conftest import blocks_at_random


# Dimensions at each section (N even, odd and 1), outputs, inputs, periods.
SHAPES = [((2, 3, 1, 2), 2, 1, 6), ((1, 3, 2), 1, 2, 5), ((2,), 1, 1, 9)]


@settings(max_examples=12)
@given(st.sampled_from(SHAPES), st.integers(0, 99))
def test_any_system_is_identified_exactly(shape, seed):
    dims, ny, nu, periods = shape
    blocks = blocks_at_random(seed, dims, ny, nu)
    model = hj.linear.LDTP.from_blocks(*blocks)
    N = len(dims)
    top = N * periods // 2 / periods
    design = hj.multisine(N, periods, (0, top), 1.0, seed, lines="two-phase", inputs=nu)
    estimate = hj.estimate_htf(
        hj.experiments.simulate_experiments(model, design, start="periodic")
    )
    assert_array_equal(estimate.frequencies, design.frequencies)
    exact = model.htf(estimate.frequencies)
    error = np.abs(estimate.H - exact.H).max()
    assert error < 1e-11 * np.abs(exact.H).max()


def test_two_inputs_may_share_an_experiment_on_different_lines(hopper):
    blocks = blocks_at_random(5, (2, 1, 3), 1, 2)
    model = hj.linear.LDTP.from_blocks(*blocks)
    lines = [[0.1, 0.3], [0.1, 0.3]]
    design = hj.experiments.Design.from_lines(
        lines, 1.0, 0.4, n_sections=3, periods=10, channels=[[0, 1], [1, 0]], inputs=2
    )
    data = hj.experiments.simulate_experiments(model, design, start="periodic")
    estimate = hj.estimate_htf(data, (-1, 0))
    assert estimate.harmonics == (-1, 0)
    expected = model.htf([0.1, 0.3], (-1, 0)).H
    assert_allclose(estimate.H, expected, atol=1e-13)


def test_repeated_frequencies_are_averaged_by_their_power():
    """With y = g u exactly for one experiment and 3 g u for the other."""
    lines = [[0.25]] * 2, [[1.0], [2.0]], [[0.3], [2.0]]
    design = hj.experiments.Design.from_lines(*lines, n_sections=4, periods=4)
    u = design.signals(9)
    gains = np.array([1.0, 3.0])
    y = u * gains[:, None, None]
    estimate = hj.estimate_htf(
        hj.experiments.ExperimentData(u, y, n_sections=4, periods=4)
    )
    measured = estimate[0][0, 0, 0]
    expected = (1 * 1 + 4 * 3) / (1 + 4)
    assert_allclose(measured, expected, atol=1e-13)
    assert_allclose(estimate[1], 0, atol=1e-13)


def failed(data, experiments):
    """The same data, as if these experiments had failed at sample 50."""
    y = data.y.copy()
    result = data.result.copy()
    y[experiments, 50:] = np.nan
    result[experiments] = hj.errors.Result.BLOW_UP
    return dataclasses.replace(data, y=y, result=result)


def test_failed_experiments_are_left_out(paper_data, paper_estimate):
    design = hj.experiments.paper_design()
    data = failed(paper_data, [3, 70])
    is_lost = np.isin(design.experiment, [3, 70])
    lost = np.sort(design.frequency[is_lost])
    estimate = hj.estimate_htf(data)
    assert_array_equal(estimate.frequencies, np.setdiff1d(design.frequencies, lost))
    kept = np.isin(paper_estimate.frequencies, estimate.frequencies)
    assert_array_equal(estimate.H, paper_estimate.H[:, kept])
    with pytest.raises(
        hj.errors.DefinitionError, match="from 0 experiments \\(80 failed"
    ):
        hj.estimate_htf(failed(data, np.arange(80)))


def record(*cosines, n_sections=8, periods=8, cycles=8):
    """One experiment per argument, a list of (f, phase); the output repeats the input."""
    n = np.arange(n_sections * cycles)
    u = [
        sum(np.cos(2 * np.pi * f * n / n_sections + phase) for f, phase in c)
        for c in cosines
    ]
    u = np.stack(u)[..., None]
    return hj.experiments.ExperimentData(u, u, n_sections=n_sections, periods=periods)


def test_half_integers_need_two_phases():
    data = record([(1.5, 0.3), (0.25, 0.0)])
    measured = hj.estimate_htf(data).frequencies
    assert_array_equal(measured, [0.25])
    first = [(1.5, 0.3)]
    second = [(1.5, 0.3 + np.pi)]
    opposite = record(first, second)
    with pytest.raises(
        hj.errors.DefinitionError, match="multiples of 1/2 with two phases"
    ):
        hj.estimate_htf(opposite)
    data = record([(1.5, 0.3)], [(1.5, 0.9)], [(1.5, 2.0)])
    uneven = hj.estimate_htf(data)
    assert_allclose(uneven[0], 1.0, atol=1e-13)
    assert_allclose(uneven[-3], 0.0, atol=1e-13)
    assert_array_equal(uneven.variance_dof.dof, 1)  # (of three for two unknowns)
