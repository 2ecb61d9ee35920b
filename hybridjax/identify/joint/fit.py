"""`fit_ldtp`: maximum likelihood for the matrices of a linear periodic model.

`_fit_to_htf` and `_fit_to_records` take the same stages: a first model (`realization.py`, or
`series/subspace.py`), the descent to the nearest minimum (`descent.py`), the fit with its
covariance (`_finished`), and doubts about it. For records, it is also decided whether outputs
depend on the input at their own section (D). The descent finds the minimum nearest to the first
model: if a fit is poor, give a known model as `initial` to see whether there is a better minimum.

If a covariance is wrong, look at `_finished`; if an iteration ends too early, at `settled` and
`stalled` in `descent.py` of this folder.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import Annotated, Literal, NamedTuple, cast

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy import special

from ..._core.arguments import Numbers, require_same
from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Order, Scalar, SignalNames, Vector
from ..._core.boundary.values import Integers
from ..._core.findings import Finding, warn_of
from ..._core.precision import require_x64
from ..._core.results import Result
from ..._core.text import how_many, signal_values
from ...errors import DefinitionError
from ...experiments.record import RecordedData
from ...linear.frequency_response import Harmonics, all_harmonics, check_harmonics
from ...linear.htf import HTF
from ...linear.ldtp import LDTP
from .. import weights
from ..denominator import Covariance, multipliers_of
from ..descent import Spread
from ..fit import WithCost, not_converged
from ..instrument import in_loop
from ..multiplier_estimate import (
    MultiplierFit,
    RoughFit,
    contradicted_by,
    undetermined,
)
from ..periodic import (
    LocalCoordinates,
    PeriodicModel,
    characteristic_slopes,
    local_coordinates,
)
from ..realization import given_dims
from ..series import prediction, residuals
from ..series.prediction import Predictor, SeriesPart, SeriesProblem
from ..series.records import (
    MAY_DRIFT,
    OF_DRIFT,
    CycleGrid,
    PreparedRecords,
    with_drift,
)
from ..series.subspace import answers_at_once, subspace_model
from .descent import ModelPoint, descend
from .frequency import FrequencyProblem, transfer, transfer_slopes
from .realization import realized_htf


Dimensions = Order | Annotated[Numbers, Integers("sections", sign="positive")]
Guess = LDTP | Dimensions

# The inputs must decrease the cost by at least this for each unknown, in units of the errors'
# variance. (It is 1 if errors are white and outputs do not respond.) Smaller: noise that is
# filtered by the system looks like a response, and gives multipliers. Larger: weak responses are
# refused.
_ANSWERED = 5.0


class LDTPFit(WithCost, MultiplierFit):
    r"""A linear periodic model that maximizes the likelihood, and its uncertainty.

    **Fields** beside those of every `Fit`:

    - `model`: the fitted `LDTP`. The coordinates of its states are arbitrary; multipliers and HTFs
      do not depend on them, and have standard errors.
    - `multipliers` (d,): by decreasing modulus; d is the smallest dimension of any
      x[n]. `coefficients` (d,): coefficients of the polynomial of the multipliers.
    - `covariance` (d, d): covariance of the coefficients, infinite if the data do not determine all
      of them. `covariance_dof` is infinite if variances were given. `standard_errors`, `contains`
      and `ellipse` follow from it.
    - `unknowns`: number of unknowns, less those that only determine the coordinates of the states.
    - `cost`: sum of squares of the residuals in units of the errors' standard deviations, whose
      expectation is `dof`. A larger cost means too few dimensions, or a local minimum. Without
      variances, as always for time series, the standard deviations are estimated from the
      residuals, so that `cost` always equals `dof`: see `correlation`, and use `hj.validate`.
    - `correlation`: of the residuals of HTFs at neighboring frequencies; about 0 for enough
      dimensions. None for time series.
    - `harmonics` (M,): harmonics that were fitted; for time series, all N.
    - `noise_model`: an `LDTP` whose response to independent white inputs of variance one is the
      noise of the outputs; None for HTFs. `noise` (ny,): standard deviation of the errors one step
      ahead.
    - `findings`: "feedback" if a controller sets the inputs of time series, or may do so (only
      without `references`); "drift" if a second fit to the first 1000 cycles of time series, in
      which outputs may drift, has other multipliers (they lie outside of each other's confidence
      regions); "distortion" if residuals follow products of earlier outputs; "left over" if they
      depend on the inputs; "process noise" or "colored noise" if residuals are correlated in time;
      "misfit" if residuals of HTFs are larger than their variances, or similar at neighboring
      frequencies, because the dimensions are too few or the iteration found a local minimum;
      "order" if one dimension less explains the data; "undetermined"; "no convergence".
    """

    model: LDTP
    cost: float = eqx.field(static=True)
    correlation: float | None = eqx.field(static=True)
    harmonics: tuple[int, ...] = eqx.field(static=True)
    noise_model: LDTP | None
    _coordinates: LocalCoordinates
    _spread: Spread
    _scale: Float[np.ndarray, " ny"]

    @property
    def noise(self) -> Float[np.ndarray, " ny"] | None:
        if self.noise_model is None:
            return None
        D = np.asarray(self.noise_model.D)
        return np.sqrt((D**2).sum(axis=2).mean(axis=0))

    @property
    def n_sections(self) -> int:
        return self.model.n_sections

    @property
    def inputs(self) -> tuple[str, ...]:
        return self.model.inputs

    @property
    def outputs(self) -> tuple[str, ...]:
        return self.model.outputs

    @property
    def unknowns(self) -> int:
        return self._coordinates.size

    @checked
    def htf(
        self, frequencies: Scalar | Vector, harmonics: Harmonics | None = None
    ) -> HTF:
        """Return the HTFs of the fitted model at `frequencies` (F,), in cycles per period.

        The variance is that of the fit, to first order. It is infinite for combinations that the
        data do not determine, e.g. at harmonics that were not fitted.

        **Arguments:** `harmonics`: Default: those that were fitted.
        """
        f = np.atleast_1d(np.asarray(frequencies, float))
        N = self.n_sections
        if harmonics is None:
            harmonics = self.harmonics
        harmonics = check_harmonics(harmonics, N)
        H = transfer(self._coordinates.model, f, harmonics)
        variance = np.zeros(H.shape)
        for rows, slopes in transfer_slopes(self._coordinates, f, harmonics):
            variance[:, rows] = self._spread.variance(slopes)
        size = self._scale[:, None]
        names = self.inputs, self.outputs
        return HTF(
            f, H * size, harmonics, N, *names, "fit", variance=variance * size**2
        )

    @checked
    def noise_spectrum(
        self, frequencies: Scalar | Vector, harmonics: Harmonics | None = None
    ) -> Float[np.ndarray, "M F ny"]:
        """Return the spectrum of the fitted noise at the harmonics of `frequencies` (F,).

        White noise with the standard deviation sigma has the spectrum sigma^2 for all f and m. The
        variance of an H_m that is measured with a cosine of amplitude a in P periods is
        4 S(f + m) / (N P a^2): that of `Design.expected_variance(noise=1)` times the spectrum.

        **Arguments:** `harmonics`: Default: all N.

        **Returns:** (M, F, ny), the squared unit of each output.

        **Raises:** `DefinitionError` if no noise was fitted, or if it grows without bound.
        """
        if self.noise_model is None:
            raise DefinitionError(
                "no noise is fitted to HTFs (`HTF.variance`): fit time series."
            )
        f = np.atleast_1d(np.asarray(frequencies, float))
        return prediction.noise_spectrum(self.noise_model, f, harmonics)

    def spread(self, grid: CycleGrid) -> Iterator[Float[np.ndarray, "S T ny r"]]:
        """Iterate over sections: roots of the covariance of the predictions by errors of the fit,
        in units of the noise."""
        part = SeriesPart.of(grid, self._scale)
        units = np.outer(self._scale, self._scale)
        S = cast(Predictor, self.predictor).S / units
        path = SeriesProblem(
            parts=[part],
            S=S,
            by_section=True,
            free_start=True,
            residuals=0,
        ).path(self._coordinates.model, part)
        sizes = np.sqrt(np.linalg.diagonal(S))[:, :, None]
        slopes = prediction.slopes_of(self._coordinates, part, path)
        for J, size in zip(slopes, sizes, strict=True):
            yield J @ self._spread.root / size

    @property
    def predictor(self) -> Predictor | None:
        """The predictor one step ahead that `hj.validate` uses; None if no noise was fitted."""
        if self.noise_model is None:
            return None
        D = np.asarray(self.noise_model.D)
        model = self._coordinates.model.times(self._scale)
        return Predictor(model, D @ D.mT)

    @property
    def determines_direct(self) -> bool:
        """Test whether the data determine D, unless it was taken as zero."""
        coordinates = self._coordinates
        if not coordinates.direct:
            return True
        entries = np.concatenate([np.r_[place["D"]] for place in coordinates.places])
        slopes = np.eye(coordinates.size)[:, entries]
        return bool(np.isfinite(self._spread.variance(slopes)).all())

    def _about(self) -> str:
        about = f"chi-square per degree of freedom {self.chi2_per_dof:.3g} (dof {self.dof:.0f})"
        if self.noise is not None:
            about = f"errors one step ahead {signal_values(self.outputs, self.noise)}"
        sections = how_many(self.n_sections, "section", "sections")
        return f"{about}; {self.unknowns} unknowns, {sections}"


@checked
def fit_ldtp(
    data: HTF | RecordedData,
    dims: Dimensions | None = None,
    initial: LDTP | None = None,
    *,
    noise: Literal["output", "innovations"] = "output",
    start: Literal["free", "cycle"] = "free",
    check: bool = True,
    references: SignalNames | None = None,
) -> LDTPFit:
    r"""Fit the matrices A[n], B[n], C[n], D[n] of a periodic model by maximum likelihood.

    For *HTFs* with independent, circular, Gaussian errors of the given variances, the fit minimizes

    $$V(A, B, C, D) = \sum \frac{2}{v}\, | H_m(\omega) - \hat H_m(\omega; A, B, C, D) |^2$$

    over all frequencies, harmonics, outputs and inputs. `fit_multipliers` gives each of the
    transfer functions a numerator of its own; here they follow from fewer unknowns, and the
    standard errors of multipliers are smaller (`hj.identify.cramer_rao` returns them).

    For *time series*, with Gaussian one-step prediction errors e,

    $$x[n+1] = A[n] x[n] + B[n] u[n] + K[n] e[n], \qquad y[n] = C[n] x[n] + D[n] u[n] + e[n]$$

    it minimizes $V = \sum_n T_n \log \det S[n]$ with S[n] the covariance of the $T_n$ errors at
    section n (Ljung, *System Identification*, 1999, for each section). With `noise="output"` K is
    zero and S the same at all sections: white noise of sensors. With "innovations" the noise is any
    periodic process of the states: process noise (every such system has this form, by Kalman's
    filter), and, with more states, colored noise.

    The iteration is Levenberg-Marquardt's, with exact derivatives, in local coordinates that leave
    out changes of the state coordinates (McKelvey, Helmersson and Ribarits 2004).

    **Arguments:**

    - `data`: estimated HTFs, with as many harmonics as possible: few harmonics determine few
      entries of the matrices. Without variances each output is weighted by its residuals. Or time
      series, as for `fit_series`.
    - `dims`: dimensions of the state at each section, or one for all. The fit starts from a
      realization of HTFs, and from a subspace method for time series, which need `dims`. Too few
      dimensions bias the multipliers: compare `cost` with `dof` where variances are known; for time
      series, see `findings`. The iteration finds a local minimum; the same checks reveal a poor
      one. Default: states of HTFs above the noise, which may bias a multiplier.
    - `initial`: an observable model to start from, in place of `dims`. If its D is zero, D stays
      zero. Default: None.
    - `noise`: model of the noise of time series, see above; "output" for HTFs. Default: "output".
    - `start`: initial state of each record of time series: "free", or zero for "cycle". HTFs have
      none. Default: "free".
    - `check`: whether to check data and fit. An error is raised if outputs do not respond to the
      inputs (not with "innovations"). `findings`, and warnings (`FindingWarning`), report if one
      dimension less explains the data as well, if residuals of time series depend on the inputs,
      and if drift explains the multipliers. Default: True.
    - `references`: names of the inputs that enter a control loop from outside. The controller sets
      the other inputs. The fit is a model of the plant, from the other inputs to the outputs, with
      innovations. The plant may be unstable. The fit is consistent if D is zero at sections where
      the controller responds without delay, which the response of the outputs to the reference
      shows. If the reference was not recorded, pass noise="innovations". Default: None.

    Without a reference, D is fixed to zero in three cases. First, outputs do not depend on inputs
    at the same section. Second, inputs depend on earlier residuals. Third, the past determines the
    inputs (few excited frequencies), and a fit with D is not better (at 5 %). Otherwise D is
    fitted, and a finding reports that a controller could cause the dependence. If the data do not
    determine D, the printed fit reports this.

    **Returns:** `hj.identify.LDTPFit`: `model`, the fitted `hj.linear.LDTP`; `multipliers` (d,),
    without unit, with `standard_errors` (d,) and `covariance` (d, d), that of their coefficients;
    `findings`.

    **Raises:** `DefinitionError` for both `dims` and `initial`, if data and initial model do not
    fit together, for NaN in the HTFs, variances that are not positive, an unobservable initial
    model, fewer numbers in the data than unknowns, outputs that do not respond to the inputs, or
    records with `lead`.

    **Example:**

    ```python
    fit = hj.fit_ldtp(htf, dims=2)
    print(fit.multipliers, fit.model)
    ```

    **Before:** `hj.estimate_htf`, or data as for `hj.fit_series`. **After:** `hj.validate`.
    """
    require_x64()
    free_start = start == "free"
    if dims is not None and initial is not None:
        raise DefinitionError(
            "fit_ldtp: `initial` has its own dimensions: give it or `dims`."
        )
    guess = dims if initial is None else initial
    if not isinstance(data, HTF):
        if guess is None:
            raise DefinitionError(
                "fit_ldtp: give the dimensions of the state as `dims`, which time series need."
            )
        how = _How(noise == "innovations" or references is not None, free_start, check)
        fit = _fit_to_records(data, guess, how, references)
    elif references is None and noise == "output" and free_start:
        fit = _fit_to_htf(data, guess, check)
    else:
        raise DefinitionError(
            "`references`, `noise` and `start` are for time series: give the data, not HTFs, or "
            "leave these arguments out (and pass `references` to `estimate_htf`)."
        )
    if check:
        warn_of(fit.findings)
    return fit


class _How(NamedTuple):
    """How a model is fitted to time series."""

    innovations: bool
    """Whether noise enters the states."""
    free_start: bool
    """Whether the states at the starts of records are unknown."""
    check: bool


def _fit_to_htf(htf: HTF, guess: Guess | None, check: bool) -> LDTPFit:
    scale = weights.check_values(htf)
    direct = _is_direct(guess)
    if not isinstance(guess, LDTP):
        guess = realized_htf(htf, given_dims(guess, htf.n_sections, "dims"))
    require_same("initial model and data", guess, htf)
    problem = FrequencyProblem.of(htf, weights.error_weights(htf, scale), scale)
    model = PeriodicModel.of(guess, scale)
    unknowns = local_coordinates(model, direct).size
    dof = problem.residuals - unknowns
    if dof < 1:
        raise DefinitionError(
            f"the HTFs hold {problem.residuals} numbers, too few for {unknowns} unknowns: give "
            "more frequencies, or smaller `dims`."
        )
    if not np.isfinite(problem.cost(model)):
        raise DefinitionError(
            "`initial` has an infinite response at a frequency: give a stable one."
        )
    point, converged = descend(ModelPoint(problem, model, direct))
    if htf.variance is None:
        # A second descent, with the outputs weighted by their residuals.
        errors = np.abs(problem.errors(point.model))
        square = (errors**2).mean(axis=(0, 1, 3))
        size = np.maximum(np.sqrt(square / 2), weights.SMALLEST_ERROR)
        problem = problem._replace(weight=problem.weight / size[:, None])
        start = ModelPoint(problem, point.model, direct)
        point, converged = descend(start)
    if check:
        _require_answer(point)
    fit = _finished(point, converged, htf, scale, dof)
    if not check:
        return fit

    def smaller(dims: Sequence[int]) -> PeriodicModel:
        return PeriodicModel.of(realized_htf(htf, dims), scale)

    return _with_findings(fit, _surplus(fit, point, smaller))


def _fit_to_records(
    data: RecordedData, guess: Guess, how: _How, references: SignalNames | None
) -> LDTPFit:
    """Return a fit to time series, with the findings of its residuals."""
    drive = None
    if references is not None:
        data, drive = in_loop(data, references)
    records = PreparedRecords(data, how.free_start)
    outside = records if drive is None else PreparedRecords(drive, how.free_start)
    chosen = isinstance(guess, LDTP)
    direct = _is_direct(guess)
    if how.innovations and not chosen:
        direct = answers_at_once(records, outside)
    fit = _fit_to_series(records, guess, how, direct)
    grid = records.whole()
    answers: list[Finding] = []
    if drive is None:
        fit, answers = _without_feedback(records, guess, how, fit, grid)
    error = cast(Predictor, fit.predictor).errors(grid, how.free_start)
    doubts: list[Finding] = []
    if how.check and not residuals.is_exact(grid, error).all():
        doubts = _doubts(records, outside, how, fit, grid, error)
    if doubts:
        fit = dataclasses.replace(fit, findings=_about_point(fit))
    return _with_findings(fit, [*doubts, *answers])


def _without_feedback(
    records: PreparedRecords, guess: Guess, how: _How, fit: LDTPFit, grid: CycleGrid
) -> tuple[LDTPFit, list[Finding]]:
    """Return the fit, with D = 0 if a controller seems to make the inputs, and the finding."""
    error = cast(Predictor, fit.predictor).errors(grid, how.free_start)
    fitted = how.innovations and fit._coordinates.direct
    chosen = isinstance(guess, LDTP)
    remedy = residuals.FOR_WHITE_NOISE
    if how.innovations:
        remedy = residuals.FOR_GIVEN_D if fitted and chosen else residuals.FOR_ZERO_D
    answers = residuals.about_answers(grid, error, records.inputs, remedy)
    if answers and fitted and not chosen:
        fit = _fit_to_series(records, guess, how, False)
    elif not answers and fitted and fit.determines_direct:
        answers = [residuals.UNSEEN]
    return fit, answers


def _doubts(
    records: PreparedRecords,
    outside: PreparedRecords,
    how: _How,
    fit: LDTPFit,
    grid: CycleGrid,
    error: Float[np.ndarray, "S T N ny"],
) -> list[Finding]:
    """Return the most important finding about drift, about distortion, and about residuals that
    depend on inputs."""

    def drifting() -> RoughFit:  # (from the fit on: half of the steps)
        begun = PreparedRecords(with_drift(records.records))
        model = fit._coordinates.model.times(fit._scale / begun.scale)
        unchecked = how._replace(check=False)
        slow = _fit_to_series(begun, model, unchecked, fit._coordinates.direct)
        covariance = Covariance(slow.covariance, slow.covariance_dof)
        return slow.coefficients, lambda: covariance

    unknown = undetermined(fit)
    if unknown:
        return unknown
    if contradicted_by(fit, [drifting], OF_DRIFT) is not None:
        return [MAY_DRIFT]
    # (Distortion is correlated in time, as process noise is, which would be named in its place. A
    # fit of innovations calls it colored noise.)
    if not how.innovations:
        predicted = np.where(grid.sampled, grid.y - error, 0.0)
        c = fit.coefficients
        if residuals.is_distorted(grid, error, predicted, c):
            return [residuals.DISTORTED]
    # (References never respond to outputs.)
    direct = fit._coordinates.direct or outside is not records
    return residuals.about_misfit(outside.whole(), grid, error, how.innovations, direct)


def _likelier(records: PreparedRecords, guess: Guess, how: _How) -> LDTPFit:
    """Return a fit with D = 0 if data that determine D do not contradict it; else one with D."""
    fit = _fit_to_series(records, guess, how, True)
    if not fit.determines_direct:
        return fit
    model = fit._coordinates.model
    without = model._replace(D=[0.0 * D for D in model.D])
    samples = records.sampled.mean(axis=1)
    for start in (guess, without):  # (may differ in minima)
        zero = _fit_to_series(records, start, how, False)
        rise = samples @ (_error_sizes(zero) - _error_sizes(fit))
        # (At 5 %: a D that is not needed enlarges errors a little, but a missing D is a bias.)
        p = _probability(float(rise), fit.unknowns - zero.unknowns)
        if zero.result == Result.OK and p > 0.05:
            return zero
    return fit


def _error_sizes(fit: LDTPFit) -> Float[np.ndarray, " N"]:
    """Return the log determinants of the errors' covariances."""
    return np.linalg.slogdet(cast(Predictor, fit.predictor).S)[1]


def _probability(rise: float, unknowns: int) -> float:
    """Return the probability that unknowns whose true values are zero lower the cost by as much."""
    return float(special.gammaincc(unknowns / 2, max(rise, 0.0) / 2))


def _fit_to_series(
    records: PreparedRecords,
    guess: Guess | PeriodicModel,
    how: _How,
    direct: bool | None,
) -> LDTPFit:
    """Return a fit with D, or with D = 0. If this is not decided (None): with D = 0 unless the data
    contradict it."""
    if direct is None:
        return _likelier(records, cast(Guess, guess), how)
    if records.lead:
        raise DefinitionError(
            f"the outputs of the records depend on inputs up to {records.lead} samples later "
            "(`lead`), those of an LDTP on earlier ones only: use `fit_series`."
        )
    model = _first_model(records, guess, how, direct)
    problem = _series_problem(records, how)
    dof = _freedom_of(records, problem, model, direct)
    if not np.isfinite(problem.cost(model)):
        raise DefinitionError(
            "the responses of `initial` are infinite: give a stable model."
        )
    start = ModelPoint(problem.reweighted(model), model, direct)
    point, converged = descend(start)
    if how.check and not how.innovations:
        _require_answer(point)
    fit = _finished(point, converged, records, records.scale, dof)
    if not how.check:
        return fit

    def smaller(dims: Sequence[int]) -> PeriodicModel:
        return subspace_model(records, dims, how.innovations, direct)

    return _with_findings(fit, _surplus(fit, point, smaller))


def _first_model(
    records: PreparedRecords, guess: Guess | PeriodicModel, how: _How, direct: bool
) -> PeriodicModel:
    """Return the model from which the descent starts."""
    if isinstance(guess, PeriodicModel):
        return guess
    if isinstance(guess, LDTP):
        require_same("initial model and data", guess, records)
        errors = len(records.outputs) if how.innovations else 0
        return PeriodicModel.of(guess, records.scale, errors)
    dims = given_dims(guess, records.n_sections, "dims") or []
    return subspace_model(records, dims, how.innovations, direct)


def _series_problem(records: PreparedRecords, how: _How) -> SeriesProblem:
    parts = [SeriesPart.of(grid, records.scale) for grid in records.grids]
    drift = sum(round(float((part.drift**2).sum())) for part in parts)
    numbers = int(records.sampled.sum()) - drift
    unit = np.eye(len(records.outputs))
    S = np.tile(unit, (records.n_sections, 1, 1))
    return SeriesProblem(
        parts=parts,
        S=S,
        by_section=how.innovations,
        free_start=how.free_start,
        residuals=numbers,
    )


def _freedom_of(
    records: PreparedRecords,
    problem: SeriesProblem,
    model: PeriodicModel,
    direct: bool,
) -> int:
    """Return the degrees of freedom of the residuals.

    **Raises:** `DefinitionError` for too few numbers.
    """
    numbers = problem.residuals
    unknowns = local_coordinates(model, direct).size
    starts = 0
    if problem.free_start:
        first = np.concatenate([part.first for part in problem.parts])
        starts = int(np.array(model.dims)[first].sum())
    if 3 * starts > numbers:  # errors would be smaller, and regions with them
        raise DefinitionError(
            f"{starts} coordinates of the states at the start of {len(records.records)} records "
            f"are to be found from {numbers} numbers: leave out records shorter than a cycle."
        )
    dof = numbers - unknowns - starts
    fewest = records.sampled.min()
    N, ny = records.sampled.shape
    if dof < 1 or fewest <= ny + unknowns / (N * ny):
        raise DefinitionError(
            f"the series hold {numbers} numbers, {fewest} samples of an output at one of "
            f"the sections, too few for {unknowns} unknowns: record more, or fit fewer dimensions."
        )
    return dof


def _require_answer(point: ModelPoint) -> None:
    """**Raises:** `DefinitionError` if the inputs explain no more of the outputs than the same
    number of unknowns explains of noise."""
    matrices_of_inputs = (point.model.B, point.model.D)
    B, D = ([0.0 * x for x in matrices] for matrices in matrices_of_inputs)
    explained = point.problem.cost(point.model._replace(B=B, D=D)) - point.cost
    if explained < _ANSWERED * point.coordinates.size:
        raise DefinitionError(
            "the outputs do not answer the inputs: they show nothing but noise. Look for inputs "
            "that were not applied or not recorded with these outputs, or pass check=False."
        )


def _surplus(
    fit: LDTPFit, point: ModelPoint, smaller: Callable[[Sequence[int]], PeriodicModel]
) -> list[Finding]:
    """Return a finding if a model with one dimension less at each section is nearly as good, or if
    the data do not determine the multipliers.

    **Arguments:** `smaller`: a first model with these dimensions.
    """
    unknown = undetermined(fit)
    dims = [d - 1 for d in point.model.dims]
    if unknown or min(dims) < 1:
        return unknown
    with suppress(DefinitionError):
        start = ModelPoint(point.problem, smaller(dims), point.direct)
        # (Ten steps lead near the minimum.)
        fewer, _ = descend(start, max_steps=10)
        unit = 1.0 if np.isinf(fit.covariance_dof) else point.cost / fit.dof
        rise = (point.problem.cost(fewer.model) - point.cost) / unit
        lost = point.coordinates.size - fewer.coordinates.size
        if _probability(rise, lost) > residuals.ANSWER:
            text = (
                "one dimension less explains the data, so a multiplier may be spurious."
            )
            return [Finding("order", text)]
    return []


def _with_findings(fit: LDTPFit, more: Sequence[Finding]) -> LDTPFit:
    return dataclasses.replace(fit, findings=(*fit.findings, *more))


def _about_point(fit: LDTPFit) -> tuple[Finding, ...]:
    """Return the findings that follow from the end of the descent alone."""
    findings = not_converged(fit.result)
    alike = weights.are_alike(fit.correlation or 0.0, fit.dof)
    if fit.cost > 2 * fit.dof or alike:
        text = (
            "errors are larger than their variances, or alike at neighboring frequencies: too few "
            "dimensions, or a local minimum that another `initial` model avoids."
        )
        findings.append(Finding("misfit", text))
    if not fit.determines_direct:
        text = "the data do not determine D: excite more lines."
        findings.append(Finding("undetermined", text))
    return tuple(findings)


def _is_direct(guess: Guess | None) -> bool:
    """Return whether outputs may depend on the input at their own section."""
    return not isinstance(guess, LDTP) or bool(np.asarray(guess.D).any())


def _finished(
    point: ModelPoint,
    converged: bool,
    data: HTF | PreparedRecords,
    scale: Float[np.ndarray, " ny"],
    dof: int,
) -> LDTPFit:
    """Return the fit at a minimum, with the outputs in their own units. `scale`: units of the
    outputs in the problem."""
    model = point.coordinates.model
    unit = point.cost / dof
    known = False
    noise = None
    correlation = None
    harmonics = all_harmonics(data.n_sections)
    if isinstance(data, HTF):
        known = data.variance is not None
        harmonics = data.harmonics
        problem = cast(FrequencyProblem, point.problem)
        if known:
            _, deviation = weights.estimated_noise(weights.largest_misfit(data), unit)
            unit = deviation**2
        correlation = weights.neighbor_correlation(
            problem.errors(model),
            problem.weight * problem.target,
            np.asarray(data.frequencies),
        )
    else:
        S = cast(SeriesProblem, point.problem).S
        noise = prediction.noise_model(model, S, scale, data.outputs)
    c, slopes = characteristic_slopes(point.coordinates)
    spread = point.equations.spread(unit)
    fit = LDTPFit(
        model=model.to_ldtp(scale, data.inputs, data.outputs),
        multipliers=multipliers_of(c),
        coefficients=c,
        covariance=spread.covariance(slopes),
        covariance_dof=np.inf if known else float(dof),
        cost=point.cost if known else float(dof),
        dof=float(dof),
        correlation=correlation,
        result=int(Result.OK if converged else Result.NOT_CONVERGED),
        harmonics=harmonics,
        noise_model=noise,
        _coordinates=point.coordinates,
        _spread=spread,
        _scale=scale,
    )
    return dataclasses.replace(fit, findings=_about_point(fit))
