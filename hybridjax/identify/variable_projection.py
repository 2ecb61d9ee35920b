r"""The least-squares problem of `fit_multipliers`: HTFs with one common denominator, whose
numerators are eliminated.

Every entry of the HTFs (one harmonic, output and input) obeys $H = B / \chi + \varepsilon$ with a
polynomial B in $z^{-1}$ of its own, and a common $\chi(z^{-N}) = 1 + c_1 z^{-N} + \ldots + c_d
z^{-dN}$. For given c the best numerators solve a linear least-squares problem, whose residual
depends on c alone (variable projection: Golub and Pereyra 1973).

`multipliers.py` calls `grouped` (entries with equal weights become one `HTFGroup`),
`maximum_likelihood` (the descent over c) and `summarize` (covariance and cost). A *response* is an
entry of the HTFs, or a combination of two entries with real numerator. Residuals and their
derivatives are those of `misfit_of`: test these first.

Errors are scaled to variance 1 of each real component: $w = \sqrt{2 / E|\varepsilon|^2}$. Real
equations are all real parts, then all imaginary parts (`split`). Both must stay. If error bars are
wrong, look at `summarize`; if numerators are, at `unfold`; if HTFs are refused for too few
frequencies, at `numerator_size`.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import count
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Inexact, Int

from ..errors import DefinitionError
from ..linear.htf import HTF
from .denominator import Covariance, chi, inverse_of_remainder, sandwich
from .descent import (
    NO_LEADING_COEFFICIENT,
    ROUGH,
    ROUNDING,
    Coefficients,
    Gradient,
    least_squares,
    without,
)
from .weights import check_values, error_weights


# Number of decimal digits to which weights must agree (up to a factor) for entries to be in one
# group. More: a group for each entry, which takes longer. Fewer: wrong weights.
EQUAL_WEIGHTS = 9
# Largest number of weighted solutions of the linearized problem; and the change of c, relative to 1
# + |c|, that ends them. More solutions or a smaller change: the descent starts closer to the
# minimum, which it does not need.
_MAX_REWEIGHTINGS = 6
_SETTLED_START = 1e-3


class HTFGroup(NamedTuple):
    """Responses with the same equations and, up to a factor, the same weights.

    There are E complex equations for each of K responses, and r real unknowns of its numerator.
    """

    harmonic: Int[np.ndarray, " K"]
    """The position of a response's harmonic in the HTFs."""
    mirror: Int[np.ndarray, " K"]
    """The position of the opposite harmonic; -1 if there is none."""
    share: Complex[np.ndarray, " K"]
    """The factor of the response in the HTF of its harmonic. (The conjugate is its factor in the
    opposite harmonic.)"""
    channel: Int[np.ndarray, "K 2"]
    """Output and input of the response."""
    line: Int[np.ndarray, " E"]
    """Equations with the same number have errors from the same noise: those of one frequency, or of
    one class of frequencies."""
    period_delay: Complex[np.ndarray, " E"]
    """z^-N, the delay by one period."""
    basis: Float[np.ndarray, "2*E r"]
    """Orthonormal basis of the numerators' values on these frequencies."""
    to_powers: Inexact[np.ndarray, "R r"]
    """The (smallest) coefficients of the powers of z^-1 that make each element of the basis."""
    weight: Float[np.ndarray, " E"]
    scale: Float[np.ndarray, " K"]
    data: Complex[np.ndarray, "E K"]
    """The responses times `scale`."""

    @property
    def dof(self) -> int:
        """Real equations that the numerator of one response leaves."""
        return len(self.basis) - self.basis.shape[1]

    @property
    def size(self) -> int:
        """K, the number of responses."""
        return self.data.shape[1]

    def weighted(
        self, c: Coefficients, values: Complex[np.ndarray, "E n"]
    ) -> Float[np.ndarray, "2*E n"]:
        """Return the weighted rows of the equation chi H = B. (Errors of H are multiplied by
        chi.)"""
        return split(self._weight_by_chi(c)[:, None] * values)

    def numerator_space(
        self, c: Coefficients
    ) -> tuple[Float[np.ndarray, "2*E r"], Float[np.ndarray, "r r"]]:
        """Return an orthonormal basis of the numerators' weighted values, and the triangular factor
        of the QR decomposition."""
        weight = np.tile(self._weight_by_chi(c), 2)
        return np.linalg.qr(weight[:, None] * self.basis)

    def _weight_by_chi(self, c: Coefficients) -> Float[np.ndarray, " E"]:
        return self.weight / np.abs(chi(self.period_delay, c))


def split(values: Complex[np.ndarray, "*d E n"]) -> Float[np.ndarray, "*d 2*E n"]:
    """Return real parts, then imaginary parts."""
    return np.concatenate([np.real(values), np.imag(values)], axis=-2)


Groups = Sequence[HTFGroup]


class Misfit(NamedTuple):
    """The residual of one group at some c, with the best numerators."""

    residual: Float[np.ndarray, "2 E K"]
    """In units of the error."""
    jacobian: Float[np.ndarray, "d 2 E K"]
    """Derivative of the residual by c. (The term that is proportional to the residual is omitted:
    Kaufman 1975.)"""
    noise: Float[np.ndarray, "d d"]
    """Expected part of jacobian^T jacobian that is due to errors in the data, per entry, for errors
    of variance 1."""
    leverage: Float[np.ndarray, "2 E"]
    """The share of each real equation that the numerators explain, whatever the data are."""


def misfit_of(group: HTFGroup, c: Coefficients, noise: bool = False) -> Misfit:
    """Return the misfit at c and its derivatives; `Misfit.noise` is zero unless asked for."""
    d = len(c)
    E = len(group.period_delay)
    q, _ = group.numerator_space(c)
    below = chi(group.period_delay, c)[:, None]
    target = group.weighted(c, below * group.data)
    explained = q @ (q.T @ target)
    # Delays divided by chi, without the phase of chi, which is common to all rows.
    powers = np.arange(1, d + 1)[:, None, None]
    delays = group.period_delay[:, None] ** powers / below

    def filtered(rows):
        values = rows[:E] + 1j * rows[E:]
        return without(q, split(delays * values))

    by_noise = np.zeros((d, d))
    if noise:
        leaks = filtered(q).reshape(d, -1)
        by_noise = leaks @ leaks.T
    residual = (target - explained).reshape(2, E, -1)
    slopes = filtered(explained).reshape(d, *residual.shape)
    leverage = (q**2).sum(axis=1).reshape(2, E)
    return Misfit(residual, slopes, by_noise, leverage)


def late_columns(
    group: HTFGroup, c: Coefficients
) -> tuple[Float[np.ndarray, "n d1"], Float[np.ndarray, " E"]]:
    r"""Return $z^{-jN} H$, j = 0, ..., d, less numerators and weighted by $1/|\chi|$.

    Combined with the coefficients of chi, the columns leave errors only. Also returns the part of
    each equation's variance that the numerators leave.
    """
    q, _ = group.numerator_space(c)
    delay = group.period_delay[:, None]
    columns = []
    for j in range(len(c) + 1):
        rows = group.weighted(c, delay**j * group.data)
        columns.append(without(q, rows).ravel())
    by_row = (q**2).sum(axis=1)
    taken = by_row.reshape(2, -1).sum(axis=0)
    gain = np.abs(chi(group.period_delay, c)) ** 2
    left = (2 - taken) / gain
    return np.stack(columns, axis=1), left


def delayed_responses(groups: Groups, c: Coefficients) -> tuple[np.ndarray, np.ndarray]:
    """Return roots of two Gram matrices of the delayed responses of all groups.

    The second root is that of the Gram matrix expected for errors of variance 1, and the first one
    is in its units. (Without roots, half of the digits would be lost.)
    """
    delays = np.arange(len(c) + 1)
    apart = np.abs(delays[:, None] - delays)
    columns = []
    noise_gram = np.zeros(apart.shape)
    for group in groups:
        delayed, left = late_columns(group, c)
        columns.append(delayed)
        powers = group.period_delay ** delays[:, None]
        by_delay = (left * powers.real).sum(axis=1)
        noise_gram += by_delay[apart] * group.size
    noise = np.linalg.cholesky(noise_gram)
    _, triangle = np.linalg.qr(np.concatenate(columns))
    return np.linalg.solve(noise, triangle.T), noise


def residuals_of(groups: Groups, c: Coefficients) -> Gradient:
    """Return the residuals of all groups, and their Jacobian."""
    residuals = []
    jacobians = []
    for group in groups:
        misfit = misfit_of(group, c)
        residuals.append(misfit.residual.ravel())
        jacobians.append(misfit.jacobian.reshape(len(c), -1))
    jacobian = np.concatenate(jacobians, axis=1)
    return np.concatenate(residuals), jacobian.T


def cost_of(groups: Groups, c: Coefficients) -> tuple[float, int]:
    """Return the sum of squares of the misfit, and its expectation for errors of variance 1."""
    cost = sum(float((misfit_of(group, c).residual ** 2).sum()) for group in groups)
    return cost, sum(group.dof * group.size for group in groups)


def maximum_likelihood(
    groups: list[HTFGroup],
    order: int,
    start: Coefficients | None = None,
    rough: bool = False,
) -> tuple[Coefficients, bool]:
    """Return the coefficients with the smallest misfit, and whether they are a minimum.

    **Arguments:** `start`: where the descent starts. Default: the solution of the linearized
    problem. `rough`: whether to stop when noise of variance one could explain the next step.
    """
    if start is None:
        start = _linearized(groups, order)
    limits = ROUGH if rough else {}
    return least_squares(lambda c: residuals_of(groups, c), start, **limits)


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
        last = c
        c = null[1:] / null[0]
        allowed = _SETTLED_START * (1 + np.abs(c).max())
        if np.abs(c - last).max() < allowed:
            break
    return c


def summarize(
    groups: list[HTFGroup], c: Coefficients, errors: Literal["residuals", "variance"]
) -> tuple[Covariance, float, int]:
    r"""Return the covariance of the coefficients, the cost, and its expected value.

    The cost is the sum of squares of the misfit in units of the errors supposed; its expected value
    is the number of real equations that the numerators leave.

    With the residuals r, their Jacobian J and its part Q that errors make, $\mathrm{Cov}(c) = (J^T
    J - Q)^{-1} M (J^T J - Q)^{-1}$, where M is the covariance of the gradient $J^T r$: $J^T J$ for
    errors of the variances supposed, or the sum over frequencies of the squares of their parts of
    the gradient. The fit of c reduces each part; this is corrected on average (Bell and McCaffrey
    2002).
    """
    d = len(c)
    lines = 1 + max(int(group.line.max()) for group in groups)
    score = np.zeros((lines, d))
    shares = np.zeros((lines, d, d))
    noise = np.zeros((d, d))
    for group in groups:
        misfit = misfit_of(group, c, noise=True)
        noise += misfit.noise * group.size
        # A residual is smaller than the error, since the numerators fit a share of its equation.
        # (This share is at most 1, up to rounding.)
        left = 1 - np.minimum(misfit.leverage, 1 - 1e-15)
        error = misfit.residual / np.sqrt(left)[..., None]
        slopes = misfit.jacobian
        np.add.at(score, group.line, np.einsum("jaek,aek->ej", slopes, error))
        np.add.at(shares, group.line, np.einsum("iaek,jaek->eij", slopes, slopes))
    cost, dof = cost_of(groups, c)
    square = shares.sum(axis=0)
    if errors == "variance":
        return sandwich(square - noise, square), cost, dof
    with suppress(np.linalg.LinAlgError):  # some combination of coefficients is unknown
        root = np.linalg.cholesky(square)
        half = np.linalg.inv(root)
        enlarged = inverse_of_remainder(half @ shares @ half.T, 0.5)
        score = np.einsum("lij,lj->li", enlarged, score @ half.T) @ root.T
    return sandwich(square - noise, score.T @ score, shares), cost, dof


def numerators_of(group: HTFGroup, c: Coefficients) -> Inexact[np.ndarray, "R K"]:
    """Return the best numerators for c, of data that are not scaled."""
    q, triangle = group.numerator_space(c)
    below = chi(group.period_delay, c)[:, None]
    target = group.weighted(c, below * group.data)
    in_basis = np.linalg.solve(triangle, q.T @ target)
    return group.to_powers @ in_basis / group.scale


def unfold(
    htf: HTF, groups: list[HTFGroup], numerators: Sequence[Inexact[np.ndarray, "R K"]]
) -> Complex[np.ndarray, "M R ny nu"]:
    """Return the numerators of the HTFs, from the numerators of the responses of each group."""
    _, _, ny, nu = htf.H.shape
    shape = (len(htf.harmonics), ny, nu, len(numerators[0]))
    out = np.zeros(shape, complex)
    for group, b in zip(groups, numerators, strict=True):
        entries = (group.share * b).T
        i, j = group.channel.T
        np.add.at(out, (group.harmonic, i, j), entries)
        paired = group.mirror >= 0
        opposite = group.mirror[paired], i[paired], j[paired]
        np.add.at(out, opposite, entries[paired].conj())
    return np.moveaxis(out, 3, 1)


def grouped(htf: HTF, order: int, extra_lags: int | None) -> list[HTFGroup]:
    """Group all entries of the HTFs, weighted by their variances, for a fit with `order`
    multipliers."""
    size = numerator_size(htf, order, extra_lags)
    return group_htf(htf, error_weights(htf, check_values(htf)), size)


class FittedResponse(NamedTuple):
    """An entry of the HTFs, or a combination of two entries, whose numerator does not depend on
    other responses."""

    harmonic: tuple[int, int]
    """The positions of its harmonic and of the opposite harmonic; the latter is -1 if there is
    none."""
    share: complex
    """The factor of the response in the HTF of its harmonic. (The conjugate is its factor in the
    opposite harmonic.)"""
    channel: tuple[int, int]
    """Output and input."""
    values: Complex[np.ndarray, " E"]
    weight: Float[np.ndarray, " E"]


def group_htf(
    htf: HTF, weight: Float[np.ndarray, "M F ny nu"], size: int
) -> list[HTFGroup]:
    r"""Group all entries of the HTFs, with numerators of `size` coefficients.

    The numerator of $H_m$ is real if m and -m are the same harmonic. It is the conjugate of that of
    $H_{-m}$ otherwise, so that $(H_m + H_{-m}) / \sqrt 2$ and $(H_m - H_{-m}) / (\sqrt 2 i)$ are
    two responses with real numerators, and independent errors if both weights are the same. Other
    pairs, and harmonics without the opposite one, have complex numerators.
    """
    f = np.asarray(htf.frequencies)
    N = htf.n_sections
    delay = -2j * np.pi / N * f[:, None]
    powers = np.exp(delay * np.arange(size))
    turned = np.concatenate([powers, 1j * powers], axis=1)
    conjugate = np.concatenate([powers, -1j * powers], axis=1)
    matrices = {
        "real": powers,
        "single": turned,
        "double": np.concatenate([turned, conjugate]),
    }
    responses: dict[str, list[FittedResponse]] = {kind: [] for kind in matrices}
    row_of = {m % N: row for row, m in enumerate(htf.harmonics)}
    for m, row in row_of.items():
        other = row_of.get(-m % N, -1)
        if other < 0 or row <= other:
            for kind, response in _responses_of(htf, weight, row, other):
                responses[kind].append(response)
    sources = (
        np.arange(len(f)) if htf.variance_dof is None else htf.variance_dof.sources(f)
    )
    groups = []
    for kind, matrix in matrices.items():
        if responses[kind]:
            groups += equal_weights(f, sources, size, matrix, responses[kind])
    return groups


def _responses_of(
    htf: HTF, weight: Float[np.ndarray, "M F ny nu"], row: int, other: int
) -> Iterator[tuple[str, FittedResponse]]:
    """Iterate over the responses of a harmonic and the opposite one, with their kinds."""
    H = np.asarray(htf.H)
    half = np.sqrt(0.5)
    w = weight[row]
    v = weight[other]
    allowed = 10.0**-EQUAL_WEIGHTS * w
    alike = (np.abs(v - w) <= allowed).all(axis=0)
    for channel in np.ndindex(alike.shape):
        at = (slice(None), *channel)
        h = H[row][at]
        g = H[other][at]
        if other == row:
            yield "real", FittedResponse((row, -1), 1.0, channel, h, w[at])
        elif other < 0:
            yield "single", FittedResponse((row, -1), 1.0, channel, h, w[at])
        elif alike[channel]:
            pair = (row, other)
            total = half * (h + g)
            difference = half / 1j * (h - g)
            yield "real", FittedResponse(pair, half, channel, total, w[at])
            yield "real", FittedResponse(pair, 1j * half, channel, difference, w[at])
        else:
            values = np.concatenate([h, g])
            both = np.concatenate([w[at], v[at]])
            yield "double", FittedResponse((row, other), 1.0, channel, values, both)


def equal_weights(
    f: Float[np.ndarray, " F"],
    sources: Int[np.ndarray, " F"],
    size: int,
    matrix: Complex[np.ndarray, "E u"],
    responses: list[FittedResponse],
) -> list[HTFGroup]:
    """Group responses whose numerators solve the same problem, one group for each weight.

    **Arguments:** `sources`: for each frequency a number that says from which noise its errors
    come, see `HTFGroup.line`. `matrix`: maps u real coefficients to the numerator's values.
    """
    harmonic, share, channel, data, weights = map(
        np.array, zip(*responses, strict=True)
    )
    basis, to_powers = powers_basis(split(matrix))
    if len(to_powers) > size:
        to_powers = to_powers[:size] + 1j * to_powers[size:]
    scale = weights[:, 0]
    shape = weights / scale[:, None]
    _, first, kind = np.unique(
        np.round(shape, EQUAL_WEIGHTS), axis=0, return_index=True, return_inverse=True
    )
    copies = len(matrix) // len(f)
    groups = []
    for k, representative in enumerate(first):
        same = np.flatnonzero(kind.ravel() == k)
        group = HTFGroup(
            harmonic=harmonic[same, 0],
            mirror=harmonic[same, 1],
            share=share[same],
            channel=channel[same],
            line=np.tile(sources, copies),
            period_delay=np.tile(np.exp(-2j * np.pi * f), copies),
            basis=basis,
            to_powers=to_powers,
            weight=shape[representative],
            scale=scale[same],
            data=(data[same] * scale[same, None]).T,
        )
        groups.append(group)
    return groups


def powers_basis(
    powers: Inexact[np.ndarray, "rows R"],
) -> tuple[Inexact[np.ndarray, "rows r"], Inexact[np.ndarray, "R r"]]:
    """Return an orthonormal basis of the powers of z^-1 on some frequencies.

    Combinations that vanish on these frequencies are left out. The second matrix holds the
    (smallest) coefficients that make each element.
    """
    u, s, vh = np.linalg.svd(powers, full_matrices=False)
    # (The threshold is low, because leaving out one combination more would change bounds by 0.3 %.)
    kept = s > 0.1 * ROUNDING * s[0]
    columns = vh[kept].conj().T
    return u[:, kept], columns / s[kept]


def numerator_size(htf: HTF, order: int, extra_lags: int | None) -> int:
    """Return how many coefficients each numerator has; `extra_lags` as of `fit_multipliers`.

    **Raises:** `DefinitionError` for too few frequencies to determine them and the multipliers.
    """
    N = htf.n_sections
    beyond = N if extra_lags is None else extra_lags
    size = order * N + beyond + 1
    harmonics = {m % N for m in htf.harmonics}
    # (Each harmonic of a pair m, -m, and a harmonic that is its own mirror image, has half as many
    # coefficients.)
    unknown = [size if -m % N in harmonics else 2 * size for m in harmonics]
    entries = len(htf.outputs) * len(htf.inputs)

    def enough(frequencies: int) -> bool:
        return sum(max(2 * frequencies - k, 0) for k in unknown) * entries >= order

    if not enough(len(htf.frequencies)):
        raise DefinitionError(
            f"{len(htf.frequencies)} frequencies are too few for numerators of {size} coefficients "
            f"and {order} multipliers: {next(filter(enough, count()))} or more are needed. Measure "
            "more, take fewer sections, or lower `order`."
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

    Sensor noise is assumed to be white. Noise that drives the system has the system's poles at all
    harmonics. Therefore the variance of an output is modeled as $a + b / |\chi|^2$, times the
    variances `lines` of frequencies and inputs.

    This is one scoring step towards the largest restricted likelihood (Patterson and Thompson
    1971), from the weights of the groups. It accounts for the fitted numerators.
    """
    square = np.zeros((outputs, 2))
    expected = np.zeros((outputs, 2, 2))
    for group in groups:
        # (F, K), columns alike but for factors
        relative = lines[:, 0, group.channel[:, 1]]
        spectra = _components(group.period_delay, c)
        parts = spectra * group.weight**2 * relative[group.line, 0]
        half = group.scale**2 / 2
        size = half * relative[0] / relative[0, 0]
        residual = (misfit_of(group, c).residual ** 2).sum(axis=0)
        # tr(G_k R G_l R), where R subtracts the best numerators: the mean of `parts[k]` times the
        # squares of the residuals, for errors with the variances `parts[l]`.
        q, _ = group.numerator_space(c)
        rows = np.concatenate([parts, parts], axis=1)
        projected = [q.T @ (row[:, None] * q) for row in rows]
        along = np.stack(projected)
        along = along.reshape(2, -1)
        left = 1 - 2 * (q**2).sum(axis=1)
        products = rows * left @ rows.T + along @ along.T
        for k, i in enumerate(group.channel[:, 0]):
            square[i] += size[k] * (parts @ residual[:, k])
            expected[i] += size[k] ** 2 * products
    sizes = np.stack([amounts(*pair) for pair in zip(expected, square, strict=True)])
    period_delay = np.exp(-2j * np.pi * f)
    spectrum = sizes @ _components(period_delay, c)
    return spectrum.T[..., None] * lines


def _components(
    delay: Complex[np.ndarray, " E"], c: Coefficients
) -> Float[np.ndarray, "2 E"]:
    """Return the spectra of white noise and of noise that passes the system."""
    white = np.ones(len(delay))
    filtered = 1 / np.abs(chi(delay, c)) ** 2
    return np.stack([white, filtered])


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
    alone = square[only] / expected[only, only]
    return np.where(np.arange(2) == only, alone, 0.0)
