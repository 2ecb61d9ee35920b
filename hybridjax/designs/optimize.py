"""The design that estimates a quantity of interest in the fewest strides."""

import dataclasses
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Seed
from .._core.execution import one_blas_thread
from .._core.progress import working
from .._core.text import listed
from ..errors import DefinitionError
from ..experiments.design.design import Design
from ..experiments.design.multisine import multisine
from .allocation import ENOUGH, allocate, certify, to_design, worthwhile
from .candidates import Candidates, Model, NoiseLike, make_noise, mean_squares, rms_of
from .criteria import criterion_of
from .criterion import Criterion
from .distortion import Products, products
from .goals import Goal, Multipliers
from .limits import Limit, PowerLimits, as_limits, below_peaks, peak_of, power_limits
from .optimal_design import OptimalDesign


class Rules(NamedTuple):
    """The limits that experiments must obey."""

    linear: PowerLimits
    distortion: Products | None
    cosines: Candidates
    peak: dict[str, float]
    seed: int

    def scaled(self, design: Design) -> Design:
        """Return the same proportions, as large as allowed."""
        use = self.linear.cost @ self.cosines.power_of(design)
        if self.distortion is not None:
            use = np.append(use, self.distortion.rms(design) / self.distortion.level)
        return dataclasses.replace(design, amplitude=design.amplitude / np.sqrt(use.max()))

    def below_peaks(self, design: Design) -> Design:
        """Return the design within the peaks, and with these phases also within a distortion."""
        if not self.peak:
            return design
        design = below_peaks(design, self.peak, self.seed)
        if self.distortion is None:
            return design
        use = (self.distortion.rms(design, phases=True) / self.distortion.level).max()
        return dataclasses.replace(design, amplitude=design.amplitude / np.sqrt(max(use, 1.0)))

    def distorted(self, design: Design) -> dict[str, float]:
        """Return the rms of distortions in a design, by name."""
        if self.distortion is None:
            return {}
        rms = self.distortion.rms(design, bool(self.peak)).tolist()
        return dict(zip(self.distortion.names, rms, strict=True))

    def less_distorted(self, criterion: Criterion, design: Design) -> Design:
        """Return the same cosines in the same experiments, with the best powers for the distortion
        of just these, from those that they have. (That form is not convex, so that better ones may
        exist.)"""
        if self.distortion is None:
            return design
        each = self.cosines.powers_in(design)
        power = each.mean(axis=0)
        kept = np.flatnonzero(power)
        power, share = power[kept], each[:, kept] / power[kept]
        limits = self.linear.only(kept)._replace(curved=self.distortion.divided(kept, share))
        factor = np.ones(len(self.cosines.line))
        factor[kept] = np.sqrt(allocate(criterion.only(kept), limits, power).power / power)
        amplitude = design.amplitude * factor[self.cosines.places(design)]
        return self.scaled(dataclasses.replace(design, amplitude=amplitude))

    def reached(self, design: Design) -> tuple[str, ...]:
        """Return names of the limits that are reached; peaks always are."""
        use: dict[str, float] = {}
        shares = self.linear.cost @ self.cosines.power_of(design)
        for name, share in zip(self.linear.names, shares, strict=True):
            use[name] = max(use.get(name, 0.0), np.inf if name.startswith(peak_of("")) else share)
        if self.distortion is not None:
            levels = zip(self.distorted(design).items(), self.distortion.level, strict=True)
            use |= {name: rms / level for (name, rms), level in levels}
        return tuple(name for name, share in use.items() if share > 1 / (1 + ENOUGH))


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
    seed: Seed = 0,
    robust: Literal["mean", "worst"] = "mean",
) -> OptimalDesign:
    r"""Find the amplitudes with which the fewest strides estimate a quantity of interest.

    ```python
    plan = hj.optimal_design(model)               # multipliers, the input's power limited
    plan = hj.optimal_design(model, limit={"yM": 0.01, "vM": 0.05})     # or the deviations
    data = hj.run_experiments(cycle, sections, plan.design, outputs)
    ```

    The variance of the goal is the Cramer-Rao bound. It is a convex function of the cosines'
    powers, and `certificate` in the result bounds the distance from the optimum. Large components
    are excited in several experiments, small ones in only one. If variances are to be estimated
    from the data, run `plan.design.realizations(4)` or record two periods of the multisine.

    **Arguments:**

    - `model`: the system, exact or estimated; a `StructuredFit` also does, whose deviations are
      those of the fitted harmonics. Several models (`hj.designs.draws` of an estimate) make the
      design robust, see `robust`; the limits hold for each.
    - `design`: the design to improve. Lines that are not in it are forbidden; inputs, periods and
      the number of experiments are kept. Default: `multisine` with all lines.
    - `goal`: `"multipliers"`, or one of `hj.designs`: `Multipliers`, `Parameters`,
      `FrequencyResponse`. Default: `"multipliers"`.
    - `limit`: largest rms values by name, of inputs or outputs (their deviation from the cycle),
      over all experiments: `{"u": 0.01}`; `"input"` or `"output"`: rms values of these as in
      `design`; or `hj.designs.Limits`, also of peaks, rates, strides and distortion.
      Default: `"input"`.
    - `noise`: of each measured output, by name: the standard deviation of white noise, or a
      function that returns it by the frequency of the output (0 to N/2 cycles per period), the root
      of a spectrum. Default: all outputs are measured, with white noise 20 dB below their rms
      deviation in `design` within the limits.
    - `seed` of phases and division. Default: 0.
    - `robust`: with several models, minimize the mean of their criteria, or the worst one (a mean
      of 16th powers, which is slightly smaller). Default: `"mean"`.

    **Raises:** `DefinitionError` for limits that nothing satisfies, goals that the data do not
    identify, multipliers that are not simple, and arguments that do not fit together.
    """
    models = [model] if isinstance(model, Model) else list(model)
    if not models:
        raise DefinitionError("`model` holds no model.")
    usual = multisine(models[0].n_sections, inputs=models[0].inputs) if design is None else design
    _check_alike(models, usual)
    given = as_limits(limit)
    cosines = Candidates.of(usual)
    squares = [mean_squares(each, cosines) for each in models]
    linear = power_limits(given, models, squares, cosines.power_of(usual))

    count = given.experiments(usual, len(cosines.line))
    distortion, limits = None, linear
    if given.distortion is not None:
        power = cosines.power_of(usual)
        distortion = products(given.distortion, cosines, models[0].inputs, power)
        distortion.require_those_of(models[0])
        limits = limits._replace(curved=distortion.bound)
    limits.require_limits()
    rules = Rules(linear, distortion, cosines, dict(given.peak), seed)
    usual = rules.below_peaks(rules.scaled(usual))
    usual_power = cosines.power_of(usual)
    shown = [*models[0].inputs, *models[0].outputs]
    usual_rms = rms_of(squares, shown, usual_power)
    goal = Multipliers() if isinstance(goal, str) else goal
    errors = make_noise(models[0], noise, usual_rms)
    criterion = criterion_of(goal, models, cosines, errors, usual_power, robust)

    before = criterion.bound(usual_power)
    ideal = allocate(criterion, limits, usual_power)
    kept = worthwhile(cosines, ideal.power * ideal.bound.sensitivity, count)
    best = allocate(criterion.only(kept), limits.only(kept), ideal.power[kept])
    use = best.power * limits.only(kept).share(best.power)
    made = to_design(cosines.only(kept), best.power, use, count, usual, seed)
    made = rules.below_peaks(rules.less_distorted(criterion, made))
    power = cosines.power_of(made)
    after = criterion.only(kept).bound(power[kept])
    shorter = usual.experiments / count
    # Compared with all designs whose distortion is bounded as this one's is.
    level = np.maximum(limits.use_of_curved(power), 1)
    excess = certify(ideal.bound, ideal.power, limits, level).excess
    return OptimalDesign(
        design=made,
        usual=usual,
        names=criterion.names,
        variances=after.variances * shorter,
        usual_variances=before.variances,
        criterion=after.criterion * shorter,
        usual_criterion=before.criterion,
        certificate=excess * after.criterion / ideal.bound.criterion,
        frequencies=cosines.f,
        channels=cosines.channel,
        power=power,
        usual_power=usual_power,
        sensitivity=ideal.certificate.relative,
        limited=rules.reached(made),
        rms=rms_of(squares, shown, power) | rules.distorted(made),
        usual_rms=usual_rms | rules.distorted(usual),
    )


def _check_alike(models: list[Model], design: Design) -> None:
    """**Raises:** `DefinitionError` for models and a design that do not fit together."""
    first = models[0]
    for k, model in enumerate(models):
        for name in ("n_sections", "inputs", "outputs"):
            if getattr(model, name) != getattr(first, name):
                raise DefinitionError(f"model {k} has other {name} than model 0.")
    if design.n_sections != first.n_sections or design.input_names != first.inputs:
        raise DefinitionError(
            f"the design has {design.n_sections} sections and the inputs "
            f"{listed(design.input_names)}, the model {first.n_sections} and "
            f"{listed(first.inputs)}."
        )
