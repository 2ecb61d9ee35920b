"""`fit_rational`: the paper's own fit, a rational function of z for H_0 of each output (Sec.
VI-C3).

Poles to the power N are compared with the Floquet multipliers. The fit is biased, since the true
H_0 has more poles; `fit_multipliers` has no such bias. `_fit_one` descends from several starts
(`_starts`), and takes the lowest minimum.

If another minimum is lower, add starts (`_STARTS`); if a fit has not converged, look at
`least_squares` in `descent.py`. The form of the function must stay as in the paper, with which it
is compared: `_fit_one` uses the code of `fit_multipliers` as for a system with one section.
"""

import functools
from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float, Int

from .._core.arguments import channel_index
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Index, Order, Scalar, Vector
from .._core.html import card, text, unit_circle
from .._core.precision import require_x64
from .._core.results import Result
from .._core.showable import WithMultipliers
from .._core.text import how_many, number
from ..errors import ComputationError, DefinitionError
from ..linear.htf import HTF
from ..linear.multipliers import largest_first
from .descent import least_squares
from .multiplier_estimate import MultiplierComparison, Truth, compare_multipliers
from .variable_projection import (
    FittedResponse,
    HTFGroup,
    equal_weights,
    late_columns,
    numerators_of,
    residuals_of,
)


# Iterations of Sanathanan and Koerner from which descents start. Fewer: other minima are found;
# more: the same result in longer time.
_STARTS = (0, 1, 4, 29)
# A descent ends if a step changes the residual, relative to H, by less than this. Costs that differ
# by less are equal (a converged fit is then preferred). Smaller: descents on exact data stall in
# rounding. Larger: coefficients have relative errors of this size.
_ACCURACY = 1e-8


class RationalFit(WithMultipliers, eqx.Module):
    r"""Rational functions of $z = e^{2 \pi i f / N}$ fitted to $H_0$, one per output.

    $$H_0(z) \approx \frac{b_0 z^{-1} + b_1 z^{-2} + \ldots + b_q z^{-q-1}}
    {1 + a_1 z^{-1} + \ldots + a_p z^{-p}}$$

    with real coefficients. A pole $p$ stands for the Floquet multiplier $p^N$. The true $H_0$ has
    all N-th roots of every multiplier as poles, so a fit of low order is biased even on exact data.

    **Fields** (ny outputs on the first axis):

    - `numerator` b (ny, q+1); `denominator` (ny, p+1), its first entry 1.
    - `poles` (ny, p) and `zeros` (ny, q) in z, without those at the origin; a zero at infinity is
      NaN. Sorted by decreasing modulus.
    - `multipliers` (ny, p): poles to the power N, in the order of the poles.
    - `residual` (ny,): root mean square misfit, relative to the rms of H.
    - `result` (ny,): codes of `Result`, OK or NOT_CONVERGED.
    - `n_sections`, `outputs`, `input`: those of the HTF.
    """

    numerator: Float[np.ndarray, "ny b"]
    denominator: Float[np.ndarray, "ny a"]
    poles: Complex[np.ndarray, "ny p"]
    zeros: Complex[np.ndarray, "ny q"]
    multipliers: Complex[np.ndarray, "ny p"]
    residual: Float[np.ndarray, " ny"]
    result: Int[np.ndarray, " ny"]
    n_sections: int = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    input: str = eqx.field(static=True)

    @checked
    def htf(self, frequencies: Scalar | Vector) -> HTF:
        """Return the fitted functions at `frequencies` (F,), cycles per period."""
        f = np.atleast_1d(np.asarray(frequencies, float))
        N = self.n_sections
        delay = np.exp(-2j * np.pi * f / N)
        polyval = np.polynomial.polynomial.polyval
        top = polyval(delay, self.numerator.T)
        bottom = polyval(delay, self.denominator.T)
        H = (top / bottom * delay).T[None, :, :, None]
        return HTF(f, H, 0, N, self.input, self.outputs, "rational fit")

    @checked
    def compare(
        self, other: Truth, output: str | int | None = None
    ) -> MultiplierComparison:
        """Pair the multipliers of each output (or of one output) with the true multipliers. There
        is no test: the errors of this fit are not known.

        **Raises:** `DefinitionError` for an output that is not there.

        **Example:**

        ```python
        print(hj.identify.fit_rational(htf).compare(cycle, output="yM"))
        ```
        """
        chosen = range(len(self.outputs))
        if output is not None:
            chosen = [channel_index("output", output, self.outputs)]
        parts = [compare_multipliers(self.multipliers[k], other) for k in chosen]
        names: list[str] = []
        for k, part in zip(chosen, parts, strict=True):
            names += [self.outputs[k]] * len(part.true)
        return MultiplierComparison(
            np.concatenate([part.true for part in parts]),
            np.concatenate([part.estimated for part in parts]),
            tuple(names),
            with_fit=parts[0].with_fit,
        )

    def __repr__(self) -> str:
        poles = self.denominator.shape[1] - 1
        zeros = self.numerator.shape[1] - 1
        sizes = (
            f"{how_many(poles, 'pole', 'poles')}, {how_many(zeros, 'zero', 'zeros')}"
        )
        rows = [f"RationalFit(H_0 from {self.input}, {sizes})"]
        fits = zip(
            self.outputs, self.multipliers, self.residual, self.result, strict=True
        )
        for name, multipliers, residual, code in fits:
            shown = ", ".join(number(x, 5) for x in multipliers)
            if code != Result.OK:
                shown = f"none: {Result(int(code)).message}"
            rows.append(f"  {name}: multipliers {shown}; residual {residual:.2e}")
        return "\n".join(rows)

    def _repr_html_(self) -> str:
        shown = self.multipliers[self.result == Result.OK].ravel()
        return card("RationalFit", "", text(repr(self)), unit_circle(shown))


@checked
def fit_rational(
    htf: HTF,
    *,
    output: str | int | None = None,
    input: str | int = 0,
    poles: Order = 2,
    zeros: Index = 1,
) -> RationalFit:
    """Fit a rational function of z with real coefficients to $H_0$.

    This is the paper's fit, for comparison with it: a fit of low order is biased even on exact data
    (see `RationalFit`), and `hj.fit_multipliers` is not. The residual `H - B/A` is minimized by
    Gauss-Newton steps in the denominator only: for a given denominator the best numerator solves a
    linear problem (variable projection). The descents start from several solutions of the
    linearized problem (Levy 1959; Sanathanan and Koerner 1963) and the best result is kept. (One
    program of optimistix for all outputs finds the same minima, but takes 8 s of a CPU to compile,
    20 times as long as a first call on the host.)

    **Arguments:**

    - `htf`: estimated or exact. (Other harmonics of a real system have complex coefficients, which
      this form does not have: `fit_multipliers` fits all harmonics.)
    - `output`: name or index. Default: every output. `input`: name or index. Default: 0.
    - `poles`, `zeros`: their numbers. Default: 2 and 1, the paper's.

    **Returns:** `hj.identify.RationalFit`, without units: `poles` (ny, p), `zeros` (ny, q),
    `multipliers` (ny, p), and `residual` (ny,), relative to H. Outputs are on the first axis also
    where there is only one.

    **Raises:** `DefinitionError` for an output or input that is not there, for fewer
    lines than coefficients, and for an H with NaN or of zeros; `ComputationError` if no start leads
    to a finite fit.

    **Example:**

    ```python
    rational = hj.identify.fit_rational(htf, output="yM", poles=2, zeros=1)
    print(rational.multipliers)
    ```

    **Before:** `hj.estimate_htf`. **After:** `hj.plot.poles_zeros`, `hj.plot.multipliers`.
    """
    require_x64(htf.H)
    htf.require_sampled("`fit_rational`")
    column = channel_index("input", input, htf.inputs)
    rows = range(len(htf.outputs))
    if output is not None:
        rows = [channel_index("output", output, htf.outputs)]
    H = np.asarray(htf[0])[:, :, column]
    if 2 * len(H) < poles + zeros + 1:
        raise DefinitionError(
            f"{poles} poles and {zeros} zeros have {poles + zeros + 1} coefficients, too many for "
            f"{len(H)} frequencies: take fewer poles, or measure more frequencies."
        )
    # The denominator of a system with one section.
    f = np.asarray(htf.frequencies) / htf.n_sections
    fits = [
        _fit_one(f, H[:, row], f"H_0 of {htf.outputs[row]}", poles, zeros)
        for row in rows
    ]
    numerator, denominator, residual, result = map(np.array, zip(*fits, strict=True))
    roots = np.stack([_roots(a) for a in denominator])
    # A pole far outside of the unit circle overflows.
    with np.errstate(over="ignore", invalid="ignore"):
        multipliers = roots**htf.n_sections
    return RationalFit(
        numerator=numerator,
        denominator=denominator,
        poles=roots,
        zeros=np.stack([_roots(b) for b in numerator]),
        multipliers=multipliers,
        residual=residual,
        result=result,
        n_sections=htf.n_sections,
        outputs=tuple(htf.outputs[row] for row in rows),
        input=htf.inputs[column],
    )


class _Fitted(NamedTuple):
    """The fit of one response."""

    numerator: Float[np.ndarray, " b"]
    denominator: Float[np.ndarray, " a"]
    residual: float
    result: int


def _fit_one(
    f: Float[np.ndarray, " F"],
    h: Complex[np.ndarray, " F"],
    name: str,
    poles: int,
    zeros: int,
) -> _Fitted:
    """Return the best of the descents from all starts.

    **Raises:** `DefinitionError` for NaN or zeros; `ComputationError` if no start leads to a finite
    fit.
    """
    if not np.isfinite(h).all():
        raise DefinitionError(
            f"{name} holds NaN or infinity: leave these frequencies out."
        )
    power = np.mean(np.abs(h) ** 2)
    rms = float(np.sqrt(power))
    if rms == 0:
        raise DefinitionError(f"{name} is zero: leave this output out.")
    delays = 1 + np.arange(zeros + 1)
    exponent = -2j * np.pi * f[:, None] * delays
    powers = np.exp(exponent)
    response = FittedResponse(
        harmonic=(0, -1),
        share=1.0,
        channel=(0, 0),
        values=h / rms,
        weight=np.full(len(h), len(h) ** -0.5),
    )
    lines = np.arange(len(f))
    (group,) = equal_weights(f, lines, zeros + 1, powers, [response])
    linearize = functools.partial(residuals_of, [group])
    ends = []
    with np.errstate(all="ignore"):
        for start in _starts(group, poles):
            a, converged = least_squares(linearize, start, 200, _ACCURACY**2)
            cost = float(np.linalg.norm(linearize(a)[0]))
            if np.isfinite(cost):
                ends.append((cost, converged, a))
    if not ends:
        raise ComputationError(
            f"no start led to a finite fit of {name}: try fewer poles."
        )
    lowest = min(cost for cost, _, _ in ends) * (1 + _ACCURACY)
    good = [end for end in ends if end[0] <= lowest]
    cost, converged, a = next((end for end in good if end[1]), good[0])
    b = numerators_of(group, a)[:, 0] * rms
    result = Result.OK if converged else Result.NOT_CONVERGED
    return _Fitted(
        numerator=b,
        denominator=np.append(1.0, a),
        residual=cost,
        result=int(result),
    )


def _roots(coefficients: Float[np.ndarray, " c"]) -> Complex[np.ndarray, " n"]:
    """Return the roots by decreasing modulus; NaN for each root at infinity."""
    finite = np.roots(coefficients).astype(complex)
    finite = finite[largest_first(finite)]
    infinite = len(coefficients) - 1 - len(finite)
    return np.concatenate([np.full(infinite, np.nan), finite])


def _starts(group: HTFGroup, poles: int) -> Iterator[Float[np.ndarray, " p"]]:
    """Iterate over starts, by Sanathanan and Koerner's method: the next problem is weighted by the
    last denominator."""
    a = np.zeros(poles)
    for step in range(1 + max(_STARTS)):
        columns, _ = late_columns(group, a)
        target = -columns[:, 0]
        a, *_ = np.linalg.lstsq(columns[:, 1:], target)
        if step in _STARTS:
            yield a
