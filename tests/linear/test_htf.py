"""Harmonic transfer functions: exact values, three independent ways, prediction, bad input."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.test_util
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj
from hybridjax.linear.frequency_response import all_harmonics

from .conftest import blocks_at_random, simulate_blocks


# (dimensions, outputs, inputs): even and odd N, dimensions that vary, several inputs and outputs.
SHAPES = [((3, 2, 4, 1), 2, 2), ((2, 3, 2, 1, 2), 1, 2), ((2,), 1, 1)]
seeds = st.integers(0, 2**32)


@settings(max_examples=8)
@given(seeds, st.sampled_from(SHAPES), st.sampled_from([0.125, 0.375, -0.375, 0.875]))
def test_three_ways_agree(seed, shape, f):
    dims, ny, nu = shape
    N = len(dims)
    blocks = blocks_at_random(seed, dims, ny, nu)
    ldtp = hj.linear.LDTP.from_blocks(*blocks)
    htf = ldtp.htf([f])
    m = np.array(htf.harmonics)
    H = np.asarray(htf.H)[:, 0]
    assert htf.harmonics == all_harmonics(N)
    assert_array_equal(m, np.arange(N) - N // 2)

    # The Fourier series of the impulse response, y[n] = sum_r h[n, r] u[n-r].
    omega = 2 * np.pi * f / N
    h = np.asarray(ldtp.impulse_response(120))
    times = np.arange(120)
    delays = np.exp(-1j * omega * times)
    G = np.einsum("nrij,r->nij", h, delays)
    fourier = np.exp(-2j * np.pi * np.outer(m, np.arange(N)) / N) / N
    expected = np.einsum("mn,nij->mij", fourier, G)
    assert_allclose(H, expected, rtol=0, atol=1e-12)

    # The DFT of the response to a cosine, once the transient has died.
    periods = 8
    transient = 160 // N
    channel = seed % nu
    n = np.arange((transient + periods) * N)
    u = np.zeros((len(n), nu))
    wave = np.cos(omega * n + 0.3)
    u[:, channel] = wave
    rest = np.zeros(dims[0])
    _, y = simulate_blocks(blocks, u, rest)
    steady_output = y[transient * N :]
    Y = np.fft.fft(steady_output, axis=0)
    steady = u[transient * N :, channel]
    U = np.fft.fft(steady)
    line = round(f * periods)
    lines = (line + m * periods) % (periods * N)
    found = H[:, :, channel]
    by_spectra = Y[lines] / U[line]
    assert_allclose(found, by_spectra, rtol=0, atol=1e-12)


@settings(max_examples=4)
@given(seeds, st.sampled_from(SHAPES[:2]))
def test_prediction_is_the_periodic_response(seed, shape):
    dims, ny, nu = shape
    N = len(dims)
    periods = 4
    blocks = blocks_at_random(seed, dims, ny, nu)
    ldtp = hj.linear.LDTP.from_blocks(*blocks)
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(periods * N, nu))
    start = ldtp.periodic_state(u, periods)
    expected = ldtp.simulate(u, start)
    # Negative frequencies follow by symmetry.
    lines = np.arange(periods * N // 2 + 1)
    f = lines / periods
    predicted = ldtp.htf(f).predict(u)
    assert_allclose(predicted, expected, rtol=0, atol=1e-11)


@pytest.mark.slow
def test_derivatives_by_matrices_and_frequencies(synthetic):
    @jax.jit
    def values(A, B, C, D, f):
        model = hj.linear.LDTP(A, B, C, D)
        htf = model.htf(f, harmonics=(-3, 0, 1))
        return jnp.stack([htf.H.real, htf.H.imag])

    f = np.array([0.4, 1.7])
    arrays = (synthetic.A, synthetic.B, synthetic.C, synthetic.D, f)
    jax.test_util.check_grads(values, arrays, order=1, modes=("rev",), eps=1e-6)


def test_a_prediction_has_derivatives_by_the_htf(synthetic):
    htf = synthetic.htf([0.5])
    angle = 2 * np.pi * 0.5 * np.arange(12) / 6
    wave = np.cos(angle)
    u = np.stack([wave, wave], axis=1)

    @jax.jit
    def loss(H):
        changed = eqx.tree_at(lambda htf: htf.H, htf, H)
        return jnp.sum(changed.predict(u) ** 2)

    gradient = jax.jit(jax.grad(loss))(htf.H)
    entry = (2, 0, 1, 0)
    h = 1e-6
    step = np.zeros(htf.H.shape)
    step[entry] = h
    H = np.asarray(htf.H)
    higher = loss(H + step)
    change = higher - loss(H - step)
    difference = change / (2 * h)
    assert_allclose(difference, gradient[entry].real, rtol=1e-6)


def test_a_multiplier_on_the_unit_circle_is_named():
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    B = np.ones((2, 1))
    C = np.ones((1, 2))
    ldtp = hj.linear.LDTP.from_blocks([turn] * 3, [B] * 3, [C] * 3)
    angle = np.arctan2(0.8, 0.6)
    resonance = 3 * angle / (2 * np.pi)
    beside = ldtp.htf([0.1, resonance + 1e-6])
    assert np.all(np.isfinite(beside.H))
    with pytest.raises(
        hj.errors.DefinitionError,
        match=rf"f = {resonance:g} .* unbounded: the multiplier",
    ):
        ldtp.htf([0.1, resonance])

    ones = np.ones((4, 1, 1))
    integrator = hj.linear.LDTP(ones, ones, ones)
    with pytest.raises(
        hj.errors.DefinitionError, match="f = 2 cycles per period is unbounded"
    ):
        integrator.htf([0.3, 2.0, 0.7])


def test_frequencies_are_given_once():
    with pytest.raises(
        hj.errors.DefinitionError, match="`frequencies` holds 0.1 .* twice"
    ):
        values = np.ones((1, 2, 1, 1))
        hj.linear.HTF([0.1, 0.1], values, 0, 4)
