"""Fits to time series: accurate without noise, calibrated with noise, gaps, unknown starts."""

import dataclasses
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import hybridjax as hj
from hybridjax.errors import FindingWarning
from hybridjax.identify.multiplier_estimate import MultiplierEstimate, contradicted_by
from hybridjax.identify.series.covariance import block_scores
from hybridjax.identify.series.delayed_outputs import (
    late_outputs,
    total_least_squares,
)
from hybridjax.identify.series.linearization import (
    each_fit,
    filtered_response,
    linearize,
)
from hybridjax.identify.series.output_error import OutputErrorProblem
from hybridjax.identify.series.records import OF_DRIFT, PreparedRecords, with_drift
from hybridjax.identify.series.subspace import subspace_model

from .conftest import SHAPES, scaled
from .test_uncertainty import covered


def record(model, samples, seed=0, noise=0.0, first_section=0, x0=None, **about):
    """The response to white input, with white noise."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(samples, len(model.inputs)))
    y = np.array(model.simulate(u, x0, first_section))
    y += noise * rng.normal(size=y.shape)
    about |= dict(
        n_sections=model.n_sections, inputs=model.inputs, outputs=model.outputs
    )
    return hj.experiments.SectionSeries(u, y, first_section=first_section, **about)


def with_outputs(data, y):
    return hj.experiments.SectionSeries(
        data.u, y, n_sections=data.n_sections, drift=data.drift
    )


def problem_of(data, order, extra_lags, free_start=True):
    return OutputErrorProblem.from_data(
        PreparedRecords(data), order, extra_lags, free_start
    )


def test_the_hopper_is_identified_to_rounding(hopper, multipliers):
    fit = hj.fit_series(
        record(hopper, 32 * 120, x0=np.array([0.01, -0.02, 0.01, 0.0])), hopper
    )
    assert fit.compare(multipliers).max_error < 1e-13
    f = np.array([0.0, 0.3, 1.7, 16.0])
    error = fit.htf(f).error(hopper.htf(f))
    assert error.max() < 1e-12
    np.testing.assert_allclose(
        fit.impulse_response(200), hopper.impulse_response(200), atol=1e-12
    )
    assert fit.result == hj.errors.Result.OK
    assert np.all(fit.noise < 1e-14)


@settings(max_examples=6)
@given(st.sampled_from(SHAPES), st.integers(0, 99), st.integers(0, 3))
def test_random_systems_unknown_starts_and_gaps(shape, seed, first):
    """Two records of odd lengths, with missing outputs and inputs."""
    model = scaled(seed, *shape)
    N = len(shape[0])
    rng = np.random.default_rng(seed)
    records = []
    for k in range(2):
        section = (first + k) % N
        x0 = rng.normal(size=model.dims[section])
        length = 60 * N + 1 + k
        whole = record(model, length, seed + k, first_section=section, x0=x0)
        is_gap = rng.random(whole.y.shape) < 0.02
        whole.y[is_gap] = np.nan
        missing = 25 * N + 2
        whole.u[missing, 0] = np.nan
        records.append(whole)
    fit = hj.fit_series(records, model)
    np.testing.assert_allclose(
        fit.coefficients, np.poly(model.multipliers).real[1:], atol=1e-7
    )
    lags = fit.numerators.shape[1]
    np.testing.assert_allclose(
        fit.impulse_response(lags), model.impulse_response(lags), atol=1e-7
    )


def test_inputs_before_the_start_act_through_all_lags():
    """A register of one cycle beside a multiplier of 0.7; records begin in any section."""
    of_a_section = 0.7**0.25
    decay = np.diag([of_a_section, 0, 0, 0, 0])
    chain = np.diag([0.0, 1, 1, 1], -1)
    A = decay + chain
    B = np.array([[1.0], [1], [0], [0], [0]])
    C = np.array([[1.0, 0, 0, 0, 1]])
    D = np.zeros((1, 1))
    blocks = [[x] * 4 for x in (A, B, C, D)]
    model = hj.linear.LDTP.from_blocks(*blocks)

    begin = np.ones(5)
    data = [record(model, 240, seed=k, first_section=k, x0=begin) for k in range(1, 4)]
    problem = problem_of(data, 1, 4)
    rough = total_least_squares(late_outputs(problem, 1))
    np.testing.assert_allclose(rough, -0.7, atol=1e-9)
    fit = hj.fit_series(data, 1)
    np.testing.assert_allclose(fit.coefficients, -0.7, atol=1e-9)
    validation = hj.validate(fit, data)
    assert validation.white
    assert validation.fit.min() > 99.999


def test_outputs_that_depend_on_later_inputs(small):
    data = record(small, 400)
    f = np.array([0.1, 0.9])
    fit = hj.fit_series(
        hj.experiments.SectionSeries(data.u[:-2], data.y[2:], n_sections=4, lead=2), 2
    )
    response = small.impulse_response(22)
    ahead_response = np.roll(response, -2, axis=0)
    expected = ahead_response[:, 2:]
    np.testing.assert_allclose(fit.impulse_response(20), expected, atol=1e-9)
    ahead = np.exp(1j * np.pi * (f + np.reshape(fit.htf(f).harmonics, (-1, 1))))[
        ..., None, None
    ]
    expected_htf = ahead * small.htf(f).H
    np.testing.assert_allclose(fit.htf(f).H, expected_htf, atol=1e-9)


def test_regions_cover(small):
    """Regions of multipliers, and variances of HTFs, are those of the errors of 24 draws."""
    true = small.multipliers
    runs = 24
    f = np.array([0.1, 0.9, 1.6])
    exact = small.htf(f, (-1, 0, 1))
    hits = 0
    errors = []
    variances = []
    distances = []
    noise = []
    for seed in range(runs):
        data = record(small, 4 * 120, seed, 0.3)
        fit = hj.fit_series(data, 2)
        hits += fit.contains(true).all()
        errors.append(fit.compare(true).error ** 2)
        variances.append(fit.standard_errors**2)
        noise.append(fit.noise)
        htf = fit.htf(f, (-1, 0, 1))
        square = np.abs(htf.H - exact.H) ** 2
        distances.append(square / htf.variance)
    assert covered(hits, runs)
    rms = np.sqrt(np.mean(errors, axis=0))
    estimated = np.sqrt(np.mean(variances, axis=0))
    np.testing.assert_allclose(estimated, rms, rtol=0.25)
    square = np.mean(distances, axis=0)
    np.testing.assert_allclose(square, 1.0, atol=0.7)
    assert abs(np.mean(square) - 1) < 0.15
    np.testing.assert_allclose(np.mean(noise, axis=0), 0.3, rtol=0.02)


def slopes_of(problem, solution):
    """The derivative of the residuals of one record and output in the only coefficient, (T, N)."""

    def section(_, part, n, fit, regression):
        x = part.y[:, :, n, fit.outputs, None]
        fitted = filtered_response(fit.coefficients, solution.c, regression, x)
        return regression.residual(fit.slopes, fitted).ravel()

    return np.stack(each_fit(problem, solution, section)[0], axis=1)


def test_the_covariance_of_the_gradient_with_process_noise():
    """Numerators take much of such errors, and blocks of cycles depend on each other."""
    unit = np.ones((1, 1))
    cycles = 250
    N = 2
    true = 0.8
    blocks = [true * unit, unit], [unit, unit / 2], [unit, unit], [0 * unit] * N
    model = hj.linear.LDTP.from_blocks(*blocks)
    rng = np.random.default_rng(0)

    def noise():
        white = rng.normal(size=(N * cycles, 1))
        return 0.1 * np.asarray(model.simulate(white))

    estimated = 0.0
    measured = 0.0
    runs = 12
    for seed in range(runs):
        clean = record(model, N * cycles, seed)
        noisy = with_outputs(clean, clean.y + noise())
        problem = problem_of(noisy, 1, 12)
        solution = linearize(problem, np.array([-true]))
        draws = (
            np.stack([noise() for _ in range(50)]).reshape(-1, cycles, N)
            / problem.scale
        )
        products = np.einsum("btn,tn->b", draws, slopes_of(problem, solution))
        measured += np.mean(products**2) / runs
        estimated += (
            block_scores(problem, solution, 11).covariance().matrix[0, 0] / runs
        )
    assert estimated == pytest.approx(measured, rel=0.1)


def test_experiments_are_used_from_their_start(small):
    """The transient is information; failed experiments are left out; all data are records."""
    design = hj.multisine(n_sections=4, periods=24, frequencies=(0, 2.0))
    data = hj.experiments.simulate_experiments(small, design, discard=0)
    y = np.array(data.y)
    result = np.zeros(len(data.y), int)
    y[-1] = 1e3
    result[-1] = hj.errors.Result.BLOW_UP
    data = dataclasses.replace(data, y=y, result=result)
    fit = hj.fit_series(data, 2)
    assert fit.compare(small.multipliers).max_error < 1e-8
    assert (
        f"SeriesFit(multipliers (± standard error) {small.multipliers[0].real:.4f}"
        in repr(fit)
    )
    same = (data, data.records, [data], iter(data.records))
    fit, *fits = (hj.fit_series(x, 2, start="cycle") for x in same)
    assert fit.compare(small.multipliers).max_error < 1e-8
    np.testing.assert_array_equal(
        [x.coefficients for x in fits], [fit.coefficients] * 3
    )


@pytest.mark.slow
def test_spurious_multipliers_raise_an_error(small):
    for seed in range(4):
        data = record(small, 400, seed, 0.3)
        with pytest.raises(
            hj.errors.DefinitionError, match="the data support 2 multipliers, not 3"
        ):
            hj.fit_series(data, 3)
    assert "support 2 multipliers, not 3" in repr(hj.fit_series(data, 3, check=False))


@pytest.mark.slow
def test_an_order_that_is_too_low_is_noticed(small):
    """One multiplier of a pair; with the right order, nonlinear outputs are no reason for doubt."""
    for seed in range(2):
        data = record(small, 400, seed, 0.3, drift=np.inf)  # (a constant)
        text = "Order: `order` may be too low: order 2 gives"
        with pytest.warns(FindingWarning, match=text) as caught:
            fit = hj.fit_series(data, 1)
        assert caught[0].filename == __file__
        printed = " ".join(repr(fit).split())
        assert fit.findings[0].text in printed
        assert "too low" in fit._repr_html_()
        curved = 0.1 * data.y**2 / data.y.std()
        bent = with_outputs(data, data.y + curved)
        assert not hj.fit_series(bent, 2).findings
    design = hj.multisine(4, 8, amplitude=1.0).realizations(4)
    data = hj.experiments.simulate_experiments(small, design)
    htf = hj.estimate_htf(hj.experiments.add_noise(data, snr=40, seed=1))
    assert "2 gives other" in hj.fit_multipliers(htf, 1).findings[0].text
    assert not hj.fit_multipliers(htf, 2).findings


@pytest.mark.slow
def test_undeclared_drift_and_offsets_are_noticed(small, monkeypatch):
    """A drift with the right order or one less, and an offset with one multiplier too many."""
    slow = np.cos(np.pi / 100 * (np.arange(100) + 0.5) * np.arange(1, 5)[:, None]).sum(
        axis=0
    )

    def moved(change, seed=1):
        data = record(small, 400, seed, 0.1)
        return with_outputs(
            data, data.y + np.reshape(change, (-1, 1)) * data.y.std(axis=0)
        )

    drift = moved(slow.repeat(4))
    offset = moved(0.3)
    far = moved(1.0)
    for fit, cases in (
        (hj.fit_series, ((drift, 1), (drift, 2), (offset, 3))),
        (hj.fit_ldtp, ((drift, small.dims), (far, small.dims))),
    ):
        for data, guess in cases:
            with pytest.warns(FindingWarning, match="Drift: outputs may drift"):
                multipliers = fit(data, guess).multipliers
            apart = np.abs(multipliers - small.multipliers[0])
            assert apart.max() > 0.1
    first = mock.Mock(wraps=subspace_model)
    monkeypatch.setattr("hybridjax.identify.joint.fit.subspace_model", first)
    for data in (
        moved(0.0),
        *(dataclasses.replace(x, drift=20) for x in (drift, offset, far)),
    ):
        assert not hj.fit_series(data, 2).findings
        fit = hj.fit_ldtp(data, small.dims, noise="innovations")
        assert fit.result == hj.errors.Result.OK
        assert {x.cause for x in fit.findings} <= {"feedback"}  # (D was fitted)
    assert (
        first.call_count == 8
    )  # (Fits, smaller ones; trials of a drift begin at the fit.)
    with pytest.raises(
        hj.errors.DefinitionError, match="not 2.*outputs may drift: `with_drift"
    ):
        drifting = moved(3 * slow.repeat(4), seed=0)
        hj.fit_series(drifting, 2)
    (begun,) = with_drift([record(small, 4100)])  # (Longer ones take too long.)
    found = (len(begun.u), begun.drift, with_drift([begun]))
    assert found == (4000, 20, [])


def test_inputs_that_begin_after_the_trial_of_a_drift(monkeypatch):
    """A multiplier of 0.98 is none; one of 1 may be, but then no input acts in the trial."""
    B = np.ones((2, 1))
    C = np.array([[0.1, 0.5]])
    D = np.zeros((1, 1))
    for multiplier, late in (0.98, 0), (1.0, 50):
        A = np.diag([multiplier, -0.7])
        model = hj.linear.LDTP.from_blocks([A], [B], [C], [D])
        data = record(model, 400, noise=0.2)
        before = ((late, 0), (0, 0))
        signals = (np.pad(x, before) for x in (data.u, data.y))
        fit = hj.fit_series(
            hj.experiments.SectionSeries(*signals, n_sections=1), 2, check=False
        )
        assert late or not fit.findings
        monkeypatch.setattr("hybridjax.identify.series.records.SLOW", 1)


def test_how_far_another_fit_contradicts():
    """By 1, 2.5 and 4 standard errors: an order does at 95 %, a drift at 99.9 %."""
    covariance = np.array([[0.01]]), np.inf
    root = np.array([0.5 + 0j])
    coefficient = np.array([-0.5])
    fit = MultiplierEstimate(root, coefficient, *covariance)
    others = [
        [lambda c=c: (np.array([c]), lambda: covariance)] for c in (-0.6, -0.75, -0.9)
    ]
    doubts = [
        contradicted_by(fit, x, level) is not None
        for x in others
        for level in (0.95, OF_DRIFT)
    ]
    assert doubts == [False, False, True, False, True, True]


def test_announced_drift_is_removed(small):
    """Slow changes of each section's outputs, of any size, change nothing."""
    T = 150
    n = np.arange(600)
    cycle = n // 4 + 0.5
    section = n % 4
    plain = record(small, 4 * T, noise=0.1, drift=50)
    phase = np.pi * 3 * cycle / T
    slow = np.cos(phase)
    wave = 5 * slow * np.cos(section) + 7
    moved_outputs = plain.y + wave[:, None]
    moved = with_outputs(plain, moved_outputs)
    without = hj.fit_series(plain, 2)
    fit = hj.fit_series(moved, 2)
    np.testing.assert_allclose(fit.coefficients, without.coefficients, atol=1e-6)
    assert fit.contains(small.multipliers, 0.999).all()
    assert hj.validate(fit, moved).fit.min() > 90


def test_long_records_that_drift_are_cut(small):
    long = record(small, 4100, drift=10, lead=1)
    piece, *_ = PreparedRecords(long, free_start=True).records
    assert len(piece.u) == 1367
    assert np.isnan(piece.y[-1]).all()


def test_bad_records(small, monkeypatch):
    good = record(small, 400)
    cases = {
        "section 0 was sampled 14 times, too few.* 5 or more cycles": record(small, 56),
        "y1 is constant or missing": with_outputs(good, good.y * [1, np.nan]),
        "y0 is constant or missing": with_outputs(good, good.y * [0, 1] + [2, 0]),
        "the same sections, inputs": [
            good,
            hj.experiments.SectionSeries(good.u, good.y, n_sections=5),
        ],
    }
    for message, data in cases.items():
        with pytest.raises(hj.errors.DefinitionError, match=message):
            hj.fit_series(data, 2)
    monkeypatch.setattr("hybridjax.identify.series.output_error.on_all_cores", None)
    with pytest.raises(
        hj.errors.DefinitionError, match="sampled 10 times, too few.* 9 or more cycles"
    ):
        hj.fit_series(record(small, 40), 2)


def test_absolute_outputs_are_refused(small):
    """At each door where they would spoil the result; HTFs only at multiples of f = 1."""
    lines = dict(frequencies=[[0.25, 1.0]] * 2, phases=[[0.0, 0.0], [0.0, np.pi / 2]])
    design = hj.experiments.Design.from_lines(
        **lines, amplitudes=0.1, n_sections=4, periods=8
    )
    good = hj.experiments.simulate_experiments(small, design, start="periodic")
    data = dataclasses.replace(
        good, y=good.y + 1e2 * np.tile([[0], [1], [2], [1]], (8, 1))
    )
    for door, *arguments in (
        (hj.fit_series, data, 2),
        (hj.fit_ldtp, data, 2),
        (hj.validate, small, data),
        (hj.estimate_htf, data),
        (hj.fitting.ObservedSeries, data, hj.ClockPhase(4)),
        (hj.designs.SequentialDesign(hj.multisine(4, 8), 2, 0.1).add, data),
    ):
        with pytest.raises(hj.errors.DefinitionError, match="subtract the limit cycle"):
            door(*arguments)
    estimated = hj.estimate_htf(good)
    error = estimated.error(small.htf([0.25, 1.0]))
    assert error.max() < 1e-9


def test_absolute_outputs_are_refused_beside_an_input_of_zeros():
    """Parameters are also fitted to experiments in which one input was not used."""
    u = np.random.default_rng(0).normal(size=(1, 40, 2)) * [1, 0]
    deviations = np.cumsum(u[..., :1], axis=1)
    cycle = 1e3 * np.tile([[0], [1], [2], [1]], (10, 1))
    about = dict(n_sections=4, periods=10)
    data = hj.experiments.ExperimentData(u, deviations + cycle, **about)
    with pytest.raises(hj.errors.DefinitionError, match="subtract the limit cycle"):
        hj.fitting.ObservedSeries(data, hj.ClockPhase(4))


@pytest.mark.parametrize("unit", [1e-12, 1e9])
def test_inputs_have_units_of_their_own(unit):
    """The HTFs are those of the same data in other units. Inputs that are equal are refused."""
    u = np.random.default_rng(0).normal(size=(400, 2))
    two_inputs = scaled(0, (2, 2, 2, 2), 2, 2)
    y = np.asarray(two_inputs.simulate(u)) + 1e-3 * np.random.default_rng(1).normal(
        size=(400, 2)
    )
    units = np.array([1, unit])
    fits = [
        hj.fit_series(hj.experiments.SectionSeries(v, y, n_sections=4), 2)
        for v in (u, u * units)
    ]
    htfs = [fit.htf([0.3]).H for fit in fits]
    in_units = htfs[1] * units
    np.testing.assert_allclose(in_units, htfs[0], rtol=1e-6)
    found = [fit.model.multipliers for fit in fits]
    np.testing.assert_allclose(*found, rtol=1e-6)
    design = hj.multisine(4, 8, lines="odd", inputs=2, division="disjoint")
    data = hj.experiments.simulate_experiments(two_inputs, design, discard=2)
    data = hj.identify.remove_transient(
        dataclasses.replace(data, u=data.u * units), 2
    ).data
    htf = hj.estimate_htf(data)
    np.testing.assert_allclose(htf.frequencies, design.frequencies)
    np.testing.assert_allclose(
        htf.H * units, two_inputs.htf(htf.frequencies).H, atol=1e-9
    )
    with pytest.raises(hj.errors.DefinitionError, match="are no pair"):
        hj.experiments.ExperimentData(
            units * [u, [-1, 1] * u], [y, y], n_sections=4, periods=8
        ).odd_part()
    with pytest.raises(hj.errors.DefinitionError, match="u0, u1 cannot be told apart"):
        hj.fit_series(
            hj.experiments.SectionSeries(u[:, :1] * units, y, n_sections=4), 2
        )


def test_a_multiplier_that_changes_along_the_data_is_named():
    """Trials with multipliers from 0.7 to 0.3, then the same with 0.5 in all."""

    def records(multipliers):
        rng = np.random.default_rng(1)
        each = []
        for z in multipliers:
            u = rng.normal(size=(160, 1))
            x = np.zeros(161)
            for i in range(160):
                # Two sections in a period.
                factor = z if i % 2 else 1.0
                carried = factor * x[i]
                x[i + 1] = carried + u[i, 0]
            noise = 0.1 * rng.normal(size=(160, 1))
            y = x[:160, None] + noise
            each.append(hj.experiments.SectionSeries(u, y, n_sections=2))
        return each

    def causes(multipliers):
        fit = hj.fit_series(records(multipliers), 1, check=False)
        return {finding.cause for finding in fit.findings}

    assert "changing system" in causes(np.linspace(0.7, 0.3, 8))
    assert causes([0.5] * 8) == set()
