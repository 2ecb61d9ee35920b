r"""Harmonic transfer functions with their numerators projected out.

Every series (one harmonic, output and input) is $H = B / \chi + \varepsilon$ with a polynomial B
in $z^{-1}$ of its own and one $\chi(z^{-N}) = 1 + c_1 z^{-N} + \ldots + c_d z^{-dN}$ for all. For
given c the best numerators are a linear least-squares problem; what they cannot explain depends on
c alone (variable projection: Golub and Pereyra 1973).

Errors are scaled to variance 1 of each real component: $w = \sqrt{2 / E|\varepsilon|^2}$.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Complex, Float, Inexact, Int

from ...linear.htf import HTF


RANK = 1e-13  # singular values below this part of the largest are rounding errors


class Group(NamedTuple):
    """Series with the same equations and, up to a factor, the same weights.

    There are E equations, one per frequency (positive, and negative for pairs of harmonics), K
    series and R unknowns, which are real if `real`.
    """

    rows: Int[np.ndarray, " K"]
    """Which harmonic, in the HTF; with `columns` it says where a series belongs."""
    mirror: Int[np.ndarray, " K"] | None
    """The harmonic with the opposite sign, whose conjugate has the same numerator."""
    columns: Int[np.ndarray, "K 2"]
    """Output and input."""
    real: bool
    line: Int[np.ndarray, " E"]
    """The frequency that an equation belongs to."""
    lag: Complex[np.ndarray, " E"]
    """z^-N."""
    basis: Inexact[np.ndarray, "rows r"]
    """Orthonormal basis of the powers of z^-1 on these frequencies; rows as `split` makes them."""
    to_powers: Inexact[np.ndarray, "R r"]
    """The (smallest) coefficients of the powers that make each element of the basis."""
    weight: Float[np.ndarray, " E"]
    scale: Float[np.ndarray, " K"]
    data: Complex[np.ndarray, "E K"]
    """H times `scale`."""

    @property
    def freedom(self) -> int:
        """Real equations that the numerators of one series leave."""
        return 2 * len(self.lag) - self.basis.shape[1] * (1 if self.real else 2)

    def split(self, values: np.ndarray) -> np.ndarray:
        return np.concatenate([values.real, values.imag]) if self.real else values

    def weights(self, c: Float[np.ndarray, " d"]) -> Float[np.ndarray, " E"]:
        return self.weight / np.abs(chi(self.lag, c))

    def decompose(self, c: Float[np.ndarray, " d"]):
        """Orthonormal basis (rows, r) of what the numerators can explain, and its triangle."""
        w = self.weights(c)
        return np.linalg.qr(np.concatenate([w, w])[: len(self.basis), None] * self.basis)

    def weighted(self, c: Float[np.ndarray, " d"], values: np.ndarray) -> np.ndarray:
        return self.split(self.weights(c)[:, None] * values)

    def components(self, values: np.ndarray) -> Float[np.ndarray, "2 E K"]:
        """Real and imaginary parts."""
        if self.real:
            return values.reshape(2, len(self.lag), -1)
        return np.stack([values.real, values.imag])


class Evaluation(NamedTuple):
    """What the data say at some c, of one group."""

    residual: Float[np.ndarray, "2 E K"]
    """What no numerators explain, in units of the error."""
    jacobian: Float[np.ndarray, "d 2 E K"]
    """Its derivative with respect to c (without what vanishes with the residual: Kaufman 1975)."""
    noise: Float[np.ndarray, "d d"]
    """Part of jacobian^T jacobian that comes from errors of variance 1 in the data, per series."""
    leverage: Float[np.ndarray, "2 E"]
    """Share of each equation that the numerators explain whatever the data are."""


def evaluate(group: Group, c: Float[np.ndarray, " d"], noise: bool = False) -> Evaluation:
    """The misfit at c and its derivatives; `noise` is zero unless asked for."""
    d = len(c)
    q, _ = group.decompose(c)
    target = group.weighted(c, chi(group.lag, c)[:, None] * group.data)
    inside = q @ (q.conj().T @ target)
    rows = len(group.lag)

    def filtered(values, j):
        """z^-jN / chi times what is in the rows (up to the phase of chi, which all rows share)."""
        factor = group.lag**j / chi(group.lag, c)
        if group.real:
            values = group.split(factor[:, None] * (values[:rows] + 1j * values[rows:]))
        else:
            values = factor[:, None] * values
        return values - q @ (q.conj().T @ values)

    columns = [group.components(filtered(inside, j)) for j in range(1, d + 1)]
    own = np.zeros((d, d))
    if noise:
        leaks = [filtered(q, j).ravel() for j in range(1, d + 1)]
        own = np.array([[np.vdot(a, b).real for a in leaks] for b in leaks])
        own *= 1 if group.real else 2
    leverage = (np.abs(q) ** 2).sum(axis=1)
    leverage = leverage.reshape(2, rows) if group.real else np.stack([leverage, leverage])
    residual = group.components(target - inside)
    return Evaluation(residual, np.reshape(columns, (d, *residual.shape)), own, leverage)


def delayed(group: Group, c: Float[np.ndarray, " d"]):
    """What is left of z^{-jN} H, j = 0..d, weighted by 1/|chi|, without the numerators.

    **Returns:** these columns over all series, (rows, d+1), and the part of their Gram matrix
    (d+1, d+1) that is expected from errors of variance 1.
    """
    q, _ = group.decompose(c)
    columns = []
    for j in range(len(c) + 1):
        column = group.weighted(c, group.lag[:, None] ** j * group.data)
        columns.append(group.components(column - q @ (q.conj().T @ column)).ravel())
    leverage = (np.abs(q) ** 2).sum(axis=1)
    leverage = leverage.reshape(2, -1).sum(axis=0) if group.real else 2 * leverage
    left = (2 - leverage) / np.abs(chi(group.lag, c)) ** 2
    by_lag = [float((left * (group.lag**j).real).sum()) for j in range(len(c) + 1)]
    return np.stack(columns, axis=1), scipy.linalg.toeplitz(by_lag) * group.data.shape[1]


def numerators(group: Group, c: Float[np.ndarray, " d"]) -> Inexact[np.ndarray, "R K"]:
    """The best numerators for c, of data that are not scaled."""
    q, triangle = group.decompose(c)
    target = group.weighted(c, chi(group.lag, c)[:, None] * group.data)
    return group.to_powers @ np.linalg.solve(triangle, q.conj().T @ target) / group.scale


def chi(lag: Complex[np.ndarray, " E"], c: Float[np.ndarray, " d"]) -> Complex[np.ndarray, " E"]:
    """1 + c_1 z^-N + ... + c_d z^-dN, with `lag` = z^-N."""
    return np.polynomial.polynomial.polyval(lag, np.concatenate([[1.0], c]))


def groups_of(htf: HTF, weight: Float[np.ndarray, "M F ny nu"], unknowns: int) -> list[Group]:
    """All series of the HTFs, with numerators of so many coefficients.

    Positive and negative frequencies are used, since H_m(-w) = conj H_{-m}(w); where m and -m
    are the same harmonic the numerators are real.
    """
    place = {m % htf.n_sections: row for row, m in enumerate(htf.harmonics)}
    mirror = {row: place.get(-m % htf.n_sections) for m, row in place.items()}
    own = [row for row, other in mirror.items() if other == row]
    pairs = [(row, other) for row, other in mirror.items() if other is not None and row < other]
    rest = [row for row, other in mirror.items() if other is None]
    found = []
    if own:
        found += _groups(htf, weight, unknowns, np.array(own), None, real=True)
    if pairs:
        negative, positive = np.array(pairs).T
        found += _groups(htf, weight, unknowns, positive, negative, real=False)
    if rest:
        found += _groups(htf, weight, unknowns, np.array(rest), None, real=False)
    return found


def _groups(htf: HTF, weight, unknowns: int, rows, mirror, real: bool) -> list[Group]:
    """Harmonics whose numerators solve the same kind of problem; one group for each weight."""
    f = np.asarray(htf.f)
    F, ny, nu = len(f), len(htf.outputs), len(htf.inputs)

    def both(values, conjugate):  # negative frequencies after the positive ones
        return values if mirror is None else np.concatenate([values, conjugate])

    def series(values):  # (M, F, ny, nu) -> (E, K)
        columns = [values[rows]] + ([] if mirror is None else [values[mirror].conj()])
        return np.moveaxis(np.concatenate(columns, axis=1), 1, 0).reshape(-1, len(rows) * ny * nu)

    powers = np.exp(-2j * np.pi / htf.n_sections * f[:, None] * np.arange(unknowns))
    powers, lag = both(powers, powers.conj()), np.exp(-2j * np.pi * f)
    split = np.concatenate([powers.real, powers.imag]) if real else powers
    u, s, vh = np.linalg.svd(split, full_matrices=False)
    kept = s > RANK * s[0]
    basis, to_powers = u[:, kept], vh[kept].conj().T / s[kept]

    weights, data = series(weight), series(np.asarray(htf.H))
    scale = weights[0]
    shape = weights / scale
    _, first, which = np.unique(np.round(shape, 9), axis=1, return_index=True, return_inverse=True)
    number, i, j = np.unravel_index(np.arange(len(scale)), (len(rows), ny, nu))
    columns, line = np.stack([i, j], axis=1), both(np.arange(F), np.arange(F))
    found = []
    for k, one in enumerate(first):
        same = np.flatnonzero(which.ravel() == k)
        found.append(
            Group(
                rows=rows[number[same]],
                mirror=None if mirror is None else mirror[number[same]],
                columns=columns[same],
                real=real,
                line=line,
                lag=both(lag, lag.conj()),
                basis=basis,
                to_powers=to_powers,
                weight=shape[:, one],
                scale=scale[same],
                data=data[:, same] * scale[same],
            )
        )
    return found
