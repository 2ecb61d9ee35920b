"""Multipliers and transfer functions from recorded series with any input: output error."""

from typing import Literal

import numpy as np
from jaxtyping import Float

from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Index, Order, StepCount
from ..._core.execution import one_blas_thread
from ..._core.precision import require_x64
from ..._core.results import Result
from ...errors import DefinitionError
from ...experiments.record import RecordedData
from ...linear.ldtp import LDTP
from ..descent import Coefficients, least_squares
from ..multipliers.covariance import Covariance, correlated_cycles, sandwich
from ..multipliers.denominator import Denominator, multipliers_of
from .arx import delayed_outputs, refuse_order, total_least_squares
from .gradient_covariance import gradient_covariance
from .linearization import Linearization, linearize
from .nonlinear.second_order import allow_for_second_order
from .nonlinear.shared_state_fit import HORIZON
from .output_error import OutputErrorProblem, Part
from .parts import Parts
from .robust import (
    Loss,
    efficiency,
    misfit,
    reweight,
    rms_of,
    weigh_outputs,
    without_outliers,
)
from .series_fit import SeriesFit


# Outputs of pure noise, from which the noise in the Jacobian is estimated. Doubled: its share of a
# covariance scatters 0.7 times as much.
_PROBES = 4
# How often weights are found anew, at most, and the change of c, relative to 1 + |c|, that is the
# last. Doubled: slow iterations come to their end; minima of robust losses are missed by twice as
# much.
_MAX_REWEIGHTINGS, _SETTLED = 50, 1e-6
# Smallest noise of an output in the units of the moment: rounding. Doubled: outputs without noise
# count half as much beside noisy ones.
_ROUNDING = 1e-15


@checked
@one_blas_thread()
def fit_series(
    data: RecordedData,
    order: Order | LDTP,
    *,
    overhang: Index | None = None,
    start: Literal["free", "cycle"] = "free",
    loss: Loss = "squares",
    errors: Literal["residuals", "white"] = "residuals",
    distortion: bool | None = None,
    check: bool = True,
    max_steps: StepCount = 50,
) -> SeriesFit:
    r"""Multipliers, HTFs and their uncertainty from series with any input.

    Output error, with white noise of unknown variance in each output: the sum of squares of the
    difference between measured and simulated outputs is minimized over all numerators, unknown
    starts and c; all but c is solved for inside (variable projection, Golub and Pereyra 1973). It
    starts from the periodic ARX problem, solved by total least squares (Ljung, *System
    Identification: Theory for the User*, treats both). Where `distortion` is allowed for, c comes
    from the form in which all sections share one state.

    **Arguments:**

    - `data`: a `Record`, which may have gaps and any length, `ExperimentData` (all cycles are used,
      not only its window; failed experiments are left out), `SectionData`, or several of them.
      `StoredExperiments` are read part by part, some thirty times over.
    - `order`: d, the number of non-zero multipliers, or an `LDTP` model to take its rank from.
    - `overhang`: lags of the numerators beyond d N; None means N.
    - `start`: "free": whatever happened before a record, the state at its start is unknown.
      "cycle": it starts on the limit cycle, with no input before.
    - `loss`: what is minimized of the errors. "squares", the most accurate for normal ones; "huber"
      or "student" where some samples are far off: squares up to 1.345 standard deviations and
      linear beyond, or the likelihood of Student's distribution with 4 degrees of freedom
      (iteratively reweighted, standard deviations from the median). `noise` is then that of the
      normal errors with which squares would be as accurate.
    - `errors`: what the covariance is computed from. "residuals": from the misfit of blocks of
      successive cycles, so that it holds also where their errors depend on each other (process
      noise) and on the inputs (distortion). "white": from its size alone.
    - `distortion`: whether to allow for a part of the response of second order, with squares only;
      None: if that explains more than half of the misfit, and lowers the standard errors by 10 % or
      more. Data that are read part by part have no such part.
    - `check`: refuse an order that the data do not carry, as `fit_multipliers` does.
    - `max_steps`: of Gauss and Newton's iteration.

    **Raises:** `DefinitionError` for records that do not fit together, inputs that are zero, too
    few cycles (the message says how many are needed), or an order that the data do not carry.
    """
    require_x64()
    free_start = start == "free"
    order = order.rank() if isinstance(order, LDTP) else order
    parts = Parts(data)
    N = parts.n_sections
    overhang = N if overhang is None else overhang
    if distortion and loss != "squares":
        raise DefinitionError(f"distortion is allowed for with the loss 'squares', not {loss!r}.")
    if distortion and not parts.in_memory:
        raise DefinitionError("distortion is allowed for only where `data` are in memory.")
    problem = OutputErrorProblem.from_data(parts, order, overhang, free_start)
    usual = problem if loss == "squares" else without_outliers(problem)
    delayed = delayed_outputs(usual, order)
    if loss != "squares":
        problem = weigh_outputs(problem)
    c, found, _ = _minimize(problem, total_least_squares(delayed), max_steps)
    _require_freedom(found, order, problem)
    if loss == "squares":
        noise = _noise(found, order)
        problem = problem.rescale(noise)  # the weights that the misfit suggests
        c, found, converged = _minimize(problem, c, max_steps, found.rescale(noise))
        noise = _noise(found, order)
    else:
        problem, c, found, converged = _reweighted(problem, c, found, loss, max_steps)
        noise = rms_of(usual, misfit(problem, found))
    if check:
        refuse_order(delayed.rescale(noise * problem.scale / usual.scale))
    best = Denominator(c, _covariance(problem, found, errors, loss), converged)
    second = None
    if distortion is not False and loss == "squares" and parts.in_memory:
        first = assemble(problem, found, best)
        second = allow_for_second_order(
            parts.whole(),
            first.impulse_response((1 + HORIZON + order + -(-overhang // N)) * N),
            order,
            overhang,
            _section_noise(found) * problem.scale,
            free_start=free_start,
            errors=errors,
            always=distortion is True,
            max_steps=max_steps,
        )
    if second is not None:
        best, found = second, linearize(problem, second.coefficients)
    return assemble(problem, found, best, distortion=second is not None, loss=loss)


def assemble(
    problem: OutputErrorProblem,
    found: Linearization,
    denominator: Denominator,
    distortion: bool = False,
    loss: Loss = "squares",
) -> SeriesFit:
    """The fit with this denominator, in the units of the data; `found`: the problem there."""
    N, nu, ny = problem.shape
    c = denominator.coefficients

    def by_input(b):  # (..., R nu, ny) -> (..., R, ny, nu), in the units of the outputs
        b = b.reshape(*b.shape[:-2], problem.lags, nu, ny) * problem.scale
        return np.swapaxes(b, -1, -2)

    noise = _noise(found, len(c))
    if loss != "squares":
        noise = efficiency(problem, found, loss).noise
    widest = max(root.shape[1] for row in found.roots for root in row)
    roots = np.zeros((N, ny, problem.lags * nu, widest))
    for n, row in enumerate(found.roots):
        for i, root in enumerate(row):
            roots[n, i, :, : root.shape[1]] = root
    return SeriesFit(
        multipliers=multipliers_of(c),
        coefficients=c,
        covariance=denominator.covariance.matrix,
        numerators=by_input(found.numerators),
        slopes=by_input(found.slope),
        roots=roots.reshape(N, ny, problem.lags, nu, widest),
        noise=noise * problem.scale,
        covariance_freedom=denominator.covariance.freedom,
        result=Result.OK if denominator.converged else Result.NOT_CONVERGED,
        n_sections=N,
        inputs=problem.data.inputs,
        outputs=problem.data.outputs,
        lead=problem.lead,
        distortion=distortion,
    )


def _minimize(
    problem: OutputErrorProblem,
    start: Coefficients,
    max_steps: int,
    found: Linearization | None = None,
) -> tuple[Coefficients, Linearization, bool]:
    """`found`: the linearization at the start, where that is known."""
    last = [start, found]

    def at(c):
        if c is not last[0] or last[1] is None:
            last[:] = c, linearize(problem, c)
        return last[1]

    def normal(c):
        return at(c).as_residuals()

    c, converged = least_squares(normal, start, max_steps)
    return c, at(c), converged


def _reweighted(
    problem: OutputErrorProblem, c: Coefficients, found: Linearization, loss: Loss, max_steps: int
) -> tuple[OutputErrorProblem, Coefficients, Linearization, bool]:
    """The minimum of a robust loss, that of Huber first, which has no other ones."""
    converged = False
    for kind in dict.fromkeys(("huber", loss)):
        for _ in range(_MAX_REWEIGHTINGS):
            before = c
            problem = reweight(problem, found, kind)
            c, found, converged = _minimize(problem, c, max_steps)
            settled = np.abs(c - before).max() <= _SETTLED * (1 + np.abs(c).max())
            if settled:
                break
        converged = converged and bool(settled)
    return problem, c, found, converged


def _noise(found: Linearization, order: int) -> Float[np.ndarray, " ny"]:
    """Standard deviation of each output's noise, in its units of the moment."""
    left = found.freedom.sum(axis=0) - order / found.freedom.shape[1]
    return np.maximum(np.sqrt(found.square.sum(axis=0) / left), _ROUNDING)


def _section_noise(found: Linearization) -> Float[np.ndarray, "N ny"]:
    return np.sqrt(found.square / np.maximum(found.freedom, 1))


def _covariance(
    problem: OutputErrorProblem, found: Linearization, errors: str, loss: Loss
) -> Covariance:
    """Of c, by blocks of cycles, which may depend on their neighbors."""
    price = efficiency(problem, found, loss)

    def probes(k: int, part: Part, n: int):
        sampled = part.weight[:, :, n, :, None] > 0
        draws = np.random.default_rng((k, n)).standard_normal((*sampled.shape[:3], _PROBES))
        return draws * sampled * price.noise[:, None]

    noise = linearize(problem, found.c, probes).curvature / _PROBES
    curvature = np.einsum("aij,a->ij", found.curvature - noise, price.curvature)
    by_output = found.curvature
    if errors == "white" or not np.linalg.eigvalsh(by_output.sum(axis=0))[0] > 0:
        return sandwich(curvature, np.einsum("aij,a->ij", by_output, price.variance))
    lags = correlated_cycles(multipliers_of(found.c), problem.cycles)
    gradient = gradient_covariance(problem, found, lags + 1)
    return sandwich(curvature, gradient.matrix)._replace(freedom=gradient.freedom)


def _require_freedom(found: Linearization, order: int, problem: OutputErrorProblem) -> None:
    if (found.freedom > order).all():
        return
    n, i = np.argwhere(found.freedom <= order)[0]
    sampled = sum(int((part.weight[:, :, n, i] > 0).sum()) for part in problem.parts())
    missing = order + 1 - int(found.freedom[n, i])
    raise DefinitionError(
        f"section {n} was sampled {sampled} times, too few for numerators of {problem.lags} lags "
        f"and {problem.free} unknown cycles at the start of each record: {missing} or more cycles "
        "are missing. Record more, or lower `order` or `overhang`."
    )
