"""Residuals that are distortion of a nonlinear response have a finding, and noise has none."""

import dataclasses

import numpy as np
import pytest

import hybridjax as hj


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


def test_standard_errors_under_distortion_are_those_of_a_jackknife():
    """Each fit to the other blocks of cycles is another estimate. (The covariance for errors of
    equal size is too small, because the fit hides the largest errors.)"""
    blocks = 8
    cycles = 80
    data = series(0, 1.0, cycles)
    samples = np.arange(len(data.y))
    block = samples * blocks // len(samples)

    def fitted(y):
        part = dataclasses.replace(data, y=y)
        return hj.fit_series(part, 1, extra_lags=10, check=False)

    whole = fitted(data.y)
    left_out = np.array(
        [
            fitted(np.where((block == b)[:, None], np.nan, data.y)).multipliers[0].real
            for b in range(blocks)
        ]
    )
    spread = left_out - left_out.mean()
    expected = np.sqrt((blocks - 1) / blocks * (spread**2).sum())

    assert "distortion" in causes(whole)
    np.testing.assert_allclose(whole.standard_errors[0], expected, rtol=0.1)
