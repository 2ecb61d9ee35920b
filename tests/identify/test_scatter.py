"""Variances of estimates: noise, distortion, degrees of freedom, and when they cannot be had."""

import numpy as np
import pytest
from scipy import stats

import hybridjax as hj
from hybridjax.identify.htf_estimate import roundness
from hybridjax.identify.weights import estimated_noise


N = 4
P = 16
LINES = hj.multisine(N, P, (0, 2.0), 0.1, experiments=4)


@pytest.fixture(scope="module")
def model():
    rng = np.random.default_rng(0)
    A = 0.6 * rng.normal(size=(N, 2, 2))
    B = rng.normal(size=(N, 2, 1))
    C = rng.normal(size=(N, 2, 2))
    return hj.linear.LDTP(A, B, C)


def realized(model, count, repeats=1, noise=0.0, seed=0, process_noise=0.0):
    options = dict(start="periodic", discard=(repeats - 1) * P)
    options["process_noise"] = hj.experiments.ProcessNoise(process_noise, seed)
    design = LINES.realizations(count, seed)
    data = hj.experiments.simulate_experiments(model, design, **options)
    return hj.experiments.add_noise(data, std=noise, seed=seed)


def inside(model, count, repeats, variance, runs=40, **more):
    """How often discs of 95 % hold the true value, of how many: H_0 at every third line."""
    hits = []
    for seed in range(runs):
        data = realized(model, count, repeats, seed=seed, **more)
        estimate = hj.estimate_htf(data, 0, repeats=repeats, variance=variance)
        exact = model.htf(estimate.frequencies, 0)[0]
        error = np.abs(estimate[0] - exact)
        is_inside = error <= estimate.confidence_radius()[0]
        hits.append(is_inside[::3])
    return np.sum(hits), np.size(hits)


@pytest.mark.parametrize(
    "count, repeats, variance, noise",
    [
        (2, 1, "total", dict(noise=0.3)),
        (5, 1, "total", dict(process_noise=0.02)),
        (1, 2, "noise", dict(noise=0.3)),
        (2, 3, "noise", dict(noise=0.1, process_noise=0.02)),
    ],
)
def test_discs_hold_the_truth_as_often_as_they_say(
    model, count, repeats, variance, noise
):
    hits, of = inside(model, count, repeats, variance, **noise)
    assert stats.binomtest(int(hits), of, 0.95).pvalue > 1e-3


@pytest.mark.parametrize("R", [2, 3, 4, 8])
@pytest.mark.parametrize("constant, noise", [(0, 1), (1, 0), (1, 0.3), (1, 1)])
def test_discs_whatever_the_errors_are(constant, noise, R):
    """Products of two cosines are of constant size. Of such errors without noise discs that look at
    sizes alone hold 90 % (three realizations), 92 % (four), 94 % (eight); two tell no more."""
    rng = np.random.default_rng(R)
    runs = 20_000
    turns = rng.random((R, runs))
    phases = 2 * np.pi * turns
    draws = rng.normal(size=(R, runs, 2))
    parts = np.sqrt(0.5) * draws
    bias = constant * np.exp(1j * phases)
    error = bias + noise * parts @ [1, 1j]
    shares = np.full((R, 1), 1 / R)
    if constant == 0:
        # Of experiments of different strengths; Gaussian errors know nothing of it.
        concentration = np.full(R, 3.0)
        shares = rng.dirichlet(concentration)[:, None]
        error /= np.sqrt(shares)
    mean = np.sum(shares * error, axis=0)
    residuals = np.sqrt(shares) * (error - mean)
    square = (np.abs(residuals) ** 2).sum(axis=0)
    turned = (residuals**2).sum(axis=0)
    variance = square / (R - 1)
    number = np.full(runs, 1.0 * R)
    shape = roundness(square, turned, number)
    dof = np.full(runs, R - 1.0)
    by_line = shape[None, :, None, None]
    variance_dof = hj.linear.VarianceDof(dof, by_line)
    for level in (0.5, 0.8, 0.95, 0.99):
        quantiles = np.asarray(variance_dof.quantile(level))
        quantile = quantiles[0, :, 0, 0]
        inside = np.abs(mean) ** 2 <= quantile * variance
        if constant == 0:
            count = int(inside.sum())
            assert stats.binomtest(count, runs, level).pvalue > 1e-3
        elif R > 3 and level == 0.95:
            assert 0.935 < inside.mean() < 0.965
    if R == 2:
        np.testing.assert_array_equal(shape, 1)


def test_the_parts_of_the_variance(model):
    """White noise: both parts are the same; their mean is the formula of the design."""
    data = realized(model, 40, 8, noise=0.2)
    estimate = hj.estimate_htf(data, repeats=8)
    np.testing.assert_array_equal(estimate.variance_dof.dof, 39)
    one_block = LINES.expected_variance(0.2, repeats=8)
    once = one_block[0, 0] / 40
    np.testing.assert_allclose(np.mean(estimate.variance), once, rtol=0.03)
    np.testing.assert_allclose(np.mean(estimate.noise_variance), once, rtol=0.03)
    alone = hj.estimate_htf(data, repeats=8, variance="noise")
    np.testing.assert_array_equal(alone.variance, estimate.noise_variance)
    np.testing.assert_array_equal(alone.variance_dof.dof, 40 * 7)
    assert alone.noise_variance is None


def test_distortion_is_what_noise_is_not(model):
    """y = linear + cube of the input: realizations scatter, repeated periods do not."""
    data = realized(model, 20, 2)
    bent = hj.experiments.ExperimentData(
        data.u, data.y + 5 * data.u**3, n_sections=N, periods=P
    )
    estimate = hj.estimate_htf(bent, (0,), repeats=2)
    assert np.all(estimate.noise_variance < 1e-25)
    assert np.all(estimate.variance > 1e-8)
    exact = model.htf(estimate.frequencies, 0)[0]
    # The best linear approximation is not the linear part, by 3 u^3 -> 9 var(u) u for many lines.
    error = np.abs(estimate[0] - exact)
    assert np.all(error > estimate.confidence_radius()[0])


def test_sums_of_parts_are_those_of_the_whole(model):
    data = realized(model, 4, 2, noise=0.1)
    parts = [
        hj.experiments.ExperimentData(
            data.u[k : k + 4], data.y[k : k + 4], n_sections=N, periods=P
        )
        for k in range(0, 16, 4)
    ]
    one = hj.estimate_htf(data, repeats=2)
    many = hj.estimate_htf(parts, repeats=2)
    for name in ("H", "variance", "noise_variance"):
        of_many = getattr(many, name)
        np.testing.assert_allclose(of_many, getattr(one, name), rtol=1e-9)
    np.testing.assert_array_equal(many.variance_dof.dof, one.variance_dof.dof)
    np.testing.assert_allclose(
        many.variance_dof.roundness, one.variance_dof.roundness, rtol=1e-9
    )


def test_a_failed_realization_leaves_the_others(model):
    data = realized(model, 2, noise=0.1)
    result = np.zeros(len(data.u), int)
    result[0] = hj.errors.Result.BLOW_UP
    data = hj.experiments.ExperimentData(
        data.u, data.y, n_sections=N, periods=P, result=result
    )
    estimate = hj.estimate_htf(data)
    of_first = LINES.frequency[LINES.experiment == 0]
    lost = np.isin(estimate.frequencies, of_first)
    of_lost = np.mean(estimate.variance[:, lost])
    of_others = np.mean(estimate.variance[:, ~lost])
    ratio = of_lost / of_others
    assert ratio == pytest.approx(2, rel=0.3)  # of one experiment instead of two
    np.testing.assert_array_equal(
        estimate.variance_dof.dof, np.where(lost, (~lost).sum(), 1)
    )
    with pytest.raises(
        hj.errors.DefinitionError,
        match="single realization, as at f = .* does not show",
    ):
        hj.estimate_htf(data, variance="total")


def test_pairs_cancel_even_distortion(model):
    design = LINES.realizations(3).with_negatives()
    data = hj.experiments.simulate_experiments(model, design, start="periodic")
    bent = hj.experiments.ExperimentData(
        data.u, data.y + 0.3 * data.u**2, n_sections=N, periods=P
    )
    estimate = hj.estimate_htf(bent.odd_part())
    error = estimate.error(model.htf(estimate.frequencies))
    assert error.max() < 1e-12
    with pytest.raises(
        hj.errors.DefinitionError, match="experiments 0 and 1 are no pair"
    ):
        realized(model, 2).odd_part()


def test_a_pair_with_a_failed_member_is_a_failed_one(model):
    """Its inputs may be unknown."""
    design = LINES.realizations(2).with_negatives()
    data = hj.experiments.simulate_experiments(model, design, start="periodic")
    inputs = np.array(data.u)
    inputs[1] = np.nan
    result = np.zeros(len(inputs), int)
    result[1] = hj.errors.Result.BLOW_UP
    broken = hj.experiments.ExperimentData(
        inputs, data.y, n_sections=N, periods=P, result=result
    )
    pairs = broken.odd_part()
    assert not pairs.ok[0]
    assert pairs.ok[1:].all()


def test_noise_by_its_ratio(model):
    data = realized(model, 1, 4)
    noisy = hj.experiments.add_noise(data, snr=20, seed=3)
    noise = np.var(noisy.y - data.y, axis=(0, 1))
    power = np.mean(data.y**2, axis=(0, 1))
    ratio = noise / power
    np.testing.assert_allclose(ratio, 0.01, rtol=0.2)


def test_repeated_phases_show_no_distortion(model):
    data = realized(model, 1, noise=0.1)
    twice = [np.concatenate([x, x + 1e-3 * k]) for k, x in ((0, data.u), (1, data.y))]
    with pytest.raises(hj.errors.DefinitionError, match="repeat the same phases"):
        hj.estimate_htf(
            hj.experiments.ExperimentData(*twice, n_sections=N, periods=P),
            variance="total",
        )


@pytest.mark.parametrize("dof", [3, 8])
def test_weights_from_estimated_variances_widen_the_errors_of_fits(dof):
    """One unknown, 300 lines: the misfit shows the factor of the variance of its estimate."""
    rng = np.random.default_rng(0)
    weight = dof / rng.gamma(dof, size=(4000, 300))
    error = rng.normal(size=weight.shape)
    total = weight.sum(axis=1)
    estimate = (weight * error).sum(axis=1) / total
    squares = (error - estimate[:, None]) ** 2
    misfit = np.mean(weight * squares) * 300 / 299
    _, deviation = estimated_noise(dof / (dof - 1), misfit)
    weights = weight.sum(axis=1)
    expected = np.mean(1 / weights)
    actual = np.mean(estimate**2) / expected
    assert actual == pytest.approx(
        deviation**2, rel=0.12
    )  # (freedom / (freedom - 2) at most)


def test_fits_know_of_estimated_variances(model):
    exact = model.htf(np.arange(1, 32) / 16)
    H = np.asarray(exact.H)
    rng = np.random.default_rng(0)
    drawn = rng.normal(size=(2, *H.shape))
    shapes = np.random.default_rng(1).gamma(4, size=H.shape)
    variance = 0.1 * shapes
    fits = [
        hj.fit_ldtp(
            hj.linear.HTF(
                exact.frequencies,
                H + np.sqrt(0.2) * (drawn[0] + 1j * drawn[1]),
                exact.harmonics,
                N,
                exact.inputs,
                exact.outputs,
                "estimate",
                variance=variance,
                variance_dof=variance_dof,
            ),
            2,
        )
        for variance_dof in (hj.linear.VarianceDof(np.full(31, x)) for x in (4.0, 1e9))
    ]
    level = fits[0].cost / fits[0].dof
    ratio = fits[0].covariance / fits[1].covariance
    np.testing.assert_allclose(ratio, level / (2 - level), rtol=1e-6)
    assert level > 1.02
