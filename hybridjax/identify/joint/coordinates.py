r"""Data-driven local coordinates of periodic models: as many as there are models, and no more.

The coordinates of each x[n] are free. They are fixed by the output-normal form

$$\rho^2 A[n]^T A[n] + C[n]^T C[n] = I,$$

in which only those changes of A[n] and C[n] are made whose columns are orthogonal to the columns of
$[\rho A[n]; C[n]]$; no change of the coordinates of states is among these to first order (McKelvey,
Helmersson and Ribarits 2004, for each section of the period).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ...errors import DefinitionError
from .periodic_model import PeriodicModel


# Largest modulus of a multiplier of rho A. Doubled (1): the form does not exist where a multiplier
# has this modulus, and is badly conditioned near it.
_LARGEST_MODULUS = 0.5
# Doublings of the periods that are summed up: what is left out is 0.5^(2^6). One less: 4e-10 of it.
_DOUBLINGS = 6
# Smallest eigenvalue of the observability Gramian, relative to its largest, of a state that is
# seen: below, rounding. Doubled: states seen 1.4 times better are refused.
_UNSEEN = 1e-13


class LocalCoordinates(NamedTuple):
    """Directions in which a model can change: Y in A and C, and the entries of B, K and D."""

    model: PeriodicModel
    """In output-normal form."""
    to_A: list[Float[np.ndarray, "after q"]]
    """A changes by `to_A @ Y` with Y (q, d),"""
    to_C: list[Float[np.ndarray, "ny q"]]
    """C by `to_C @ Y`."""
    direct: bool
    """Whether D is free."""

    def blocks(self, n: int) -> list[tuple[str, tuple[int, int]]]:
        """What is free at section n, with its shape, in order."""
        (after, d), (ny, nu) = self.model.A[n].shape, self.model.D[n].shape
        found = [("Y", (self.to_A[n].shape[1], d)), ("B", (after, nu))]
        found.append(("K", self.model.K[n].shape))
        return found + ([("D", (ny, nu))] if self.direct else [])

    @property
    def places(self) -> list[dict[str, slice]]:
        """Where the entries of each block stand in a vector of coordinates."""
        found, first = [], 0
        for n in range(self.model.n_sections):
            at = {}
            for name, (rows, columns) in self.blocks(n):
                at[name] = slice(first, first + rows * columns)
                first += rows * columns
            found.append(at)
        return found

    @property
    def size(self) -> int:
        """How many coordinates there are."""
        shapes = [s for n in range(self.model.n_sections) for _, s in self.blocks(n)]
        return sum(rows * columns for rows, columns in shapes)

    def moved(self, step: Float[np.ndarray, " P"]) -> PeriodicModel:
        """The model with these coordinates; it itself has zero everywhere."""
        A, B, C, D, K = map(list, self.model)
        places = self.places
        for n in range(self.model.n_sections):
            change = {name: step[places[n][name]].reshape(s) for name, s in self.blocks(n)}
            A[n] = A[n] + self.to_A[n] @ change["Y"]
            C[n] = C[n] + self.to_C[n] @ change["Y"]
            B[n] = B[n] + change["B"]
            K[n] = K[n] + change["K"]
            D[n] = D[n] + change.get("D", 0.0)
        return PeriodicModel(A, B, C, D, K)


def local_coordinates(model: PeriodicModel, direct: bool) -> LocalCoordinates:
    """Around a model, whose states are brought to output-normal form.

    **Raises:** `DefinitionError` if there are states that the outputs never show.
    """
    N, rho = model.n_sections, _discount(model)
    roots, back = zip(*[_root(n, P) for n, P in enumerate(_gramians(model, rho))], strict=True)
    after = (*roots[1:], roots[0])
    model = PeriodicModel(
        [after[n].T @ model.A[n] @ back[n] for n in range(N)],
        [after[n].T @ model.B[n] for n in range(N)],
        [model.C[n] @ back[n] for n in range(N)],
        model.D,
        [after[n].T @ model.K[n] for n in range(N)],
    )
    to_A, to_C = [], []
    for A, C in zip(model.A, model.C, strict=True):
        both = np.concatenate([rho * A, C])
        left = np.linalg.qr(both, mode="complete")[0][:, A.shape[1] :]
        to_A.append(left[: len(A)] / rho)
        to_C.append(left[len(A) :])
    return LocalCoordinates(model, to_A, to_C, direct)


def _discount(model: PeriodicModel) -> float:
    """rho."""
    largest = np.abs(np.linalg.eigvals(model.monodromy())).max()
    return float((_LARGEST_MODULUS / max(largest, _LARGEST_MODULUS)) ** (1 / model.n_sections))


def _gramians(model: PeriodicModel, rho: float) -> list[Float[np.ndarray, "d d"]]:
    """Of observability: $P[n] = C[n]^T C[n] + \\rho^2 A[n]^T P[n+1] A[n]$."""

    def around(P):
        found = []
        for A, C in zip(reversed(model.A), reversed(model.C), strict=True):
            P = C.T @ C + rho**2 * A.T @ P @ A
            found.append(P)
        return found[::-1]

    d = model.dims[0]
    P, phi = around(np.zeros((d, d)))[0], rho**model.n_sections * model.monodromy()
    for _ in range(_DOUBLINGS):
        P, phi = P + phi.T @ P @ phi, phi @ phi
    return around(P)


def _root(n: int, gramian: Float[np.ndarray, "d d"]) -> tuple[np.ndarray, np.ndarray]:
    """L with L L^T = P, and L^-T."""
    values, vectors = np.linalg.eigh(gramian)
    if not values[0] > _UNSEEN * values[-1]:
        raise DefinitionError(
            f"a state at section {n} of the model is never seen in the outputs: give a minimal "
            "model, as of `hj.identify.realize`."
        )
    return vectors * np.sqrt(values), vectors / np.sqrt(values)
