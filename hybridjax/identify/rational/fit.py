"""The paper's parametric fit: one rational function of z for one harmonic (Sec. VI-C3)."""

from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Complex, Float, Int

from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Index, Order, Scalar, StepCount, Vector
from ..._core.compilation.compile import quick_jit
from ..._core.html.multipliers import complex_number, unit_circle
from ..._core.html.parts import card, table
from ..._core.precision import require_x64
from ..._core.results import Result
from ...errors import ComputationError, DefinitionError
from ...linear.htf import HTF
from ..multipliers.compare import (
    MultiplierComparison,
    Multipliers,
    channel_index,
    compare_by_output,
)


# Steps of the iteration of Sanathanan and Koerner from which fits are started. Doubled: twice the
# time, as a rule for the same result.
_STARTS = (0, 1, 4, 29)
# Relative and absolute accuracy of the denominator, in coordinates in which the residual changes by
# about as much. Doubled: half a step fewer.
_ACCURACY = 1e-8
# Relative length, in the residual, of directions of the denominator that are taken to count for
# something. Doubled: longer steps along such directions.
_FLOOR = 1e-8
# Relative difference of costs that are equal. Doubled: none but rounding.
_EQUAL_COST = 1e-9
# |H| relative to its rms that counts as zero. Doubled: none but rounding.
_ZERO = 1e-12


class RationalFit(eqx.Module):
    r"""Rational functions of $z = e^{2 \pi i f / N}$ fitted to one harmonic, one per output.

    $$H(z) \approx \frac{z^{-\delta} (b_0 + b_1 z^{-1} + \ldots + b_q z^{-q})}
    {1 + a_1 z^{-1} + \ldots + a_p z^{-p}}$$

    with real coefficients; $\delta = 1$ in the form "delayed" (no feed-through), 0 in "direct".
    A pole $p$ stands for the Floquet multiplier $p^N$. The true $H_m$ has all N-th roots of
    every multiplier as poles, so a fit of low order is biased even on exact data, by an amount
    that depends on form and weighting: both are part of the result.

    **Fields** (ny outputs on the first axis):

    - `numerator` b (ny, q+1); `denominator` (ny, p+1), its first entry 1.
    - `poles` (ny, p) and `zeros` (ny, q) in z, without those at the origin; a zero at infinity is
      NaN. Sorted by decreasing modulus.
    - `multipliers` (ny, p): poles to the power N, in the order of the poles.
    - `residual` (ny,): root mean square misfit; relative to the rms of H with uniform weighting,
      of the relative error with relative weighting.
    - `result` (ny,): codes of `Result`, OK or NOT_CONVERGED.
    - `harmonic`, `n_sections`, `form`, `weighting`, `outputs`, `input`: what was fitted.
    """

    numerator: Float[np.ndarray, "ny b"]
    denominator: Float[np.ndarray, "ny a"]
    poles: Complex[np.ndarray, "ny p"]
    zeros: Complex[np.ndarray, "ny q"]
    multipliers: Complex[np.ndarray, "ny p"]
    residual: Float[np.ndarray, " ny"]
    result: Int[np.ndarray, " ny"]
    harmonic: int = eqx.field(static=True)
    n_sections: int = eqx.field(static=True)
    form: str = eqx.field(static=True)
    weighting: str = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    input: str = eqx.field(static=True)

    @checked
    def htf(self, f: Scalar | Vector) -> HTF:
        """The fitted functions at frequencies f (F,), cycles per period: one harmonic and input."""
        f = np.atleast_1d(np.asarray(f, float))
        w = np.exp(-2j * np.pi * f / self.n_sections)[:, None]
        delay = w if self.form == "delayed" else 1.0
        polynomial = np.polynomial.polynomial.polyval
        columns = range(len(self.outputs))
        top = [polynomial(w[:, 0], self.numerator[i]) for i in columns]
        bottom = [polynomial(w[:, 0], self.denominator[i]) for i in columns]
        H = (delay * np.stack(top, axis=1) / np.stack(bottom, axis=1))[None, :, :, None]
        N = self.n_sections
        harmonic = (self.harmonic + N // 2) % N - N // 2  # (they count modulo N)
        return HTF(f, H, harmonic, N, self.input, self.outputs, "rational fit")

    @checked
    def compare(self, true: Multipliers, output: str | int | None = None) -> MultiplierComparison:
        """The multipliers of each output's fit (or of one alone) beside the true ones.

        **Raises:** `DefinitionError` for an output that is not there.
        """
        return compare_by_output(list(self.multipliers), true, self.outputs, output)

    def __repr__(self) -> str:
        rows = [
            f"RationalFit(H_{self.harmonic} from {self.input}, {self.denominator.shape[1] - 1} "
            f"poles, {self.numerator.shape[1] - 1} zeros, {self.form}, {self.weighting} weighting)"
        ]
        for name, own, residual, code in zip(
            self.outputs, self.multipliers, self.residual, self.result, strict=True
        ):
            shown = ", ".join(f"{x.real:+.5f}{x.imag:+.5f}i" for x in own)
            state = "" if code == Result.OK else f" ({Result(int(code)).message})"
            rows.append(f"  {name}: multipliers {shown}; residual {residual:.2e}{state}")
        return "\n".join(rows)

    def _repr_html_(self) -> str:
        rows = [
            (name, *map(complex_number, (pole, multiplier)), f"{residual:.2e}")
            for name, poles, own, residual in zip(
                self.outputs, self.poles, self.multipliers, self.residual, strict=True
            )
            for pole, multiplier in zip(poles, own, strict=True)
        ]
        of = repr(self).splitlines()[0].removeprefix("RationalFit(").removesuffix(")")
        head = ("output", "pole", "multiplier", "residual")
        return card("RationalFit", of, table(head, rows), unit_circle(self.multipliers.ravel()))


@checked
def fit_rational(
    htf: HTF,
    harmonic: int = 0,
    *,
    output: str | int | None = None,
    input: str | int = 0,
    poles: Order = 2,
    zeros: Index = 1,
    form: Literal["delayed", "direct"] = "delayed",
    weighting: Literal["uniform", "relative"] = "uniform",
    max_steps: StepCount = 200,
) -> RationalFit:
    """Fit a rational function of z with real coefficients to one harmonic.

    The residual is the true one, `W (H - B/A)`, minimized by Levenberg-Marquardt over the
    denominator only: for a given denominator the best numerator is a linear problem that is
    solved inside (variable projection). It starts from several solutions of the linearized
    problem (Levy 1959; Sanathanan and Koerner 1963) and the best result is kept.

    **Arguments:**

    - `htf`: estimated or exact. `harmonic`: usually 0; the others of a real system have complex
      coefficients, which this form does not have.
    - `output`: name or index; None fits every output. `input`: name or index.
    - `poles`, `zeros`: their numbers; 2 and 1 are the paper's.
    - `form`: `"delayed"`, numerator from z^-1 on (the output does not feel the input of its own
      section), or `"direct"`, from z^0 on.
    - `weighting`: `"uniform"`, or `"relative"`, each residual divided by |H|.

    **Returns:** `RationalFit`, outputs on the first axis also where there is only one.

    **Raises:** `DefinitionError` for a harmonic, output or input that is not there, for fewer
    lines than coefficients, for NaN or, with relative weighting, zeros in H;
    `ComputationError` if no start leads anywhere.
    """
    require_x64(htf.H)
    column, rows = channel_index("input", input, htf.inputs), range(len(htf.outputs))
    if output is not None:
        rows = [channel_index("output", output, htf.outputs)]
    H = np.asarray(htf.harmonic(harmonic))[:, :, column]
    if 2 * len(H) < poles + zeros + 1:
        raise DefinitionError(
            f"{poles} poles and {zeros} zeros have {poles + zeros + 1} coefficients, too many for "
            f"{len(H)} frequencies."
        )
    w = jnp.exp(-2j * jnp.pi * htf.f / htf.n_sections)
    delay = w if form == "delayed" else jnp.ones_like(w)
    fits = []
    for row in rows:
        h = H[:, row]
        name = f"H_{harmonic} of {htf.outputs[row]}"
        if not np.isfinite(h).all():
            raise DefinitionError(f"{name} holds NaN or infinity.")
        rms = float(np.sqrt(np.mean(np.abs(h) ** 2)))
        if rms == 0 or (weighting == "relative" and np.abs(h).min() < _ZERO * rms):
            raise DefinitionError(f"{name} is zero at a frequency: there is nothing to fit there.")
        weight = rms / np.abs(h) if weighting == "relative" else np.ones(len(h))
        h = jnp.asarray(h / rms)
        tried = _fit(w, delay, h, jnp.asarray(weight), poles, zeros, max_steps)
        cost = np.where(np.isfinite(tried.cost), tried.cost, np.inf)
        if not np.isfinite(cost).any():
            raise ComputationError(f"no start led to a finite fit of {name}: try fewer poles.")
        lowest = cost <= cost.min() * (1 + _EQUAL_COST)
        best = int(np.argmax(lowest * (1 + np.asarray(tried.converged))))
        fits.append(
            (
                np.asarray(tried.numerator[best]) * rms,
                np.concatenate([[1.0], tried.denominator[best]]),
                float(cost[best]),
                Result.OK if tried.converged[best] else Result.NOT_CONVERGED,
            )
        )
    numerator, denominator, residual, result = (
        np.array(values) for values in zip(*fits, strict=True)
    )
    roots = np.stack([_roots(a) for a in denominator])
    with np.errstate(over="ignore", invalid="ignore"):  # a useless pole far outside overflows
        multipliers = roots**htf.n_sections
    return RationalFit(
        numerator=numerator,
        denominator=denominator,
        poles=roots,
        zeros=np.stack([_roots(b) for b in numerator]),
        multipliers=multipliers,
        residual=residual,
        result=result.astype(int),
        harmonic=harmonic,
        n_sections=htf.n_sections,
        form=form,
        weighting=weighting,
        outputs=tuple(htf.outputs[row] for row in rows),
        input=htf.inputs[column],
    )


def _roots(coefficients: Float[np.ndarray, " c"]) -> Complex[np.ndarray, " n"]:
    """Roots by decreasing modulus; NaN for each that lies at infinity."""
    finite = np.roots(coefficients).astype(complex)
    finite = finite[np.lexsort((-finite.imag, -np.abs(finite)))]
    return np.concatenate([np.full(len(coefficients) - 1 - len(finite), np.nan), finite])


class _Trials(NamedTuple):
    """The fits from S starts."""

    denominator: Float[Array, "S p"]
    """Without its leading 1."""
    numerator: Float[Array, "S q1"]
    cost: Float[Array, " S"]
    """Root mean square of the weighted residual."""
    converged: Bool[Array, " S"]


@quick_jit
def _fit(
    w: Complex[Array, " F"],
    delay: Complex[Array, " F"],
    h: Complex[Array, " F"],
    weight: Float[Array, " F"],
    poles: int,
    zeros: int,
    max_steps: int,
) -> _Trials:
    powers_b = delay[:, None] * w[:, None] ** jnp.arange(zeros + 1)
    powers_a = w[:, None] ** (1 + jnp.arange(poles))
    weight = weight[:, None] / jnp.sqrt(h.size)

    def numerator(a):
        """The best numerator for a denominator, and the residual that it leaves."""
        columns = _real(weight * powers_b / (1 + powers_a @ a)[:, None])
        target = _real(weight * h[:, None])[:, 0]
        q, r = jnp.linalg.qr(columns)
        b = jax.scipy.linalg.solve_triangular(r, q.T @ target)
        return b, target - columns @ b

    def linearized(a, _):
        """One step of Sanathanan and Koerner: the old denominator as a weight."""
        scale = weight / jnp.abs(1 + powers_a @ a)[:, None]
        columns = _real(scale * jnp.concatenate([h[:, None] * powers_a, -powers_b], axis=1))
        size = jnp.linalg.norm(columns, axis=0)
        solution = jnp.linalg.lstsq(columns / size, -_real(scale * h[:, None])[:, 0])[0] / size
        return solution[:poles], solution[:poles]

    _, path = jax.lax.scan(linearized, jnp.zeros(poles), length=1 + max(_STARTS))
    starts = path[jnp.array(_STARTS)]
    solver = optx.LevenbergMarquardt(rtol=_ACCURACY, atol=_ACCURACY)

    def refine(start):
        # Coordinates in which the Jacobian at the start is orthonormal: those of `a` are so
        # nearly dependent for poles close to z = 1 that damping would stall.
        jacobian = jax.jacfwd(lambda a: numerator(a)[1])(start)
        floor = _FLOOR * (jnp.linalg.norm(jacobian) + _FLOOR) * jnp.eye(poles)
        scale = jnp.linalg.qr(jnp.concatenate([jacobian, floor]), mode="r")

        def place(s):
            return start + jax.scipy.linalg.solve_triangular(scale, s)

        found = optx.least_squares(
            lambda s, _: numerator(place(s))[1],
            solver,
            jnp.zeros(poles),
            max_steps=max_steps,
            throw=False,
        )
        a = place(found.value)
        b, residual = numerator(a)
        good = found.result == optx.RESULTS.successful
        return _Trials(a, b, jnp.linalg.norm(residual), good)

    return jax.lax.map(refine, starts)


def _real(z: Complex[Array, "F n"]) -> Float[Array, "rows n"]:
    return jnp.concatenate([z.real, z.imag])
