"""State-space models from responses: exact and minimal on exact data, sensible on noisy data."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import hybridjax as hj
from hybridjax.identify.joint.realization import realized_htf
from hybridjax.identify.realization import realized

from .conftest import SHAPES, scaled
from .test_series import record


# Reachable and observable: the states of the hopper that its two outputs tell apart.
MINIMAL = [4] * 21 + [2] * 5 + [3] + [4] * 5
F = np.linspace(0.05, 9.95, 40)


def test_the_hopper_from_a_band_of_frequencies(exact, hopper, multipliers):
    """620 frequencies up to 10 of 16 cycles per period."""
    model = realized_htf(exact)
    np.testing.assert_array_equal(model.dims, MINIMAL)
    np.testing.assert_allclose(model.multipliers, multipliers, atol=1e-11)
    error = model.htf(F).error(hopper.htf(F))
    assert error.max() < 1e-10
    assert model.inputs == ("u",)
    assert model.outputs == ("yM", "vM")


@settings(max_examples=5)
@given(st.sampled_from(SHAPES), st.integers(0, 99))
def test_random_systems(shape, seed):
    dims, ny, nu = shape
    model = scaled(seed, dims, ny, nu)
    N = len(dims)
    f = np.linspace(0.02, N / 2 - 0.05, 60)
    htf = model.htf(f)
    markov = np.asarray(model.impulse_response(40))
    for found in (realized_htf(htf), realized(markov)):
        found_dims = np.asarray(found.dims)
        assert np.all(found_dims <= np.asarray(model.dims))
        assert (
            found.htf(f)
            .error(
                hj.linear.HTF(f, htf.H, htf.harmonics, N, found.inputs, found.outputs)
            )
            .max()
            < 1e-7
        )


@pytest.mark.slow
def test_from_a_fit_to_a_noisy_record(hopper, multipliers):
    """States below the noise are left out, and what is left predicts well."""
    data = record(hopper, 32 * 300, 3)
    y = data.y + 0.01 * data.y.std(axis=0) * np.random.default_rng(4).normal(
        size=data.y.shape
    )
    fit = hj.fit_series(
        hj.experiments.SectionSeries(data.u, y, n_sections=32, outputs=("yM", "vM")), 2
    )
    model = fit.model
    dims = np.asarray(model.dims)
    assert np.all((dims >= 2) & (dims <= 4))
    error = model.htf(F).error(hopper.htf(F))
    assert error.max() < 2e-3
    difference = np.abs(model.multipliers[:2] - multipliers)
    assert difference.max() < 2e-3


def test_from_noisy_htfs(exact, hopper, multipliers):
    rng = np.random.default_rng(0)
    size = 1e-4 * np.abs(exact.H).max()
    variance = np.full(exact.H.shape, size**2)
    shape = exact.H.shape
    real = rng.normal(size=shape)
    imaginary = rng.normal(size=shape)
    error = real + 1j * imaginary
    size_of_errors = np.sqrt(variance / 2)
    H = exact.H + size_of_errors * error
    model = realized_htf(dataclasses.replace(exact, H=H, variance=variance), order=2)
    assert np.all(np.asarray(model.dims) <= MINIMAL)
    difference = np.abs(model.multipliers[:2] - multipliers)
    assert difference.max() < 2e-3
