r"""Harmonic transfer functions with their numerators projected out.

Every entry of the HTFs (one harmonic, output and input) obeys $H = B / \chi + \varepsilon$ with a
polynomial B in $z^{-1}$ of its own and one $\chi(z^{-N}) = 1 + c_1 z^{-N} + \ldots + c_d z^{-dN}$
for all. For given c the best numerators are a linear least-squares problem; what they cannot
explain depends on c alone (variable projection: Golub and Pereyra 1973).

Errors are scaled to variance 1 of each real component: $w = \sqrt{2 / E|\varepsilon|^2}$.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Inexact, Int

from ...linear.htf import HTF
from .denominator import chi


# Singular values of the powers of z^-1 below this part of the largest one are rounding errors.
# Doubled: at most one combination of powers is dropped more, which fits change by as little.
_RANK = 1e-13
# Decimal digits to which weights must agree (up to a factor) to be solved for together. One digit
# less: fewer groups, with weights that are off by as much.
_EQUAL_WEIGHTS = 9


class HTFGroup(NamedTuple):
    """Entries of the HTFs with the same equations and, up to a factor, the same weights.

    There are E equations, one per frequency (positive, and negative for pairs of harmonics), K
    entries and R coefficients of each numerator, which are real if `real`. Equations of real
    numerators are split into real and imaginary parts: then there are twice as many `rows`.
    """

    harmonic: Int[np.ndarray, " K"]
    """Where an entry belongs: the place of its harmonic in the HTFs,"""
    mirror: Int[np.ndarray, " K"] | None
    """that of the opposite harmonic, whose conjugate has the same numerator,"""
    channel: Int[np.ndarray, "K 2"]
    """and its output and input."""
    real: bool
    line: Int[np.ndarray, " E"]
    """The frequency that an equation belongs to."""
    period_delay: Complex[np.ndarray, " E"]
    """z^-N, the delay by one period."""
    basis: Inexact[np.ndarray, "rows r"]
    """Orthonormal basis of the powers of z^-1 on these frequencies."""
    to_powers: Inexact[np.ndarray, "R r"]
    """The (smallest) coefficients of the powers that make each element of the basis."""
    weight: Float[np.ndarray, " E"]
    scale: Float[np.ndarray, " K"]
    data: Complex[np.ndarray, "E K"]
    """H times `scale`."""

    @property
    def freedom(self) -> int:
        """Real equations that the numerators of one entry leave."""
        return 2 * len(self.period_delay) - self.basis.shape[1] * (1 if self.real else 2)

    @property
    def size(self) -> int:
        """K, the number of entries."""
        return self.data.shape[1]

    def split(self, values: Complex[np.ndarray, "E n"]) -> Inexact[np.ndarray, "rows n"]:
        """One row for each equation of the numerators."""
        return np.concatenate([values.real, values.imag]) if self.real else values

    def components(self, rows: Inexact[np.ndarray, "rows n"]) -> Float[np.ndarray, "2 E n"]:
        """Real and imaginary parts of what `split` has made."""
        if self.real:
            return rows.reshape(2, len(self.period_delay), -1)
        return np.stack([rows.real, rows.imag])

    def weights(self, c: Float[np.ndarray, " d"]) -> Float[np.ndarray, " E"]:
        """Of the equations chi H = B: errors of H are multiplied by chi there."""
        return self.weight / np.abs(chi(self.period_delay, c))

    def weighted(
        self, c: Float[np.ndarray, " d"], values: Complex[np.ndarray, "E n"]
    ) -> Inexact[np.ndarray, "rows n"]:
        return self.split(self.weights(c)[:, None] * values)

    def numerator_space(
        self, c: Float[np.ndarray, " d"]
    ) -> tuple[Inexact[np.ndarray, "rows r"], Inexact[np.ndarray, "r r"]]:
        """Orthonormal basis of what numerators can explain, and the triangle of its QR."""
        w = self.weights(c)
        return np.linalg.qr(np.concatenate([w, w])[: len(self.basis), None] * self.basis)


class Misfit(NamedTuple):
    """What the numerators of one group cannot explain at some c."""

    residual: Float[np.ndarray, "2 E K"]
    """In units of the error."""
    jacobian: Float[np.ndarray, "d 2 E K"]
    """Its derivative with respect to c (without what vanishes with the residual: Kaufman 1975)."""
    noise: Float[np.ndarray, "d d"]
    """Part of jacobian^T jacobian that comes from errors of variance 1 in the data, per entry."""
    leverage: Float[np.ndarray, "2 E"]
    """Share of each equation that the numerators explain whatever the data are."""


def misfit_of(group: HTFGroup, c: Float[np.ndarray, " d"], noise: bool = False) -> Misfit:
    """The misfit at c and its derivatives; `Misfit.noise` is zero unless asked for."""
    d = len(c)
    q, _ = group.numerator_space(c)
    target = group.weighted(c, chi(group.period_delay, c)[:, None] * group.data)
    explained = q @ (q.conj().T @ target)
    equations = len(group.period_delay)

    def filtered(rows, j):
        """z^-jN / chi times the rows (up to the phase of chi, which all rows share)."""
        factor = group.period_delay**j / chi(group.period_delay, c)
        if group.real:
            rows = group.split(factor[:, None] * (rows[:equations] + 1j * rows[equations:]))
        else:
            rows = factor[:, None] * rows
        return rows - q @ (q.conj().T @ rows)

    slopes = [group.components(filtered(explained, j)) for j in range(1, d + 1)]
    by_noise = np.zeros((d, d))
    if noise:
        leaks = [filtered(q, j).ravel() for j in range(1, d + 1)]
        by_noise = np.array([[np.vdot(a, b).real for a in leaks] for b in leaks])
        by_noise *= 1 if group.real else 2
    leverage = (np.abs(q) ** 2).sum(axis=1)
    leverage = leverage.reshape(2, equations) if group.real else np.stack([leverage, leverage])
    residual = group.components(target - explained)
    return Misfit(residual, np.reshape(slopes, (d, *residual.shape)), by_noise, leverage)


class DelayedResponses(NamedTuple):
    """What numerators leave of $z^{-jN} H$, j = 0, ..., d, weighted by $1/|\\chi|$."""

    columns: Float[np.ndarray, "rows d1"]
    """One for each j, over all entries."""
    noise_gram: Float[np.ndarray, "d1 d1"]
    """The part of their Gram matrix that is expected from errors of variance 1."""

    def noise_root(self) -> Float[np.ndarray, "d1 d1"]:
        """Cholesky's factor of `noise_gram`."""
        return np.linalg.cholesky(self.noise_gram)

    def whitened(self) -> Float[np.ndarray, "d1 r"]:
        """A root of the columns' Gram matrix (which would itself lose half of the digits), in units
        of what is expected from errors alone."""
        return np.linalg.solve(self.noise_root(), np.linalg.qr(self.columns, mode="r").T)


def delayed_responses(groups: list[HTFGroup], c: Float[np.ndarray, " d"]) -> DelayedResponses:
    """Of all groups together. The coefficients of chi combine the columns to errors alone."""
    parts = [_delayed(group, c) for group in groups]
    columns = np.concatenate([part.columns for part in parts])
    return DelayedResponses(columns, sum(part.noise_gram for part in parts))


def _delayed(group: HTFGroup, c: Float[np.ndarray, " d"]) -> DelayedResponses:
    q, _ = group.numerator_space(c)
    columns = []
    for j in range(len(c) + 1):
        column = group.weighted(c, group.period_delay[:, None] ** j * group.data)
        columns.append(group.components(column - q @ (q.conj().T @ column)).ravel())
    leverage = (np.abs(q) ** 2).sum(axis=1)
    leverage = leverage.reshape(2, -1).sum(axis=0) if group.real else 2 * leverage
    left = (2 - leverage) / np.abs(chi(group.period_delay, c)) ** 2
    delays = np.arange(len(c) + 1)
    by_delay = (left * (group.period_delay ** delays[:, None]).real).sum(axis=1)
    noise_gram = by_delay[np.abs(delays[:, None] - delays)] * group.size
    return DelayedResponses(np.stack(columns, axis=1), noise_gram)


def numerators_of(group: HTFGroup, c: Float[np.ndarray, " d"]) -> Inexact[np.ndarray, "R K"]:
    """The best numerators for c, of data that are not scaled."""
    q, triangle = group.numerator_space(c)
    target = group.weighted(c, chi(group.period_delay, c)[:, None] * group.data)
    return group.to_powers @ np.linalg.solve(triangle, q.conj().T @ target) / group.scale


def group_htf(htf: HTF, weight: Float[np.ndarray, "M F ny nu"], size: int) -> list[HTFGroup]:
    """All entries of the HTFs, with numerators of `size` coefficients.

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
        found += _groups(htf, weight, size, np.array(own), None, real=True)
    if pairs:
        negative, positive = np.array(pairs).T
        found += _groups(htf, weight, size, positive, negative, real=False)
    if rest:
        found += _groups(htf, weight, size, np.array(rest), None, real=False)
    return found


def _groups(
    htf: HTF,
    weight: Float[np.ndarray, "M F ny nu"],
    size: int,
    harmonics: Int[np.ndarray, " m"],
    mirror: Int[np.ndarray, " m"] | None,
    real: bool,
) -> list[HTFGroup]:
    """Harmonics whose numerators solve the same kind of problem; one group for each weight."""
    f = np.asarray(htf.f)
    F, ny, nu = len(f), len(htf.outputs), len(htf.inputs)

    def both(values, conjugate):  # negative frequencies after the positive ones
        return values if mirror is None else np.concatenate([values, conjugate])

    def entries(values):  # (M, F, ny, nu) -> (E, K)
        parts = [values[harmonics]] + ([] if mirror is None else [values[mirror].conj()])
        joined = np.moveaxis(np.concatenate(parts, axis=1), 1, 0)
        return joined.reshape(-1, len(harmonics) * ny * nu)

    powers = np.exp(-2j * np.pi / htf.n_sections * f[:, None] * np.arange(size))
    powers, delay = both(powers, powers.conj()), np.exp(-2j * np.pi * f)
    rows = np.concatenate([powers.real, powers.imag]) if real else powers
    basis, to_powers = powers_basis(rows)

    weights, data = entries(weight), entries(np.asarray(htf.H))
    scale = weights[0]
    shape = weights / scale
    _, first, which = np.unique(
        np.round(shape, _EQUAL_WEIGHTS), axis=1, return_index=True, return_inverse=True
    )
    number, i, j = np.unravel_index(np.arange(len(scale)), (len(harmonics), ny, nu))
    channel, line = np.stack([i, j], axis=1), both(np.arange(F), np.arange(F))
    found = []
    for k, one in enumerate(first):
        same = np.flatnonzero(which.ravel() == k)
        found.append(
            HTFGroup(
                harmonic=harmonics[number[same]],
                mirror=None if mirror is None else mirror[number[same]],
                channel=channel[same],
                real=real,
                line=line,
                period_delay=both(delay, delay.conj()),
                basis=basis,
                to_powers=to_powers,
                weight=shape[:, one],
                scale=scale[same],
                data=data[:, same] * scale[same],
            )
        )
    return found


def powers_basis(
    powers: Inexact[np.ndarray, "rows R"],
) -> tuple[Inexact[np.ndarray, "rows r"], Inexact[np.ndarray, "R r"]]:
    """An orthonormal basis of the powers of z^-1 on some frequencies, without combinations that
    these cannot tell from nothing; and the (smallest) coefficients that make each element."""
    u, s, vh = np.linalg.svd(powers, full_matrices=False)
    kept = s > _RANK * s[0]
    return u[:, kept], vh[kept].conj().T / s[kept]
