import numpy as np
import pytest

import hybridjax as hj
from hybridjax.identify.multiplier_estimate import MultiplierEstimate


@pytest.fixture(scope="module")
def found(hopper):
    u = 0.02 * np.random.default_rng(0).normal(size=(32 * 40, 1))
    y = np.asarray(hopper.simulate(u))
    y = y + 0.1 * y.std(axis=0) * np.random.default_rng(1).normal(size=y.shape)
    return hj.validate(hopper, hj.Record(u, y, n_sections=32, outputs=("yM", "vM")))


def test_validation_draws_signals_and_correlations(found):
    figure = hj.plot.validation(found, cycles=2, labels={"vM": "speed"}).figure
    grid = np.reshape(figure.axes, (2, 3))
    simulated, measured = grid[1, 0].get_lines()
    np.testing.assert_array_equal(simulated.get_ydata(), found.simulated[-64:, 1])
    np.testing.assert_array_equal(measured.get_ydata(), found.measured[-64:, 1])
    np.testing.assert_allclose(measured.get_xdata(), 38 + np.arange(64) / 32)
    assert grid[1, 0].get_ylabel() == r"$\delta$ speed"
    assert grid[0, 0].get_title() == f"fit {found.fit[0]:.2f} %"
    for k, values in ((1, found.autocorrelation[:, :, 0]), (2, found.cross_correlation[:, :, 0])):
        heights = [path.vertices[1, 1] for path in grid[0, k].collections[0].get_paths()]
        np.testing.assert_allclose(heights, values.sum(axis=0).ravel() / np.sqrt(32), atol=1e-12)


def test_regions_are_drawn_around_estimates(hopper):
    true = hopper.multipliers
    c = np.poly(true).real[1:]
    estimate = MultiplierEstimate(true * 1.01, c, 1e-4 * np.eye(2), np.inf)
    ax = hj.plot.multipliers(hopper, {"fit": estimate}).ax
    (inset,) = ax.child_axes
    drawn = [line.get_xydata() for line in inset.get_lines() if len(line.get_xdata()) == 100]
    np.testing.assert_array_equal(drawn[0] @ [1, 1j], estimate.ellipse(0))
    (left, right), (low, high) = inset.get_xlim(), inset.get_ylim()
    border = estimate.ellipse(0)
    assert left < border.real.min() < border.real.max() < right
    assert low < border.imag.min() < border.imag.max() < high
