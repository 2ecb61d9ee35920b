"""`fit_series`: multipliers and transfer functions from recorded time series with any input (output
error).

`_fit_open_loop` takes the stages in order: a first c by regression (`delayed_outputs.py`), the
minimum of the output error (`linearization.minimize`), a second minimum with outputs in units of
their noise, the covariance of c (`covariance.py`; that of a `jackknife` if residuals are
distortion, or smaller than those of any sensor), and findings about order, drift and feedback. (c
are the coefficients of the denominator chi.) With references, `in_loop.py` takes the place of the
first four. A wrong multiplier has its cause in the minimum, a wrong error bar in `covariance.py`.
"""

import dataclasses
from collections.abc import Iterator
from contextlib import suppress
from functools import cache, partial
from typing import Literal, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import (
    Index,
    Order,
    PeriodCount,
    Scalar,
    SignalNames,
    Vector,
)
from ..._core.execution import one_blas_thread
from ..._core.findings import Finding, refuse, warn_of
from ..._core.memo import remembered
from ..._core.precision import require_x64
from ..._core.results import Result
from ..._core.text import how_many, signal_values
from ...errors import DefinitionError
from ...experiments.record import RecordedData
from ...linear.frequency_response import Harmonics, check_harmonics
from ...linear.htf import HTF
from ...linear.ldtp import LDTP
from ..denominator import (
    Covariance,
    chi,
    coefficients_of,
    divided_by_chi,
    multipliers_of,
)
from ..descent import Coefficients
from ..fit import not_converged
from ..instrument import in_loop
from ..multiplier_estimate import (
    MultiplierFit,
    RoughFit,
    contradicted_by,
    left_out,
    order_doubts,
    undetermined,
)
from ..multipliers import NoiseRatios, unsupported
from ..realization import default_horizon, realized
from ..weights import SMALLEST_ERROR
from .covariance import coefficient_covariance, jackknife, uncertainty
from .delayed_outputs import DelayedOutputs, late_outputs, total_least_squares
from .in_loop import LoopEquations
from .linearization import (
    Linearization,
    minimize,
)
from .output_error import OutputErrorProblem, SectionRegression, TooFewCycles
from .records import (
    MAY_DRIFT,
    OF_DRIFT,
    CycleGrid,
    PreparedRecords,
    divide_by_chi,
    lagged_inputs,
    start_responses,
    with_drift,
)
from .residuals import WIDENED, about_answers, is_distorted, is_quiet


_BIASED = "the fit is biased; name their `references`"
# Level of the test whether multipliers change along the data. Larger: chance is reported. Smaller:
# changes of a few standard errors pass.
_STEADY = 0.01
_CHANGES = Finding(
    "changing system",
    "the multipliers change along the data, more than chance explains: the fit is a mean, and its "
    "intervals are too narrow. Fit earlier and later records one by one.",
)


class SeriesFit(MultiplierFit):
    r"""A periodic system with one denominator in $q^{-N}$, fitted to recorded time series.

    $$\chi(q^{-N})\, y[n] = \sum_{r=0}^{R-1} b_{n \bmod N}[r]\, u[n-r], \qquad
    \chi(q^{-N}) = 1 + c_1 q^{-N} + \ldots + c_d q^{-dN} = \prod_i (1 - \lambda_i q^{-N})$$

    This is exact for a periodic system with d non-zero multipliers, if R is large enough.

    **Fields** beside those of every `Fit`:

    - `multipliers` (d,): by decreasing modulus. `coefficients` (d,): c_1 to c_d.
    - `covariance` (d, d): covariance of the coefficients. `standard_errors`, `contains` and
      `ellipse` follow from it.
    - `numerators` (N, R, ny, nu): b at each section. Combinations of inputs that were not
      excited are zero.
    - `slopes` (d, N, R, ny, nu): their derivatives with respect to c.
    - `roots` (N, ny, R, nu, r): a square root of their covariance given c, for noise of variance 1.
    - `noise` (ny,): standard deviation of the residuals.
    - `n_sections`, `inputs`, `outputs`. `lead`: the first lag of the numerators is -lead, as given
      by the records.
    - `references`: signals that enter the loop from outside. With them, `noise` is the standard
      deviation of $\chi y$.
    - `findings`: "drift" if a fit to the first 1000 cycles, in which outputs may drift, has other
      multipliers (outside of each other's confidence regions); "order" if a fit with one or two
      multipliers more contradicts this fit in the same way; "feedback" if inputs depend on earlier
      residuals, as with a controller, so that the fit is biased; "distortion" if residuals follow
      products of earlier responses; "changing system" if the multipliers of earlier and later
      cycles differ; "undetermined"; "no convergence". With "distortion", or if residuals are
      below 1 % of the responses (as in simulations without noise), `covariance` is that of a
      jackknife where this is larger.
    """

    numerators: Float[np.ndarray, "N R ny nu"]
    slopes: Float[np.ndarray, "d N R ny nu"]
    roots: Float[np.ndarray, "N ny R nu r"]
    noise: Float[np.ndarray, " ny"]
    n_sections: int = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    lead: int = eqx.field(static=True, default=0)
    references: tuple[str, ...] = eqx.field(static=True, default=())

    @remembered
    def model(self) -> LDTP:
        """A minimal state-space model with the fitted responses, without states below the noise."""
        markov = self.impulse_response(2 * default_horizon(self.n_sections) + 1)
        square = (self.roots**2).sum(axis=4)
        spread = square.mean(axis=(0, 2))
        return realized(
            markov,
            noise=spread * self.noise[:, None] ** 2,
            order=len(self.multipliers),
            inputs=self.inputs,
            outputs=self.outputs,
        )

    @checked
    def impulse_response(
        self, n_lags: PeriodCount
    ) -> Float[np.ndarray, "N lags ny nu"]:
        """Return the Markov parameters: the response at section n to a unit input r sections
        earlier."""
        N, R, *shape = self.numerators.shape
        cycles = -(-max(self.lead + n_lags, R) // N)
        padding = cycles * N - R
        widths = ((0, 0), (0, padding), (0, 0), (0, 0))
        h = np.pad(self.numerators, widths)
        by_cycle = h.reshape(N, cycles, -1)
        divided = divide_by_chi(self.coefficients, by_cycle)
        h = divided.reshape(N, -1, *shape)
        return h[:, self.lead : self.lead + n_lags]

    @checked
    def htf(
        self, frequencies: Scalar | Vector, harmonics: Harmonics | None = None
    ) -> HTF:
        """Return the harmonic transfer functions at `frequencies` (F,), in cycles per period.

        The variance is that of white noise for the numerators, and follows from `covariance` for c.
        It is large or infinite at frequencies without power of the inputs.

        **Arguments:** `harmonics`: Default: all N.
        """
        f = np.atleast_1d(np.asarray(frequencies, float))
        harmonics = check_harmonics(harmonics, self.n_sections)
        N = self.n_sections
        c = self.coefficients
        lags = np.outer(harmonics, np.arange(N))
        waves = np.exp(-2j * np.pi * lags / N) / N

        def sum_up(b):  # (..., N, R, ny, nu) -> (..., M, F, ny, nu)
            by_harmonic = np.einsum("mn,...nrij->...mrij", waves, b)
            return divided_by_chi(by_harmonic, c, f, N, self.lead)

        H = sum_up(self.numerators)
        period_delay = np.exp(-2j * np.pi * f)[:, None, None]
        below = chi(period_delay, c)
        numbers = np.arange(1, len(c) + 1)
        lags = numbers[:, None, None, None, None]
        of_chi = period_delay**lags / below * H
        slope = sum_up(self.slopes) - of_chi
        by_c = np.einsum("amfij,ab,bmfij->mfij", slope, self.covariance, slope.conj())
        r = np.arange(self.numerators.shape[1]) - self.lead
        exponent = -2j * np.pi / N * np.outer(f, r)
        powers = np.exp(exponent)
        spread = np.tensordot(powers, self.roots, axes=(1, 2))  # (F, N, ny, nu, r)
        square = np.abs(spread / N) ** 2
        power = square.sum(axis=(1, 4))
        by_b = power / np.abs(below) ** 2
        of_noise = self.noise[:, None] ** 2
        variance = by_c.real + by_b * of_noise
        variance = np.where(np.isnan(variance), np.inf, variance)
        names = self.inputs, self.outputs
        return HTF(f, H, harmonics, N, *names, "series fit", variance=variance)

    def _about(self) -> str:
        loop = (
            f"in a loop, by {', '.join(self.references)}; " if self.references else ""
        )
        return (
            f"{loop}noise {signal_values(self.outputs, self.noise)}; "
            f"{how_many(self.n_sections, 'section', 'sections')}, "
            f"{how_many(self.numerators.shape[1], 'lag', 'lags')}"
        )

    @property
    def free_cycles(self) -> int:
        """The cycles at the start of a record on which earlier inputs act without a model."""
        N, R = self.numerators.shape[:2]
        return -(-(R - 1 - self.lead) // N)

    def spread(self, grid: CycleGrid) -> Iterator[Float[np.ndarray, "S T ny r"]]:
        """Iterate over sections: roots of the covariance of the outputs by errors of numerators,
        for noise of variance one. (Errors of c change single sections little.)"""
        N, ny, R, nu, r = self.roots.shape
        v = divide_by_chi(self.coefficients, grid.u)
        for n, root in enumerate(self.roots.reshape(N, ny, R * nu, r)):
            lagged = lagged_inputs(v, n, R, self.lead)
            yield np.tensordot(lagged, root, (2, 1))

    def predicted(
        self, grid: CycleGrid, free_start: bool
    ) -> Float[np.ndarray, "S T N ny"]:
        """Return the outputs that follow from the inputs, with the initial conditions and the drift
        that fit best."""
        N, R, ny, _ = self.numerators.shape
        T = grid.u.shape[1]
        v = divide_by_chi(self.coefficients, grid.u)
        # As in the fit, the effect of earlier inputs on these first cycles is free.
        free = min(self.free_cycles, T) if free_start else 0
        no_drift = grid.drift[:, :, :0]
        out = np.zeros(grid.y.shape)
        for n, i in np.ndindex(N, ny):
            of_output = self.numerators[n, :, i]
            numerator = of_output.reshape(-1, 1)
            forced = lagged_inputs(v, n, R, self.lead) @ numerator
            first = grid.first[:, n]
            starts = start_responses(self.coefficients, first, T, free)
            unknown = np.concatenate([starts, grid.drift], axis=2)
            y = grid.y[:, :, n, i]
            sampled = grid.sampled[:, :, n, i]
            regression = SectionRegression.make(forced, unknown, no_drift, sampled)
            residual = regression.residual(np.ones(1), y)
            error = residual.reshape(y.shape)
            response = regression.response(np.ones(1), y)
            fitted = y - error
            out[:, :, n, i] = np.where(sampled, fitted, response)
        return out


@checked
@one_blas_thread()
def fit_series(
    data: RecordedData,
    order: Order | LDTP,
    *,
    extra_lags: Index | None = None,
    start: Literal["free", "cycle"] = "free",
    check: bool = True,
    references: SignalNames | None = None,
) -> SeriesFit:
    r"""Estimate multipliers and HTFs from time series with any input, with their uncertainty.

    The fit minimizes the output error: the sum of squares of measured minus simulated outputs, each
    in units of its noise, which is taken as white with an unknown variance. The responses have a
    common denominator, with the coefficients c, whose roots are the multipliers, and a numerator
    for each section, output and input. The unknowns are c, the numerators and the initial
    conditions. All but c are eliminated (variable projection, Golub and Pereyra 1973). The
    iteration starts from the solution of a linear problem (periodic ARX, by total least squares).
    (Output error and ARX: Ljung, *System Identification: Theory for the User*.)

    **Arguments:**

    - `data`: `SectionSeries`, `ExperimentData` (all cycles of successful experiments), or
      `SectionData`. If outputs drift or have offsets, pass `[dataclasses.replace(r, drift=20) for r
      in data.records]`.
    - `order`: d, the number of non-zero multipliers, or an `LDTP` model that has this number.
    - `extra_lags`: number of lags of each numerator beyond d N, with N sections. Default: N.
    - `start`: initial condition of the records. "free": unknown. "cycle": on the limit cycle, with
      no input before. Default: "free".
    - `check`: whether to raise an error for an order that the data do not support, and to emit
      `findings` as warnings (`FindingWarning`). Default: True.
    - `references`: names of the inputs that enter a control loop from outside. The controller sets
      the other inputs. The fit is a model of the plant, stable or unstable, from the other inputs
      to the outputs. It uses instrumental variables, which are consistent for any noise and
      controller. `start` has no effect: the first cycles of each record are not used. Default:
      None.

    **Returns:** `hj.identify.SeriesFit`: `multipliers` (d,), complex, without unit, by decreasing
    modulus; `standard_errors` (d,); `noise` (ny,), standard deviations in units of the outputs;
    `findings`. `fit.htf(frequencies)` returns the HTFs.

    **Raises:** `DefinitionError` for records that do not fit together, inputs that are zero, too
    few cycles (the message says how many are needed), or an order that the data do not support.

    **Example:**

    ```python
    fit = hj.fit_series(data, order=2)
    print(fit.multipliers, fit.standard_errors)
    ```

    **Before:** `hj.run_experiments` or `hj.recordings.sample_sections`. **After:** `hj.validate`.
    """
    require_x64()
    order = order.rank() if isinstance(order, LDTP) else order
    if references is None:
        fit = _fit_open_loop(data, order, extra_lags, start == "free", check)
    else:
        fit = _fit_in_loop(data, order, extra_lags, references, check)
    if check:
        warn_of(fit.findings)
    return fit


def _fit_in_loop(
    data: RecordedData,
    order: int,
    extra_lags: int | None,
    references: SignalNames,
    check: bool,
) -> SeriesFit:
    plant, drive = in_loop(data, references)
    fit = SeriesFit(**LoopEquations(plant, drive, order, extra_lags).fit(check))
    fewer = max(extra_lags - plant[0].n_sections, 0) if extra_lags else 0
    higher = [lambda: LoopEquations(plant, drive, order + 1, fewer).coefficients()]
    return dataclasses.replace(fit, findings=tuple(order_doubts(fit, higher)))


class _Weighted(NamedTuple):
    """A fit with weights from its own residuals."""

    problem: OutputErrorProblem
    solution: Linearization
    converged: bool
    ratios: NoiseRatios


def _fit_open_loop(
    data: RecordedData | PreparedRecords,
    order: int,
    extra_lags: int | None,
    free_start: bool,
    check: bool,
) -> SeriesFit:
    records = data
    if not isinstance(records, PreparedRecords):
        records = PreparedRecords(records, free_start)
    extra_lags = records.n_sections if extra_lags is None else extra_lags

    def weighted(order: int) -> _Weighted:
        problem = OutputErrorProblem.from_data(records, order, extra_lags, free_start)
        delayed = late_outputs(problem, order)
        solution, _ = minimize(problem, total_least_squares(delayed))
        _require_freedom(problem, solution)
        noise = _noise(solution)
        problem = problem._replace(scale=problem.scale * noise)
        solution, converged = minimize(problem, solution.c)
        ratios = _noise_ratios(delayed, noise * _noise(solution))
        return _Weighted(
            problem=problem,
            solution=solution,
            converged=converged,
            ratios=ratios,
        )

    best = weighted(order)
    covariance, p_steady = uncertainty(best.problem, best.solution)
    fit = assemble(best.problem, best.solution, covariance, best.converged)
    grid = records.whole()
    predicted = fit.predicted(grid, free_start)
    error = np.where(grid.sampled, grid.y - predicted, 0.0)
    distortion = []
    if is_distorted(grid, error, predicted, fit.coefficients):
        distortion = [WIDENED]
    if distortion or is_quiet(grid, error, predicted):
        wider = jackknife(best.problem, best.solution, covariance)
        fit = dataclasses.replace(
            fit, covariance=wider.matrix, covariance_dof=wider.dof
        )
    answers = about_answers(grid, error, records.inputs, _BIASED)
    drift = _about_drift(fit, records, free_start)

    def ratios(k: int) -> NoiseRatios:
        return best.ratios if k == order else weighted(k).ratios

    surplus = unsupported(ratios, order, check)
    refuse([*surplus, *(answers or drift)])
    doubts = [*surplus, *drift]
    if not doubts:
        # One more multiplier, or a pair. (If outputs drift, additional multipliers would be those
        # of the drift.)
        higher = [
            cache(partial(_of_order, order + k, records, fit, free_start))
            for k in (1, 2)
        ]
        doubts = order_doubts(fit, higher) or left_out(higher[0])
    changes = [_CHANGES] if p_steady < _STEADY else []
    return dataclasses.replace(
        fit, findings=(*fit.findings, *doubts, *distortion, *changes, *answers)
    )


def _about_drift(
    fit: SeriesFit, records: PreparedRecords, free_start: bool
) -> list[Finding]:
    """Return a finding if slow drift of the outputs may explain multipliers of a fit.

    This is so if a fit in which outputs may drift has other multipliers; or if it has as little
    noise without the multipliers that may be 1. (A multiplier of 1 looks like a constant.)
    """

    # (A fit with drift is refused if an input begins to act later than the records begin, or if
    # drift was declared.)
    def slow() -> PreparedRecords:
        return PreparedRecords(with_drift(records.records))

    def drifting() -> RoughFit:
        order = len(fit.coefficients)
        problem = _problem_like(fit, slow(), order, free_start)
        return _rough(problem, total_least_squares(late_outputs(problem, order)))

    unknown = undetermined(fit)
    if unknown:
        return unknown
    if contradicted_by(fit, [drifting], OF_DRIFT) is not None:
        return [MAY_DRIFT]
    reach = 2 * fit.standard_errors
    may_be_one = np.real(fit.multipliers) + reach > 1
    if not may_be_one.any() or may_be_one.all():
        return []
    fewer = coefficients_of(fit.multipliers[~may_be_one])
    with suppress(DefinitionError):
        problem = _problem_like(fit, slow(), len(fewer), free_start)
        solution, _ = minimize(problem, fewer, rough=True)
        _require_freedom(problem, solution)
        degrees = solution.dof.sum(axis=0)
        spread = 1 / np.sqrt(2 * degrees)
        if (_noise(solution) < 1 + 3 * spread).all():
            return [MAY_DRIFT]
    return []


def _of_order(
    order: int, records: PreparedRecords, fit: SeriesFit, free_start: bool
) -> RoughFit:
    """Fit a higher order roughly, beginning at a fit.

    **Raises:** `DefinitionError` for too few cycles.
    """
    missing = order - len(fit.coefficients)
    start = np.pad(fit.coefficients, (0, missing))
    return _rough(_problem_like(fit, records, order, free_start), start)


def _problem_like(
    fit: SeriesFit, records: PreparedRecords, order: int, free_start: bool
) -> OutputErrorProblem:
    """Return a problem in units of a fit's noise. It has no more lags than the fit, if possible.
    (These are enough if there are no zero multipliers.)"""
    N, R = fit.numerators.shape[:2]
    beyond = R - 1 - fit.lead - order * N
    extra_lags = max(beyond, 0)
    problem = OutputErrorProblem.from_data(records, order, extra_lags, free_start)
    return problem._replace(scale=fit.noise)


def _rough(problem: OutputErrorProblem, start: Coefficients) -> RoughFit:
    solution, _ = minimize(problem, start, rough=True)
    _require_freedom(problem, solution)
    return solution.c, partial(coefficient_covariance, problem, solution)


def assemble(
    problem: OutputErrorProblem,
    solution: Linearization,
    covariance: Covariance,
    converged: bool,
) -> SeriesFit:
    """Return the fit with the denominator of a solution, in the units of the data."""
    N, nu, ny = problem.shape
    d = len(solution.c)
    lags = problem.lags
    columns = lags * nu  # lags, then inputs
    widest = max(fit.root.shape[1] for section in solution.fits for fit in section)
    numerators = np.zeros((N, columns, ny))
    slopes = np.zeros((d, N, columns, ny))
    roots = np.zeros((N, ny, columns, widest))
    for n, to_lags in enumerate(problem.to_lags):
        for fit in solution.fits[n]:
            by_c = np.moveaxis(fit.slopes[..., 0], 1, 0)
            coefficients = fit.coefficients[..., 0]
            numerators[n][:, fit.outputs] = to_lags @ coefficients
            slopes[:, n][..., fit.outputs] = to_lags @ by_c
            roots[n, fit.outputs, :, : fit.root.shape[1]] = to_lags @ fit.root

    def by_input(b):  # (..., R nu, ny) -> (..., R, ny, nu), in the units of the outputs
        by_lag = b.reshape(*b.shape[:-2], lags, nu, ny)
        b = by_lag * problem.scale
        return b.mT

    result = int(Result.OK if converged else Result.NOT_CONVERGED)
    return SeriesFit(
        multipliers=multipliers_of(solution.c),
        coefficients=solution.c,
        covariance=covariance.matrix,
        covariance_dof=covariance.dof,
        numerators=by_input(numerators),
        slopes=by_input(slopes),
        roots=roots.reshape(N, ny, problem.lags, nu, widest),
        noise=_noise(solution) * problem.scale,
        dof=float(solution.dof.sum() - d),
        result=result,
        findings=tuple(not_converged(result)),
        **problem.records.about,
    )


def _noise(solution: Linearization) -> Float[np.ndarray, " ny"]:
    """Return the standard deviation of each output's noise, in units of the problem's scale."""
    of_c = len(solution.c) / solution.dof.shape[1]
    left = solution.dof.sum(axis=0) - of_c
    variance = solution.square.sum(axis=0) / left
    return np.maximum(np.sqrt(variance), SMALLEST_ERROR)


def missing_cycles(
    problem: OutputErrorProblem, solution: Linearization, least: int
) -> int:
    """Return about how many more cycles are needed for this number of degrees of freedom."""
    n, i = np.unravel_index(np.argmin(solution.dof), solution.dof.shape)
    # (If `dof` is 0, there may be fewer samples than unknowns: `freedom_left` may be negative.)
    left = int(solution.dof[n, i]) or problem.freedom_left(int(n), int(i))
    return max(least - left, 0)


def _require_freedom(problem: OutputErrorProblem, solution: Linearization) -> None:
    order = len(solution.c)
    missing = missing_cycles(problem, solution, order + 1)
    if missing:
        n, i = np.argwhere(solution.dof <= order)[0]
        raise TooFewCycles(problem, n, i, missing)


def _noise_ratios(
    delayed: DelayedOutputs, noise: Float[np.ndarray, " ny"]
) -> NoiseRatios:
    """Return the ratios of a fit to outputs with noise of this standard deviation."""
    rows = max(delayed.dof, 1)
    relative = delayed.gram / noise[:, None, None] ** 2
    gram = relative.sum(axis=0)
    spread = float(np.sqrt(2 / rows))
    return np.linalg.eigvalsh(gram) / rows, spread
