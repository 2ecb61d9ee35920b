"""Transients taken out of records: exact for linear systems, and what is refused."""

import numpy as np
import pytest

import hybridjax as hj
from hybridjax.experiments.data import Simulated

from ..linear.conftest import hopper as hopper


@pytest.fixture(scope="module")
def full():
    return hj.multisine(periods=12, frequencies=(0, 3.0))


def errors(model, data, harmonics=(-1, 0, 1)):
    estimate = hj.estimate_htf(data, harmonics)
    exact = model.htf(estimate.frequencies, harmonics)
    error = np.abs(estimate.H - exact.H).max()
    size = np.abs(exact.H).max()
    return float(error / size)


def test_the_transient_of_a_linear_system_is_removed_exactly(hopper, full):
    """The window begins one period after the start."""
    odd = hj.experiments.Design.from_lines(
        [[j / 16] for j in range(1, 48, 2)], n_sections=32, periods=16
    )
    for design, discard in ((full, 10), (odd, 1)):
        data = hj.experiments.simulate_experiments(hopper, design, discard=discard)
        assert data.window.start == 32 * discard
        assert errors(hopper, data) > 1e-3
        fit = hj.identify.remove_transient(data, 2)
        assert errors(hopper, fit.data) < 1e-9
        error = np.abs(fit.multipliers - hopper.multipliers).max()
        assert error < 1e-8
        cycles = data.u.shape[1] - 32
        assert fit.data.u.shape[1] == cycles
        assert "removed rms up to" in repr(fit)


def test_noise_is_not_mistaken_for_a_transient(hopper, full):
    """The order is found, and the estimate is as good as that of records without a transient."""
    rest = hj.experiments.simulate_experiments(hopper, full, discard=12)
    data = hj.experiments.add_noise(rest, snr=30, seed=1)
    still = hj.experiments.simulate_experiments(
        hopper, full, start="periodic", discard=12
    )
    still = hj.experiments.ExperimentData(
        still.u, still.y + data.y - rest.y, n_sections=32, periods=12
    )
    fit = hj.identify.remove_transient(data)
    assert len(fit.multipliers) == 2
    error = np.abs(fit.multipliers - hopper.multipliers).max()
    assert error < 0.03
    with_transient = errors(hopper, still)
    assert errors(hopper, fit.data) < 1.2 * with_transient


def test_failed_experiments_stay_out(hopper, full):
    data = hj.experiments.simulate_experiments(hopper, full, discard=10)
    result = np.zeros(len(data.u), int)
    y = data.y.copy()
    result[2] = hj.errors.Result.BLOW_UP
    y[2, 50:] = np.nan
    causes = ["" for _ in result]
    causes[2] = "it fell"
    failed_at = np.where(result, 50, -1)
    plant = Simulated(failed_at, late=y[..., 0], causes=tuple(causes))
    data = hj.experiments.ExperimentData(
        data.u, y, n_sections=32, periods=12, result=result, simulated=plant
    )
    fit = hj.identify.remove_transient(data, 2)
    assert "#2: section 18, cycle 0: it fell" in fit.data.summary()
    np.testing.assert_array_equal(fit.data.simulated.late, y[:, 32:, 0])
    assert np.isnan(fit.removed[2]).all()
    assert np.isfinite(fit.removed[3]).all()
    estimate = hj.estimate_htf(fit.data, 0)
    exact = hopper.htf(estimate.frequencies, 0)[0]
    error = np.abs(estimate[0] - exact).max()
    assert error < 1e-9
