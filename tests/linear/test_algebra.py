"""Series, parallel, inverse and feedback, against transfer matrices of lifted systems."""

import dataclasses

import equinox as eqx
import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj

from .conftest import blocks_at_random


N = 4
IN = {"u": "N", "w": ""}
OUT = {"y": "m", "v": ""}
# All lines f + integers of four classes, among them those that are their own mirror images.
F = np.array([0, 0.5, 1, 1.5, 2, 0.3, 1.3, 0.7, 1.7, -0.2, 0.8, 1.8, -1.2])


def system(seed, dims, inputs=IN, outputs=OUT, through=1.0):
    A, B, C, D = blocks_at_random(seed, dims, len(outputs), len(inputs))
    return hj.linear.LDTP.from_blocks(
        A, B, C, [through * d for d in D], inputs, outputs
    )


def lifted(ldtp, z):
    """The transfer matrices from all inputs of a period to all outputs of it."""
    A = np.asarray(ldtp.A)
    B = np.asarray(ldtp.B)
    C = np.asarray(ldtp.C)
    D = np.asarray(ldtp.D)
    n = A.shape[1]
    nu = D.shape[2]
    # States and inputs as functions of the state at section 0 and of all inputs.
    everything = np.eye(n + N * nu)
    x = everything[:n]
    outputs = []
    for k in range(N):
        first = n + k * nu
        after = n + (k + 1) * nu
        u = everything[first:after]
        output = C[k] @ x + D[k] @ u
        outputs.append(output)
        forced = B[k] @ u
        x = A[k] @ x + forced
    y = np.concatenate(outputs)
    shift = z[:, None, None] * np.eye(n)
    of_state = x[:, :n]
    resolvent = np.linalg.inv(shift - of_state)
    by_state = y[:, :n] @ resolvent @ x[:, n:]
    return by_state + y[:, n:]


@pytest.fixture(scope="module")
def pair():
    plant = system(0, (3, 2, 4, 1))
    controller = system(1, (1, 2, 1, 3), OUT, IN, 0.1)
    return plant, controller


def test_systems_against_lifted_ones(pair):
    P, K = pair
    f = np.array([0.0, 0.17, 0.5])
    z = np.exp(2j * np.pi * f)
    plant = lifted(P, z)
    controller = lifted(K, z)
    one = np.eye(2 * N)

    def require(system, expected):
        assert_allclose(lifted(system, z), expected, rtol=0, atol=1e-12)

    require(P @ K, plant @ controller)
    require(P + P, plant + plant)
    require(P.inverse(), np.linalg.inv(plant))
    closed = np.linalg.solve(one + plant @ controller, plant)
    require(P.feedback(K), closed)
    gain = 0.1 * np.eye(2)
    require(P.feedback(gain), np.linalg.solve(one + 0.1 * plant, plant))

    assert P.feedback(K).inputs == tuple(IN)
    assert (P @ K).inputs == tuple(OUT)
    assert (P @ K).outputs == tuple(OUT)
    program = eqx.filter_jit(lambda P, K: P.feedback(K).htf(0.3).H)
    inside = program(P, K)
    assert_allclose(inside, P.feedback(K).htf(0.3).H, rtol=0, atol=1e-12)


def test_transfer_functions_against_systems(pair):
    P, K = pair
    H = P.htf(F)
    G = K.htf(F)
    for ours, exact in (
        (H @ G, P @ K),
        (H @ K, P @ K),
        (H + H, P + P),
        (H.inverse(), P.inverse()),
        (H.feedback(G), P.feedback(K)),
    ):
        assert_allclose(ours.H, exact.htf(F).H, rtol=0, atol=1e-12)
        assert ours.source == "exact"
        assert ours.variance is None
        assert ours.inputs == exact.inputs
        assert ours.outputs == exact.outputs


@pytest.mark.parametrize(
    "operation",
    [hj.linear.HTF.__matmul__, lambda H, G: H.inverse(), hj.linear.HTF.feedback],
    ids=["series", "inverse", "feedback"],
)
def test_variances_are_those_of_draws(operation, pair):
    P, K = pair
    H = P.htf(F[5:])
    G = K.htf(F[5:])
    rng = np.random.default_rng(0)
    size = 1e-5

    def draws(htf):
        parts = rng.normal(size=(200, *htf.H.shape, 2))
        draws = parts @ [1, 1j]
        noise = size / np.sqrt(2) * draws
        return np.asarray(htf.H) + noise

    def with_variance(htf):
        variance = np.full(htf.H.shape, size**2)
        return dataclasses.replace(htf, source="estimate", variance=variance)

    @jax.jit
    @jax.vmap
    def results(H_draw, G_draw):
        noisy_H = eqx.tree_at(lambda htf: htf.H, H, H_draw)
        noisy_G = eqx.tree_at(lambda htf: htf.H, G, G_draw)
        return operation(noisy_H, noisy_G).H

    drawn = np.asarray(results(draws(H), draws(G)))
    error = drawn - operation(H, G).H
    scatter = np.mean(np.abs(error) ** 2, axis=0)
    variance = operation(with_variance(H), with_variance(G)).variance
    ratio = scatter / np.asarray(variance)
    # (Errors of neighboring entries are those of the same draws.)
    assert abs(ratio.mean() - 1) < 0.08
    assert ratio.std() < 0.1


def test_what_does_not_fit_is_refused(pair):
    P, K = pair

    def refused(text):
        return pytest.raises(hj.errors.DefinitionError, match=text)

    with refused(r"'y' \(m\).*'y' \(mm\)"):
        other_units = system(1, (1, 2, 1, 3), {"y": "mm", "v": ""}, IN)
        P.feedback(other_units)
    with refused("are not the inputs"):
        P @ P
    with refused("different n_sections"):
        P @ system(2, (2, 2), OUT, IN)
    with refused("needs a square and invertible D"):
        system(2, (2, 2, 2, 2), through=0).inverse()
    with refused("answers itself at section 2"):
        inverse = np.linalg.inv(P.D[2])
        blocking = K.D.at[2].set(-inverse)
        eqx.tree_at(lambda x: x.D, K, blocking).feedback(P)
    with refused(r"of shape \(2 inputs, 2 outputs\) or of shape \(4 sections"):
        P.feedback(np.eye(3))
    with refused("do not hold f = 1.3"):
        P.htf([0.3, 0.7]).inverse()
    with refused("needs all 4 harmonics"):
        of_plant = P.htf(F, (0, 1))
        of_plant @ K.htf(F, (0, 1))
