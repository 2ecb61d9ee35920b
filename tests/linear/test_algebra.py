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
    return hj.LDTP.from_blocks(A, B, C, [through * d for d in D], inputs, outputs)


def lifted(ldtp, z):
    """The transfer matrices from all inputs of a period to all outputs of it."""
    A, B, C, D = map(np.asarray, (ldtp.A, ldtp.B, ldtp.C, ldtp.D))
    n = A.shape[1]
    nu = D.shape[2]
    x = np.eye(
        n, n + N * nu
    )  # as a function of the state at section 0, and of all inputs
    rows = []
    for k in range(N):
        u = np.eye(N * nu, n + N * nu, n)[k * nu : (k + 1) * nu]
        rows.append(C[k] @ x + D[k] @ u)
        x = A[k] @ x + B[k] @ u
    y = np.concatenate(rows)
    resolvent = np.linalg.inv(z[:, None, None] * np.eye(n) - x[:, :n])
    return y[:, :n] @ resolvent @ x[:, n:] + y[:, n:]


@pytest.fixture(scope="module")
def pair():
    return system(0, (3, 2, 4, 1)), system(1, (1, 2, 1, 3), OUT, IN, 0.1)


def test_systems_against_lifted_ones(pair):
    P, F = pair
    z = np.exp(2j * np.pi * np.array([0.0, 0.17, 0.5]))
    a = lifted(P, z)
    b = lifted(F, z)
    one = np.eye(2 * N)
    for ours, exact in (
        (P @ F, a @ b),
        (P + P, a + a),
        (P.inverse(), np.linalg.inv(a)),
        (P.feedback(F), np.linalg.solve(one + a @ b, a)),
        (P.feedback(0.1 * np.eye(2)), np.linalg.solve(one + 0.1 * a, a)),
    ):
        assert_allclose(lifted(ours, z), exact, rtol=0, atol=1e-12)
    assert P.feedback(F).inputs == tuple(IN)
    assert (P @ F).inputs == (P @ F).outputs == tuple(OUT)
    inside = eqx.filter_jit(lambda P, F: P.feedback(F).htf(0.3).H)(P, F)
    assert_allclose(inside, P.feedback(F).htf(0.3).H, rtol=0, atol=1e-12)


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


def test_variances_are_those_of_draws(pair):
    H, G = (x.htf(F[5:]) for x in pair)
    rng = np.random.default_rng(0)
    size = 1e-5

    def drawn(x):
        noise = rng.normal(size=(200, *x.H.shape, 2)) @ [1, 1j] * size / np.sqrt(2)
        return np.asarray(x.H) + noise

    def known(x):
        return dataclasses.replace(
            x, source="estimate", variance=np.full(x.H.shape, size**2)
        )

    for operation in (hj.HTF.__matmul__, lambda H, G: H.inverse(), hj.HTF.feedback):

        @jax.jit
        @jax.vmap
        def values(*of_htfs):
            pairs = zip((H, G), of_htfs, strict=True)
            return operation(*(eqx.tree_at(lambda x: x.H, *pair) for pair in pairs)).H  # noqa: B023

        error = np.asarray(values(drawn(H), drawn(G))) - operation(H, G).H
        variance = operation(known(H), known(G)).variance
        ratio = np.mean(np.abs(error) ** 2, axis=0) / np.asarray(variance)
        # (Errors of neighboring entries are those of the same draws.)
        assert abs(ratio.mean() - 1) < 0.08
        assert ratio.std() < 0.1


def test_what_does_not_fit_is_refused(pair):
    P, K = pair

    def refused(text):
        return pytest.raises(hj.DefinitionError, match=text)

    with refused(r"'y' \(m\).*'y' \(mm\)"):
        P.feedback(system(1, (1, 2, 1, 3), {"y": "mm", "v": ""}, IN))
    with refused("are not the inputs"):
        P @ P
    with refused("different n_sections"):
        P @ system(2, (2, 2), OUT, IN)
    with refused("needs a square and invertible D"):
        system(2, (2, 2, 2, 2), through=0).inverse()
    with refused("answers itself at section 2"):
        eqx.tree_at(lambda x: x.D, K, K.D.at[2].set(-np.linalg.inv(P.D[2]))).feedback(P)
    with refused(r"of shape \(2 inputs, 2 outputs\) or of shape \(4 sections"):
        P.feedback(np.eye(3))
    with refused("do not hold f = 1.3"):
        P.htf([0.3, 0.7]).inverse()
    with refused("needs all 4 harmonics"):
        P.htf(F, (0, 1)) @ K.htf(F, (0, 1))
