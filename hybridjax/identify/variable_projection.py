r"""Harmonic transfer functions with their numerators eliminated.

Every entry of the HTFs (one harmonic, output and input) obeys $H = B / \chi + \varepsilon$ with a
polynomial B in $z^{-1}$ of its own and one $\chi(z^{-N}) = 1 + c_1 z^{-N} + \ldots + c_d z^{-dN}$
for all. For given c the best numerators solve a linear least-squares problem, whose residual
depends on c alone (variable projection: Golub and Pereyra 1973).

Errors are scaled to variance 1 of each real component: $w = \sqrt{2 / E|\varepsilon|^2}$.
"""

from itertools import count
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Inexact, Int

from ..errors import DefinitionError
from ..linear.htf import HTF
from .denominator import Covariance, chi, inverse_of_remainder, sandwich
from .descent import NO_LEADING_COEFFICIENT, ROUNDING, Coefficients, least_squares


# Decimal digits to which weights must agree (up to a factor) to be solved for together. More: a
# group for each entry, which takes longer; fewer: weights that are off by as much.
EQUAL_WEIGHTS = 9
# Weighted solutions of the linearized problem, at most, and the change of c, relative to 1 + |c|,
# that ends them. More, smaller: a closer start, which the descent does not need.
_MAX_REWEIGHTINGS, _SETTLED_START = 6, 1e-3


class HTFGroup(NamedTuple):
    """Entries of the HTFs with the same equations and, up to a factor, the same weights.

    There are E equations, one per frequency (positive, and negative for pairs of harmonics), K
    entries and R coefficients of each numerator, which are real if `real`. Equations of real
    numerators are split into real and imaginary parts: then there are twice as many `rows`.
    """

    harmonic: Int[np.ndarray, " K"]
    """The position of an entry's harmonic in the HTFs,"""
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
        """Return one row for each equation of the numerators."""
        return np.concatenate([np.real(values), np.imag(values)]) if self.real else values

    def components(self, rows: Inexact[np.ndarray, "rows n"]) -> Float[np.ndarray, "2 E n"]:
        """Return the real and imaginary parts of rows that `split` has made."""
        if self.real:
            return rows.reshape(2, len(self.period_delay), -1)
        return np.stack([np.real(rows), np.imag(rows)])

    def weighted(
        self, c: Coefficients, values: Complex[np.ndarray, "E n"]
    ) -> Inexact[np.ndarray, "rows n"]:
        """Return the rows of chi H = B, weighted: errors of H are multiplied by chi there."""
        return self.split((self.weight / np.abs(chi(self.period_delay, c)))[:, None] * values)

    def numerator_space(
        self, c: Coefficients
    ) -> tuple[Inexact[np.ndarray, "rows r"], Inexact[np.ndarray, "r r"]]:
        """Return an orthonormal basis of the numerators' weighted values, and its QR's triangle."""
        w = self.weight / np.abs(chi(self.period_delay, c))
        return np.linalg.qr(np.concatenate([w, w])[: len(self.basis), None] * self.basis)

    def leverage(self, q: Inexact[np.ndarray, "rows r"]) -> Float[np.ndarray, "2 E"]:
        """Return the share of each real equation that the numerators explain for any data."""
        share = (np.abs(q) ** 2).sum(axis=1)
        return share.reshape(2, -1) if self.real else np.stack([share, share])


class Misfit(NamedTuple):
    """The residual of one group at some c, with the best numerators."""

    residual: Float[np.ndarray, "2 E K"]
    """In units of the error."""
    jacobian: Float[np.ndarray, "d 2 E K"]
    """Its derivative with respect to c (without what vanishes with the residual: Kaufman 1975)."""
    noise: Float[np.ndarray, "d d"]
    """Part of jacobian^T jacobian that comes from errors of variance 1 in the data, per entry."""
    leverage: Float[np.ndarray, "2 E"]


def misfit_of(group: HTFGroup, c: Coefficients, noise: bool = False) -> Misfit:
    """Return the misfit at c and its derivatives; `Misfit.noise` is zero unless asked for."""
    d, equations = len(c), len(group.period_delay)
    q, _ = group.numerator_space(c)
    below = chi(group.period_delay, c)[:, None]
    target = group.weighted(c, below * group.data)
    explained = q @ (q.conj().T @ target)

    def filtered(rows, j):
        """z^-jN / chi times the rows (up to the phase of chi, which all rows share)."""
        factor = group.period_delay[:, None] ** j / below
        if group.real:
            rows = rows[:equations] + 1j * rows[equations:]
        rows = group.split(factor * rows)
        return rows - q @ (q.conj().T @ rows)

    slopes = [group.components(filtered(explained, j)) for j in range(1, d + 1)]
    by_noise = np.zeros((d, d))
    if noise:
        leaks = [filtered(q, j).ravel() for j in range(1, d + 1)]
        by_noise = np.array([[np.vdot(a, b).real for a in leaks] for b in leaks])
        by_noise *= 1 if group.real else 2
    residual = group.components(target - explained)
    return Misfit(residual, np.reshape(slopes, (d, *residual.shape)), by_noise, group.leverage(q))


def delayed_responses(
    groups: list[HTFGroup], c: Coefficients
) -> tuple[Float[np.ndarray, "d1 r"], Float[np.ndarray, "d1 d1"]]:
    r"""Return roots of two Gram matrices of $z^{-jN} H$, j = 0, ..., d, less numerators.

    The responses of all groups are weighted by $1/|\chi|$; the coefficients of chi combine them to
    errors alone. The first root is in units of the second, which is that of the Gram matrix that is
    expected from errors of variance 1. (The Gram matrix itself would lose half of the digits.)
    """
    delays, columns, noise_gram = np.arange(len(c) + 1), [], 0.0
    for group in groups:
        q, _ = group.numerator_space(c)
        parts = [group.weighted(c, group.period_delay[:, None] ** j * group.data) for j in delays]
        parts = [group.components(part - q @ (q.conj().T @ part)).ravel() for part in parts]
        columns.append(np.stack(parts, axis=1))
        left = (2 - group.leverage(q).sum(axis=0)) / np.abs(chi(group.period_delay, c)) ** 2
        by_delay = (left * (group.period_delay ** delays[:, None]).real).sum(axis=1)
        noise_gram = noise_gram + by_delay[np.abs(delays[:, None] - delays)] * group.size
    noise = np.linalg.cholesky(noise_gram)
    _, triangle = np.linalg.qr(np.concatenate(columns))
    return np.linalg.solve(noise, triangle.T), noise


def maximum_likelihood(
    groups: list[HTFGroup], order: int, start: Coefficients | None = None
) -> tuple[Coefficients, bool]:
    """Return the coefficients with the smallest misfit, and whether they are a minimum.

    **Arguments:** `start`: where the descent starts. Default: the solution of the linearized
    problem.
    """

    def linearize(c):
        parts = [misfit_of(group, c) for group in groups]
        jacobian = np.concatenate([p.jacobian.reshape(order, -1) for p in parts], axis=1)
        return np.concatenate([p.residual.ravel() for p in parts]), jacobian.T

    return least_squares(linearize, _linearized(groups, order) if start is None else start)


def _linearized(groups: list[HTFGroup], order: int) -> Coefficients:
    """Solve chi H = B by total least squares, weighted by 1/|chi| of the last solution.

    The covariance of the errors is known up to a factor, so that the solution is consistent.
    """
    c = np.zeros(order)
    for _ in range(_MAX_REWEIGHTINGS):
        whitened, noise = delayed_responses(groups, c)
        vectors, _, _ = np.linalg.svd(whitened)
        null = np.linalg.solve(noise.T, vectors[:, -1])
        if abs(null[0]) < NO_LEADING_COEFFICIENT * np.abs(null).max():
            break
        c, last = null[1:] / null[0], c
        if np.abs(c - last).max() < _SETTLED_START * (1 + np.abs(c).max()):
            break
    return c


def summarize(
    groups: list[HTFGroup], c: Coefficients, errors: Literal["residuals", "variance"]
) -> tuple[Covariance, float, int]:
    r"""Return the covariance of the coefficients, the cost, and its expected value.

    The cost is the sum of squares of the misfit in units of the errors supposed; its expected value
    is the number of real equations that the numerators leave.

    With the residuals r, their Jacobian J and its part Q that errors make,
    $\mathrm{Cov}(c) = (J^T J - Q)^{-1} M (J^T J - Q)^{-1}$, where M is the covariance of the
    gradient $J^T r$: $J^T J$ for errors of the variances supposed, or the sum over frequencies of
    the squares of their parts of the gradient. Each part is first made as large as it is on average
    before c takes its share of it (Bell and McCaffrey 2002).
    """
    d = len(c)
    lines = 1 + max(int(group.line.max()) for group in groups)
    score, shares = np.zeros((lines, d)), np.zeros((lines, d, d))
    noise, cost, freedom = np.zeros((d, d)), 0.0, 0
    for group in groups:
        misfit = misfit_of(group, c, noise=True)
        noise += misfit.noise * group.size
        cost += float((misfit.residual**2).sum())
        freedom += group.freedom * group.size
        # A residual is smaller than the error, by the share of its equation in the numerators.
        error = misfit.residual / np.sqrt(1 - misfit.leverage)[..., None]
        np.add.at(score, group.line, np.einsum("jaek,aek->ej", misfit.jacobian, error))
        products = np.einsum("iaek,jaek->eij", misfit.jacobian, misfit.jacobian)
        np.add.at(shares, group.line, products)
    square = shares.sum(axis=0)
    if errors == "variance":
        return sandwich(square - noise, square), cost, freedom
    try:
        root = np.linalg.cholesky(square)
        half = np.linalg.inv(root)
        left = inverse_of_remainder(half @ shares @ half.T, 0.5)
        score = np.einsum("lij,lj->li", left, score @ half.T) @ root.T
    except np.linalg.LinAlgError:  # some combination of coefficients is unknown
        pass
    return sandwich(square - noise, score.T @ score, shares), cost, freedom


def numerators_of(group: HTFGroup, c: Coefficients) -> Inexact[np.ndarray, "R K"]:
    """Return the best numerators for c, of data that are not scaled."""
    q, triangle = group.numerator_space(c)
    target = group.weighted(c, chi(group.period_delay, c)[:, None] * group.data)
    return group.to_powers @ np.linalg.solve(triangle, q.conj().T @ target) / group.scale


def grouped(htf: HTF, order: int, overhang: int | None) -> list[HTFGroup]:
    """Group all entries of the HTFs, weighted by their variances, for so many multipliers."""
    size = numerator_size(htf, order, overhang)
    return group_htf(htf, error_weights(htf, check_values(htf)), size)


def group_htf(htf: HTF, weight: Float[np.ndarray, "M F ny nu"], size: int) -> list[HTFGroup]:
    """Group all entries of the HTFs, with numerators of `size` coefficients.

    Positive and negative frequencies are used, since H_m(-w) = conj H_{-m}(w); where m and -m
    are the same harmonic the numerators are real.
    """
    row_of = {m % htf.n_sections: row for row, m in enumerate(htf.harmonics)}
    opposite = {row: row_of.get(-m % htf.n_sections) for m, row in row_of.items()}
    pairs = {other: row for row, other in opposite.items() if other is not None and row < other}
    kinds = (
        ([row for row, other in opposite.items() if other == row], None, True),
        (list(pairs), list(pairs.values()), False),
        ([row for row, other in opposite.items() if other is None], None, False),
    )
    return [group for kind in kinds if kind[0] for group in _groups(htf, weight, size, *kind)]


def _groups(
    htf: HTF,
    weight: Float[np.ndarray, "M F ny nu"],
    size: int,
    rows: list[int],
    mirror: list[int] | None,
    real: bool,
) -> list[HTFGroup]:
    """Return harmonics whose numerators solve the same problem, one group for each weight."""
    f = np.asarray(htf.f)
    F, ny, nu = len(f), len(htf.outputs), len(htf.inputs)

    def both(values, conjugate):  # negative frequencies after the positive ones
        return values if mirror is None else np.concatenate([values, conjugate])

    def entries(values):  # (M, F, ny, nu) -> (E, K)
        parts = [values[rows]] + ([] if mirror is None else [values[mirror].conj()])
        return np.moveaxis(np.concatenate(parts, axis=1), 1, 0).reshape(-1, len(rows) * ny * nu)

    powers = np.exp(-2j * np.pi / htf.n_sections * f[:, None] * np.arange(size))
    powers, delay = both(powers, powers.conj()), np.exp(-2j * np.pi * f)
    powers = np.concatenate([np.real(powers), np.imag(powers)]) if real else powers
    basis, to_powers = powers_basis(powers)
    weights, data = entries(weight), entries(np.asarray(htf.H))
    scale = weights[0]
    shape = weights / scale
    _, first, which = np.unique(
        np.round(shape, EQUAL_WEIGHTS), axis=1, return_index=True, return_inverse=True
    )
    number, i, j = np.unravel_index(np.arange(len(scale)), (len(rows), ny, nu))
    channel, line = np.stack([i, j], axis=1), both(np.arange(F), np.arange(F))
    groups = []
    for k, representative in enumerate(first):
        same = np.flatnonzero(which.ravel() == k)
        groups.append(
            HTFGroup(
                harmonic=np.array(rows)[number[same]],
                mirror=None if mirror is None else np.array(mirror)[number[same]],
                channel=channel[same],
                real=real,
                line=line,
                period_delay=both(delay, delay.conj()),
                basis=basis,
                to_powers=to_powers,
                weight=shape[:, representative],
                scale=scale[same],
                data=data[:, same] * scale[same],
            )
        )
    return groups


def powers_basis(
    powers: Inexact[np.ndarray, "rows R"],
) -> tuple[Inexact[np.ndarray, "rows r"], Inexact[np.ndarray, "R r"]]:
    """Return an orthonormal basis of the powers of z^-1 on some frequencies.

    Combinations that vanish on these frequencies are left out. The second matrix holds the
    (smallest) coefficients that make each element.
    """
    u, s, vh = np.linalg.svd(powers, full_matrices=False)
    kept = s > 0.1 * ROUNDING * s[0]  # one combination less would change bounds by 0.3 %
    return u[:, kept], vh[kept].conj().T / s[kept]


# Smallest error that an HTF is supposed to have, relative to the rms of its output: that of
# rounding. Smaller: infinite weights; larger: exact outputs count too little beside noisy ones.
SMALLEST_ERROR = 1e-15


def check_values(htf: HTF) -> Float[np.ndarray, " ny"]:
    """Return the rms of each output's HTFs.

    **Raises:** `DefinitionError` for NaN, an output that is zero, or variances that are no
    positive numbers.
    """
    htf.require_sampled("a fit")
    H = np.asarray(htf.H)
    if not np.isfinite(H).all():
        raise DefinitionError("the HTFs hold NaN or infinity.")
    rms = np.sqrt(np.mean(np.abs(H) ** 2, axis=(0, 1, 3)))
    if (rms == 0).any():
        name = htf.outputs[int(np.argmin(rms))]
        raise DefinitionError(f"the HTFs of {name} are zero: leave this output out.")
    if htf.variance is not None:
        bad = np.argwhere(~(np.isfinite(htf.variance) & (np.asarray(htf.variance) >= 0)))
        if len(bad):
            m, k, i, _ = (int(x) for x in bad[0])
            raise DefinitionError(
                f"the variance of H_{htf.harmonics[m]} of {htf.outputs[i]} at f = "
                f"{float(htf.f[k]):g} is not a positive number: estimate it from several "
                "realizations (`Design.realizations`) or windows (`repeats` of estimate_htf)."
            )
    return rms


def error_weights(htf: HTF, rms: Float[np.ndarray, " ny"]) -> Float[np.ndarray, "M F ny nu"]:
    """Return one over the standard deviation of real and imaginary part, known or supposed.

    Variances that were estimated with few degrees of freedom are poor weights: they are replaced
    by the nearest product of a factor for each frequency and one for each harmonic, up to its
    sign (which is the form for white noise and any spectrum of the input).

    **Arguments:** `rms`: where there are no variances, errors are taken as equal parts of it, but
    for the power of the inputs.
    """
    if htf.variance is None:
        return np.broadcast_to(1 / (rms[:, None] * np.sqrt(line_variances(htf))), htf.H.shape)
    variance = np.asarray(htf.variance)
    if htf.scatter is not None:
        freedom = np.asarray(htf.scatter.freedom)
        variance = _product_of_factors(variance, np.asarray(htf.harmonics), freedom)
    return weights_of(variance, rms)


def line_variances(htf: HTF) -> Float[np.ndarray, "F 1 nu"]:
    """Return variances of each frequency and input by white noise, relative to their mean."""
    if htf.power is None:
        return np.ones((len(htf.f), 1, len(htf.inputs)))
    variance = 1 / np.asarray(htf.power)[:, None]
    return variance / variance.mean()


def weights_of(
    variance: Float[np.ndarray, "... ny _"], rms: Float[np.ndarray, " ny"]
) -> Float[np.ndarray, "... ny _"]:
    """Return one over the standard deviation of real and imaginary part."""
    return np.sqrt(2 / np.maximum(variance, (SMALLEST_ERROR * rms[:, None]) ** 2))


def _product_of_factors(
    variance: Float[np.ndarray, "M F ny nu"],
    harmonics: Int[np.ndarray, " M"],
    freedom: Float[np.ndarray, " F"],
) -> Float[np.ndarray, "M F ny nu"]:
    """Return the product of factors of frequency and harmonic with the same sums."""
    if not variance.all():
        return variance
    _, same = np.unique(np.abs(harmonics), return_inverse=True)
    share = freedom / freedom.sum()
    size = np.ones((same.max() + 1, 1, *variance.shape[2:]))
    for _ in range(20):  # more sweeps change nothing in 6 digits
        by_line = (variance / size[same]).mean(axis=0)
        by_harmonic = np.tensordot(share, variance / by_line, axes=(0, 1))
        size = np.stack([by_harmonic[same == k].mean(axis=0) for k in range(len(size))])[:, None]
    return size[same] * by_line


def numerator_size(htf: HTF, order: int, overhang: int | None) -> int:
    """Return how many coefficients each numerator has; `overhang` as of `fit_multipliers`.

    **Raises:** `DefinitionError` for too few frequencies to determine them and the multipliers.
    """
    N = htf.n_sections
    size = order * N + (N if overhang is None else overhang) + 1
    harmonics = {m % N for m in htf.harmonics}
    # Half of a pair, or a harmonic that is its own mirror image, has half as many coefficients.
    unknown = [size if -m % N in harmonics else 2 * size for m in harmonics]
    entries = len(htf.outputs) * len(htf.inputs)

    def enough(frequencies: int) -> bool:
        return sum(max(2 * frequencies - k, 0) for k in unknown) * entries >= order

    if not enough(len(htf.f)):
        raise DefinitionError(
            f"{len(htf.f)} frequencies are too few for numerators of {size} coefficients and "
            f"{order} multipliers: {next(filter(enough, count()))} or more are needed. Measure "
            "more, or lower `order` or `overhang`."
        )
    return size


def error_spectrum(
    groups: list[HTFGroup],
    c: Coefficients,
    f: Float[np.ndarray, " F"],
    lines: Float[np.ndarray, "F 1 nu"],
    outputs: int,
) -> Float[np.ndarray, "F ny nu"]:
    r"""Return the variance of the errors of each output, zero where the residual is zero.

    Noise of the sensors is taken for white; noise that drives the system has the system's poles,
    at all harmonics. The variance of an output is therefore modeled as $a + b / |\chi|^2$, times
    the variances `lines` of frequencies and inputs.

    This is a step of scoring towards the largest restricted likelihood (Patterson and Thompson
    1971), from the weights of the groups, which accounts for the fitted numerators.
    """
    square, expected = np.zeros((outputs, 2)), np.zeros((outputs, 2, 2))
    for group in groups:
        relative = lines[:, 0, group.channel[:, 1]]  # (F, K), columns alike but for factors
        parts = _components(group.period_delay, c) * group.weight**2 * relative[group.line, 0]
        size = group.scale**2 / 2 * relative[0] / relative[0, 0]
        residual = (misfit_of(group, c).residual ** 2).sum(axis=0)
        products = _expected_products(group, c, parts)
        for k, i in enumerate(group.channel[:, 0]):
            square[i] += size[k] * (parts @ residual[:, k])
            expected[i] += size[k] ** 2 * products
    sizes = np.stack([amounts(*pair) for pair in zip(expected, square, strict=True)])
    return (sizes @ _components(np.exp(-2j * np.pi * f), c)).T[..., None] * lines


def _components(
    period_delay: Complex[np.ndarray, " E"], c: Coefficients
) -> Float[np.ndarray, "2 E"]:
    """Return the spectra of white noise and of noise that passes the system."""
    return np.stack([np.ones(len(period_delay)), 1 / np.abs(chi(period_delay, c)) ** 2])


def _expected_products(
    group: HTFGroup, c: Coefficients, parts: Float[np.ndarray, "2 E"]
) -> Float[np.ndarray, "2 2"]:
    """Return tr(G_k R G_l R), where R subtracts the best numerators.

    It is the mean of `parts[k]` times the squares of the residuals, for errors with the variances
    `parts[l]`.
    """
    q, _ = group.numerator_space(c)
    rows = np.concatenate([parts, parts], axis=1)[:, : len(q)]
    taken = (np.abs(q) ** 2).sum(axis=1)
    along = [q.conj().T @ (row[:, None] * q) for row in rows]
    both = np.array([[np.vdot(a, b).real for a in along] for b in along])
    return (1 if group.real else 2) * (rows * (1 - 2 * taken) @ rows.T + both)


def amounts(
    expected: Float[np.ndarray, "2 2"], square: Float[np.ndarray, " 2"]
) -> Float[np.ndarray, " 2"]:
    """Return the amounts of two kinds of noise, none of them negative, from two sums of squares.

    **Arguments:** `expected`: the mean contribution of each kind (columns) to each sum.
    """
    both = np.linalg.lstsq(expected, square)[0]
    if both.min() >= 0:
        return both
    only = int(both.argmax())
    return np.where(np.arange(2) == only, square[only] / expected[only, only], 0.0)
