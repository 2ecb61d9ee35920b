"""The design that answers a question in the fewest strides."""

import dataclasses
from collections.abc import Callable
from typing import Literal

import numpy as np
from jaxtyping import Float

from .._core.boundary.checked import checked
from .._core.boundary.kinds import ExperimentCount, Positive, Seed, StepCount
from .._core.progress import working
from ..errors import DefinitionError
from ..experiments.design.design import Design
from ..experiments.design.multisine import multisine
from .allocation import allocate
from .candidates import Candidates
from .goals import Goal, Multipliers
from .grouping import to_design, worthwhile
from .limits import Limit, make_limits
from .noise import NoiseLike, make_noise
from .optimal_design import OptimalDesign
from .questions.measured import Model
from .questions.question_of import question_of


# Cosines that together tell less than such a part of all are left out, the largest part of these
# with which the criterion grows by less than the factor. Doubled: fewer weak lines, whose answers
# distortion hides.
_NEGLIGIBLE = (2e-3, 1e-4, 0.0)
_AS_GOOD = 1.01


@checked
@working("optimal_design")
def optimal_design(
    model: Model,
    design: Design | None = None,
    *,
    goal: Literal["multipliers"] | Goal = "multipliers",
    limit: Limit = "input",
    noise: NoiseLike | None = None,
    largest: Positive | Callable[[np.ndarray], np.ndarray] | None = None,
    experiments: ExperimentCount | None = None,
    seed: Seed = 0,
    max_steps: StepCount = 300,
) -> OptimalDesign:
    r"""The amplitudes that answer a question in the fewest strides, and proof that they do.

    ```python
    plan = hj.optimal_design(model)               # multipliers, the input's power limited
    plan = hj.optimal_design(model, limit={"yM": 0.01, "vM": 0.05})     # or the way from the cycle
    data = hj.run_experiments(cycle, sections, plan.design, outputs)
    ```

    The variance of the goal is the Cramer-Rao bound with white noise. It is a convex function of
    the cosines' powers, and the result's `certificate` says how far from the optimum they are.
    Strong cosines stand in several experiments, weak ones in one: for variances that are estimated
    run `plan.design.realizations(4)`, or two windows.

    **Arguments:**

    - `model`: what is known of the system, exact or estimated: a `StructuredFit` also does. Its
      deviations are then those of the harmonics that were fitted.
    - `design`: what one would do otherwise. Its lines, inputs, periods and experiments are those of
      the result; by default `multisine` with all lines. Lines that are not in it are forbidden.
    - `goal`: `"multipliers"`, or a `hj.designs.Multipliers` or `hj.designs.Parameters`.
    - `limit`: rms values by name, of inputs or of outputs (their deviation from the cycle), over
      all experiments: `{"u": 0.01}`. Or what may be no larger than in `design`: `"input"` or
      `"output"`, of each.
    - `noise`: of each output that is measured, by name: the standard deviation of white noise, or
      a function that gives it by the frequency of the output (0 to N/2 cycles per period), the root
      of a spectrum. By default all are measured, with white noise 20 dB below their rms deviation
      in `design` within the limits.
    - `largest`: amplitude that no cosine may exceed; a number, or a function of an array of f. Zero
      forbids a frequency.
    - `experiments`: their number, by default that of `design`. `seed` of phases and division.
    - `max_steps` of the iteration.

    **Raises:** `DefinitionError` for limits that nothing satisfies, goals that the data cannot see,
    multipliers that are not simple, and arguments that do not fit together.
    """
    usual = _usual(model) if design is None else design
    if usual.n_sections != model.n_sections or len(usual.input_names) != len(model.inputs):
        raise DefinitionError(
            f"the design has {usual.n_sections} sections and {len(usual.input_names)} inputs, the "
            f"model {model.n_sections} and {len(model.inputs)}."
        )
    cosines = Candidates.of(usual)
    usual_power = cosines.power_of(usual)
    squares = _squares(model, cosines)
    count = usual.experiments if experiments is None else experiments
    most = _largest(largest, cosines, count)
    limits = make_limits(limit, squares, model.inputs, usual_power, most)
    if count > len(cosines.f):
        raise DefinitionError(
            f"{count} experiments are more than the {len(cosines.f)} cosines that there are."
        )

    # The usual proportions, as large as the limits allow.
    factor = 1 / limits.use(usual_power).max()
    usual_power = usual_power * factor
    usual = dataclasses.replace(usual, amplitude=usual.amplitude * np.sqrt(factor))
    usual_rms = _rms(squares, usual_power)
    goal = Multipliers() if isinstance(goal, str) else goal
    errors = make_noise(model.outputs, model.n_sections, noise, usual_rms)
    question = question_of(goal, model, cosines, errors, usual_power)

    before = question.answer(usual_power)
    allowed = np.flatnonzero(most > 0)
    ideal = allocate(question.only(allowed), limits.only(allowed), usual_power[allowed], max_steps)
    for negligible in _NEGLIGIBLE:
        gain = ideal.power * ideal.answer.sensitivity
        kept = allowed[worthwhile(cosines.only(allowed), gain, count, negligible)]
        start = ideal.power[np.searchsorted(allowed, kept)]
        best = allocate(question.only(kept), limits.only(kept), start, max_steps)
        worse = best.answer.criterion / ideal.answer.criterion
        if worse < _AS_GOOD:
            break
    shorter = usual.experiments / count
    power, relative = np.zeros_like(usual_power), np.zeros_like(usual_power)
    power[kept], relative[allowed] = best.power, ideal.certificate.relative
    return OptimalDesign(
        design=to_design(cosines, power, power * limits.cost.mean(axis=0), count, usual, seed),
        usual=usual,
        names=question.names,
        variances=best.answer.variances * shorter,
        usual_variances=before.variances,
        criterion=best.answer.criterion * shorter,
        usual_criterion=before.criterion,
        certificate=ideal.certificate.excess * worse,
        frequencies=cosines.f,
        channels=cosines.channel,
        power=power,
        usual_power=usual_power,
        sensitivity=relative,
        limited=limits.names,
        rms=_rms(squares, power),
        usual_rms=usual_rms,
    )


def _usual(model: Model) -> Design:
    """All lines of the usual band, with the same amplitude."""
    return multisine(model.n_sections, inputs=model.inputs)


def _squares(model: Model, cosines: Candidates) -> dict[str, Float[np.ndarray, " K"]]:
    """Mean square of each signal per unit of each cosine's power, by name."""
    H = np.asarray(model.htf(cosines.f).H)
    answers = (np.abs(H) ** 2).sum(axis=0)[np.arange(len(cosines.f)), :, cosines.channel].T
    inputs = [(cosines.channel == i).astype(float) for i in range(len(model.inputs))]
    return dict(zip((*model.inputs, *model.outputs), (*inputs, *answers), strict=True))


def _rms(
    squares: dict[str, Float[np.ndarray, " K"]], power: Float[np.ndarray, " K"]
) -> dict[str, float]:
    return {name: float(np.sqrt(square @ power)) for name, square in squares.items()}


def _largest(
    largest: float | Callable[[np.ndarray], np.ndarray] | None, cosines: Candidates, count: int
) -> Float[np.ndarray, " K"]:
    """The largest mean square of each cosine, if it stands in one experiment only."""
    if largest is None:
        return np.full(len(cosines.f), np.inf)
    given = np.asarray(largest(cosines.f) if callable(largest) else largest)
    if given.dtype.kind not in "fiu" or given.shape not in ((), cosines.f.shape):
        raise DefinitionError("`largest` must give a real number for each frequency.")
    amplitude = np.broadcast_to(given, cosines.f.shape)
    if not (amplitude >= 0).all():
        raise DefinitionError("`largest` must give amplitudes that are not negative.")
    return amplitude**2 / (2 * count)
