"""Harmonic transfer functions: exact values, three independent ways, prediction, bad input."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.test_util
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose

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
    ldtp = hj.LDTP.from_blocks(*blocks)
    htf = ldtp.htf([f])
    assert htf.harmonics == all_harmonics(N)
    assert len(htf.harmonics) == N
    assert htf.harmonics[0] == -(N // 2)

    # The Fourier series of the impulse response, y[n] = sum_r h[n, r] u[n-r].
    w = 2 * np.pi * f / N
    m = np.array(htf.harmonics)
    h = np.asarray(ldtp.impulse_response(120))
    G = np.einsum("nrij,r->nij", h, np.exp(-1j * w * np.arange(120)))
    H = (
        np.einsum("mn,nij->mij", np.exp(-2j * np.pi * np.outer(m, np.arange(N)) / N), G)
        / N
    )
    assert_allclose(np.asarray(htf.H)[:, 0], H, rtol=0, atol=1e-12)

    # The DFT of the response to a cosine, once the transient has died.
    periods = 8
    settle = 160 // N
    u = np.zeros(((settle + periods) * N, nu))
    j = seed % nu
    u[:, j] = np.cos(w * np.arange(len(u)) + 0.3)
    _, y = simulate_blocks(blocks, u, np.zeros(dims[0]))
    Y = np.fft.fft(y[settle * N :], axis=0)
    U = np.fft.fft(u[settle * N :, j])
    k = round(f * periods)
    lines = (k + m * periods) % (periods * N)
    measured = np.asarray(htf.H)[:, 0, :, j]
    assert_allclose(measured, Y[lines] / U[k], rtol=0, atol=1e-12)


@settings(max_examples=4)
@given(seeds, st.sampled_from(SHAPES[:2]))
def test_prediction_is_the_periodic_response(seed, shape):
    dims, ny, nu = shape
    N = len(dims)
    P = 4
    ldtp = hj.LDTP.from_blocks(*blocks_at_random(seed, dims, ny, nu))
    u = np.random.default_rng(seed).normal(size=(P * N, nu))
    y = ldtp.simulate(u, ldtp.periodic_state(u, P))
    htf = ldtp.htf(np.arange(P * N // 2 + 1) / P)  # negative frequencies by symmetry
    assert_allclose(htf.predict(u), y, rtol=0, atol=1e-11)


def test_derivatives(synthetic):
    f = np.array([0.4, 1.7])

    @jax.jit
    def values(A, B, C, D, f):
        ldtp = hj.LDTP(A, B, C, D)
        htf = ldtp.htf(f, harmonics=(-3, 0, 1))
        return jnp.stack([htf.H.real, htf.H.imag])

    arrays = (synthetic.A, synthetic.B, synthetic.C, synthetic.D, f)
    jax.test_util.check_grads(values, arrays, order=1, modes=("rev",), eps=1e-6)
    u = np.cos(2 * np.pi * 0.5 * np.arange(12) / 6)[:, None] * np.ones(2)

    htf = synthetic.htf([0.5])

    @jax.jit
    def loss(H):
        return jnp.sum(eqx.tree_at(lambda h: h.H, htf, H).predict(u) ** 2)

    gradient = jax.jit(jax.grad(loss))(htf.H)
    bump = np.zeros(htf.H.shape)
    bump[2, 0, 1, 0] = 1e-6
    up, down = (loss(np.asarray(htf.H) + s * bump) for s in (1, -1))
    slope = np.asarray(gradient)[2, 0, 1, 0].real
    assert_allclose((up - down) / 2e-6, slope, rtol=1e-6)


def test_a_multiplier_on_the_unit_circle_is_named():
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    ldtp = hj.LDTP.from_blocks([turn] * 3, [np.ones((2, 1))] * 3, [np.ones((1, 2))] * 3)
    f = 3 * np.arctan2(0.8, 0.6) / (2 * np.pi)
    assert np.all(np.isfinite(ldtp.htf([0.1, f + 1e-6]).H))
    with pytest.raises(
        hj.DefinitionError, match=rf"f = {f:g} .* unbounded: the multiplier"
    ):
        ldtp.htf([0.1, f])
    integrator = hj.LDTP(np.ones((4, 1, 1)), np.ones((4, 1, 1)), np.ones((4, 1, 1)))
    with pytest.raises(
        hj.DefinitionError, match="f = 2 cycles per period is unbounded"
    ):
        integrator.htf([0.3, 2.0, 0.7])
    with pytest.raises(hj.DefinitionError, match="`f` holds 0.1 .* twice"):
        hj.HTF([0.1, 0.1], np.ones((1, 2, 1, 1)), 0, 4)
