"""Validation: fits in percent, tests with the level that they state, amplitude sweeps."""

import equinox as eqx
import numpy as np
import pytest
from scipy import stats

import hybridjax as hj

from .test_series import record
from .test_uncertainty import covered


@pytest.mark.slow
def test_the_true_model_leaves_white_noise(small):
    """P-values are uniform, for unknown starts and missing samples, and for fits to other data,
    and correlations have variance one."""
    p = []
    of_fits = []
    correlations = []
    for seed in range(30):
        data = record(small, 4 * 100, seed, 0.3, first_section=1, x0=np.ones(3))
        rng = np.random.default_rng(seed)
        is_gap = rng.random(data.y.shape) < 0.02
        data.y[is_gap] = np.nan
        found = hj.validate(small, data)
        p.append([found.whiteness, found.independence])
        other = record(small, 4 * 60, 100 + seed, 0.3)
        for fit in (hj.fit_series(other, 2), hj.fit_ldtp(other, initial=small)):
            found = hj.validate(fit, data)
            of_fits.append([found.whiteness, found.independence])
            correlations.append(found.cross_correlation)
    by_seed = np.reshape(p, (30, 2, 2))
    for test in by_seed.transpose(1, 2, 0).reshape(4, 30):
        assert stats.kstest(test, "uniform").pvalue > 1e-3
    accepted = int((np.array(p) > 0.05).sum())
    assert covered(accepted, 120)
    mean_square = np.mean(np.square(correlations))
    np.testing.assert_allclose(mean_square, 1, atol=0.15)
    for test in np.swapaxes(of_fits, 0, 1):
        assert covered(int((test > 0.05).sum()), 120)


def test_the_fit_is_the_share_explained(small):
    data = record(small, 4 * 200, 0, 0.3)
    found = hj.validate(small, data, start="cycle")
    clean = np.asarray(small.simulate(data.u))
    np.testing.assert_allclose(found.simulated, clean, atol=1e-12)
    squares = (data.y - clean) ** 2
    left = np.sqrt(np.mean(squares, axis=0))
    np.testing.assert_allclose(found.noise, left)
    shares = 1 - left / data.y.std(axis=0)
    np.testing.assert_allclose(found.fit, 100 * shares)
    assert found.white
    assert "independence of the input not rejected" in repr(found)


def test_a_wrong_model_is_refused(small):
    data = record(small, 4 * 200, 0, 0.3)
    found = hj.validate(
        eqx.tree_at(lambda m: m.B, small, small.B.at[2].multiply(1.3)), data
    )
    assert found.independence.min() < 1e-6
    assert "independence of the input rejected" in repr(found)
    wrong = eqx.tree_at(lambda m: m.C, small, -small.C)
    turned = hj.validate(wrong, data)
    assert "no better than by the mean cycle: y0, y1" in repr(turned)
    with pytest.raises(
        hj.errors.DefinitionError, match="unstable plant grows without bound"
    ):
        unstable = eqx.tree_at(lambda m: m.A, small, 9 * small.A)
        hj.validate(unstable, data)
    data_of_low = record(small, 4 * 300, 1, 0.1)
    low = hj.fit_series(data_of_low, 1, extra_lags=0, check=False)
    assert not hj.validate(low, data).independent


def test_a_misfit_that_is_called_visible_is_noticed_in_four_of_five_data(small):
    """White noise, and a response to the inputs of the last samples that the model lacks."""
    noticed = 0
    runs = 25
    N = 4
    for seed in range(runs):
        data = record(small, N * 80, seed, 0.5)
        rng = np.random.default_rng(1000 + seed)
        signs = rng.choice([-1.0, 1.0], N)
        section = np.arange(N * 80) % N
        hidden = signs[section] * data.u[:, 0]
        outputs = np.asarray(small.simulate(data.u))
        response = outputs[:, 1]
        size = np.sqrt(np.mean(response**2))
        found = hj.validate(small, data)
        hidden_size = np.sqrt(np.mean(hidden**2))
        data.y[:, 1] += found.visible[1] * size * hidden / hidden_size
        p_value = hj.validate(small, data).independence[1]
        noticed += p_value < found.alpha / 2
    assert covered(noticed, runs, 0.8)
    assert "detectable with 80 % power: " in repr(found)
    few, more = (
        hj.validate(small, record(small, N * n, 0, 0.5)).visible for n in (80, 320)
    )
    np.testing.assert_allclose(more / few, 0.5, rtol=0.15)


@pytest.mark.parametrize("start", ["free", "cycle"])
def test_announced_drift_is_taken_out_of_models_and_fits_alike(small, start):
    """Neither residuals nor p-values of the true model change, however large the drift is."""
    plain = record(small, 4 * 150, 0, 0.3, first_section=1)
    plain.y[5:9, 0] = np.nan
    whole_cycles = (1 + np.arange(4 * 150)) // 4
    cycle = (whole_cycles + 0.5) / 151
    slow = np.cos(np.pi * 3 * cycle)
    sections = np.arange(4 * 150) % 4
    by_section = np.cos(sections)
    wave = 9 * slow * by_section + 7
    about = dict(
        n_sections=4,
        first_section=1,
        outputs=plain.outputs,
        drift=50,
    )
    drift = wave[:, None] * [1.0, -2.0]
    records = (
        hj.experiments.SectionSeries(plain.u, plain.y + k * drift, **about)
        for k in (0, 1)
    )
    still, moved = (hj.validate(small, x, start=start) for x in records)
    np.testing.assert_allclose(moved.noise, still.noise, rtol=1e-3)
    np.testing.assert_allclose(moved.whiteness, still.whiteness, rtol=0.05)
    assert moved.white
    assert moved.independent
    np.testing.assert_allclose(still.noise, 0.3, rtol=0.1)
    unsaid = hj.experiments.SectionSeries(
        plain.u, plain.y + wave[:, None], **dict(about, drift=None)
    )
    assert not hj.validate(small, unsaid, start=start).white


def test_records_shorter_than_the_lags(small):
    """Short pieces count where they can: not where an unknown start explains all of them."""
    whole = record(small, 4 * 100, 0, 0.3)
    pieces = [whole.part(0, 103), whole.part(103, 106), whole.part(106, 400)]
    found = hj.validate(small, pieces)
    assert found.left_out == 1
    assert "compare, left out: 1\n" in repr(found)
    np.testing.assert_array_equal(found.measured, whole.y[106:])
    assert found.white
    assert found.independent
    assert hj.validate(small, pieces, start="cycle").left_out == 0
    with pytest.raises(
        hj.errors.DefinitionError, match="0.75 cycles without gaps are too few"
    ):
        halves = [whole.part(0, 3), whole.part(3, 6)]
        hj.validate(small, halves)
    with pytest.raises(hj.errors.DefinitionError, match="^u is zero or missing"):
        hj.validate(
            small,
            hj.experiments.SectionSeries(
                0 * whole.u, whole.y, n_sections=4, outputs=whole.outputs
            ),
        )
    many = [whole.part(k, k + 2) for k in range(0, 400, 2)]
    validation = hj.validate(small, many, start="cycle")
    assert validation.autocorrelation.shape[1] == 1


def test_nothing_is_simulated_beyond_the_known_inputs(small):
    data = record(small, 4 * 100, 0, 0.3)
    ahead = hj.experiments.SectionSeries(
        data.u, data.y, n_sections=4, outputs=data.outputs, lead=5
    )
    found = hj.validate(small, ahead)
    assert found.simulated.shape == found.measured.shape == (395, 2)
    assert np.isfinite(found.measured).all()
