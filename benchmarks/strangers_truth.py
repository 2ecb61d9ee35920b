"""Data of strangers: generators in plain NumPy, which do not import the package.

Each returns data and the truth of `benchmarks/strangers.py`.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np


class Loop(NamedTuple):
    """A linear system with period N: x[i + 1] = A[n] x[i] + B[n] u[i], y[i] = C[n] x[i], with n = i
    mod N."""

    A: np.ndarray
    """(N, d, d)"""
    B: np.ndarray
    """(N, d, 1)"""
    C: np.ndarray
    """(N, ny, d)"""

    @property
    def multipliers(self) -> np.ndarray:
        """Eigenvalues of the product over a period, by decreasing modulus."""
        product = np.eye(self.A.shape[1])
        for matrix in self.A:
            product = matrix @ product
        values = np.linalg.eigvals(product).astype(complex)
        return values[np.argsort(-np.abs(values))]

    def response(self, u: np.ndarray, noise: np.ndarray | None = None) -> np.ndarray:
        """Return outputs (S, n, ny) for inputs (S, n, 1), from rest.

        **Arguments:** `noise` (S, n, d): added to the states after each section.
        """
        N = len(self.A)
        x = np.zeros((len(u), self.A.shape[1]))
        y = np.zeros((*u.shape[:2], self.C.shape[1]))
        for i in range(u.shape[1]):
            n = i % N
            y[:, i] = x @ self.C[n].T
            x = x @ self.A[n].T + u[:, i] @ self.B[n].T
            if noise is not None:
                x = x + noise[:, i]
        return y


def loop_with(
    multipliers: list[complex], N: int, outputs: int, rng: np.random.Generator
) -> Loop:
    """Return a random loop with given multipliers (of a pair the upper one alone)."""
    blocks = []
    for z in np.asarray(multipliers, complex):
        if z.imag:
            blocks.append(np.array([[z.real, z.imag], [-z.imag, z.real]]))
        else:
            blocks.append(np.array([[z.real]]))
    d = sum(len(block) for block in blocks)
    core = np.zeros((d, d))
    at = 0
    for block in blocks:
        core[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    # States between sections are turned at random, and return after a period.
    frames = [np.eye(d) + 0.4 * rng.normal(size=(d, d)) for _ in range(N)]
    frames.append(frames[0])
    A = []
    for n in range(N):
        stage = core if n == N - 1 else np.eye(d)
        A.append(frames[n + 1] @ stage @ np.linalg.inv(frames[n]))
    B = rng.normal(size=(N, d, 1))
    C = rng.normal(size=(N, outputs, d))
    return Loop(np.array(A), B, C)


def periodic_response(loop: Loop, u: np.ndarray, settle: int = 60) -> np.ndarray:
    """Return the periodic response to periodic inputs (S, n, 1)."""
    repeats = -(-settle * len(loop.A) // u.shape[1]) + 1
    y = loop.response(np.tile(u, (1, repeats, 1)))
    return y[:, -u.shape[1] :]
