r"""Periodic models on the host for fits: matrices without padding (`PeriodicModel`), and the local
coordinates in which they are changed (`LocalCoordinates`).

The coordinates of the state x[n] are free at every section. They are fixed by the output-normal
form

$$\rho^2 F[n]^T F[n] + C[n]^T C[n] = I, \qquad F = A - K C.$$

Only those changes of F[n] and C[n] are made whose columns are orthogonal to the columns of $[\rho
F[n]; C[n]]$. To first order, none of these is a change of the coordinates of states (McKelvey,
Helmersson and Ribarits 2004; Ribarits, Deistler and Hanzon 2005; for each section of the period).
Given F and C, predictions are linear in $B - K D$, K and D, which are the other coordinates.

`fit_ldtp`, bounds and designs call `local_coordinates(model)`, and `moved(step)` for the next
model.

If a fit drifts without changing its predictions, look at `local_coordinates`; if a new model is not
the expected one, at `LocalCoordinates.moved`.
"""

from collections.abc import Callable
from functools import reduce
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..errors import DefinitionError
from ..linear.ldtp import LDTP
from .descent import ROUNDING, NormalEquations


Blocks = list[Float[np.ndarray, "rows columns"]]
"""One matrix for each section."""

# Largest modulus of a multiplier of rho F, which determines rho. At 1 the normal form does not
# exist; near 0 the coordinates weight the first period only.
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
        unit = scale[:, None]
        A, B, C, D = (np.asarray(x) for x in model.matrices[:4])
        sections = range(len(dims))
        return cls(
            A=[A[n, : after[n], : dims[n]] for n in sections],
            B=[B[n, : after[n]] for n in sections],
            C=[C[n, :, : dims[n]] / unit for n in sections],
            D=[D[n] / unit for n in sections],
            K=[np.zeros((after[n], errors)) for n in sections],
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
        """Return the model with outputs and errors multiplied by `scale`."""
        unit = scale[:, None]
        return self._replace(
            C=[unit * C for C in self.C],
            D=[unit * D for D in self.D],
            K=[K / scale[: K.shape[1]] for K in self.K],
        )

    @property
    def dims(self) -> list[int]:
        return [a.shape[1] for a in self.A]

    @property
    def n_sections(self) -> int:
        return len(self.A)

    @property
    def gain(self) -> Blocks:
        """K, (d[n+1], ny); zero where noise does not enter the state."""
        if self.K[0].shape[1]:
            return self.K
        return [np.zeros((len(K), len(C))) for K, C in zip(self.K, self.C, strict=True)]

    @property
    def F(self) -> Blocks:
        """A - K C, the matrices by which errors of predictions decay."""
        return [A - K @ C for A, K, C in zip(self.A, self.gain, self.C, strict=True)]

    def monodromy(self, first: int = 0) -> Float[np.ndarray, "d d"]:
        """Return the product of A over one period from section `first` on."""
        factors = [*self.A[first:], *self.A[:first]]
        return reduce(lambda product, A: A @ product, factors)

    @property
    def radius(self) -> float:
        """The largest modulus of a multiplier."""
        return float(np.abs(np.linalg.eigvals(self.monodromy())).max())

    @property
    def of_errors(self) -> "PeriodicModel":
        """The model with A - K C in place of A: its states are the errors of predicted states."""
        return self._replace(A=self.F)

    def refined(
        self, direct: bool, linearize: Callable[["LocalCoordinates"], NormalEquations]
    ) -> "PeriodicModel":
        """Return the model with the best B, K and D (if free): predictions and HTFs are linear in
        them.

        **Raises:** `LinAlgError` for a model that is resonant or overflows.
        """
        fixed_A = [np.zeros((len(A), 0)) for A in self.A]
        fixed_C = [np.zeros((len(C), 0)) for C in self.C]
        coordinates = LocalCoordinates(
            model=self,
            to_A=fixed_A,
            to_C=fixed_C,
            direct=direct,
        )
        step, _ = linearize(coordinates).step(0.0)
        return coordinates.moved(step)


class LocalCoordinates(NamedTuple):
    """Directions in which a model can change: Y in F and C, and the entries of B - K D, K and D."""

    model: PeriodicModel
    """The model, in output-normal form."""
    to_A: list[Float[np.ndarray, "after q"]]
    """A changes by `to_A @ Y` with Y (q, d), F by `to_A - K to_C` times Y."""
    to_C: list[Float[np.ndarray, "ny q"]]
    """C changes by `to_C @ Y`."""
    direct: bool
    """Whether D is free."""

    def blocks(self, n: int) -> dict[str, tuple[int, int]]:
        """Return the shapes of the free blocks at section n by name, in order."""
        after, d = self.model.A[n].shape
        ny, nu = self.model.D[n].shape
        shapes = {
            "Y": (self.to_A[n].shape[1], d),
            "B": (after, nu),
            "K": (after, self.model.K[n].shape[1]),
        }
        if self.direct:
            shapes["D"] = (ny, nu)
        return shapes

    @property
    def places(self) -> list[dict[str, slice]]:
        """For each section, the slice of each block in a vector of coordinates."""
        out = []
        first = 0
        for n in range(self.model.n_sections):
            places = {}
            for name, (rows, columns) in self.blocks(n).items():
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

        A and B are computed from F and B - K D. (Steps in A and K themselves would have to follow a
        curve where A and K C nearly cancel.)
        """
        places = self.places
        moved: list[tuple] = []
        old = zip(*self.model, self.model.F, self.model.gain, strict=True)
        for n, (_, B, C, D, K, F, gain) in enumerate(old):
            place = places[n]
            change = {
                name: step[place[name]].reshape(shape)
                for name, shape in self.blocks(n).items()
            }
            later_K = K + change["K"]
            later_gain = later_K if later_K.shape[1] else gain
            to_F = self.to_A[n] - gain @ self.to_C[n]
            later_F = F + to_F @ change["Y"]
            later_C = C + self.to_C[n] @ change["Y"]
            later_D = D + change.get("D", 0.0)
            later_A = later_F + later_gain @ later_C
            later_B = B - gain @ D + change["B"] + later_gain @ later_D
            moved.append((later_A, later_B, later_C, later_D, later_K))
        return PeriodicModel(*map(list, zip(*moved, strict=True)))


def local_coordinates(model: PeriodicModel, direct: bool) -> LocalCoordinates:
    """Return coordinates around a model, whose states are brought to output-normal form.

    **Raises:** `DefinitionError` for unobservable states.
    """
    N = model.n_sections
    largest = max(model.of_errors.radius, _LARGEST_MODULUS)
    rho = (_LARGEST_MODULUS / largest) ** (1 / N)
    gramians = _gramians(model.of_errors, rho)
    pairs = [_root(n, P) for n, P in enumerate(gramians)]
    roots, back = zip(*pairs, strict=True)
    after = (*roots[1:], roots[0])
    normal = PeriodicModel(
        A=[after[n].T @ model.A[n] @ back[n] for n in range(N)],
        B=[after[n].T @ model.B[n] for n in range(N)],
        C=[model.C[n] @ back[n] for n in range(N)],
        D=model.D,
        K=[after[n].T @ model.K[n] for n in range(N)],
    )
    to_A = []
    to_C = []
    for F, K, C in zip(normal.F, normal.gain, normal.C, strict=True):
        states, d = F.shape
        columns = np.concatenate([rho * F, C])
        orthogonal = np.linalg.qr(columns, mode="complete")[0][:, d:]
        to_C.append(orthogonal[states:])
        by_error = K @ orthogonal[states:]
        to_A.append(orthogonal[:states] / rho + by_error)
    return LocalCoordinates(
        model=normal,
        to_A=to_A,
        to_C=to_C,
        direct=direct,
    )


def _gramians(model: PeriodicModel, rho: float) -> Blocks:
    """Return $P[n] = C[n]^T C[n] + \\rho^2 A[n]^T P[n+1] A[n]$, the observability Gramians."""

    def around(P: Float[np.ndarray, "d d"]) -> Blocks:
        out = []
        for A, C in zip(reversed(model.A), reversed(model.C), strict=True):
            later = rho**2 * A.T @ P @ A
            P = C.T @ C + later
            out.append(P)
        return out[::-1]

    d = model.dims[0]
    P = around(np.zeros((d, d)))[0]
    phi = rho**model.n_sections * model.monodromy()
    # The number of periods is doubled six times, until the remainder, 0.5^(2^6), is a rounding
    # error.
    for _ in range(6):
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
    N = model.n_sections
    d = min(model.dims)
    first = int(np.argmin(model.dims))
    phi = model.monodromy(first)
    adjugate = np.eye(d)
    c: list[float] = []
    by_phi = []
    for k in range(1, d + 1):
        by_phi.append(-adjugate.T)
        c.append(-np.trace(phi @ adjugate) / k)
        adjugate = phi @ adjugate + c[-1] * np.eye(d)
    sections = [(first + k) % N for k in range(N)]
    before = [np.eye(d)]
    for n in sections[:-1]:
        before.append(model.A[n] @ before[-1])
    places = coordinates.places
    after = np.eye(d)
    slopes = np.zeros((d, coordinates.size))
    for n, entering in zip(reversed(sections), reversed(before), strict=True):
        place = places[n]
        by_A = after.T @ np.array(by_phi) @ entering.T
        by_Y = coordinates.to_A[n].T @ by_A
        slopes[:, place["Y"]] = by_Y.reshape(d, -1)
        if model.K[n].shape[1]:
            by_K = by_A @ model.C[n].T
            slopes[:, place["K"]] = by_K.reshape(d, -1)
        after = after @ model.A[n]
    return np.array(c), slopes
