"""Floquet multipliers from the exact structure of the harmonic transfer functions."""

from collections.abc import Sequence
from itertools import count
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Complex, Float, Inexact

from .._core.errors import DefinitionError
from ..periodic.htf import HTF
from ..periodic.ldtp import LDTP
from ..periodic.transfer import check_harmonics
from .compare import MultiplierComparison, Multipliers, compare_multipliers


_RANK = 1e-13  # singular values below this part of the largest are rounding errors


class StructuredFit(eqx.Module):
    r"""All harmonics, outputs and inputs with one denominator in $z^{-N}$.

    $$H_m(z) = \frac{B_m(z^{-1})}{\chi(z^{-N})}, \qquad
    \chi(z^{-N}) = 1 + c_1 z^{-N} + \ldots + c_d z^{-dN} = \prod_i (1 - \lambda_i z^{-N})$$

    which is exact for a periodic system with d non-zero multipliers $\lambda_i$, if the degree
    of the polynomials B_m is high enough (d N and an overhang: at most N times the number of
    periods after which the zero multipliers' part of the state is gone).

    **Fields:**

    - `multipliers` (d,): by decreasing modulus. `coefficients` (d,): c_1 to c_d, real.
    - `residual` (ny,): rms misfit of each output's HTFs relative to their rms.
    - `numerators` (M, degree + 1, ny, nu): coefficients of B_m, by rising power of z^-1. In a
      narrow band of frequencies many give the same fit; these are the smallest.
    - `harmonics` (M,), `sections`, `inputs`, `outputs`: what was fitted.
    """

    multipliers: Complex[np.ndarray, " d"]
    coefficients: Float[np.ndarray, " d"]
    residual: Float[np.ndarray, " ny"]
    numerators: Complex[np.ndarray, "M coefficients ny nu"]
    harmonics: tuple[int, ...] = eqx.field(static=True)
    sections: int = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)

    def evaluate(self, f: ArrayLike, harmonics: int | Sequence[int] | None = None) -> HTF:
        """The fitted HTFs at frequencies f (cycles per period) inside the band of the data.

        **Raises:** `DefinitionError` for a harmonic that was not fitted.
        """
        f = np.atleast_1d(np.asarray(f, float))
        wanted = self.harmonics if harmonics is None else check_harmonics(harmonics, self.sections)
        absent = [m for m in wanted if m not in self.harmonics]
        if absent:
            raise DefinitionError(
                f"harmonic {absent[0]} was not fitted; the harmonics are {self.harmonics}."
            )
        rows = [self.harmonics.index(m) for m in wanted]
        powers = _powers(f, self.sections, self.numerators.shape[1])
        H = np.einsum("fr,mrij->mfij", powers, self.numerators[rows])
        H = H / _chi(np.exp(-2j * np.pi * f), self.coefficients)[:, None, None]
        return HTF(f, H, wanted, self.sections, self.inputs, self.outputs, "structured fit")

    def compare(self, true: Multipliers) -> MultiplierComparison:
        """The multipliers beside the true ones, paired; printing it shows a table."""
        return compare_multipliers(self.multipliers, true)

    def __repr__(self) -> str:
        shown = ", ".join(f"{x.real:+.7f}{x.imag:+.7f}i" for x in self.multipliers)
        misfit = ", ".join(
            f"{name} {x:.1e}" for name, x in zip(self.outputs, self.residual, strict=True)
        )
        return (
            f"StructuredFit(multipliers {shown}; residual {misfit}; "
            f"{len(self.harmonics)} harmonics, degree {self.numerators.shape[1] - 1})"
        )


def fit_multipliers(
    htf: HTF,
    order: int | LDTP,
    harmonics: int | Sequence[int] | None = None,
    *,
    overhang: int | None = None,
    iterations: int = 6,
) -> StructuredFit:
    r"""Fit the common denominator of the HTFs, whose roots are the Floquet multipliers.

    Multiplied by $\chi$, the equation is linear in its coefficients c and in those of the
    numerators; the numerators are projected out (singular value decomposition of their powers of
    z), and c is left as a small least-squares problem over all harmonics, outputs and inputs
    together. Iterated with the weight $1/|\chi|$ of the last solution, so that in the end the
    misfit of the HTFs counts. Positive and negative frequencies are used:
    $H_m(-w) = \overline{H_{-m}(w)}$, for m = 0 (and N/2) numerators are real.

    **Arguments:**

    - `htf`: exact or estimated. Each output counts relative to its own rms.
    - `order`: d, the number of non-zero multipliers, or an `LDTP` model to take its rank from.
    - `harmonics`: those to use; None means all of `htf`.
    - `overhang`: degree of the numerators beyond d N; None means N.
    - `iterations`: number of weighted solutions.

    **Raises:** `DefinitionError` for an order below 1, NaN in the HTFs, a harmonic that `htf`
    does not hold, or too few frequencies for so many coefficients (the message says how many).
    """
    order = order.rank() if isinstance(order, LDTP) else order
    N = htf.sections
    overhang = N if overhang is None else overhang
    if order < 1 or iterations < 1 or overhang < 0:
        raise DefinitionError(
            "a structured fit needs order >= 1 (the number of non-zero multipliers), iterations "
            f">= 1 and overhang >= 0, not {order}, {iterations} and {overhang}."
        )
    if harmonics is not None:
        htf = htf.select(harmonics)
    f, H = np.asarray(htf.f), np.asarray(htf.H)
    if not np.isfinite(H).all():
        raise DefinitionError("the HTFs hold NaN or infinity.")
    rms = np.sqrt(np.mean(np.abs(H) ** 2, axis=(0, 1, 3)))
    if (rms == 0).any():
        name = htf.outputs[int(np.argmin(rms))]
        raise DefinitionError(f"the HTFs of {name} are zero: leave this output out.")

    unknowns = order * N + overhang + 1
    blocks = _blocks(htf, H / rms[:, None], unknowns)
    if _freedom(blocks, len(f), unknowns) < order:
        needed = next(F for F in count(1) if _freedom(blocks, F, unknowns) >= order)
        raise DefinitionError(
            f"{len(f)} frequencies are too few for numerators of {unknowns} coefficients and "
            f"{order} multipliers: {needed} or more are needed. Measure more, or lower `order` or "
            "`overhang`."
        )
    c = np.zeros(order)
    for _ in range(iterations):
        c = _denominator(blocks, c)

    numerators = np.zeros((len(htf.harmonics), unknowns, *H.shape[2:]), complex)
    for block in blocks:
        b = block.numerators(c).reshape(unknowns, len(block.rows), *H.shape[2:])
        numerators[block.rows] = b.swapaxes(0, 1)
        if block.mirror is not None:
            numerators[block.mirror] = b.swapaxes(0, 1).conj()
    multipliers = np.roots([1.0, *c]).astype(complex)
    fit = StructuredFit(
        multipliers=multipliers[np.lexsort((-multipliers.imag, -np.abs(multipliers)))],
        coefficients=c,
        residual=np.zeros(len(rms)),
        numerators=numerators * rms[:, None],
        harmonics=htf.harmonics,
        sections=N,
        inputs=htf.inputs,
        outputs=htf.outputs,
    )
    misfit = np.abs(np.asarray(fit.evaluate(f).H) - H) ** 2
    residual = np.sqrt(np.mean(misfit, axis=(0, 1, 3))) / rms
    return eqx.tree_at(lambda fit: fit.residual, fit, residual)


class _Block(NamedTuple):
    """Harmonics whose numerators solve the same linear problem.

    `data` (equations, series) and `powers` (equations, unknowns) are complex; the unknowns are
    real if `real`. `lag` is z^-N for each equation. `rows` are the harmonics in the HTF and, in
    a block of pairs, `mirror` their negatives.
    """

    rows: list[int]
    mirror: list[int] | None
    real: bool
    lag: Complex[np.ndarray, " E"]
    powers: Complex[np.ndarray, "E R"]
    data: Complex[np.ndarray, "E series"]

    def _split(self, values: np.ndarray) -> np.ndarray:
        return np.concatenate([values.real, values.imag]) if self.real else values

    def _weighted_powers(self, c: Float[np.ndarray, " d"]):
        """1/|chi| for each equation, and the decomposition of the powers with these weights."""
        weight = 1 / np.abs(_chi(self.lag, c))[:, None]
        u, s, vh = np.linalg.svd(self._split(weight * self.powers), full_matrices=False)
        kept = s > _RANK * s[0]
        return weight, u[:, kept], s[kept], vh[kept]

    def projected(self, c: Float[np.ndarray, " d"]) -> Float[np.ndarray, "rows columns"]:
        """What is left of z^{-jN} H, j = 0..d, when all numerators are projected out."""
        weight, u, _, _ = self._weighted_powers(c)
        columns = []
        for j in range(len(c) + 1):
            column = self._split(weight * self.lag[:, None] ** j * self.data)
            column = column - u @ (u.conj().T @ column)
            columns.append(np.concatenate([column.real.ravel(), column.imag.ravel()]))
        return np.stack(columns, axis=1)

    def numerators(self, c: Float[np.ndarray, " d"]) -> Inexact[np.ndarray, "R series"]:
        weight, u, s, vh = self._weighted_powers(c)
        target = self._split(weight * _chi(self.lag, c)[:, None] * self.data)
        return vh.conj().T @ ((u.conj().T @ target) / s[:, None])


def _blocks(htf: HTF, H: Complex[np.ndarray, "M F ny nu"], unknowns: int) -> list[_Block]:
    f, N = np.asarray(htf.f), htf.sections
    place = {m % N: row for row, m in enumerate(htf.harmonics)}
    own = [row for m, row in place.items() if -m % N == m]
    pairs = [(row, place[-m % N]) for m, row in place.items() if 0 < m < N / 2 and -m % N in place]
    rest = [row for m, row in place.items() if -m % N not in place]

    def series(values):
        return np.moveaxis(values, 1, 0).reshape(values.shape[1], -1)

    powers, lag = _powers(f, N, unknowns), np.exp(-2j * np.pi * f)
    blocks = []
    if own:
        blocks.append(_Block(own, None, True, lag, powers, series(H[own])))
    if pairs:
        rows, mirror = (list(side) for side in zip(*pairs, strict=True))
        both = np.concatenate([series(H[rows]), series(H[mirror]).conj()])
        lags, all_powers = (
            np.concatenate([lag, lag.conj()]),
            np.concatenate([powers, powers.conj()]),
        )
        blocks.append(_Block(rows, mirror, False, lags, all_powers, both))
    if rest:
        blocks.append(_Block(rest, None, False, lag, powers, series(H[rest])))
    return blocks


def _freedom(blocks: list[_Block], frequencies: int, unknowns: int) -> int:
    """Real equations that are left for the denominator when the numerators are gone."""
    total = 0
    for block in blocks:
        equations = 2 * frequencies if block.mirror is not None else frequencies
        surplus = 2 * equations - (1 if block.real else 2) * unknowns
        total += max(surplus, 0) * block.data.shape[1]
    return total


def _denominator(blocks: list[_Block], c: Float[np.ndarray, " d"]) -> Float[np.ndarray, " d"]:
    """Least squares for c, weighted by 1/|chi| of the last c."""
    columns = np.concatenate([block.projected(c) for block in blocks])
    return np.linalg.lstsq(columns[:, 1:], -columns[:, 0])[0]


def _powers(f: Float[np.ndarray, " F"], sections: int, number: int):
    """z^0, z^-1, ... at the frequencies f, (F, number)."""
    return np.exp(-2j * np.pi / sections * f[:, None] * np.arange(number))


def _chi(lag: Complex[np.ndarray, " E"], c: Float[np.ndarray, " d"]) -> Complex[np.ndarray, " E"]:
    """1 + c_1 z^-N + ... + c_d z^-dN, with `lag` = z^-N."""
    return np.polynomial.polynomial.polyval(lag, np.concatenate([[1.0], c]))
