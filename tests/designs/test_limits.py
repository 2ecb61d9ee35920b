"""Limits: the signals themselves obey them. Noise: its spectrum attracts or repels power."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj

from .conftest import TWO_NOISE


Limits = hj.designs.Limits
RMS = {"u0": 0.1, "u1": 0.05}


def test_peaks_hold_in_every_experiment(optimal_two):
    free = optimal_two()
    plan = optimal_two(limit=Limits(rms={"u1": 0.05}, peak={"u0": 0.1}))
    u = plan.design.signals()
    largest = np.abs(u).max(axis=1)
    peaks = largest[:, 0]
    assert_allclose(peaks, 0.1)
    square = u[..., 1] ** 2
    rms = np.sqrt(np.mean(square))
    assert_allclose(rms, plan.rms["u1"])
    assert plan.limited == ("u1", "peak of u0")
    # (The crest factor is about 2.)
    assert 1.5 < plan.criterion / free.criterion < 5
    assert plan.certificate > 1.5
    # The usual amplitudes get phases for low peaks, too: the design saves strides by its powers.
    usual_size = np.abs(plan.usual.signals())
    usual_peaks = usual_size.max(axis=1)[:, 0]
    assert set(usual_peaks.round(6)) == {0.0, 0.1}


def test_rates(optimal_two):
    """The change from one section to the next, also from the last one to the first."""
    plan = optimal_two(limit=Limits(rms=RMS, rate={"u0": 0.03}))
    signals = plan.design.signals(33)
    changes = np.diff(signals, axis=1)
    change = changes[:, : 6 * 32]
    square = change[..., 0] ** 2
    measured = np.sqrt(np.mean(square))
    assert measured == pytest.approx(0.03, rel=1e-3)
    assert plan.certificate < 1.03
    assert "rms of u0 and u1 and rate of u0 limited" in plan.advice


def test_strides(optimal_two, two_usual):
    """A smaller number of experiments holds fewer lines; words and strides go together."""
    plan = optimal_two(limit=Limits(rms="input", cycles=300))
    assert plan.design.experiments == 300 // 32
    assert plan.cycles <= 300
    squares = two_usual.signals() ** 2
    power = np.sqrt(np.mean(squares, axis=(0, 1)))
    for i in (0, 1):
        allowed = power[i] * (1 + 1e-9)
        assert plan.rms[f"u{i}"] <= allowed


def test_a_peak_that_nothing_exceeds_changes_nothing(optimal_two):
    free = optimal_two()
    loose = optimal_two(limit=Limits(rms=RMS, peak={"u0": 9.0}))
    assert loose.criterion == pytest.approx(free.criterion)


def test_noise_that_differs_between_harmonics(two, optimal_two):
    """Against `cramer_rao`, which takes numerators out in another way."""

    def red(std):
        return lambda f: std / np.sqrt(0.2 + f**2)

    noise = {output: red(std) for output, std in TWO_NOISE.items()}
    plan = optimal_two(limit={"u0": 0.1, "u1": 0.1}, noise=noise)
    assert plan.certificate < 1.03

    N = 6
    harmonics = np.array([-1, 0, 1])
    htf = two.htf(plan.usual.frequencies, harmonics)
    # Harmonic m of an output is seen at f + m, of which lines between sections are mirrored.
    shifted = htf.frequencies + harmonics[:, None]
    shift = (shifted + N / 2) % N
    seen_at = np.abs(shift - N / 2)
    spectra = [level(seen_at) ** 2 for level in noise.values()]
    spectrum = np.stack(spectra, axis=2)[..., None]
    usual_variance = plan.usual.expected_variance()[:, None, :]
    variance = spectrum * usual_variance
    uncertain = dataclasses.replace(htf, source="estimate", variance=variance)
    bound = hj.identify.cramer_rao(two, uncertain)
    total = np.trace(bound.multiplier_covariances[0])
    assert plan.usual_criterion == pytest.approx(total, rel=1e-6)
