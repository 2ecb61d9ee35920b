"""Fits to recorded series: exact without noise, calibrated with it, gaps, unknown starts."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy import linalg

import hybridjax as hj
from hybridjax.experiments.record import HasRecords
from hybridjax.identify.series.arx import delayed_outputs
from hybridjax.identify.series.gradient_covariance import gradient_covariance
from hybridjax.identify.series.linearization import each_part, linearize
from hybridjax.identify.series.nonlinear import shared_state_fit
from hybridjax.identify.series.nonlinear.channels import Columns, channel_misfits
from hybridjax.identify.series.nonlinear.jackknife import jackknife
from hybridjax.identify.series.output_error import OutputErrorProblem
from hybridjax.identify.series.parts import Parts

from ..linear.conftest import blocks_at_random
from .test_uncertainty import covered


def scaled(seed, dims, ny, nu, modulus=0.7):
    """A random system whose largest multiplier has this modulus."""
    A, B, C, D = blocks_at_random(seed, dims, ny, nu)
    size = np.abs(hj.LDTP.from_blocks(A, B, C, D).multipliers[0])
    factor = (modulus / size) ** (1 / len(dims))
    return hj.LDTP.from_blocks([a * factor for a in A], B, C, D)


@pytest.fixture(scope="module")
def small():
    return scaled(3, (2, 3, 4, 2), 2, 1)


def record(model, samples, seed=0, noise=0.0, first_section=0, x0=None):
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(samples, len(model.inputs)))
    y = np.array(model.simulate(u, x0, first_section))
    y += noise * rng.normal(size=y.shape)
    about = dict(n_sections=model.n_sections, inputs=model.inputs, outputs=model.outputs)
    return hj.Record(u, y, first_section=first_section, **about)


def test_the_hopper_is_found_exactly(hopper, multipliers):
    fit = hj.fit_series(record(hopper, 32 * 120, x0=np.array([0.01, -0.02, 0.01, 0.0])), hopper)
    assert fit.compare(multipliers).max_error < 1e-13
    f = np.array([0.0, 0.3, 1.7, 16.0])
    assert fit.htf(f).error(hopper.htf(f)).max() < 1e-12
    np.testing.assert_allclose(fit.impulse_response(200), hopper.impulse_response(200), atol=1e-12)
    assert fit.result == hj.Result.OK and np.all(fit.noise < 1e-14)


SHAPES = [((2, 3, 4, 2), 2, 1), ((3, 2, 2), 1, 2), ((2,), 1, 1)]


@settings(max_examples=8)
@given(st.sampled_from(SHAPES), st.integers(0, 99), st.integers(0, 3))
def test_random_systems_unknown_starts_and_gaps(shape, seed, first):
    """Two records of odd lengths, with bad outputs and inputs here and there."""
    dims, ny, nu = shape
    model, N = scaled(seed, dims, ny, nu), len(dims)
    rng = np.random.default_rng(seed)
    records = []
    for k in range(2):
        section = (first + k) % N
        x0 = rng.normal(size=dims[section])
        one = record(model, 60 * N + 1 + k, seed + k, first_section=section, x0=x0)
        u, y = one.u.copy(), one.y.copy()
        y[rng.random(y.shape) < 0.02] = np.nan
        u[25 * N + 2, 0] = np.nan
        about = dict(inputs=model.inputs, outputs=model.outputs)
        records.append(hj.Record(u, y, n_sections=N, first_section=section, **about))
    fit = hj.fit_series(records, model)
    np.testing.assert_allclose(fit.coefficients, np.poly(model.multipliers).real[1:], atol=1e-7)
    lags = fit.numerators.shape[1]
    np.testing.assert_allclose(fit.impulse_response(lags), model.impulse_response(lags), atol=1e-7)


@pytest.mark.parametrize("alike", [True, False])
def test_outputs_do_not_meddle(small, alike):
    """For given coefficients each output has its own regression, in whatever unit it is."""
    whole = record(small, 4 * 60, noise=0.1)
    y = whole.y.copy()
    y[np.random.default_rng(1).random(len(y)) < 0.1, : None if alike else 1] = np.nan
    c, unit = np.array([-0.5, 0.2]), np.array([2.0, 0.1])

    def of(outputs):
        parts = Parts(hj.Record(whole.u, y[:, outputs], n_sections=4))
        problem = OutputErrorProblem.from_data(parts, 2, 4, free_start=True)
        return problem, linearize(problem, c), delayed_outputs(problem, 2)

    problem, both, delayed = of([0, 1])
    other = problem.rescale(unit)
    for i in range(2):
        _, alone, one = of([i])
        np.testing.assert_allclose(both.square[:, [i]], alone.square, rtol=1e-12)
        np.testing.assert_allclose(both.gradient[[i]], alone.gradient, atol=1e-9)
        np.testing.assert_allclose(both.curvature[[i]], alone.curvature, rtol=1e-10)
        np.testing.assert_allclose(both.numerators[..., [i]], alone.numerators, atol=1e-12)
        np.testing.assert_allclose(both.slope[..., [i]], alone.slope, atol=1e-11)
        np.testing.assert_array_equal(both.freedom[:, [i]], alone.freedom)
        np.testing.assert_allclose(delayed.gram[[i]], one.gram, rtol=1e-9)
        for n in range(4):
            x, z = both.roots[n][i], alone.roots[n][0]
            np.testing.assert_allclose(x @ x.T, z @ z.T, atol=1e-12)
    for a, b in zip(linearize(other, c)[:-2], both.rescale(unit)[:-2], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(
        delayed_outputs(other, 2).gram, delayed.rescale(unit).gram, rtol=1e-9
    )


def test_regions_cover(small):
    """Of multipliers and of the HTFs at fixed frequencies; the error is what is said."""
    true, runs, f = small.multipliers, 40, np.array([0.1, 0.9, 1.6])
    exact = small.htf(f, (-1, 0, 1))
    fits = [hj.fit_series(record(small, 4 * 120, seed, 0.3), 2) for seed in range(runs)]
    assert covered(sum(fit.contains(true).all() for fit in fits), runs)
    rms = np.sqrt(np.mean([fit.compare(true).error ** 2 for fit in fits], axis=0))
    said = np.sqrt(np.mean([fit.standard_errors**2 for fit in fits], axis=0))
    np.testing.assert_allclose(said, rms, rtol=0.25)
    square = 0.0
    for fit in fits:
        estimate = fit.htf(f, (-1, 0, 1))
        square += np.abs(estimate.H - exact.H) ** 2 / estimate.variance / runs
    np.testing.assert_allclose(square, 1.0, atol=0.7)
    assert abs(np.mean(square) - 1) < 0.15
    np.testing.assert_allclose(np.mean([fit.noise for fit in fits], axis=0), 0.3, rtol=0.02)


def test_unknown_starts_leave_the_first_cycles_without_a_say():
    """Of an input at the first sample only, section 0 sees lag 2 a cycle later; what it sees at
    once may as well come from before."""
    u, y = np.zeros((10, 1)), np.ones((10, 1))
    u[0] = 1.0
    parts = Parts(hj.Record(u, y, n_sections=2))
    seen = {}
    for free_start in (True, False):
        problem = OutputErrorProblem.from_data(parts, 1, 0, free_start=free_start)
        seen[free_start] = [x.shape[1] for x in problem.to_lags]
    assert seen == {True: [1, 0], False: [2, 1]}


def test_process_noise_is_seen_in_the_residuals(small):
    """A random input nobody recorded: regions from white errors would be too small."""
    true, runs = small.multipliers, 40
    hits = 0
    for seed in range(runs):
        clean = record(small, 4 * 100, seed)
        hidden = np.random.default_rng(1000 + seed).normal(size=clean.u.shape)
        y = clean.y + 0.3 * np.asarray(small.simulate(hidden))
        fit = hj.fit_series(hj.Record(clean.u, y, n_sections=4), 2)
        hits += fit.contains(true).all()
    assert covered(hits, runs)


def slopes_of(problem, found):
    """The derivative of the residuals of one record and output in the only coefficient, (T, N)."""
    slopes = {}

    def section(_, part, n, fit, regression):
        x = part.y[:, :, n, fit.outputs, None]
        slopes[n] = fit.samples(found.c, regression, x)[1].ravel()

    each_part(problem, found, section, lambda k, sections: None)
    return np.stack([slopes[n] for n in sorted(slopes)], axis=1)


def test_the_gradient_scatters_as_is_said_where_noise_drives_the_system():
    """Though numerators take much of such errors, and blocks of cycles depend on each other."""
    one, cycles, N, true = np.ones((1, 1)), 250, 2, 0.8
    model = hj.LDTP.from_blocks([true * one, one], [one, one / 2], [one, one], [0 * one] * N)
    rng = np.random.default_rng(0)

    def noise():
        return 0.1 * np.asarray(model.simulate(rng.normal(size=(N * cycles, 1))))

    said, happened = 0.0, 0.0
    for seed in range(20):
        clean = record(model, N * cycles, seed)
        data = hj.Record(clean.u, clean.y + noise(), n_sections=N)
        problem = OutputErrorProblem.from_data(Parts(data), 1, 12, free_start=True)
        found = linearize(problem, np.array([-true]))
        draws = np.stack([noise() for _ in range(50)]).reshape(-1, cycles, N) / problem.scale
        happened += np.mean(np.einsum("btn,tn->b", draws, slopes_of(problem, found)) ** 2) / 20
        said += gradient_covariance(problem, found, 11).matrix[0, 0] / 20
    assert said == pytest.approx(happened, rel=0.06)


def test_standard_errors_of_short_records_are_not_too_large(small):
    """Numerators take a fifth of each error; the misfit says the same as white noise's size."""
    ratios = []
    for seed in range(12):
        data = record(small, 4 * 120, seed, 0.3)
        sizes = [
            hj.fit_series(data, 2, distortion=False, errors=errors).standard_errors[0]
            for errors in ("residuals", "white")
        ]
        ratios.append(sizes[0] / sizes[1])
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1, abs=0.1)


OUTLIERS = {
    "none": lambda rng, shape: rng.normal(size=shape),
    "heavy tails": lambda rng, shape: rng.standard_t(3, size=shape),
    "spikes": lambda rng, shape: (
        rng.normal(size=shape) + 300 * (rng.random(shape) < 0.01) * rng.choice([-1, 1], shape)
    ),
}


@pytest.mark.parametrize("kind", OUTLIERS)
def test_robust_losses(small, kind):
    """As good as squares for normal errors, better where some are far off; regions hold."""
    true, runs, fits = small.multipliers, 8, {}
    for loss in ("squares", "huber", "student"):
        fits[loss] = []
        for seed in range(runs):
            data = record(small, 4 * 100, seed)
            noise = 0.1 * OUTLIERS[kind](np.random.default_rng(seed), data.y.shape)
            data = hj.Record(data.u, data.y + noise, n_sections=4)
            fits[loss].append(
                hj.fit_series(data, 2, loss=loss, distortion=False, check=loss != "squares")
            )
    rms = {
        loss: np.sqrt(np.mean([f.compare(true).error[0] ** 2 for f in found]))
        for loss, found in fits.items()
    }
    for loss in ("huber", "student"):
        assert covered(sum(fit.contains(true).all() for fit in fits[loss]), runs)
        said = np.sqrt(np.mean([fit.standard_errors[0] ** 2 for fit in fits[loss]]))
        assert said == pytest.approx(rms[loss], rel=0.5)
        assert all(fit.result == hj.Result.OK for fit in fits[loss])
        worse = {"none": 1.25, "heavy tails": 1.1, "spikes": 0.2}[kind]
        assert rms[loss] < worse * rms["squares"]


def test_losses_leave_exact_data_alone(small):
    fit = hj.fit_series(record(small, 4 * 80), 2, loss="huber")
    assert fit.compare(small.multipliers).max_error < 1e-8


@pytest.fixture(scope="module")
def experiments(small):
    """From rest, with their transients."""
    design = hj.multisine(n_sections=4, periods=24, band=(0, 2.0))
    return hj.experiments.simulate_experiments(small, design, discard=0)


def test_experiments_are_used_from_their_start(small, experiments):
    """The transient that a window of periods avoids is information; what failed is left out."""
    data = experiments
    S, y = len(data.u), np.array(data.y)
    y[-1] = 1e3
    data = hj.ExperimentData(
        data.u, y, n_sections=4, periods=24, inputs=small.inputs, outputs=small.outputs,
        result=[0] * (S - 1) + [hj.Result.BLOW_UP],
    )  # fmt: skip
    for start in ("free", "cycle"):
        fit = hj.fit_series(data, 2, start=start)
        assert fit.compare(small.multipliers).max_error < 1e-8
        assert f"SeriesFit(multipliers {small.multipliers[0].real:.4f}" in repr(fit)


def test_all_data_are_made_of_records(small, experiments):
    """A record, experiments, and mixtures of these are the same data."""
    data = experiments
    fits = [
        hj.fit_series(same, 2, start="cycle", distortion=False)
        for same in (data, data.records, [data], iter(data.records))
    ]
    for fit in fits[1:]:
        np.testing.assert_array_equal(fit.coefficients, fits[0].coefficients)
    whole = record(small, 100, first_section=1)
    assert whole.records == (whole,) and isinstance(data, HasRecords)
    part = whole.part(10, 20)
    assert part.first_section == 3 and part.outputs == whole.outputs
    np.testing.assert_array_equal(part.y, whole.y[10:20])


def test_a_chirp_will_do(hopper, multipliers):
    n = np.arange(32 * 400)
    u = 0.02 * np.cos(np.pi * 0.6 * n**2 / n[-1])[:, None]
    fit = hj.fit_series(hj.Record(u, hopper.simulate(u), n_sections=32), 2)
    assert fit.compare(multipliers).max_error < 1e-6


def test_multipliers_that_noise_would_invent_are_refused(small):
    """But for 1 % of cases."""
    refused, runs = 0, 15
    for seed in range(runs):
        data = record(small, 400, seed, 0.3)
        try:
            hj.fit_series(data, 3, max_steps=5)
        except hj.DefinitionError as error:
            assert "the data carry 2 multipliers, not 3" in str(error)
            refused += 1
    assert covered(refused, runs, 0.98)
    assert len(hj.fit_series(data, 3, check=False).multipliers) == 3


ANGLES = (0.3, 0.8, 0.5, 0.4)


def quadratic(seed, size, cycles=300, modulus=0.9):
    """y = x + x**2 / 2 of a system with products of states and inputs, about a fixed point."""
    rng = np.random.default_rng(seed)
    N, u = 4, size * rng.normal(size=(4 * cycles, 1))
    turn = [np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) for a in ANGLES]
    bend = rng.normal(size=(N, 2, 3, 3)) / 4
    push = rng.normal(size=(N, 2))
    x, y = np.zeros(2), []
    for k, force in enumerate(u[:, 0]):
        y.append(x + x**2 / 2)
        z = np.append(x, force)
        x = modulus * turn[k % N] @ x + push[k % N] * force + bend[k % N] @ z @ z
    true = modulus**N * np.exp([1j * sum(ANGLES), -1j * sum(ANGLES)])
    return hj.Record(u, np.array(y), n_sections=N, drift=np.inf), true


def test_distortion_of_second_order():
    """What is left is of third order: with a tenth of the input it is a hundredth, not a tenth."""
    errors = {}
    for size in (0.03, 0.003):
        for distortion in (False, True):
            both = []
            for seed in range(3):
                data, true = quadratic(seed, size)
                fit = hj.fit_series(data, 2, distortion=distortion)
                assert fit.distortion == distortion
                both.append(fit.compare(true).max_error)
            errors[size, distortion] = np.sqrt(np.mean(np.square(both)))
    assert errors[0.003, True] < errors[0.003, False] / 20
    assert 5 < errors[0.03, False] / errors[0.003, False] < 20
    assert errors[0.03, True] / errors[0.003, True] > 40
    assert hj.fit_series(data, 2).distortion


def test_how_sure_where_products_are_taken():
    """Neither many unknowns nor what distant cycles have in common make errors look small."""
    found, said = [], []
    for seed in range(10):
        data, true = quadratic(seed, 0.03, cycles=120)
        fit = hj.fit_series(data, 2, distortion=True, check=False)
        assert fit.distortion
        found.append(fit.compare(true).max_error)
        said.append(fit.standard_errors[0])
    assert 0.75 < np.sqrt(np.mean(np.square(said)) / np.mean(np.square(found))) < 1.4


@pytest.mark.parametrize("cycles, length, modulus", [(120, 12, 0.9), (84, 14, 0.95)])
def test_the_jackknife_is_that_of_fits_without_a_block(cycles, length, modulus, monkeypatch):
    """Of the linearized problem, at its minimum. Blocks are a tenth of the cycles, but longer than
    it takes until a tenth is left of a response."""
    seen = []

    def looked_at(*arguments):
        seen[:] = [*arguments, jackknife(*arguments)]
        return seen[-1]

    monkeypatch.setattr(shared_state_fit, "jackknife", looked_at)
    monkeypatch.setattr(shared_state_fit, "_SETTLED_GAIN", 1e-20)
    # Also of blocks that the others hardly predict:
    monkeypatch.setattr("hybridjax.identify.multipliers.covariance._SMALLEST_REMAINDER", 1e-9)
    data, _ = quadratic(0, 0.03, cycles, modulus)
    hj.fit_series(data, 2, distortion=True, check=False)
    model, _ = shared_state_fit._minimize(*seen[:2], 50)
    fit = shared_state_fit.SharedStateFit(seen[0], model, True)
    shared_state_fit.denominator_of(fit, "residuals")
    problem, model, root, to_c, found = seen
    columns, errors, whens, shared, own = Columns.of(problem, model), [], [], [], []
    for n, i, rows, e, slopes, _ in channel_misfits(problem, model):
        errors.append(e)
        whens.append(np.nonzero(rows)[1])
        shared.append(slopes.dense(columns, rows) @ root)
        own.append(np.concatenate([slopes.basis, problem.direct[n][i].drift], axis=2)[rows])
    slopes = np.concatenate([np.concatenate(shared), linalg.block_diag(*own)], axis=1)
    error, block = np.concatenate(errors), np.concatenate(whens) // length
    changes = []
    for b in range(-(-cycles // length)):
        rest = block != b
        changes.append(to_c @ np.linalg.lstsq(slopes[rest], error[rest])[0][: len(root)])
    np.testing.assert_allclose(found.matrix, np.transpose(changes) @ changes, rtol=1e-6)
    assert 2 < found.freedom < len(changes)


def test_drift_is_no_response(small):
    """Slow changes of each section's outputs, of any size, change nothing if they are announced."""
    plain = record(small, 4 * 150, noise=0.1)
    T = 150
    cycle = (np.arange(4 * T) // 4 + 0.5) / T
    wave = 5 * np.cos(np.pi * 3 * cycle) * np.cos(np.arange(4 * T) % 4) + 7
    about = dict(n_sections=4, inputs=plain.inputs, outputs=plain.outputs, drift=50)
    fits = [
        hj.fit_series(hj.Record(plain.u, y, **about), 2) for y in (plain.y, plain.y + wave[:, None])
    ]
    np.testing.assert_allclose(fits[0].coefficients, fits[1].coefficients, atol=1e-6)
    assert fits[1].contains(small.multipliers, 0.999).all()
    found = hj.validate(fits[1], hj.Record(plain.u, plain.y + wave[:, None], **about))
    assert found.fit.min() > 90
    with pytest.raises(hj.DefinitionError, match="positive number of cycles"):
        hj.Record(plain.u, plain.y, n_sections=4, drift=0)


def test_bad_records(small):
    good = record(small, 400)
    with pytest.raises(hj.DefinitionError, match="section 0 was sampled 10 times, too few"):
        hj.fit_series(record(small, 40), 2)
    with pytest.raises(hj.DefinitionError, match="`order` must be an integer from 1"):
        hj.fit_series(good, 0)
    with pytest.raises(hj.DefinitionError, match="allowed for with the loss 'squares'"):
        hj.fit_series(good, 2, loss="huber", distortion=True)
    with pytest.raises(hj.DefinitionError, match="input u is zero"):
        hj.fit_series(hj.Record(0 * good.u, good.y, n_sections=4), 2)
    with pytest.raises(hj.DefinitionError, match="output y1 is zero or missing"):
        hj.fit_series(hj.Record(good.u, good.y * [1, np.nan], n_sections=4), 2)
    with pytest.raises(hj.DefinitionError, match="do not belong together"):
        hj.fit_series([good, hj.Record(good.u, good.y, n_sections=5)], 2)
    with pytest.raises(hj.DefinitionError, match="input is NaN at every sample"):
        hj.fit_series(hj.Record(good.u * np.nan, good.y, n_sections=4), 2)
    with pytest.raises(hj.DefinitionError, match=r"not \(400, 1\) and \(399, 2\)"):
        hj.Record(good.u, good.y[1:], n_sections=4)
    with pytest.raises(
        hj.DefinitionError, match="`first_section` must be one of the sections 0..3"
    ):
        hj.Record(good.u, good.y, n_sections=4, first_section=4)
    with pytest.raises(hj.DefinitionError, match="`y` must be finite"):
        y = good.y.copy()
        y[7] = np.inf
        hj.Record(good.u, y, n_sections=4)
    with pytest.raises(hj.DefinitionError, match="no experiment that ran to its end"):
        hj.fit_series(
            hj.ExperimentData(good.u[None], good.y[None], n_sections=4, periods=9, result=[5]), 2
        )
    assert "Record(400 samples from section 0; N = 4; u -> y0, y1)" == repr(good)
