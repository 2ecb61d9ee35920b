r"""Residuals of harmonic transfer functions, and their derivatives in closed form.

With $z = e^{2 \pi i f / N}$ and periodic $\tilde x$, the response to $u[n] = z^n$ is
$z^n \tilde x[n]$ and

$$z\,\tilde x[n+1] = A[n] \tilde x[n] + B[n], \qquad
H_m = \frac{1}{N} \sum_n e^{-2 \pi i m n / N} (C[n] \tilde x[n] + D[n]).$$

A change of the matrices at section n alone changes $H_m$ by

$$\delta H_m = \frac{1}{N} e^{-2 \pi i m n / N} \left( \nu_m[n] (\delta A\,\tilde x[n] + \delta B)
+ \delta C\,\tilde x[n] + \delta D \right),$$

with $\nu_m[n] = z_m^{-1} \mu_m[n+1]$, $z_m = z e^{2 \pi i m / N}$ and the adjoint $\mu_m[n] = C[n]
+ z_m^{-1} \mu_m[n+1] A[n]$.

`fit_ldtp` calls `FrequencyProblem` for costs and linearized equations; designs and bounds call
`transfer` and `transfer_slopes`. If a derivative is wrong, compare `_fill` with the second formula;
if the HTFs themselves are wrong, look at `states_at`. The order of the axes of an HTF (harmonic,
frequency, output, input) must stay, also in its derivatives, which have the unknown first.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from ...linear.htf import HTF
from ..descent import NormalEquations
from ..periodic import LocalCoordinates, PeriodicModel


# Number of entries of a Jacobian in memory at once (32 MB). Larger: memory. Smaller: loops in
# Python.
_HELD = 2**21


class FrequencyProblem(NamedTuple):
    """Harmonic transfer functions to which a model is fitted."""

    f: Float[np.ndarray, " F"]
    harmonics: tuple[int, ...]
    target: Complex[np.ndarray, "M F ny nu"]
    weight: Float[np.ndarray, "M F ny nu"]
    """The inverse of the standard deviation of real and imaginary part."""

    @classmethod
    def of(
        cls,
        htf: HTF,
        weight: Float[np.ndarray, "M F ny nu"],
        scale: Float[np.ndarray, " ny"],
    ) -> "FrequencyProblem":
        """Return the problem with outputs in units of `scale`.

        **Arguments:** `weight`: for outputs in their own units.
        """
        size = scale[:, None]
        return cls(
            np.asarray(htf.frequencies),
            htf.harmonics,
            np.asarray(htf.H) / size,
            weight * size,
        )

    @property
    def residuals(self) -> int:
        """The number of real residuals."""
        return 2 * self.target.size

    def errors(self, model: PeriodicModel) -> Complex[np.ndarray, "M F ny nu"]:
        """Return the residuals in units of standard deviations."""
        return self.weight * (self.target - transfer(model, self.f, self.harmonics))

    def cost(self, model: PeriodicModel) -> float:
        """Return the sum of squares; infinite or NaN for a model that is resonant or overflows."""
        try:
            with np.errstate(all="ignore"):
                return float((np.abs(self.errors(model)) ** 2).sum())
        except np.linalg.LinAlgError:
            return np.inf

    def linearize(self, coordinates: LocalCoordinates) -> NormalEquations:
        """Return the least-squares problem of the P coordinates around their model."""
        P = coordinates.size
        error = self.errors(coordinates.model)
        gram = np.zeros((P, P))
        gradient = np.zeros(P)
        pieces = transfer_slopes(coordinates, self.f, self.harmonics, self.weight)
        for rows, slopes in pieces:
            J = slopes.reshape(P, -1).view(float)
            gram += J @ J.T
            residual = np.ascontiguousarray(error[:, rows]).ravel()
            gradient += J @ residual.view(float)
        return NormalEquations(gram, gradient)


def transfer(
    model: PeriodicModel, f: Float[np.ndarray, " F"], harmonics: tuple[int, ...]
) -> Complex[np.ndarray, "M F ny nu"]:
    """Return the harmonic transfer functions of a model."""
    N = model.n_sections
    states = states_at(model, f)
    responses = [_outputs(model, n, states[n]) for n in range(N)]
    lags = np.outer(harmonics, np.arange(N))
    waves = np.exp(-2j * np.pi / N * lags) / N
    return np.tensordot(waves, np.stack(responses), 1).swapaxes(1, 2)


def _outputs(
    model: PeriodicModel, n: int, state: Complex[np.ndarray, "d F nu"]
) -> Complex[np.ndarray, "ny F nu"]:
    direct = model.D[n][:, None]
    return _real_times(model.C[n], state) + direct


def transfer_slopes(
    coordinates: LocalCoordinates,
    f: Float[np.ndarray, " F"],
    harmonics: tuple[int, ...],
    weight: Float[np.ndarray, "M F ny nu"] | None = None,
) -> Iterator[tuple[slice, Complex[np.ndarray, "P M F ny nu"]]]:
    """Iterate over derivatives of the HTFs, times weights, by groups of frequencies."""
    model = coordinates.model
    m = np.array(harmonics)
    if weight is None:
        entries = model.D[0].shape
        weight = np.ones((len(m), len(f), *entries))
    # Derivatives by later states are states of the transposed system, with the sections in reverse
    # order.
    dual = model._replace(
        A=[A.T for A in model.A[::-1]], B=[C.T for C in model.C[::-1]]
    )
    numbers = coordinates.size * weight[:, 0].size
    step = max(_HELD // numbers, 1)
    places = coordinates.places
    for first in range(0, len(f), step):
        rows = slice(first, first + step)
        w = weight[:, rows]
        states = states_at(model, f[rows])
        shifted = np.add.outer(m, f[rows]).ravel()
        later = states_at(dual, shifted)[::-1]
        slopes = np.zeros((coordinates.size, *w.shape), complex)
        for n, place in enumerate(places):
            shapes = coordinates.blocks(n)
            blocks = {
                name: slopes[place[name]].reshape(*shape, *w.shape)
                for name, shape in shapes.items()
            }
            N = model.n_sections
            exponents = -2j * np.pi / N * n * m
            waves = np.exp(exponents) / N
            after = later[n].reshape(-1, *w.shape[:3])  # (d, M, F, ny)
            _fill(blocks, coordinates, n, states[n], after, waves, w)
        yield rows, slopes


def _fill(
    blocks: dict[str, Complex[np.ndarray, "..."]],
    coordinates: LocalCoordinates,
    n: int,
    state: Complex[np.ndarray, "d F nu"],
    after: Complex[np.ndarray, "after M F ny"],
    waves: Complex[np.ndarray, " M"],
    weight: Float[np.ndarray, "M F ny nu"],
) -> None:
    """Write the derivatives by the blocks of section n, each (rows, columns, M, F, ny, nu).

    **Arguments:** `after`: derivatives of the HTFs by the next state, without the factor `waves`.
    """
    model = coordinates.model
    wave = waves[:, None, None]
    after = after * wave
    outputs = _outputs(model, n, state)
    by_C = coordinates.to_C[n].T[:, None, None, :] * wave  # (q, M, F, ny)
    by_Y = _real_times(coordinates.to_A[n].T, after) + by_C
    gains = blocks["K"].shape[1]
    for j in range(weight.shape[3]):
        w = weight[..., j]
        x = state[None, :, None, :, None, j]
        weighted = (by_Y * w)[:, None]
        np.multiply(weighted, x, out=blocks["Y"][..., j])
        blocks["B"][:, j, ..., j] = after * w
        if gains:
            blocks["K"][..., j] = (after * w)[:, None] * outputs[
                None, :, None, :, None, j
            ]
    if not coordinates.direct:
        return
    through = _real_times(model.gain[n].T, after)  # (ny, M, F, ny)
    for i, j in np.ndindex(model.D[n].shape):
        D = blocks["D"][i, j, ..., j]
        D += through[i] * weight[..., j]
        D[..., i] += wave[..., 0] * weight[..., i, j]


def states_at(
    model: PeriodicModel, f: Float[np.ndarray, " F"]
) -> list[Complex[np.ndarray, "_ F nu"]]:
    r"""Return $\tilde x$ at each section, (d, F, nu)."""
    N = model.n_sections
    nu = model.B[0].shape[1]
    phi = model.monodromy()
    exponents = -2j * np.pi / N * f
    back = np.exp(exponents)[:, None]

    def around(x):
        states = []
        for A, B in zip(model.A, model.B, strict=True):
            states.append(x)
            x = (_real_times(A, x) + B[:, None, :]) * back
        return states, x

    at_rest = np.zeros((len(phi), len(f), nu), complex)
    _, forced = around(at_rest)
    back_a_period = np.exp(-2j * np.pi * f)[:, None, None]
    turn = phi * back_a_period
    resolvent = np.linalg.inv(np.eye(len(phi)) - turn)
    states, _ = around(np.einsum("fab,bfj->afj", resolvent, forced))
    return states


def _real_times(matrix: Float[np.ndarray, "a b"], x: Complex[np.ndarray, "b *rest"]):
    """Return the product with a real matrix, (a, *rest)."""
    values = np.ascontiguousarray(x).view(float)
    parts = values.reshape(len(x), -1)
    product = (matrix @ parts).view(complex)
    return product.reshape(len(matrix), *x.shape[1:])
