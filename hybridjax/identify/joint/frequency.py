r"""Residuals of harmonic transfer functions, and their derivatives in closed form.

With $z = e^{2 \pi i f / N}$ and periodic $\tilde x$, the response to $u[n] = z^n$ is
$z^n \tilde x[n]$ and

$$z\,\tilde x[n+1] = A[n] \tilde x[n] + B[n], \qquad
H_m = \frac{1}{N} \sum_n e^{-2 \pi i m n / N} (C[n] \tilde x[n] + D[n]).$$

A change of the matrices at section n alone changes $H_m$ by

$$\delta H_m = \frac{1}{N} e^{-2 \pi i m n / N} \left( \nu_m[n] (\delta A\,\tilde x[n] + \delta B)
+ \delta C\,\tilde x[n] + \delta D \right),$$

with $\nu_m[n] = z_m^{-1} \mu_m[n+1]$, $z_m = z e^{2 \pi i m / N}$ and the adjoint
$\mu_m[n] = C[n] + z_m^{-1} \mu_m[n+1] A[n]$.
"""

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from ...linear.htf import HTF
from ..descent import NormalEquations
from .model import LocalCoordinates, PeriodicModel


# Numbers of a Jacobian that are held at once, 32 MB. Larger: memory; smaller: loops in Python.
_HELD = 2**21


class FrequencyProblem(NamedTuple):
    """Harmonic transfer functions to which a model is fitted."""

    f: Float[np.ndarray, " F"]
    harmonics: tuple[int, ...]
    target: Complex[np.ndarray, "M F ny nu"]
    weight: Float[np.ndarray, "M F ny nu"]
    """One over the standard deviation of real and imaginary part."""

    @classmethod
    def of(
        cls, htf: HTF, weight: Float[np.ndarray, "M F ny nu"], scale: Float[np.ndarray, " ny"]
    ) -> "FrequencyProblem":
        """Return the problem with outputs in units of `scale`.

        **Arguments:** `weight`: for outputs in their own units.
        """
        size = scale[:, None]
        return cls(np.asarray(htf.f), htf.harmonics, np.asarray(htf.H) / size, weight * size)

    @property
    def residuals(self) -> int:
        """The number of real residuals."""
        return 2 * self.target.size

    def errors(self, model: PeriodicModel) -> Complex[np.ndarray, "M F ny nu"]:
        """Return the residuals in units of standard deviations."""
        return self.weight * (self.target - transfer(model, self.f, self.harmonics))

    def cost(self, model: PeriodicModel) -> float:
        """Return the sum of squares; infinite for a model that is resonant or overflows."""
        try:
            with np.errstate(all="ignore"):
                cost = float((np.abs(self.errors(model)) ** 2).sum())
        except np.linalg.LinAlgError:
            return np.inf
        return cost if np.isfinite(cost) else np.inf

    def refined(self, model: PeriodicModel, direct: bool) -> PeriodicModel:
        """Return the model with the best B (and D, if free), in which the HTFs are linear.

        **Raises:** `LinAlgError` for a model that is resonant or overflows.
        """
        N, (ny, nu) = model.n_sections, model.D[0].shape
        m = np.array(self.harmonics)
        ends = np.cumsum([0, *[len(B) for B in model.B]]).tolist()
        waves = np.exp(-2j * np.pi / N * np.outer(np.arange(N), m)) / N
        size = ends[-1] + (N * ny if direct else 0)
        gram, along = np.zeros((nu, size, size)), np.zeros((nu, size))
        error = self.errors(model)
        for rows in _chunks(len(self.f), size * len(m) * ny):
            J = np.zeros((size, len(m), rows.stop - rows.start, ny), complex)
            np.concatenate(_after(model, self.f[rows], m), out=J[: ends[-1]])
            if direct:
                D = J[ends[-1] :].reshape(N, ny, *J.shape[1:])
                for i in range(ny):
                    D[:, i, :, :, i] = waves[:, :, None]
            for j in range(nu):
                columns = (J * self.weight[:, rows, :, j]).reshape(size, -1).view(float)
                gram[j] += columns @ columns.T
                along[j] += columns @ np.ascontiguousarray(error[:, rows, :, j]).ravel().view(float)
        each = [NormalEquations(g, a).step(0.0)[0] for g, a in zip(gram, along, strict=True)]
        change = np.stack(each, axis=1)
        B = [B + change[a:b] for B, (a, b) in zip(model.B, pairwise(ends), strict=True)]
        changes = change[ends[-1] :].reshape(-1, ny, nu)
        D = [D + x for D, x in zip(model.D, changes, strict=True)] if direct else model.D
        return model._replace(B=B, D=D)

    def linearize(self, coordinates: LocalCoordinates) -> NormalEquations:
        P, error = coordinates.size, self.errors(coordinates.model)
        gram, gradient = np.zeros((P, P)), np.zeros(P)
        for rows in _chunks(len(self.f), P * self.weight[:, 0].size):
            slopes = _slopes(coordinates, self.f[rows], self.harmonics, self.weight[:, rows])
            J = slopes.reshape(P, -1).view(float)
            gram += J @ J.T
            gradient += J @ np.ascontiguousarray(error[:, rows]).ravel().view(float)
        return NormalEquations(gram, gradient)


def transfer(
    model: PeriodicModel, f: Float[np.ndarray, " F"], harmonics: tuple[int, ...]
) -> Complex[np.ndarray, "M F ny nu"]:
    """Return the harmonic transfer functions of a model."""
    N = model.n_sections
    G = np.stack(
        [
            _real_times(C, x) + D[:, None, :]
            for x, C, D in zip(states_at(model, f), model.C, model.D, strict=True)
        ]
    )  # (N, ny, F, nu)
    waves = np.exp(-2j * np.pi / N * np.outer(harmonics, np.arange(N))) / N
    return np.tensordot(waves, G, 1).swapaxes(1, 2)


def transfer_slopes(
    coordinates: LocalCoordinates, f: Float[np.ndarray, " F"], harmonics: tuple[int, ...]
) -> Iterator[tuple[slice, Complex[np.ndarray, "P M F ny nu"]]]:
    """Iterate over derivatives of the harmonic transfer functions, by groups of frequencies."""
    ny, nu = coordinates.model.D[0].shape
    for rows in _chunks(len(f), coordinates.size * len(harmonics) * ny * nu):
        ones = np.ones((len(harmonics), len(f[rows]), ny, nu))
        yield rows, _slopes(coordinates, f[rows], harmonics, ones)


def _chunks(length: int, size: int) -> list[slice]:
    """Return slices of frequencies, `size` numbers of a Jacobian for each frequency."""
    step = max(_HELD // size, 1)
    return [slice(k, min(k + step, length)) for k in range(0, length, step)]


def _slopes(
    coordinates: LocalCoordinates,
    f: Float[np.ndarray, " F"],
    harmonics: tuple[int, ...],
    weight: Float[np.ndarray, "M F ny nu"],
) -> Complex[np.ndarray, "P M F ny nu"]:
    """Return derivatives of the HTFs times weights."""
    model, places, m = coordinates.model, coordinates.places, np.array(harmonics)
    N, (ny, nu) = model.n_sections, model.D[0].shape
    states, after = states_at(model, f), _after(model, f, m)
    J = np.zeros((coordinates.size, *weight.shape), complex)
    for n, at in enumerate(places):
        wave = _waves(m, n, N)[:, None, None]
        shapes = dict(coordinates.blocks(n))
        left = _real_times(coordinates.to_A[n].T, after[n])  # (q, M, F, ny)
        left += coordinates.to_C[n].T[:, None, None, :] * wave
        Y, B = (J[at[name]].reshape(*shapes[name], *weight.shape) for name in ("Y", "B"))
        for j in range(nu):
            x = states[n][None, :, None, :, None, j]  # (1, d, 1, F, 1)
            np.multiply((left * weight[..., j])[:, None], x, out=Y[..., j])
            B[:, j, ..., j] = after[n] * weight[..., j]
        if coordinates.direct:
            D = J[at["D"]].reshape(*shapes["D"], *weight.shape)
            for i, j in np.ndindex(ny, nu):
                D[i, j, ..., i, j] = wave[..., 0] * weight[..., i, j]
    return J


def _after(model: PeriodicModel, f: Float[np.ndarray, " F"], m: Int[np.ndarray, " M"]):
    """Return derivatives of the HTFs by the state after each section, (d, M, F, ny).

    They are the states of the transposed system, whose sections come in the other order.
    """
    N, ny = model.n_sections, len(model.C[0])
    dual = model._replace(A=[A.T for A in model.A[::-1]], B=[C.T for C in model.C[::-1]])
    states = states_at(dual, np.add.outer(m, f).ravel())[::-1]
    waves = [_waves(m, n, N)[:, None, None] for n in range(N)]
    return [x.reshape(-1, len(m), len(f), ny) * w for x, w in zip(states, waves, strict=True)]


def _waves(m: Int[np.ndarray, " M"], n: int, N: int):
    return np.exp(-2j * np.pi / N * n * m) / N


def states_at(
    model: PeriodicModel, f: Float[np.ndarray, " F"]
) -> list[Complex[np.ndarray, "_ F nu"]]:
    r"""Return $\tilde x$ at each section, (d, F, nu)."""
    N, nu, phi = model.n_sections, model.B[0].shape[1], model.monodromy()
    back = np.exp(-2j * np.pi / N * f)[:, None]

    def around(x):
        states = []
        for A, B in zip(model.A, model.B, strict=True):
            states.append(x)
            x = (_real_times(A, x) + B[:, None, :]) * back
        return states, x

    _, forced = around(np.zeros((len(phi), len(f), nu), complex))
    turn = phi * np.exp(-2j * np.pi * f)[:, None, None]
    return around(np.einsum("fab,bfj->afj", np.linalg.inv(np.eye(len(phi)) - turn), forced))[0]


def _real_times(matrix: Float[np.ndarray, "a b"], x: Complex[np.ndarray, "b *rest"]):
    """Return the product with a real matrix, (a, *rest)."""
    parts = np.ascontiguousarray(x).view(float).reshape(len(x), -1)
    return (matrix @ parts).view(complex).reshape(len(matrix), *x.shape[1:])

