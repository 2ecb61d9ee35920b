r"""Periodic models on the host: matrices without padding, in local coordinates.

Predictions are linear in $B - K D$, K and D, given $F = A - K C$ and C. The coordinates of each
x[n] are free. They are fixed by the output-normal form

$$\rho^2 F[n]^T F[n] + C[n]^T C[n] = I,$$

in which only those changes of F[n] and C[n] are made whose columns are orthogonal to the columns of
$[\rho F[n]; C[n]]$; no change of the coordinates of states is among these to first order (McKelvey,
Helmersson and Ribarits 2004; Ribarits, Deistler and Hanzon 2005; for each section of the period).
"""

from collections.abc import Callable
from functools import reduce
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..errors import DefinitionError
from ..linear.ldtp import LDTP
from .descent import ROUNDING, NormalEquations


Blocks = list[Float[np.ndarray, "rows columns"]]
"""One matrix for each section."""

# Largest modulus of a multiplier of rho F. At 1 the form does not exist; near 0 the coordinates
# weight the first period only.
_LARGEST_MODULUS = 0.5


class PeriodicModel(NamedTuple):
    """$x[n+1] = A[n] x[n] + B[n] u[n] + K[n] e[n]$, $y[n] = C[n] x[n] + D[n] u[n] + e[n]$."""

    A: Blocks
    """(d[n+1], d[n]) at section n."""
    B: Blocks
    """(d[n+1], nu)."""
    C: Blocks
    """(ny, d[n])."""
    D: Blocks
    """(ny, nu)."""
    K: Blocks
    """(d[n+1], ny), or without columns: then noise does not enter the state."""

    @classmethod
    def of(
        cls, model: LDTP, scale: Float[np.ndarray, " ny"], errors: int = 0
    ) -> "PeriodicModel":
        """Return an `LDTP` with outputs in units of `scale`, and with K = 0 of `errors` columns."""
        dims = [int(d) for d in np.asarray(model.dims)]
        after = [*dims[1:], dims[0]]
        A, B, C, D = (np.asarray(x) for x in (model.A, model.B, model.C, model.D))
        return cls(
            [a[:j, :i] for a, i, j in zip(A, dims, after, strict=True)],
            [b[:j] for b, j in zip(B, after, strict=True)],
            [c[:, :i] / scale[:, None] for c, i in zip(C, dims, strict=True)],
            [d / scale[:, None] for d in D],
            [np.zeros((j, errors)) for j in after],
        )

    def to_ldtp(
        self,
        scale: Float[np.ndarray, " ny"],
        inputs: tuple[str, ...],
        outputs: tuple[str, ...],
    ) -> LDTP:
        """Return the model with outputs in their own units."""
        return LDTP.from_blocks(*self.times(scale)[:4], inputs, outputs)

    def times(self, scale: Float[np.ndarray, " ny"]) -> "PeriodicModel":
        """Return the model with outputs and errors that are larger by these factors."""
        C, D = ([scale[:, None] * x for x in blocks] for blocks in (self.C, self.D))
        return self._replace(C=C, D=D, K=[K / scale[: K.shape[1]] for K in self.K])

    @property
    def dims(self) -> list[int]:
        return [a.shape[1] for a in self.A]

    @property
    def n_sections(self) -> int:
        return len(self.A)

    @property
    def gain(self) -> Blocks:
        """K, (d[n+1], ny); zero where noise does not enter the state."""
        free = zip(self.K, self.C, strict=True)
        return [K if K.shape[1] else np.zeros((len(K), len(C))) for K, C in free]

    @property
    def F(self) -> Blocks:
        """A - K C, of the errors of predictions."""
        return [A - K @ C for A, K, C in zip(self.A, self.gain, self.C, strict=True)]

    def monodromy(self, first: int = 0) -> Float[np.ndarray, "d d"]:
        """Return the product of A over one period from section `first` on."""
        return reduce(
            lambda product, A: A @ product, [*self.A[first:], *self.A[:first]]
        )

    def refined(
        self, direct: bool, linearize: Callable[["LocalCoordinates"], NormalEquations]
    ) -> "PeriodicModel":
        """Return the model with the best B, K and D (if free): predictions and HTFs are linear in
        them.

        **Raises:** `LinAlgError` for a model that is resonant or overflows.
        """
        to_A, to_C = (
            [np.zeros((len(x), 0)) for x in blocks] for blocks in (self.A, self.C)
        )
        coordinates = LocalCoordinates(self, to_A, to_C, direct)
        return coordinates.moved(linearize(coordinates).step(0.0)[0])


class LocalCoordinates(NamedTuple):
    """Directions in which a model can change: Y in F and C, and the entries of B - K D, K and D."""

    model: PeriodicModel
    """In output-normal form."""
    to_A: list[Float[np.ndarray, "after q"]]
    """A changes by `to_A @ Y` with Y (q, d), F by `to_A - K to_C` times Y."""
    to_C: list[Float[np.ndarray, "ny q"]]
    """C changes by `to_C @ Y`."""
    direct: bool
    """Whether D is free."""

    def blocks(self, n: int) -> list[tuple[str, tuple[int, int]]]:
        """Return the names and shapes of the free blocks at section n, in order."""
        (after, d) = self.model.A[n].shape
        (ny, nu) = self.model.D[n].shape
        free = [("Y", (self.to_A[n].shape[1], d)), ("B", (after, nu))]
        free.append(("K", (after, self.model.K[n].shape[1])))
        return free + ([("D", (ny, nu))] if self.direct else [])

    @property
    def places(self) -> list[dict[str, slice]]:
        """The entries of each block in a vector of coordinates, for each section."""
        out = []
        first = 0
        for n in range(self.model.n_sections):
            places = {}
            for name, (rows, columns) in self.blocks(n):
                places[name] = slice(first, first + rows * columns)
                first += rows * columns
            out.append(places)
        return out

    @property
    def size(self) -> int:
        """The number of coordinates."""
        return max(place.stop for place in self.places[-1].values())

    def moved(self, step: Float[np.ndarray, " P"]) -> PeriodicModel:
        """Return the model with these coordinates; those of `model` are zero.

        A and B follow from F and B - K D, so that steps go straight where A and K C nearly cancel.
        """
        A, B, C, D, K = map(list, self.model)
        places = self.places
        F = self.model.F
        gain = self.model.gain
        for n in range(self.model.n_sections):
            change = {
                name: step[places[n][name]].reshape(s) for name, s in self.blocks(n)
            }
            K[n] = K[n] + change["K"]
            later = K[n] if K[n].shape[1] else gain[n]
            F[n] = F[n] + (self.to_A[n] - gain[n] @ self.to_C[n]) @ change["Y"]
            C[n] = C[n] + self.to_C[n] @ change["Y"]
            A[n] = F[n] + later @ C[n]
            B[n] = B[n] - gain[n] @ D[n] + change["B"]
            D[n] = D[n] + change.get("D", 0.0)
            B[n] = B[n] + later @ D[n]
        return PeriodicModel(A, B, C, D, K)


def local_coordinates(model: PeriodicModel, direct: bool) -> LocalCoordinates:
    """Return coordinates around a model, whose states are brought to output-normal form.

    **Raises:** `DefinitionError` for unobservable states.
    """
    N = model.n_sections
    predictor = model._replace(A=model.F)
    largest = np.abs(np.linalg.eigvals(predictor.monodromy())).max()
    rho = float((_LARGEST_MODULUS / max(largest, _LARGEST_MODULUS)) ** (1 / N))
    roots, back = zip(
        *[_root(n, P) for n, P in enumerate(_gramians(predictor, rho))], strict=True
    )
    after = (*roots[1:], roots[0])
    model = PeriodicModel(
        [after[n].T @ model.A[n] @ back[n] for n in range(N)],
        [after[n].T @ model.B[n] for n in range(N)],
        [model.C[n] @ back[n] for n in range(N)],
        model.D,
        [after[n].T @ model.K[n] for n in range(N)],
    )
    to_A = []
    to_C = []
    for F, K, C in zip(model.F, model.gain, model.C, strict=True):
        left = np.linalg.qr(np.concatenate([rho * F, C]), mode="complete")[0][
            :, F.shape[1] :
        ]
        to_C.append(left[len(F) :])
        to_A.append(left[: len(F)] / rho + K @ to_C[-1])
    return LocalCoordinates(model, to_A, to_C, direct)


def _gramians(model: PeriodicModel, rho: float) -> Blocks:
    """Return $P[n] = C[n]^T C[n] + \\rho^2 A[n]^T P[n+1] A[n]$, the observability Gramians."""

    def around(P: Float[np.ndarray, "d d"]) -> Blocks:
        out = []
        for A, C in zip(reversed(model.A), reversed(model.C), strict=True):
            P = C.T @ C + rho**2 * A.T @ P @ A
            out.append(P)
        return out[::-1]

    d = model.dims[0]
    P = around(np.zeros((d, d)))[0]
    phi = rho**model.n_sections * model.monodromy()
    for _ in range(
        6
    ):  # periods are doubled until the remainder, 0.5^(2^6), is rounding
        P = P + phi.T @ P @ phi
        phi = phi @ phi
    return around(P)


def _root(n: int, gramian: Float[np.ndarray, "d d"]) -> tuple[np.ndarray, np.ndarray]:
    """Return L with L L^T = P, and L^-T."""
    values, vectors = np.linalg.eigh(gramian)
    if not values[0] > ROUNDING * values[-1]:
        raise DefinitionError(
            f"a state at section {n} of the model has no effect on the outputs: give a minimal "
            "model."
        )
    return vectors * np.sqrt(values), vectors / np.sqrt(values)


def characteristic_slopes(
    coordinates: LocalCoordinates,
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, "d P"]]:
    r"""Return coefficients $c_1, \ldots, c_d$ of $\det(\lambda I - \Phi)$ and their derivatives.

    They are computed at the section with the smallest dimension d (recursion of Faddeev and
    Leverrier).
    """
    model = coordinates.model
    places = coordinates.places
    N = model.n_sections
    first = int(np.argmin(model.dims))
    phi = model.monodromy(first)
    d = min(model.dims)
    M = np.eye(d)
    c = []
    by_phi = []
    for k in range(1, d + 1):
        by_phi.append(-M.T)
        c.append(-np.trace(phi @ M) / k)
        M = phi @ M + c[-1] * np.eye(d)
    slopes = np.zeros((d, coordinates.size))
    order = [(first + k) % N for k in range(N)]
    before = accumulate(
        (model.A[n] for n in order[:-1]), lambda P, A: A @ P, initial=np.eye(d)
    )
    after = np.eye(d)
    for n, entering in zip(reversed(order), reversed(list(before)), strict=True):
        by_A = after.T @ np.array(by_phi) @ entering.T
        slopes[:, places[n]["Y"]] = (coordinates.to_A[n].T @ by_A).reshape(d, -1)
        if model.K[n].shape[1]:
            slopes[:, places[n]["K"]] = (by_A @ model.C[n].T).reshape(d, -1)
        after = after @ model.A[n]
    return np.array(c), slopes
