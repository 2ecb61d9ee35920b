"""Maximum likelihood for the matrices of a linear periodic model."""

import dataclasses
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Annotated, Any, Literal, cast

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy import special

from ..._core.arguments import Numbers, require_same
from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Order, Scalar, SignalNames, Vector
from ..._core.boundary.values import Integers
from ..._core.precision import require_x64
from ..._core.results import Result
from ..._core.text import signal_values
from ...errors import DefinitionError, FindingWarning
from ...experiments.record import RecordedData
from ...linear.frequency_response import Harmonics, all_harmonics, check_harmonics
from ...linear.htf import HTF
from ...linear.ldtp import LDTP
from .. import weights
from ..denominator import Covariance, multipliers_of
from ..descent import FIRST_DAMPING, Spread, descend
from ..instrument import in_loop
from ..multiplier_estimate import MultiplierEstimate, RoughFit
from ..multipliers import exact_htf
from ..periodic import (
    LocalCoordinates,
    PeriodicModel,
    characteristic_slopes,
    local_coordinates,
)
from ..series import prediction, residuals
from ..series.prediction import Predictor, SeriesPart, SeriesProblem
from ..series.records import MAY_DRIFT, CycleGrid, PreparedRecords, with_drift
from ..series.subspace import answers_at_once, default_horizon, subspace_model
from .frequency import FrequencyProblem, ModelPoint, transfer, transfer_slopes
from .realization import given_dims, realize


Guess = LDTP | Order | Annotated[Numbers, Integers("sections", sign="positive")]

# Least decrease of the cost by the inputs, for each unknown, in units of the errors' variance (1 if
# errors are white and nothing answers). Smaller: multipliers of noise that is filtered by the
# system, which looks like a response. Larger: weak responses are refused.
_ANSWERED = 5.0


class LDTPFit(MultiplierEstimate):
    r"""A linear periodic model that maximizes the likelihood, and its uncertainty.

    **Fields:**

    - `model`: the fitted `LDTP`. The coordinates of its states are arbitrary; multipliers and HTFs
      do not depend on them, and have standard errors.
    - `multipliers` (d,): by decreasing modulus, d the smallest dimension of any x[n].
      `coefficients` (d,): of their polynomial.
    - `covariance` (d, d): covariance of the coefficients, with `covariance_freedom` degrees of
      freedom (infinite if variances were given). `standard_errors`, `contains` and `ellipse` follow
      from it. Infinite if the data do not determine all coefficients.
    - `unknowns`: number of unknowns, without the choice of coordinates.
    - `cost`: sum of squares of the residuals in units of the errors' standard deviations, and
      `freedom`, its expectation. A larger cost means too few dimensions, or a local minimum.
      Without variances, as always for time series, the unit follows from the residuals, and the two
      are equal: see `correlation`, and use `hj.validate`.
    - `correlation`: of the residuals of HTFs at neighboring frequencies; about 0 for enough
      dimensions. None for time series.
    - `result`: code of `Result`, OK or NOT_CONVERGED.
    - `harmonics` (M,): harmonics that were fitted; for time series, all N.
    - `noise`: an `LDTP` whose response to independent white inputs of variance one is the noise of
      the outputs; None for HTFs.
    - `feedback`: a sentence about inputs of time series that a controller makes, or may make; empty
      if nothing speaks for a controller, or a `reference` was given.
    - `doubt`: a sentence if drift of the outputs of time series (in the first 1000 cycles) gives
      multipliers outside of each other's confidence regions, or if residuals depend on the inputs:
      the dimensions are too few, or the iteration found a local minimum. Otherwise empty.
    """

    model: LDTP
    cost: float = eqx.field(static=True)
    freedom: int = eqx.field(static=True)
    correlation: float | None = eqx.field(static=True)
    result: int = eqx.field(static=True)
    harmonics: tuple[int, ...] = eqx.field(static=True)
    noise: LDTP | None
    _coordinates: LocalCoordinates
    _spread: Spread
    _scale: Float[np.ndarray, " ny"]
    feedback: str = eqx.field(static=True, default="")
    doubt: str = eqx.field(static=True, default="")

    @property
    def unknowns(self) -> int:
        return self._coordinates.size

    n_sections = property(lambda self: self.model.n_sections)
    inputs = property(lambda self: self.model.inputs)
    outputs = property(lambda self: self.model.outputs)

    @checked
    def htf(self, f: Scalar | Vector, harmonics: Harmonics | None = None) -> HTF:
        """Return the HTFs of the fitted model at frequencies f (F,), in cycles per period.

        The variance is that of the fit, to first order. It is infinite for combinations that the
        data do not determine, e.g. at harmonics that were not fitted.

        **Arguments:** `harmonics`: Default: those that were fitted.
        """
        f = np.atleast_1d(np.asarray(f, float))
        N = self.n_sections
        harmonics = (
            self.harmonics if harmonics is None else check_harmonics(harmonics, N)
        )
        H = transfer(self._coordinates.model, f, harmonics)
        variance = np.zeros(H.shape)
        for rows, slopes in transfer_slopes(self._coordinates, f, harmonics):
            variance[:, rows] = self._spread.variance(slopes)
        size = self._scale[:, None]
        return HTF(
            f,
            H * size,
            harmonics,
            N,
            self.inputs,
            self.outputs,
            "fit",
            variance=variance * size**2,
        )

    @checked
    def noise_spectrum(
        self, f: Scalar | Vector, harmonics: Harmonics | None = None
    ) -> Float[np.ndarray, "M F ny"]:
        """Return the spectrum of the fitted noise at the harmonics of frequencies f (F,).

        White noise with the standard deviation sigma has the spectrum sigma^2 for all f and m. The
        variance of an H_m that is measured with a cosine of amplitude a in P periods is
        4 S(f + m) / (N P a^2): that of `Design.expected_variance(noise=1)` times the spectrum.

        **Arguments:** `harmonics`: Default: all N.

        **Returns:** (M, F, ny), the squared unit of each output.

        **Raises:** `DefinitionError` if no noise was fitted, or if it grows without bound.
        """
        if self.noise is None:
            raise DefinitionError(
                "no noise is fitted to HTFs (`HTF.variance`): fit time series."
            )
        return prediction.noise_spectrum(
            self.noise, np.atleast_1d(np.asarray(f, float)), harmonics
        )

    def spread(self, grid: CycleGrid) -> Iterator[Float[np.ndarray, "S T ny r"]]:
        """Iterate over sections: roots of the covariance of the predictions by errors of the fit,
        in units of the noise."""
        part, model = SeriesPart.of(grid, self._scale), self._coordinates.model
        S = cast(Predictor, self.predictor).S / np.outer(self._scale, self._scale)
        path = SeriesProblem([part], S, True, True, 0).path(model, part)
        sizes = np.sqrt(np.diagonal(S, axis1=1, axis2=2))[:, :, None]
        for J, size in zip(
            prediction.slopes_of(self._coordinates, part, path), sizes, strict=True
        ):
            yield J @ self._spread.root / size

    @property
    def predictor(self) -> Predictor | None:
        """The predictor one step ahead that `hj.validate` uses; None if no noise was fitted."""
        if self.noise is None:
            return None
        D = np.asarray(self.noise.D)
        return Predictor(
            self._coordinates.model.times(self._scale), D @ D.swapaxes(1, 2)
        )

    @property
    def determines_direct(self) -> bool:
        """Test whether the data determine D, unless it was taken as zero."""
        coordinates = self._coordinates
        places = [np.r_[x["D"]] for x in coordinates.places if coordinates.direct]
        slopes = np.eye(coordinates.size)[:, np.concatenate([np.r_[:0], *places])]
        return bool(np.isfinite(self._spread.variance(slopes)).all())

    def _about(self) -> str:
        about = f"chi-square {self.cost:.6g} with {self.freedom} degrees of freedom"
        if self.cost > 2 * self.freedom or weights.are_alike(
            self.correlation or 0.0, self.freedom
        ):
            about += (
                " (errors are larger than their variances, or alike at neighboring frequencies: "
                "too few dimensions, or a local minimum that another guess avoids)"
            )
        if self.noise is not None:
            size = np.sqrt((np.asarray(self.noise.D) ** 2).sum(axis=2).mean(axis=0))
            about = f"errors one step ahead {signal_values(self.outputs, size)}"
        about = f"{about}; {self.unknowns} unknowns, {self.n_sections} sections"
        unknown = (
            ""
            if self.determines_direct
            else "the data do not determine D: excite more lines"
        )
        return "; ".join(filter(None, [about, unknown, self.doubt, self.feedback]))


@checked
def fit_ldtp(
    data: HTF | RecordedData,
    guess: Guess,
    *,
    noise: Literal["output", "innovations"] = "output",
    start: Literal["free", "cycle"] = "free",
    check: bool = True,
    reference: SignalNames | None = None,
) -> LDTPFit:
    r"""Fit the matrices A[n], B[n], C[n], D[n] of a periodic model by maximum likelihood.

    For *HTFs* with independent, circular, Gaussian errors of the given variances, the fit minimizes

    $$V(A, B, C, D) = \sum \frac{2}{v}\, | H_m(\omega) - \hat H_m(\omega; A, B, C, D) |^2$$

    over all frequencies, harmonics, outputs and inputs. `fit_multipliers` gives each of the
    transfer functions a numerator of its own; here they follow from fewer unknowns, and the
    standard errors of multipliers are smaller (`hj.identify.ldtp_bound` returns them).

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
    - `guess`: dimensions of the state at each section (or one for all): the fit starts from
      `hj.identify.realize` for HTFs, and from a subspace method for time series. Alternatively, an
      observable initial model with these dimensions; if its D is zero, D stays zero. Too few
      dimensions bias the multipliers: compare `cost` with `freedom` where variances are known;
      for time series, see `doubt`. The iteration finds a local minimum; the same checks reveal a
      poor one.
    - `noise`: model of the noise of time series, see above; "output" for HTFs. Default: "output".
    - `start`: initial state of each record of time series: "free", or zero for "cycle". HTFs have
      none. Default: "free".
    - `check`: whether to raise an error if outputs do not respond to the inputs (not with
      "innovations"), and to test whether one dimension less explains the data as well, whether
      residuals of time series depend on the inputs, and whether drift explains the multipliers;
      `doubt` and a `FindingWarning` then say so. Default: True.
    - `reference`: names of the inputs that enter a control loop from outside. The controller makes
      the other inputs. The plant from these to the outputs is fitted with innovations; it may be
      unstable. The fit is consistent if D is zero at sections where the controller responds without
      delay, which the response of the outputs to the reference shows. If the reference was not
      recorded, pass noise="innovations". Default: None.

    Without a reference, D is fixed to zero in three cases: outputs do not depend on inputs at the
    same section; inputs depend on earlier residuals; or the past determines the inputs (few
    excited frequencies) and a fit with D is not better (at 5 %). Otherwise D is fitted, and
    `feedback` reports that a controller could cause the dependence. If the data do not determine
    D, the printed fit reports this.

    **Raises:** `DefinitionError` if data and guess do not fit together, for NaN in the HTFs,
    variances that are not positive, a guess with an unobservable state, fewer numbers in the data
    than unknowns, outputs that do not respond to the inputs, or records with `lead`.
    """
    require_x64()
    if isinstance(data, HTF):
        if reference is not None or noise == "innovations" or start == "cycle":
            raise DefinitionError(
                "`reference`, `noise` and `start` are for time series: give the data, not HTFs, or "
                "leave these arguments out (and pass `reference` to `estimate_htf`)."
            )
        fit = _fit_to_htf(data, guess, check)
    else:
        drive = None
        if reference is not None:
            data, drive = in_loop(data, reference)
        innovations = noise == "innovations" or drive is not None
        records, direct = PreparedRecords(data, start == "free"), _is_direct(guess)
        outside = records if drive is None else PreparedRecords(drive, start == "free")
        if innovations and not isinstance(guess, LDTP):
            direct = answers_at_once(records, outside)
        how = (innovations, start == "free", check)
        fit = _fit_to_series(records, guess, *how, direct)
        direct = fit._coordinates.direct
        grid = records.whole()
        errors = lambda: cast(Predictor, fit.predictor).errors(grid, start == "free")  # noqa: E731
        unseen = innovations and direct and drive is None and fit.determines_direct
        feedback = residuals.UNSEEN * unseen
        if drive is None and (
            answers := residuals.answering(grid, errors(), records.inputs)
        ):
            if innovations and direct and not isinstance(guess, LDTP):
                fit, direct = _fit_to_series(records, guess, *how, False), False
            remedy = residuals.REMEDIES[innovations + (innovations and not direct)]
            feedback = residuals.about_answering(answers, remedy)

        def drifting() -> RoughFit:  # (from the fit on: half of the steps)
            begun = PreparedRecords(with_drift(records.records))
            model = fit._coordinates.model.times(fit._scale / begun.scale)
            slow = _fit_to_series(begun, model, *how[:2], False, direct)
            return slow.coefficients, lambda: Covariance(
                slow.covariance, slow.covariance_freedom
            )

        doubt = fit.doubt
        if check and not residuals.is_exact(grid, error := errors()).all():
            misfit = residuals.about_misfit(outside.whole(), grid, error, innovations)
            doubt = fit.contradiction([drifting], MAY_DRIFT) or misfit or doubt
        fit = dataclasses.replace(fit, feedback=feedback, doubt=doubt)
    if fit.doubt:
        warnings.warn(f"Fit: {fit.doubt}.", FindingWarning, stacklevel=3)
    return fit


def _fit_to_htf(htf: HTF, guess: Guess, check: bool) -> LDTPFit:
    scale, direct = weights.check_values(htf), _is_direct(guess)
    if not isinstance(guess, LDTP):
        guess = realize(htf, np.array(given_dims(guess, htf.n_sections, "guess")))
    require_same("guess and data", guess, htf)
    problem = FrequencyProblem.of(htf, weights.error_weights(htf, scale), scale)
    model = PeriodicModel.of(guess, scale)
    unknowns = local_coordinates(model, direct).size
    freedom = problem.residuals - unknowns
    if freedom < 1:
        text = f"{problem.residuals} numbers, too few for {unknowns} unknowns"
        raise DefinitionError(
            f"the HTFs hold {text}: give more frequencies, or smaller `guess`."
        )
    if not np.isfinite(problem.cost(model)):
        raise DefinitionError(
            "`guess` has an infinite response at a frequency: give a stable one."
        )
    point, converged = descend(ModelPoint(problem, model, direct), FIRST_DAMPING)
    if htf.variance is None:
        # A second descent, with the outputs weighted by their residuals.
        square = (np.abs(problem.errors(point.model)) ** 2).mean(axis=(0, 1, 3))
        weight = (
            problem.weight
            / np.maximum(np.sqrt(square / 2), weights.SMALLEST_ERROR)[:, None]
        )
        problem = problem._replace(weight=weight)
        point, converged = descend(
            ModelPoint(problem, point.model, direct), FIRST_DAMPING
        )
    if check:
        _require_answer(point)
    fit = _finished(point, converged, htf, scale, freedom)
    smaller = lambda dims: PeriodicModel.of(realize(htf, np.array(dims)), scale)  # noqa: E731
    return dataclasses.replace(
        fit, doubt=_surplus(fit, point, smaller) if check else ""
    )


def _likelier(
    records: PreparedRecords, guess: Guess, how: tuple[bool, bool, bool]
) -> LDTPFit:
    """Return a fit with D = 0 if data that determine D do not contradict it; else one with D."""
    fit = _fit_to_series(records, guess, *how, True)
    model = fit._coordinates.model
    if not fit.determines_direct:
        return fit
    for start in (
        guess,
        model._replace(D=[0.0 * D for D in model.D]),
    ):  # (may differ in minima)
        zero = _fit_to_series(records, start, *how, False)
        sizes = [
            np.linalg.slogdet(cast(Predictor, x.predictor).S)[1] for x in (zero, fit)
        ]
        ratio = max(float(records.sampled.mean(axis=1) @ (sizes[0] - sizes[1])), 0.0)
        # (At 5 %: a D that is fitted in vain enlarges errors a little, a missing one is a bias.)
        degrees = fit.unknowns - zero.unknowns
        if (
            zero.result == Result.OK
            and special.gammaincc(degrees / 2, ratio / 2) > 0.05
        ):
            return zero
    return fit


def _fit_to_series(
    records: PreparedRecords,
    guess: Guess | PeriodicModel,
    innovations: bool,
    free_start: bool,
    check: bool,
    direct: bool | None,
) -> LDTPFit:
    """Return a fit with D, with D = 0, or (None) with D = 0 if the data do not contradict it."""
    if direct is None:
        return _likelier(records, guess, (innovations, free_start, check))
    if records.lead:
        raise DefinitionError(
            f"the outputs of the records depend on inputs up to {records.lead} samples later "
            "(`lead`), those of an LDTP on earlier ones only: use `fit_series`."
        )
    N, ny, scale = records.n_sections, len(records.outputs), records.scale
    parts = [SeriesPart.of(grid, scale) for grid in records.grids]
    first = [n for part in parts for n in part.first.tolist()]
    drift = sum(round(float((part.drift**2).sum())) for part in parts)
    numbers = int(records.sampled.sum()) - drift
    problem = SeriesProblem(
        parts, np.tile(np.eye(ny), (N, 1, 1)), innovations, free_start, numbers
    )
    if isinstance(guess, PeriodicModel):
        model = guess
    elif isinstance(guess, LDTP):
        require_same("guess and data", guess, records)
        model = PeriodicModel.of(guess, scale, ny if innovations else 0)
    else:
        model = subspace_model(
            records, given_dims(guess, N, "guess") or [], innovations, direct
        )
    unknowns = local_coordinates(model, direct).size
    starts = sum(model.dims[n] for n in first) if free_start else 0
    freedom = numbers - unknowns - starts
    if 3 * starts > numbers:  # errors would be smaller, and regions with them
        raise DefinitionError(
            f"{starts} coordinates of the states at the start of {len(first)} records are to be "
            f"found from {numbers} numbers: leave out records shorter than a cycle."
        )
    fewest = records.sampled.min()
    if freedom < 1 or fewest <= ny + unknowns / (N * ny):
        raise DefinitionError(
            f"the series hold {numbers} numbers, {fewest} samples of an output at one of "
            f"the sections, too few for {unknowns} unknowns: record more, or fit fewer dimensions."
        )
    if not np.isfinite(problem.cost(model)):
        raise DefinitionError(
            "the responses of `guess` are infinite: give a stable model."
        )
    point, converged = descend(
        ModelPoint(problem.reweighted(model), model, direct), FIRST_DAMPING
    )
    if check and not innovations:
        _require_answer(point)
    fit = _finished(point, converged, records, scale, freedom)
    smaller = lambda dims: subspace_model(records, dims, innovations, direct)  # noqa: E731
    return dataclasses.replace(
        fit, doubt=_surplus(fit, point, smaller) if check else ""
    )


def _require_answer(point: ModelPoint) -> None:
    """**Raises:** `DefinitionError` if the inputs explain no more than unknowns do of noise."""
    B, D = ([0.0 * x for x in matrices] for matrices in (point.model.B, point.model.D))
    explained = point.problem.cost(point.model._replace(B=B, D=D)) - point.cost
    if explained < _ANSWERED * point.coordinates.size:
        raise DefinitionError(
            "the outputs do not answer the inputs: they show nothing but noise. Look for inputs "
            "that were not applied or not recorded with these outputs, or pass check=False."
        )


def _surplus(
    fit: LDTPFit, point: ModelPoint, smaller: Callable[[Any], PeriodicModel]
) -> str:
    """Return a sentence if a model with one dimension less at each section is nearly as good, or
    the data do not determine the multipliers; else "".

    **Arguments:** `smaller`: a first model with these dimensions.
    """
    dims, unknown = [d - 1 for d in point.model.dims], fit.contradiction([])
    with suppress(DefinitionError):
        if min(dims) > 0 and not unknown:
            start = ModelPoint(point.problem, smaller(dims), point.direct)
            fewer, _ = descend(
                start, FIRST_DAMPING, max_steps=10
            )  # (enough to come near)
            unit = 1.0 if fit.covariance_freedom == np.inf else point.cost / fit.freedom
            rise = max(point.problem.cost(fewer.model) - point.cost, 0.0) / unit
            degrees = point.coordinates.size - fewer.coordinates.size
            if special.gammaincc(degrees / 2, rise / 2) > residuals.ANSWER:
                return "one dimension less explains the data, so a multiplier may be spurious"
    return unknown


def _is_direct(guess: Guess) -> bool:
    """Return whether outputs may depend on the input at their own section."""
    return not isinstance(guess, LDTP) or bool(np.asarray(guess.D).any())


def _finished(
    point: ModelPoint,
    converged: bool,
    data: HTF | PreparedRecords,
    scale: Float[np.ndarray, " ny"],
    freedom: int,
) -> LDTPFit:
    """Return the fit at a minimum, with the outputs in their own units, which are `scale`."""
    model, unit, known = point.coordinates.model, point.cost / freedom, False
    noise = correlation = None
    harmonics = all_harmonics(data.n_sections)
    if isinstance(data, HTF):
        known, harmonics = data.variance is not None, data.harmonics
        problem = cast(FrequencyProblem, point.problem)
        if known:
            unit = weights.estimated_noise(weights.largest_misfit(data), unit)[1] ** 2
        size = problem.weight * problem.target
        correlation = weights.neighbor_correlation(
            problem.errors(model), size, np.asarray(data.f)
        )
    else:
        S = cast(SeriesProblem, point.problem).S
        noise = prediction.noise_model(model, S, scale, data.outputs)
    c, slopes = characteristic_slopes(point.coordinates)
    spread = point.equations.spread(unit)
    return LDTPFit(
        model=model.to_ldtp(scale, data.inputs, data.outputs),
        multipliers=multipliers_of(c),
        coefficients=c,
        covariance=spread.covariance(slopes),
        covariance_freedom=np.inf if known else float(freedom),
        cost=point.cost if known else float(freedom),
        freedom=freedom,
        correlation=correlation,
        result=Result.OK if converged else Result.NOT_CONVERGED,
        harmonics=harmonics,
        noise=noise,
        _coordinates=point.coordinates,
        _spread=spread,
        _scale=scale,
    )


@checked
def ldtp_bound(model: LDTP, htf: HTF) -> MultiplierEstimate:
    r"""Return the Cramer-Rao bound of the multipliers for known dimensions of the states.

    The errors of the HTFs are independent, circular and Gaussian, as for `multiplier_bound`. The
    unknowns are the matrices A[n], B[n], C[n] (and D[n], if the model has any) instead of free
    numerators: this is the bound of `fit_ldtp`. The squared ratio of the standard errors of
    `multiplier_bound` to these is the factor by which the structure reduces the amount of data.

    **Arguments:**

    - `model`: the true model, of which the minimal part counts. `htf`: HTFs with the frequencies,
      harmonics and `variance` of the experiment; H is not used.

    **Returns:** as many multipliers as the smallest state of the minimal model has coordinates.

    **Raises:** `DefinitionError` if the two do not fit together, or `htf` has no variances.
    """
    exact = exact_htf(model, htf)
    minimal = realize(
        np.asarray(model.impulse_response(2 * default_horizon(model.n_sections) + 1))
    )
    scale = weights.check_values(exact)
    problem = FrequencyProblem.of(exact, weights.error_weights(exact, scale), scale)
    direct = bool(np.asarray(model.D).any())
    coordinates = local_coordinates(PeriodicModel.of(minimal, scale), direct)
    c, slopes = characteristic_slopes(coordinates)
    spread = problem.linearize(coordinates).spread()
    return MultiplierEstimate(multipliers_of(c), c, spread.covariance(slopes), np.inf)
