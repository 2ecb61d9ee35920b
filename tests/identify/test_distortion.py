"""Residuals that are distortion of a nonlinear response have a finding, and noise has none."""

import dataclasses

import numpy as np
import pytest

import hybridjax as hj
from hybridjax.identify.series import fit as series_fit


TRANSIENT = 20
"""The cycles that are simulated first and left out."""


def slow_mode(rng, u, bend, process):
    """A slow mode (multiplier 0.72) that responds to its own square, times `bend`."""
    x = np.zeros(len(u))
    for k in range(len(u) - 1):
        decay, push = (0.9, 1.0) if k % 2 else (0.8, -0.7)
        linear = decay * x[k] + push * u[k]
        kick = process * 0.01 * rng.normal()
        x[k + 1] = linear + bend * x[k] ** 2 + kick
    return x


def deviations(y):
    """Outputs less their means at each of two sections."""
    by_cycle = y.reshape(-1, 2, 2)
    centered = by_cycle - by_cycle.mean(axis=0)
    return centered.reshape(y.shape)


def series(seed, bend, cycles=150, noise=0.0, process=0.0):
    """Two outputs of a slow mode, at two sections, with noise relative to the outputs."""
    rng = np.random.default_rng(seed)
    samples = 2 * (cycles + TRANSIENT)
    u = 0.01 * rng.normal(size=(samples, 1))
    x = slow_mode(rng, u[:, 0], bend, process)

    curved = 0.5 * x + 0.3 * bend * x**2
    y = np.stack([x, curved], axis=1)
    settled = slice(2 * TRANSIENT, None)
    y = y[settled]
    y += noise * y.std(axis=0) * rng.normal(size=y.shape)
    return hj.experiments.SectionSeries(
        u[settled], deviations(y), n_sections=2, drift=np.inf
    )


def causes(fit):
    return [finding.cause for finding in fit.findings]


@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_distortion_is_named_in_fits_of_series(noise):
    found = [
        causes(hj.fit_series(series(k, 1.0, noise=noise), 1, check=False))
        for k in range(10)
    ]
    assert sum("distortion" in x for x in found) >= 9


@pytest.mark.parametrize(
    "model, named",
    [("output", {"distortion"}), ("innovations", {"distortion", "colored noise"})],
)
def test_distortion_is_named_in_state_space_models(model, named):
    found = [
        causes(hj.fit_ldtp(series(k, 1.0, noise=0.002), 1, noise=model))
        for k in range(3)
    ]
    assert all(named & set(x) for x in found)


def test_curved_sensors_are_not_called_distortion():
    """Regions hold with them."""
    found = []
    for k in range(10):
        data = series(k, 0.0, noise=0.1)
        curved = data.y + 0.1 * data.y**2 / data.y.std()
        data = dataclasses.replace(data, y=curved)
        found.append(causes(hj.fit_series(data, 1, check=False)))
    assert sum("distortion" in x for x in found) <= 1


@pytest.mark.parametrize("process", [0.0, 0.2])
@pytest.mark.slow
def test_noise_of_linear_systems_is_not_called_distortion(process):
    found = [
        causes(hj.fit_series(series(k, 0.0, 60, 0.1, process), 1, check=False))
        for k in range(40)
    ]
    assert sum("distortion" in x for x in found) <= 2


def test_an_exact_output_hides_no_distortion_of_others():
    """Its residuals are rounding errors, beside which those of the others would be nothing."""

    def with_exact(k, bend):
        data = series(k, bend, noise=0.02)
        exact = np.roll(data.u, 1, axis=0)
        exact[0] = 0.0
        return dataclasses.replace(
            data,
            y=np.concatenate([data.y, exact], axis=1),
            outputs=("a", "b", "exact"),
        )

    bent = [causes(hj.fit_series(with_exact(k, 1.0), 1, check=False)) for k in range(5)]
    right = [
        causes(hj.fit_series(with_exact(k, 0.0), 1, check=False)) for k in range(5)
    ]
    assert all("distortion" in x for x in bent)
    assert not any("distortion" in x for x in right)


def fit_and_jackknife(data, blocks=8):
    """A fit to all cycles, and the standard error by fits that leave out one block of them each."""
    samples = np.arange(len(data.y))
    block = samples * blocks // len(samples)

    def fitted(y):
        part = dataclasses.replace(data, y=y)
        return hj.fit_series(part, 1, extra_lags=10, check=False)

    left_out = []
    for b in range(blocks):
        kept = np.where((block == b)[:, None], np.nan, data.y)
        left_out.append(fitted(kept).multipliers[0].real)
    spread = left_out - np.mean(left_out)
    error = np.sqrt((blocks - 1) / blocks * (spread**2).sum())
    return fitted(data.y), error


def test_standard_errors_under_distortion_are_those_of_a_jackknife():
    """Each fit to the other blocks of cycles is another estimate. (The covariance for errors of
    equal size is too small, because the fit hides the largest errors.)"""
    fit, error = fit_and_jackknife(series(0, 1.0, cycles=80))
    assert "distortion" in causes(fit)
    np.testing.assert_allclose(fit.standard_errors[0], error, rtol=0.1)


def test_residuals_without_noise_are_distortion_also_where_it_is_not_found(monkeypatch):
    """A simulated recording without noise, with few cycles for its lags. (No sensor has residuals
    of a thousandth of the responses.)"""
    monkeypatch.setattr(series_fit, "is_distorted", lambda *_: False)
    fit, error = fit_and_jackknife(series(0, 0.01, cycles=80))
    assert not causes(fit)
    np.testing.assert_allclose(fit.standard_errors[0], error, rtol=0.1)
