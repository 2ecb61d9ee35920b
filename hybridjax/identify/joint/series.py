r"""Errors of predictions one step ahead, and their derivatives.

$$e[n] = y[n] - C[n] x[n] - D[n] u[n], \qquad x[n+1] = A[n] x[n] + B[n] u[n] + K[n] e[n]$$

With K = 0 these are the errors of a simulation (output error). A change of the matrices at
section n changes the predictions by $\delta C\,x + \delta D\,u$ there, and the next state by
$\delta A\,x + \delta B\,u + \delta K\,e - K (\delta C\,x + \delta D\,u)$, which decays with
$F = A - K C$. Where an output is missing, the mean of its error, given the others at this sample,
stands for the error.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .coordinates import LocalCoordinates
from .normal_equations import NormalEquations
from .periodic_model import PeriodicModel
from .recursion import recursion
from .series_part import SeriesPart, solve_starts


# Smallest standard deviation of an error, in units of the outputs' rms: rounding. Doubled: outputs
# without noise count half as much beside noisy ones.
_ROUNDING = 1e-15


class Path(NamedTuple):
    """What a model makes of records, section by section."""

    F: list[Float[np.ndarray, "R1 T1 after d"]]
    gain: list[Float[np.ndarray, "R1 T1 after ny"]]
    """K, as it acts on the errors of outputs that are seen,"""
    mean: list[Float[np.ndarray, "R1 T1 ny ny"]]
    """the mean of all errors, given these,"""
    whiten: list[Float[np.ndarray, "R1 T1 ny ny"]]
    """and what makes these independent with variance one."""
    x: list[Float[np.ndarray, "R T d"]]
    error: list[Float[np.ndarray, "R T ny"]]
    """Zero where an output is not seen."""
    starts: list[Float[np.ndarray, "R rows s"]]
    """What the states at the starts add to predictions, whitened."""
    start_gram: Float[np.ndarray, "R s s"]


class SeriesProblem(NamedTuple):
    """Records that a model is to predict."""

    parts: Iterable[SeriesPart]
    S: Float[np.ndarray, "N ny ny"]
    """Covariance of the errors at each section, by which they are weighted."""
    by_section: bool
    """Whether the covariance is one for each section."""
    free_start: bool
    residuals: int
    """How many numbers are predicted."""

    def cost(self, model: PeriodicModel) -> float:
        """Infinite for a model whose predictions grow beyond all numbers."""
        cost = 0.0
        with np.errstate(all="ignore"):
            for part in self.parts:
                try:
                    path = self.path(model, part)
                except np.linalg.LinAlgError:
                    return np.inf
                cost += sum(
                    float((_times(w, e) ** 2).sum())
                    for w, e in zip(path.whiten, path.error, strict=True)
                )
        return cost if np.isfinite(cost) else np.inf

    def refined(self, model: PeriodicModel, direct: bool) -> PeriodicModel:
        """Itself: there is nothing in which predictions are linear that is cheaper than a step."""
        return model

    def reweighted(self, model: PeriodicModel) -> "SeriesProblem":
        """With the covariance that the errors of a model have."""
        N, ny, _ = self.S.shape
        square, count = np.zeros((N, ny, ny)), np.zeros((N, ny, ny))
        for part in self.parts:
            path = self.path(model, part)
            for n, e in enumerate(path.error):
                square[n] += np.einsum("rti,rtj->ij", e, e)
                seen = part.seen[n].astype(float)
                count[n] += np.einsum("rti,rtj->ij", seen, seen)
        if not self.by_section:
            square[:], count[:] = square.sum(axis=0), count.sum(axis=0)
        values, vectors = np.linalg.eigh(square / np.maximum(count, 1))
        floor = np.maximum(_ROUNDING**2, _ROUNDING * values[:, -1:])
        S = vectors * np.maximum(values, floor)[:, None] @ vectors.swapaxes(1, 2)
        return self._replace(S=S)

    def linearize(self, coordinates: LocalCoordinates) -> NormalEquations:
        P = coordinates.size
        gram, gradient = np.zeros((P, P)), np.zeros(P)
        for part in self.parts:
            path = self.path(coordinates.model, part)
            R, _ = part.shape
            along = np.zeros((R, path.start_gram.shape[1], P))
            for n, J in enumerate(_slopes(coordinates, part, path)):
                J = path.whiten[n] @ part.without_drift(n, J)
                flat = J.reshape(-1, P)
                gram += flat.T @ flat
                gradient += _times(path.whiten[n], path.error[n]).ravel() @ flat
                along += path.starts[n].swapaxes(1, 2) @ J.reshape(R, -1, P)
            solved = solve_starts(path.start_gram, along)
            gram -= np.tensordot(along, solved, ((0, 1), (0, 1)))
        return NormalEquations(gram, gradient)

    def path(self, model: PeriodicModel, part: SeriesPart) -> Path:
        """From the starts that fit best."""
        R, T = part.shape
        given, whiten = zip(*[self._weights(part, n) for n in range(len(self.S))], strict=True)
        gain = [
            K @ G if K.shape[1] else np.zeros((1, 1, len(K), G.shape[-1]))
            for K, G in zip(model.K, given, strict=True)
        ]
        F = [A - G @ C for A, C, G in zip(model.A, model.C, gain, strict=True)]
        direct = [part.u[n] @ D.T for n, D in enumerate(model.D)]
        s = max(model.dims[n] for n in part.first) if self.free_start else 0

        def enter(n, x):
            here = part.first == n
            if s and here.any():
                x[here, 0, :, 1 : 1 + x.shape[2]] = np.eye(x.shape[2])

        def drive(n, later):
            known = (part.y[n] - direct[n]) * part.seen[n]
            later[..., 0] += part.u[n] @ model.B[n].T + _times(gain[n], known)

        x, left, starts = [], [], []
        gram, along = np.zeros((R, s, s)), np.zeros((R, s, 1))
        for n, at in enumerate(recursion(F, (R, T, 1 + s), enter, drive, [1 + s] * len(F))):
            seen = model.C[n] @ at
            seen[..., 0] = part.y[n] - direct[n] - seen[..., 0]
            seen = part.without_drift(n, seen)
            white = whiten[n] @ seen
            rows = white[..., 1:].reshape(R, seen.shape[1] * seen.shape[2], s)
            gram += rows.swapaxes(1, 2) @ rows
            along += rows.swapaxes(1, 2) @ white[..., :1].reshape(R, -1, 1)
            x.append(at)
            left.append(seen)
            starts.append(rows)
        x0 = solve_starts(gram, along)[:, None]
        return Path(
            F=F,
            gain=gain,
            mean=list(given),
            whiten=list(whiten),
            x=[at[..., 0] + (at[..., 1:] @ x0)[..., 0] for at in x],
            error=[e[..., 0] - (e[..., 1:] @ x0)[..., 0] for e in left],
            starts=starts,
            start_gram=gram,
        )

    def _weights(self, part: SeriesPart, n: int):
        """At section n: the mean of all errors, given those seen, and what whitens these."""
        S, lost = self.S[n], part.lost[n]
        if not lost.any():
            return np.eye(len(S))[None, None], np.linalg.inv(np.linalg.cholesky(S))[None, None]
        there = 1.0 - lost
        both = there[..., :, None] * there[..., None, :] * S
        both = both + np.eye(len(S)) * lost[..., None]
        mean = (S * there[..., None, :]) @ np.linalg.inv(both)
        return mean, np.linalg.inv(np.linalg.cholesky(both))


def _slopes(
    coordinates: LocalCoordinates, part: SeriesPart, path: Path
) -> Iterator[Float[np.ndarray, "R T ny P"]]:
    """Derivatives of the predictions at each section."""
    model, places = coordinates.model, coordinates.places

    def drive(n, later):
        at, gain, u = places[n], path.gain[n], part.u[n]
        x, after = path.x[n], later.shape[2]

        left = coordinates.to_A[n] - gain @ coordinates.to_C[n]
        later[..., at["Y"]] += _outer(left, x)
        same = np.broadcast_to(np.eye(after), (1, 1, after, after))
        later[..., at["B"]] += _outer(same, u)
        if model.K[n].shape[1]:
            later[..., at["K"]] += _outer(same, _times(path.mean[n], path.error[n]))
        if coordinates.direct:
            later[..., at["D"]] -= _outer(gain, u)

    ends = [max(s.stop for s in at.values()) for at in places]
    R, T = part.shape
    for n, x in enumerate(
        recursion(path.F, (R, T, coordinates.size), lambda n, x: None, drive, ends)
    ):
        at, J = places[n], model.C[n] @ x
        J[..., at["Y"]] += _outer(coordinates.to_C[n][None, None], path.x[n])
        if coordinates.direct:
            J[..., at["D"]] += _outer(np.eye(len(model.C[n]))[None, None], part.u[n])
        yield J


def _times(matrix, x):
    """Of a vector for each sample."""
    return (matrix @ x[..., None])[..., 0]


def _outer(left: Float[np.ndarray, "R1 T1 a q"], right: Float[np.ndarray, "R T b"]):
    """(R, T, a, q b): of each row of the left matrix and the right vector."""
    product = left[..., None] * right[:, :, None, None, :]
    return product.reshape(*product.shape[:3], -1)
