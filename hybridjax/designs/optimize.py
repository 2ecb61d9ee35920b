"""The design that answers a question in the fewest strides."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from .._core.boundary.checked import checked
from .._core.boundary.kinds import ExperimentCount, Positive, Seed, StepCount
from .._core.execution import one_blas_thread
from .._core.progress import working
from .._core.text import listed
from ..errors import DefinitionError
from ..experiments.design.design import Design
from ..experiments.design.multisine import multisine
from .allocation import Allocation, allocate, certify
from .candidates import Candidates
from .goals import Goal, Multipliers
from .grouping import places, to_design, worthwhile
from .limits.distortion import Products, products
from .limits.limits import (
    Largest,
    Limit,
    Limits,
    PowerLimits,
    experiments_within,
    largest_amplitudes,
    peak_of,
    power_limits,
    without_forbidden,
)
from .limits.peaks import below_peaks
from .noise import NoiseLike, make_noise
from .optimal_design import OptimalDesign
from .questions.question import AbstractQuestion
from .questions.question_of import question_of
from .signals import Model, mean_squares, rms_of


# Cosines that together tell less than such a part of all are left out, the largest part of these
# with which the criterion grows by less than the factor. Doubled: fewer weak lines, whose answers
# distortion hides.
_NEGLIGIBLE = (2e-3, 1e-4, 0.0)
_AS_GOOD = 1.01
# Times that the usual design is scaled to the limits, since cosines at their largest amplitude do
# not grow with the others. Doubled: nothing, unless nearly all are at theirs.
_SCALINGS = 10
# Share of a limit from which on it is said to be reached. Lower: limits that do not matter are
# named.
_REACHED = 0.99


@checked
@working("optimal_design")
@one_blas_thread()
def optimal_design(
    model: Model | Sequence[Model],
    design: Design | None = None,
    *,
    goal: Literal["multipliers"] | Goal = "multipliers",
    limit: Limit = "input",
    noise: NoiseLike | None = None,
    largest: Positive | Callable[[np.ndarray], np.ndarray] | None = None,
    experiments: ExperimentCount | None = None,
    seed: Seed = 0,
    max_steps: StepCount = 300,
    robust: Literal["mean", "worst"] = "mean",
) -> OptimalDesign:
    r"""The amplitudes that answer a question in the fewest strides, and proof that they do.

    ```python
    plan = hj.optimal_design(model)               # multipliers, the input's power limited
    plan = hj.optimal_design(model, limit={"yM": 0.01, "vM": 0.05})     # or the way from the cycle
    data = hj.run_experiments(cycle, sections, plan.design, outputs)
    ```

    The variance of the goal is the Cramer-Rao bound. It is a convex function of the cosines'
    powers, and the result's `certificate` says how far from the optimum they are. Strong cosines
    stand in several experiments, weak ones in one: for variances that are estimated run
    `plan.design.realizations(4)`, or two windows.

    **Arguments:**

    - `model`: what is known of the system, exact or estimated: a `StructuredFit` also does. Its
      deviations are then those of the harmonics that were fitted. Several models, any of which may
      be true (`hj.designs.draws` of an estimate): see `robust`. The limits hold for each.
    - `design`: what one would do otherwise. Its lines, inputs, periods and experiments are those of
      the result; by default `multisine` with all lines. Lines that are not in it are forbidden.
    - `goal`: `"multipliers"`, or one of `hj.designs`: `Multipliers`, `Parameters`,
      `FrequencyResponse`, `ImpulseResponse`, `Order`.
    - `limit`: rms values by name, of inputs, outputs (their deviation from the cycle) or states,
      over all experiments: `{"u": 0.01}`. Or what may be no larger than in `design`: `"input"` or
      `"output"`, of each. Or `hj.designs.Limits`, also of peaks, rates and strides.
    - `noise`: of each output that is measured, by name: the standard deviation of white noise, or
      a function that gives it by the frequency of the output (0 to N/2 cycles per period), the root
      of a spectrum. Or noise that was estimated: an `LDTPFit` with noise, or a model of noise as
      for `hj.identify.noise_spectrum`. By default all outputs are measured, with white noise 20 dB
      below their rms deviation in `design` within the limits.
    - `largest`: amplitude that no cosine may exceed; a number, or a function of an array of f. Zero
      forbids a frequency.
    - `experiments`: their number, by default that of `design`. `seed` of phases and division.
    - `max_steps` of the iteration.
    - `robust`: of several models, whether the mean of the criterion is made small, or that of the
      worst one (in fact a mean of 16th powers, which is a little smaller).

    **Raises:** `DefinitionError` for limits that nothing satisfies, goals that the data cannot see,
    multipliers that are not simple, and arguments that do not fit together.
    """
    models = [model] if isinstance(model, Model) else list(model)
    if not models:
        raise DefinitionError("`model` holds no model.")
    usual = multisine(models[0].n_sections, inputs=models[0].inputs) if design is None else design
    _check_alike(models, usual)
    cosines = Candidates.of(usual)
    squares = [mean_squares(one, cosines) for one in models]
    ports = {"input": models[0].inputs, "output": models[0].outputs}
    limits = power_limits(limit, squares, ports, cosines.power_of(usual))
    peak = dict(limit.peak) if isinstance(limit, Limits) else {}

    usual, most = without_forbidden(usual, largest), largest_amplitudes(largest, cosines.f)
    allowed = np.flatnonzero(most > 0)
    cosines, limits, most = cosines.only(allowed), limits.only(allowed), most[allowed]
    squares = [{name: square[allowed] for name, square in one.items()} for one in squares]
    count = experiments_within(limit, experiments, usual.experiments, usual.periods, len(cosines.f))
    distorted = None
    if isinstance(limit, Limits) and limit.distortion is not None:
        power = cosines.power_of(usual)
        distorted = products(limit.distortion, cosines, models[0].inputs, power)
        distorted.require_those_of(models[0])
        limits = limits.and_of_distortion(distorted.limited, distorted.curved)
    sums, limits = limits, limits.and_of_amplitudes(most, cosines)
    limits.require_limits()
    fit = functools.partial(_as_large_as_allowed, sums, distorted, cosines, largest)
    usual = fit(usual)
    if peak:
        usual = _below_peaks(usual, distorted, peak, seed)
    usual_power = cosines.power_of(usual)
    shown = [*models[0].inputs, *models[0].outputs]
    shown += [name for name in limits.names if name in squares[0] and name not in shown]
    usual_rms = rms_of(squares, shown, usual_power)
    distorted_rms = functools.partial(_distorted_rms, distorted, bool(peak))
    goal = Multipliers() if isinstance(goal, str) else goal
    errors = make_noise(models[0], noise, usual_rms)
    question = question_of(goal, models, cosines, errors, usual_power, robust)

    before = question.answer(usual_power)
    ideal = allocate(question, limits, usual_power, max_steps)
    kept, best = _with_fewer(question, limits, cosines, ideal, count, max_steps)
    one = most**2 / (2 * count)
    share = limits.only(kept).share(best.power)
    counts = places(cosines.only(kept), best.power * share, best.power / one[kept], count)
    if np.isfinite(most).any():
        # What each may have where it stands.
        room = sums.only(kept).and_of_powers(counts * one[kept])
        best = allocate(question.only(kept), room, best.power, max_steps)
    made = to_design(
        cosines.only(kept), best.power, best.power * share, counts, most[kept], count, usual,
        seed,
    )  # fmt: skip
    if distorted is not None:
        made = fit(_less_distorted(question, sums, distorted, most, made, max_steps))
    after = free = question.only(kept).answer(cosines.power_of(made)[kept])
    if peak:
        made = _below_peaks(made, distorted, peak, seed)
        after = question.only(kept).answer(cosines.power_of(made)[kept])
    power = cosines.power_of(made)
    shorter = usual.experiments / count
    # Compared with all designs whose distortion is bounded as this one's is.
    level = np.maximum(limits.bent(power), 1)
    excess = certify(ideal.answer, ideal.power, limits, level).excess
    return OptimalDesign(
        design=made,
        usual=usual,
        names=question.names,
        variances=after.variances * shorter,
        usual_variances=before.variances,
        criterion=after.criterion * shorter,
        usual_criterion=before.criterion,
        certificate=excess * after.criterion / ideal.answer.criterion,
        for_peaks=after.criterion / free.criterion,
        frequencies=cosines.f,
        channels=cosines.channel,
        power=power,
        usual_power=usual_power,
        sensitivity=ideal.certificate.relative,
        limited=_reached(sums, distorted, power, distorted_rms(made)),
        rms=rms_of(squares, shown, power) | distorted_rms(made),
        usual_rms=usual_rms | distorted_rms(usual),
    )


def _with_fewer(
    question: AbstractQuestion,
    limits: PowerLimits,
    cosines: Candidates,
    ideal: Allocation,
    count: int,
    max_steps: int,
) -> tuple[Int[np.ndarray, " kept"], Allocation]:
    """The cosines that matter, as so many experiments can hold, and their powers.

    **Arguments:** `ideal`, the best powers of all.
    """
    gain = ideal.power * ideal.answer.sensitivity
    for negligible in _NEGLIGIBLE:
        kept = np.flatnonzero(worthwhile(cosines, gain, count, negligible))
        best = allocate(question.only(kept), limits.only(kept), ideal.power[kept], max_steps)
        if best.answer.criterion < _AS_GOOD * ideal.answer.criterion:
            break
    return kept, best


def _as_large_as_allowed(
    limits: PowerLimits,
    distorted: Products | None,
    cosines: Candidates,
    largest: Largest,
    design: Design,
) -> Design:
    """The same proportions, but where a cosine has its largest amplitude."""
    for _ in range(_SCALINGS):
        use = limits.cost @ cosines.power_of(design)
        if distorted is not None:
            use = np.append(use, distorted.rms(design) / distorted.level)
        root = np.sqrt(1 / max(use.max(), np.finfo(float).tiny))
        design = dataclasses.replace(design, amplitude=design.amplitude * root)
        design = without_forbidden(design, largest)
    return design


def _less_distorted(
    question: AbstractQuestion,
    limits: PowerLimits,
    distorted: Products,
    most: Float[np.ndarray, " K"],
    design: Design,
    max_steps: int,
) -> Design:
    """The same cosines in the same experiments, with the best powers for the distortion of just
    these, from those that they have. (That form is not convex, so that better ones may exist.)

    **Arguments:** `limits`, without those of amplitudes, which are `most`.
    """
    each = distorted.powers(design)
    power = each.mean(axis=0)
    kept = np.flatnonzero(power)
    power, share = power[kept], each[:, kept] / power[kept]
    own = limits.only(kept)._replace(curved=distorted.divided(kept, share))
    if np.isfinite(most).any():
        own = own.and_of_powers(most[kept] ** 2 / (2 * share.max(axis=0)))
    factor = np.ones(len(most))
    factor[kept] = np.sqrt(allocate(question.only(kept), own, power, max_steps).power / power)
    amplitude = design.amplitude * factor[distorted.cosines.places(design)]
    return dataclasses.replace(design, amplitude=amplitude)


def _below_peaks(
    design: Design, distorted: Products | None, peak: dict[str, float], seed: int
) -> Design:
    """Within the peaks, and with the phases for that also within a distortion."""
    design = below_peaks(design, peak, seed)
    if distorted is None:
        return design
    use = (distorted.rms(design, phases=True) / distorted.level).max()
    return dataclasses.replace(design, amplitude=design.amplitude / np.sqrt(max(use, 1.0)))


def _reached(
    limits: PowerLimits,
    distorted: Products | None,
    power: Float[np.ndarray, " K"],
    distortion: dict[str, float],
) -> tuple[str, ...]:
    """Names of the limits that end here, or all if only those of amplitudes do; peaks always.

    **Arguments:** `limits`, without those of amplitudes.
    """
    use = {}
    for name, share in zip(limits.names, limits.cost @ power, strict=False):
        use[name] = max(use.get(name, 0.0), np.inf if name.startswith(peak_of("")) else share)
    if distorted is not None:
        levels = zip(distorted.limited, distorted.level, strict=True)
        use |= {name: distortion[name] / level for name, level in levels}
    return tuple(name for name, share in use.items() if share > _REACHED) or tuple(use)


def _distorted_rms(distorted: Products | None, phases: bool, design: Design) -> dict[str, float]:
    if distorted is None:
        return {}
    return dict(zip(distorted.limited, distorted.rms(design, phases).tolist(), strict=True))


def _check_alike(models: list[Model], design: Design) -> None:
    """**Raises:** `DefinitionError` for models and a design that do not fit together."""
    first = models[0]
    for k, one in enumerate(models):
        for name in ("n_sections", "inputs", "outputs"):
            if getattr(one, name) != getattr(first, name):
                raise DefinitionError(f"model {k} has other {name} than model 0.")
    if design.n_sections != first.n_sections or design.input_names != first.inputs:
        raise DefinitionError(
            f"the design has {design.n_sections} sections and the inputs "
            f"{listed(design.input_names)}, the model {first.n_sections} and "
            f"{listed(first.inputs)}."
        )
