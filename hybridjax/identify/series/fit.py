"""Multipliers and transfer functions from recorded series with any input: output error."""

from collections.abc import Sequence
from typing import Any, Literal

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from ..._core.precision import require_x64
from ..._core.results import Result
from ...errors import DefinitionError
from ...linear.frequency_response import check_harmonics
from ...linear.htf import HTF
from ...linear.ldtp import LDTP
from ..multipliers.estimate import MultiplierEstimate, roots_of
from ..multipliers.likelihood import dependent, gauss_newton, memory, sandwich
from ..multipliers.order import refuse_invented
from ..multipliers.projection import chi
from .layout import Layout, Recorded, lay_out
from .regression import (
    Delayed,
    Linearization,
    Problem,
    delayed_outputs,
    initial,
    linearize,
    rescale,
    set_up,
)
from .second_order import HORIZON, Estimate, with_products


_PROBES = 4  # outputs of pure noise, from which the noise in the Jacobian is estimated


class SeriesFit(MultiplierEstimate):
    r"""A periodic system with one denominator in $q^{-N}$, fitted to recorded series.

    $$\chi(q^{-N})\, y[n] = \sum_{r=0}^{R-1} b_{n \bmod N}[r]\, u[n-r], \qquad
    \chi(q^{-N}) = 1 + c_1 q^{-N} + \ldots + c_d q^{-dN} = \prod_i (1 - \lambda_i q^{-N})$$

    which is exact for a periodic system with d non-zero multipliers, if R is large enough.

    **Fields:**

    - `multipliers` (d,): by decreasing modulus. `coefficients` (d,): c_1 to c_d.
    - `covariance` (d, d): of the coefficients, estimated with `covariance_freedom` degrees of
      freedom. `standard_errors`, `contains` and `ellipse` give what follows for multipliers.
    - `numerators` (N, R, ny, nu): b at each section. Combinations of inputs that were not
      excited have none.
    - `slopes` (d, N, R, ny, nu): their derivatives with respect to c.
    - `roots` (N, ny, R, nu, r): a square root of their covariance given c, for noise of variance 1.
    - `noise` (ny,): standard deviation of what the numerators do not explain.
    - `distortion`: whether a part of second order was taken into account.
    - `result`: code of `Result`, OK or NOT_CONVERGED.
    - `n_sections`, `inputs`, `outputs`. `lead`: the first lag of the numerators is -lead, where the
      records say so.
    """

    multipliers: Complex[np.ndarray, " d"]
    coefficients: Float[np.ndarray, " d"]
    covariance: Float[np.ndarray, "d d"]
    numerators: Float[np.ndarray, "N R ny nu"]
    slopes: Float[np.ndarray, "d N R ny nu"]
    roots: Float[np.ndarray, "N ny R nu r"]
    noise: Float[np.ndarray, " ny"]
    covariance_freedom: float = eqx.field(static=True)
    result: int = eqx.field(static=True)
    n_sections: int = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    lead: int = eqx.field(static=True, default=0)
    distortion: bool = eqx.field(static=True, default=False)

    def impulse_response(self, n_lags: int) -> Float[np.ndarray, "N lags ny nu"]:
        """Markov parameters: the response at section n to a unit input r sections earlier."""
        if n_lags < 1:
            raise DefinitionError(f"`n_lags` must be at least 1, not {n_lags}.")
        N, R = self.numerators.shape[:2]
        h = np.zeros((N, max(self.lead + n_lags, R), *self.numerators.shape[2:]))
        h[:, :R] = self.numerators
        for r in range(N, h.shape[1]):
            for j, c in enumerate(self.coefficients[: r // N], 1):
                h[:, r] -= c * h[:, r - j * N]
        return h[:, self.lead : self.lead + n_lags]

    def htf(self, f: Any, harmonics: int | Sequence[int] | None = None) -> HTF:
        r"""The harmonic transfer functions at frequencies f (cycles per period), with variances.

        Only where the inputs had power; elsewhere the variance is large, or there is none at
        all. It is that of white noise of the numerators, and of c as its covariance says.
        """
        f = np.atleast_1d(np.asarray(f, float))
        harmonics = check_harmonics(harmonics, self.n_sections)
        N, R, ny, nu = self.numerators.shape
        powers = np.exp(-2j * np.pi / N * f[:, None] * (np.arange(R) - self.lead))
        lag = np.exp(-2j * np.pi * f)
        below = chi(lag, self.coefficients)
        n = np.arange(N)
        turn = np.exp(-2j * np.pi * np.outer(harmonics, n) / N) / N

        def sum_up(b):  # (..., N, R, ny, nu) -> (..., M, F, ny, nu)
            G = np.einsum("fr,...nrij->...nfij", powers, b) / below[:, None, None]
            return np.einsum("mn,...nfij->...mfij", turn, G)

        H = sum_up(self.numerators)
        delays = lag ** np.arange(1, len(self.coefficients) + 1)[:, None]
        slope = sum_up(self.slopes) - (delays / below)[:, None, :, None, None] * H
        by_c = np.einsum("amfij,ab,bmfij->mfij", slope, self.covariance, slope.conj()).real
        spread = np.tensordot(powers, self.roots, axes=(1, 2))  # (F, N, ny, nu, r)
        by_b = (np.abs(spread) ** 2).sum(axis=(1, 4)) / N**2 / np.abs(below)[:, None, None] ** 2
        variance = by_c + by_b * self.noise[:, None] ** 2
        return HTF(f, H, harmonics, N, self.inputs, self.outputs, "series fit", variance=variance)

    def __repr__(self) -> str:
        state = "" if self.result == Result.OK else f"; {Result(self.result).message}"
        noise = ", ".join(f"{n} {x:.2e}" for n, x in zip(self.outputs, self.noise, strict=True))
        return (
            f"SeriesFit(multipliers {self.show_multipliers()}; noise {noise}; "
            f"{self.n_sections} sections, {self.numerators.shape[1]} lags{state})"
        )


def fit_series(
    data: Recorded,
    order: int | LDTP,
    *,
    overhang: int | None = None,
    start: Literal["free", "rest"] = "free",
    errors: Literal["residuals", "white"] = "residuals",
    distortion: bool | None = None,
    check: bool = True,
    max_steps: int = 50,
) -> SeriesFit:
    r"""Multipliers, HTFs and their uncertainty from series with any input.

    Output error, with white noise of unknown variance in each output: the sum of squares of the
    difference between measured and simulated outputs is minimized over all numerators, unknown
    starts and c; all but c is solved for inside (variable projection, Golub and Pereyra 1973). It
    starts from the periodic ARX problem, solved by total least squares (Ljung, *System
    Identification: Theory for the User*, treats both). Where `distortion` is allowed for, c comes
    from the form in which all sections share one state.

    **Arguments:**

    - `data`: `ExperimentData` (all cycles are used, not only its window; failed experiments are
      left out), a `Record`, which may have gaps and any length, or several of them.
    - `order`: d, the number of non-zero multipliers, or an `LDTP` model to take its rank from.
    - `overhang`: lags of the numerators beyond d N; None means N.
    - `start`: "free": whatever happened before a record, the state at its start is unknown.
      "rest": it starts on the limit cycle, with no input before.
    - `errors`: what the covariance is computed from. "residuals": from the misfit cycle by
      cycle, so that it holds also where noise of successive cycles is dependent (process noise),
      with the weights of Newey and West (1987). "white": from its size alone.
    - `distortion`: whether to allow for a part of the response of second order; None: if that
      explains more than half of the misfit, and lowers the standard errors by 10 % or more.
    - `check`: refuse an order that the data do not carry, as `fit_multipliers` does.
    - `max_steps`: of Gauss and Newton's iteration.

    **Raises:** `DefinitionError` for an order below 1, records that do not fit together, inputs
    that are zero, too few cycles (the message says how many are needed), or an order that the data
    do not carry.
    """
    require_x64()
    order = order.rank() if isinstance(order, LDTP) else order
    layout = lay_out(data)
    N = layout.y.shape[2]
    overhang = N if overhang is None else overhang
    if order < 1 or max_steps < 1 or overhang < 0:
        raise DefinitionError(
            "a fit needs order >= 1 (the number of non-zero multipliers), max_steps >= 1 and "
            f"overhang >= 0, not {order}, {max_steps} and {overhang}."
        )
    _check(layout)
    problem = set_up(layout, order, overhang, start == "rest")
    delayed = delayed_outputs(problem, order)
    c, found, converged = _minimize(problem, initial(delayed), max_steps)
    _check_freedom(found, order, problem)
    noise = _noise(found, order)
    problem = rescale(problem, noise)  # the weights that the misfit suggests
    c, found, converged = _minimize(problem, c, max_steps, found.rescale(noise))
    if check:
        refuse_order(delayed.rescale(noise * _noise(found, order)))
    covariance, freedom = _covariance(problem, c, found, errors)
    best = Estimate(c, covariance, freedom, converged)
    second = None
    if distortion is not False:
        first = quick_fit(problem, c, found, layout)
        second = with_products(
            layout,
            first.impulse_response((1 + HORIZON + order + -(-overhang // N)) * N),
            order,
            overhang,
            _section_noise(found) * problem.scale,
            rest=start == "rest",
            errors=errors,
            always=distortion is True,
            max_steps=max_steps,
        )
    if second is not None:
        best, found = second, linearize(problem, second.coefficients)
    return _as_fit(problem, found, layout, best, second is not None)


def refuse_order(delayed: Delayed) -> None:
    """Raise `DefinitionError` where outputs, in units of their noise, do not carry so many
    multipliers."""
    rows = max(delayed.freedom, 1)
    gram = delayed.gram.sum(axis=0)
    refuse_invented(np.linalg.eigvalsh(gram) / rows, np.sqrt(2 / rows))


def quick_fit(problem: Problem, c: np.ndarray, found: Linearization, layout: Layout) -> SeriesFit:
    """A fit with these coefficients, whatever they are worth, and an unknown covariance."""
    unknown = np.full((len(c), len(c)), np.inf)
    return _as_fit(problem, found, layout, Estimate(c, unknown, np.inf, False), False)


def _as_fit(problem, found, layout, best: Estimate, distortion: bool) -> SeriesFit:
    N, nu, ny = layout.y.shape[2], layout.u.shape[3], layout.y.shape[3]
    c = best.coefficients

    def by_input(b):  # (..., R nu, ny) -> (..., R, ny, nu), in the units of the outputs
        b = b.reshape(*b.shape[:-2], problem.lags, nu, ny) * problem.scale
        return np.swapaxes(b, -1, -2)

    widest = max(root.shape[1] for row in found.roots for root in row)
    roots = np.zeros((N, ny, problem.lags * nu, widest))
    for n, row in enumerate(found.roots):
        for i, root in enumerate(row):
            roots[n, i, :, : root.shape[1]] = root
    return SeriesFit(
        multipliers=roots_of(c),
        coefficients=c,
        covariance=best.covariance,
        numerators=by_input(found.numerators),
        slopes=by_input(found.slope),
        roots=roots.reshape(N, ny, problem.lags, nu, widest),
        noise=_noise(found, len(c)) * problem.scale,
        covariance_freedom=best.freedom,
        result=Result.OK if best.converged else Result.NOT_CONVERGED,
        n_sections=N,
        inputs=layout.inputs,
        outputs=layout.outputs,
        lead=layout.lead,
        distortion=distortion,
    )


def _minimize(problem: Problem, start: np.ndarray, max_steps: int, found=None):
    """`found`: the linearization at the start, where that is known."""
    last = [start, found]

    def at(c):
        if c is not last[0] or last[1] is None:
            last[:] = c, linearize(problem, c)
        return last[1]

    def normal(c):
        return at(c).residual.ravel(), at(c).jacobian.reshape(len(c), -1).T

    c, converged = gauss_newton(normal, start, max_steps)
    return c, at(c), converged


def _noise(found: Linearization, order: int) -> Float[np.ndarray, " ny"]:
    """Standard deviation of each output's noise, in its units of the moment."""
    square = (found.residual**2).sum(axis=(0, 1, 2, 4))
    left = found.freedom.sum(axis=0) - order / found.freedom.shape[1]
    return np.maximum(np.sqrt(square / left), 1e-15)


def _covariance(problem: Problem, c, found: Linearization, errors: str):
    """Of c, and its degrees of freedom; by cycles, which may depend on their neighbors."""
    d = len(c)
    rng = np.random.default_rng(0)
    probes = rng.standard_normal((*problem.y.shape, _PROBES)) * problem.good[..., None]
    noise = linearize(problem, c, probes).jacobian.reshape(d, -1)
    noise = noise @ noise.T / _PROBES
    parts = np.einsum("istnac,jstnac->stij", found.jacobian, found.jacobian)
    square = parts.sum(axis=(0, 1))
    if errors == "white" or not np.linalg.eigvalsh(square)[0] > 0:
        return sandwich(square - noise, square)
    # What a sample would miss a fit to the others by: errors that are large where inputs are, as
    # those of distortion, draw the fit to themselves (MacKinnon and White 1985, HC3).
    error = found.residual / np.maximum(1 - found.leverage, 1e-3)[..., None]
    score = np.einsum("jstnic,stnic->stj", found.jacobian, error)
    lags = memory(roots_of(c), problem.y.shape[1])
    gradient, terms = dependent(score, lags)
    # The scores add up to zero at the minimum, which takes this part of their covariance away.
    half = np.linalg.inv(np.linalg.cholesky(square))
    share = np.einsum("ij,stjk,lk->stil", half, parts, half).reshape(*parts.shape[:2], d * d)
    taken = np.trace(dependent(share, lags)[0])
    gradient = gradient / max(1 - taken / d, 0.5)
    covariance, freedom = sandwich(square - noise, gradient, parts.reshape(-1, d, d))
    return covariance, freedom / terms


def _section_noise(found: Linearization) -> Float[np.ndarray, "N ny"]:
    square = (found.residual**2).sum(axis=(0, 1, 4))
    return np.sqrt(square / np.maximum(found.freedom, 1))


def _check(layout: Layout) -> None:
    for i, name in enumerate(layout.inputs):
        if not layout.u[..., i].any():
            raise DefinitionError(f"the input {name} is zero at every sample.")
    for i, name in enumerate(layout.outputs):
        seen = np.isfinite(layout.y[..., i])
        if not layout.y[..., i][seen].any():
            raise DefinitionError(f"the output {name} is zero or missing at every sample.")


def _check_freedom(found: Linearization, order: int, problem: Problem) -> None:
    if (found.freedom > order).all():
        return
    n, i = np.argwhere(found.freedom <= order)[0]
    sampled = int(problem.good[:, :, n, i].sum())
    missing = order + 1 - int(found.freedom[n, i])
    raise DefinitionError(
        f"section {n} was sampled {sampled} times, too few for numerators of {problem.lags} lags "
        f"and {problem.free} unknown cycles at the start of each record: {missing} or more cycles "
        "are missing. Record more, or lower `order` or `overhang`."
    )
