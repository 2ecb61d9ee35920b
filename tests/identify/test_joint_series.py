"""`fit_ldtp` of series: output error and innovations, gaps, starts, and the noise it finds."""

import dataclasses

import equinox as eqx
import numpy as np
import pytest
from scipy import stats

import hybridjax as hj
from hybridjax.identify.periodic import PeriodicModel, local_coordinates
from hybridjax.identify.series.prediction import (
    SeriesPart,
    SeriesProblem,
    noise_spectrum,
)
from hybridjax.identify.series.records import CycleGrid
from hybridjax.identify.series.residuals import about_answers, about_misfit

from .conftest import scaled
from .test_series import record
from .test_uncertainty import covered


ONE = np.ones(2)


def driven(model, size, sensor=0.1):
    """Noise that enters where the inputs do, and noise of the sensors."""
    shape = (model.n_sections, 2, 2)
    still = np.broadcast_to(sensor * np.eye(2), shape)
    before_inputs = model.B.shape[:2]
    none = np.zeros((*before_inputs, 2))
    B = np.concatenate([size * model.B, none], axis=2)
    D = np.concatenate([size * model.D, still], axis=2)
    return hj.linear.LDTP(model.A, B, model.C, D, model.dims, outputs=model.outputs)


def noisy(model, noise, cycles, seed):
    rng = np.random.default_rng(seed)
    n = model.n_sections * cycles
    before = 20 * model.n_sections
    u, w = (rng.normal(size=(n + before, len(x.inputs))) for x in (model, noise))
    clean = model.simulate(u)
    y = np.asarray(clean + noise.simulate(w))
    about = dict(n_sections=model.n_sections, outputs=model.outputs)
    recorded_u = u[before:]
    return hj.experiments.SectionSeries(recorded_u, y[before:], **about)


def with_gaps(whole, share, seed):
    rng = np.random.default_rng(seed)
    is_gap = rng.random(whole.y.shape) < share
    whole.y[is_gap] = np.nan
    return whole


@pytest.fixture(scope="module")
def gappy(small):
    """Three short records that start at different sections, a twentieth of the samples missing."""
    whole = (record(small, 48 + k, k, 0.1, first_section=k) for k in range(3))
    return [with_gaps(x, 0.05, k) for k, x in enumerate(whole)]


def in_innovation_form(model, seed=0):
    rng = np.random.default_rng(seed)
    model = PeriodicModel.of(model, ONE)
    gains = [0.1 * rng.normal(size=(len(A), 2)) for A in model.A]
    return model._replace(K=gains)


COVARIANCES = np.array([[1, 0.3], [0.3, 0.5]]) * np.arange(1, 5)[:, None, None]


def test_predictions_are_those_of_the_recursion_sample_by_sample(small, gappy):
    """A missing output's error is the mean given the other's."""
    part = SeriesPart.of(CycleGrid.from_records(gappy), ONE)
    model = in_innovation_form(small)
    problem = SeriesProblem([part], COVARIANCES, True, False, 0)
    path = problem.path(model, part)
    for r, one in enumerate(gappy):
        x = np.zeros(model.dims[r])
        for t, (u, y) in enumerate(zip(one.u, one.y, strict=True)):
            cycle, n = divmod(r + t, 4)
            by_state = model.C[n] @ x
            at_once = model.D[n] @ u
            e = y - by_state - at_once
            seen = np.isfinite(e)
            S = COVARIANCES[n]
            of_seen = S[np.ix_(seen, seen)]
            weighted = np.linalg.solve(of_seen, e[seen])
            mean = S[:, seen] @ weighted
            np.testing.assert_allclose(
                path.error[n][r, cycle], np.where(seen, e, 0.0), atol=1e-11
            )
            carried = model.A[n] @ x
            forced = model.B[n] @ u
            x = carried + forced + model.K[n] @ mean


@pytest.mark.parametrize("free", (True, False))
@pytest.mark.parametrize("drift", (None, np.inf))
def test_the_gradient_is_that_of_the_cost(small, gappy, free, drift):
    """With errors of outputs that depend on each other."""
    records = [dataclasses.replace(r, y=r.y + 3.0, drift=drift) for r in gappy]
    part = SeriesPart.of(CycleGrid.from_records(records), ONE)
    problem = SeriesProblem([part], COVARIANCES, True, free, 0)
    coordinates = local_coordinates(in_innovation_form(small), True)
    step = np.random.default_rng(1).normal(size=coordinates.size)
    ahead, back = (problem.cost(coordinates.moved(h * step)) for h in (1e-6, -1e-6))
    gradient = problem.linearize(coordinates).gradient
    by_differences = (ahead - back) / 2e-6
    slope = -2 * gradient @ step
    assert by_differences == pytest.approx(slope, rel=1e-5)


@pytest.mark.parametrize("start", ("free", "cycle"))
def test_series_without_noise_are_met_exactly(small, start):
    x0 = np.ones(3) if start == "free" else None
    whole_record = record(small, 4 * 60 + 3, 0, first_section=1, x0=x0)
    data = with_gaps(whole_record, 0.02, 0)
    fit = hj.fit_ldtp(
        data, initial=eqx.tree_at(lambda m: m.B, small, 1.05 * small.B), start=start
    )
    assert fit.compare(small.multipliers).max_error < 1e-9
    f = np.array([0.1, 0.4])
    error = fit.htf(f).error(small.htf(f))
    assert error.max() < 1e-9
    coordinates = local_coordinates(PeriodicModel.of(small, ONE), True)
    assert fit.unknowns == coordinates.size


def test_a_drift_is_found_where_samples_are_missing(small):
    """A constant at each section, of each output."""
    whole = record(small, 4 * 60, 0)
    levels = np.arange(8.0).reshape(4, 2)
    y = whole.y + np.tile(levels, (60, 1))
    data = with_gaps(
        hj.experiments.SectionSeries(whole.u, y, n_sections=4, drift=np.inf), 0.05, 0
    )
    fit = hj.fit_ldtp(
        data, initial=eqx.tree_at(lambda m: m.B, small, 1.05 * small.B), start="cycle"
    )
    assert fit.compare(small.multipliers).max_error < 1e-9
    samples = np.isfinite(data.y).sum()
    assert fit.dof == samples - 8 - fit.unknowns  # (8 constants)


@pytest.mark.slow
def test_too_few_dimensions_are_named(small):
    """Of plants with strong noise, and of exact ones (residuals are rounding); too many, too."""
    for noise, spare in ((0.3, "dimension less"), (0.0, "not determine")):
        for dims, doubt in (
            (small.dims, ""),
            (2, "depend on the inputs"),
            (small.dims + 1, spare),
        ):
            data = record(small, 4 * 300, 0, noise)
            fit = hj.fit_ldtp(data, dims)
            assert doubt in repr(fit.findings)
            assert bool(doubt) == bool(fit.findings)


@pytest.mark.parametrize("through", (0.0, 1.0))
@pytest.mark.slow
def test_inputs_that_their_past_determines(through):
    """Only fits with D and without it tell whether outputs answer two lines at once."""
    model = scaled(5, (2, 2, 2), 1, 1)
    model = eqx.tree_at(lambda m: m.D, model, through * model.D)
    u = np.cos(2 * np.pi / 3 * np.outer(np.arange(1200), (0.3, 1.1))).sum(
        axis=1, keepdims=True
    )
    draws = np.random.default_rng(0).normal(size=u.shape)
    noise = 0.03 * draws
    data = hj.experiments.SectionSeries(
        u, np.asarray(model.simulate(u)) + noise, n_sections=3
    )
    fit = hj.fit_ldtp(data, 2, noise="innovations", check=False)
    has_direct = bool(np.asarray(fit.model.D).any())
    assert has_direct == bool(through)


def test_residuals_of_exact_data_tell_nothing(small):
    """What depends on the input, but is rounding."""
    data = record(small, 4 * 100, 0)
    grid = CycleGrid.from_records([data])
    response = grid.u[..., :1] + 0.1 * np.random.default_rng(0).normal(
        size=grid.y.shape
    )
    for size, told in ((1e-3, True), (1e-13, False)):
        found = about_misfit(grid, grid, size * response, False, direct=True)
        assert bool(found) == told == ("noise='innovations'" in repr(found))
    in_order = response.reshape(1, -1, 2)
    feedback = np.roll(in_order, 1, axis=1).reshape(response.shape)
    assert not about_answers(grid, 1e-13 * feedback, ("u",), "")


def test_outputs_that_do_not_answer_are_refused(small):
    data = record(small, 4 * 60, 0)
    noise = hj.experiments.SectionSeries(
        data.u, np.random.default_rng(0).normal(size=data.y.shape), n_sections=4
    )
    with pytest.raises(
        hj.errors.DefinitionError, match="the outputs do not answer the inputs"
    ):
        hj.fit_ldtp(noise, initial=small)


def test_periodic_series_and_their_htfs_agree(small):
    """One steady window of a multisine, in the time and in the frequency domain."""
    design = hj.multisine(
        periods=32, n_sections=4, frequencies=(0, 2), lines="odd", seed=0
    )
    data = hj.experiments.simulate_experiments(small, design, start="periodic")
    rng = np.random.default_rng(0)
    data = eqx.tree_at(
        lambda d: d.y, data, data.y + 0.05 * rng.normal(size=data.y.shape)
    )
    in_time = hj.fit_ldtp(data, initial=small)
    htf = hj.estimate_htf(data)
    spectrum = in_time.noise_spectrum(htf.frequencies[:1], (0,))
    sigma = np.sqrt(spectrum[0, 0])
    by_line = design.expected_variance(1.0)[:, None, :]
    each = by_line * sigma[:, None] ** 2
    each = np.broadcast_to(each, htf.H.shape)
    htf = hj.linear.HTF(
        htf.frequencies, htf.H, htf.harmonics, 4, htf.inputs, htf.outputs, variance=each
    )
    in_frequency = hj.fit_ldtp(htf, initial=small)
    apart = np.abs(in_time.multipliers - in_frequency.multipliers).max()
    assert apart < 0.5 * in_time.standard_errors[0]
    np.testing.assert_allclose(
        in_time.standard_errors, in_frequency.standard_errors, rtol=0.2
    )


@pytest.mark.slow
def test_noise_that_drives_the_system_is_found(small):
    """The spectrum of the fit is that of the truth; predictions are white, simulations are not."""
    noise = driven(small, 0.3)
    data = noisy(small, noise, 600, 0)
    other = noisy(small, noise, 300, 1)
    fit = hj.fit_ldtp(data, small.dims, noise="innovations")
    f = np.linspace(0.05, 0.45, 9)
    ratio = fit.noise_spectrum(f) / noise_spectrum(noise, f)
    assert np.abs(np.log(ratio)).max() < 0.6
    assert abs(np.log(ratio).mean()) < 0.1
    assert fit.contains(small.multipliers, 0.999).all()
    assert hj.validate(fit, other, alpha=1e-3).white
    assert not hj.validate(fit.model, other, alpha=1e-3).white


@pytest.mark.slow
def test_errors_are_as_large_as_said(small):
    """The distances of 24 fits, in units of their covariance, and the coverage, at 0.1 %."""
    noise = driven(small, 0.3)
    runs = 24
    fits = [
        hj.fit_ldtp(noisy(small, noise, 150, seed), initial=small, noise="innovations")
        for seed in range(runs)
    ]
    square = [fit.distance(small.multipliers)[0] for fit in fits]
    total = sum(square)
    below = stats.chi2(2 * runs).cdf(total)
    assert 1e-3 < below < 1 - 1e-3
    assert covered(
        sum(int(fit.contains(small.multipliers[0]).all()) for fit in fits), runs
    )


def test_the_spectrum_of_noise(small):
    """White: its variance, everywhere. Else, by Parseval, the sum over all lines that end there."""
    none = noise_spectrum(driven(small, 0.3), [])
    assert none.shape == (4, 0, 2)
    f = np.array([0.1, 0.3])
    N = 4
    white = hj.linear.LDTP(
        np.zeros((N, 1, 1)),
        np.zeros((N, 1, 2)),
        np.zeros((N, 2, 1)),
        np.broadcast_to(0.3 * np.eye(2), (N, 2, 2)),
    )
    np.testing.assert_allclose(noise_spectrum(white, f), 0.09)
    noise = driven(small, 0.3)
    found = noise_spectrum(noise, f, (-1, 1))
    for row, m in zip(found, (-1, 1), strict=True):
        H = [noise.htf(f + m - k, (k,)).H[0] for k in range(-2, 2)]
        power = np.abs(H) ** 2
        total = power.sum(axis=(0, 3))
        np.testing.assert_allclose(row, total, rtol=1e-9)


@pytest.mark.parametrize("size, cause", [(0.0, None), (0.5, "process noise")])
def test_noise_of_the_states_is_named_where_only_sensors_were_fitted(size, cause):
    """Three sections, a pair of modulus 0.67; the remedy that is named leaves no doubt."""
    rng = np.random.default_rng(0)
    u = rng.normal(size=(600, 1))
    turn = np.array([[0.5, 0.45], [-0.45, 0.5]])
    x = np.zeros(2)
    y = np.zeros((600, 2))
    for i in range(600):
        y[i] = x + 0.3 * rng.normal(size=2)
        A = turn if i % 3 == 2 else np.eye(2)
        push = [u[i, 0], 0.3 * u[i, 0]]
        x = A @ x + push
        x = x + size * rng.normal(size=2)
    data = hj.experiments.SectionSeries(u, y, n_sections=3)
    found = [finding.cause for finding in hj.fit_ldtp(data, 2).findings]
    assert found == ([cause] if cause else [])
    if cause:
        assert not hj.fit_ldtp(data, 2, noise="innovations").findings


def test_a_controller_at_the_section_of_its_measurement_is_no_lack_of_dimensions():
    """Inputs that answer outputs at once are correlated with their errors, which D would take."""
    rng = np.random.default_rng(1)
    turn = np.array([[0.5, 0.45], [-0.45, 0.5]])
    x = np.zeros(2)
    u = np.zeros((1200, 1))
    y = np.zeros((1200, 2))
    for i in range(1200):
        y[i] = x + 0.1 * rng.normal(size=2)
        answer = 0.3 * y[i, 0]
        u[i] = rng.normal() - answer - 0.2 * y[i, 1]
        A = turn if i % 2 else np.eye(2)
        push = [u[i, 0], 0.3 * u[i, 0]]
        x = A @ x + push
        x = x + 0.3 * rng.normal(size=2)
    data = hj.experiments.SectionSeries(u, y, n_sections=2)
    fit = hj.fit_ldtp(data, 2, noise="innovations")
    assert {finding.cause for finding in fit.findings} == {"feedback"}
    imaginary = 1j * turn[0, 1]
    multiplier = turn[0, 0] + imaginary
    assert fit.contains(multiplier).all()
