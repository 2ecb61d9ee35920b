"""`optimal_design`: the design that estimates a quantity of interest in the fewest cycles.

It takes the stages in order: cosines of the usual design (`candidates.py`), the criterion of the
goal (`criteria.py`), limits (`limits.py`), the best powers (`allocation.allocate`), cosines that
matter and their division into experiments (`worthwhile`, `to_design`), and phases within the peaks
(`Rules`). It returns an `OptimalDesign` with a certificate. The certificate tells whether the
powers are best; standard errors come from the criterion.

The order must stay: the usual design is scaled to the limits before its noise and the criterion are
computed, and peaks come last, since they depend on the phases. If a limit is exceeded, look at
`Rules.scaled` and `Rules.below_peaks`; if a certificate is far above 1, at `allocation.py` (with
limits of peaks or distortion, it may be so at the optimum).
"""

import dataclasses
from collections.abc import Sequence
from typing import ClassVar, Literal, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._core.arguments import require_equal, require_same
from .._core.boundary.checked import checked, checked_methods
from .._core.boundary.kinds import Positive, Seed
from .._core.execution import one_blas_thread
from .._core.progress import working
from .._core.showable import Showable
from .._core.text import columns
from ..errors import DefinitionError
from ..experiments.design.design import Design
from ..experiments.design.multisine import multisine
from .allocation import ENOUGH, allocate, certify, to_design, worthwhile
from .candidates import (
    Candidates,
    Model,
    NoiseLike,
    Powers,
    make_noise,
    mean_squares,
    rms_of,
)
from .criteria import criterion_of
from .criterion import Criterion
from .goals import Goal, MultiplierGoal
from .limits import (
    Limit,
    PowerLimits,
    Products,
    as_limits,
    below_peaks,
    power_limits,
    products,
)


# `advice` recommends the design if it saves at least this factor of cycles. Larger: designs that
# save a third are called nearly optimal. Smaller: savings within the uncertainty of the model are
# advertised.
_WORTH_IT = 1.5


@checked_methods
class OptimalDesign(Showable, eqx.Module):
    """A design that needs the fewest cycles, and the design that it improves.

    Standard errors are Cramer-Rao bounds: a fit that uses all of the data reaches them where noise
    is white and responses are linear.

    **Fields:**

    - `design`: the experiments, for `run_experiments`, or `signals()` for hardware.
    - `usual`: the design that it improves, scaled to the same limits.
    - `names` (g,) of the quantities of interest; `variances` (g,) with `design`, `usual_variances`
      with `usual`.
    - `criterion` and `usual_criterion`: the minimized function, in units of a variance.
    - `certificate`: a number e, which is 1 at the optimum. No design within the limits needs fewer
      cycles than 1/e of the cycles of this design. e is the largest sum of sensitivities of any
      design within the limits, relative to the sum of this design. With one limit, it is the
      largest sensitivity of a line per unit of the limit. If peaks are limited, e may be larger at
      the optimum, because peaks of other designs are assumed to be no larger than rms values. If
      distortion is limited, e compares only with designs whose convex bound of the distortion is no
      larger than the limit, or no larger than the bound of this design.
    - `frequencies` (K,) and `channels` (K,) of all cosines. `power` and `usual_power` (K,): the
      mean square of each over all experiments. `sensitivity` (K,): the decrease of the criterion by
      more power in a cosine, divided by the price of this power. It is 1 where the optimum has
      power, and less elsewhere.
    - `limited`: names of the limits that are reached. A limit of an rms value has the name of its
      signal; there are also limits of rates, peaks and distortions.
    - `rms`, `usual_rms`: predicted rms values of all signals, by name. If distortion is limited,
      `distortion of y` is its rms, expected for random phases (with a limited peak, for the
      optimized phases).

    Functions that take a design take it, too.
    """

    _stands_for: ClassVar = ("design",)

    design: Design
    usual: Design
    names: tuple[str, ...] = eqx.field(static=True)
    variances: Float[np.ndarray, " g"]
    usual_variances: Float[np.ndarray, " g"]
    criterion: float
    usual_criterion: float
    certificate: float
    frequencies: Powers
    channels: np.ndarray
    power: Powers
    usual_power: Powers
    sensitivity: Powers
    limited: tuple[str, ...] = eqx.field(static=True)
    rms: dict[str, float]
    usual_rms: dict[str, float]

    @property
    def usual_name(self) -> str:
        """The name of the design that was improved, in prints and figures."""
        size = self.usual.amplitude
        channel = self.usual.channel
        relative = size / (np.bincount(channel, size) / np.bincount(channel))[channel]
        # (Amplitudes are larger in experiments with fewer lines.)
        return "equal amplitudes" if np.ptp(relative) < 0.2 else "the given amplitudes"

    @property
    def standard_errors(self) -> Float[np.ndarray, " g"]:
        """Standard errors of the quantities of interest, with one run of `design`. (Of a complex
        multiplier: the root of the expected squared distance from it.)"""
        return np.sqrt(self.variances)

    @property
    def usual_standard_errors(self) -> Float[np.ndarray, " g"]:
        """Standard errors with one run of `usual`."""
        return np.sqrt(self.usual_variances)

    @property
    def cycles(self) -> int:
        """Cycles of all experiments, without those that are discarded."""
        return self.design.cycles(0)

    @property
    def saved(self) -> float:
        """Number of cycles of `usual` that one cycle of `design` replaces."""
        return (
            self.usual_criterion * self.usual.cycles(0) / (self.criterion * self.cycles)
        )

    def cycles_for(self, standard_error: Positive) -> int:
        """Return the cycles, with repeats of `design`, after which no quantity has a larger
        standard error."""
        return int(
            np.ceil(self.cycles * (self.standard_errors.max() / standard_error) ** 2)
        )

    @property
    def advice(self) -> str:
        """The worth of this design, in a sentence."""
        prefixes = ("rate of ", "peak of ", "distortion of ")
        special = [n for n in self.limited if n.startswith(prefixes)]
        rms = " and ".join(n for n in self.limited if n not in special)
        limits = " and ".join([f"rms of {rms}"] * bool(rms) + special)
        saved = float(f"{self.saved:.2g}")  # (a third digit differs between machines)
        if self.saved > _WORTH_IT:
            text = (
                f"one cycle of this design replaces {saved:g} with {self.usual_name}."
            )
        else:
            text = f"{self.usual_name} are nearly optimal."
        return f"With the {limits} limited, {text}"

    def __repr__(self) -> str:
        rows = [("", self.usual_name, "optimal")]
        usual = str(self.usual.cycles(0))
        rows.append(("cycles", usual, str(self.cycles)))
        errors = zip(
            self.names, self.usual_standard_errors, self.standard_errors, strict=True
        )
        rows += [
            (f"standard error of {name}", f"{a:.2e}", f"{b:.2e}")
            for name, a, b in errors
        ]
        rms = ((n, x) for n, x in self.usual_rms.items() if x > 0)
        for n, x in rms:
            designed = f"{self.rms[n]:.3g}"
            rows.append((f"rms of {n}", f"{x:.3g}", designed))
        bounded = any(n.startswith("distortion of ") for n in self.rms)
        certificate = (
            f"certificate {self.certificate:.3f} (1 at the optimum):\n  "
            f"no design within the limits {'(of distortion: an upper bound) ' * bounded}"
            f"needs less than {100 / self.certificate:.1f} % of these cycles"
        )
        below = "\n".join(["", self.advice, certificate, repr(self.design)]).replace(
            "\n", "\n  "
        )
        return f"OptimalDesign({', '.join(self.names)}){columns(rows)}{below}"


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
        return dataclasses.replace(
            design, amplitude=design.amplitude / np.sqrt(use.max())
        )

    def below_peaks(self, design: Design) -> Design:
        """Return the design within the peaks, and with these phases also within a distortion."""
        if not self.peak:
            return design
        design = below_peaks(design, self.peak, self.seed)
        if self.distortion is None:
            return design
        use = (self.distortion.rms(design, phases=True) / self.distortion.level).max()
        return dataclasses.replace(
            design, amplitude=design.amplitude / np.sqrt(max(use, 1.0))
        )

    def distorted(self, design: Design) -> dict[str, float]:
        """Return the rms of distortions in a design, by name."""
        if self.distortion is None:
            return {}
        rms = self.distortion.rms(design, bool(self.peak)).tolist()
        return dict(zip(self.distortion.names, rms, strict=True))

    def less_distorted(self, criterion: Criterion, design: Design) -> Design:
        """Return the same cosines in the same experiments, with powers that are improved for the
        true distortion of these experiments. (This problem is not convex, so that better powers may
        exist.)"""
        if self.distortion is None:
            return design
        each = self.cosines.powers_in(design)
        power = each.mean(axis=0)
        kept = np.flatnonzero(power)
        power = power[kept]
        curved = self.distortion.divided(kept, each[:, kept] / power)
        limits = self.linear.only(kept)._replace(curved=curved)
        best = allocate(criterion.only(kept), limits, power)
        factor = np.ones(len(self.cosines.line))
        factor[kept] = np.sqrt(best.power / power)
        amplitude = design.amplitude * factor[self.cosines.places(design)]
        return self.scaled(dataclasses.replace(design, amplitude=amplitude))

    def reached(self, design: Design) -> tuple[str, ...]:
        """Return names of the limits that are reached; peaks always are."""
        use: dict[str, float] = {}
        shares = self.linear.cost @ self.cosines.power_of(design)
        for name, share in zip(self.linear.names, shares, strict=True):
            if name.startswith("peak of "):
                share = np.inf
            use[name] = max(use.get(name, 0.0), share)
        if self.distortion is not None:
            rms = self.distorted(design)
            for name, level in zip(rms, self.distortion.level, strict=True):
                use[name] = rms[name] / level
        full = 1 / (1 + ENOUGH)
        return tuple(name for name, share in use.items() if share > full)


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
    r"""Find the amplitudes with which a quantity of interest is estimated in the fewest cycles.

    The minimized variance is the Cramer-Rao bound of the `goal`, a convex function of the powers of
    the cosines; `certificate` in the result bounds the distance from the optimum. Strong cosines
    are excited in several experiments, weak ones in only one. If variances are to be estimated
    from the data, run `plan.design.realizations(4)` or record two periods of the multisine.

    **Arguments:**

    - `model`: the system, exact or estimated; or a `StructuredFit`, whose fitted harmonics give the
      deviations of outputs. Several models (`hj.designs.draw_models` of an estimate) make the
      design robust, see `robust`; the limits hold for each.
    - `design`: the design to improve. Lines that are not in it are forbidden; inputs, periods and
      the number of experiments are kept. Default: `multisine` with all lines.
    - `goal`: `"multipliers"`, or one of `hj.designs`: `MultiplierGoal`, `ParameterGoal`,
      `ResponseGoal`. Default: `"multipliers"`.
    - `limit`: largest rms values over all experiments, by name of inputs or outputs (deviations
      from the cycle), as in `{"u": 0.01}`. `"input"` or `"output"` takes the rms values of
      `design`. `hj.designs.Limits` also limits peaks, rates, cycles and distortion. Default:
      `"input"`.
    - `noise`: standard deviation of the white noise of each measured output, by name, or one number
      for all outputs; or, by name, a function of the frequency of the output (0 to N/2 cycles per
      period). Its value is the standard deviation of white noise with the spectral density at this
      frequency. Default: all outputs are measured, with white noise of a tenth of their rms
      deviation in `design`, scaled to the limits.
    - `seed`: seed of the phases, and of the division of cosines among experiments. Default: 0.
    - `robust`: with several models, minimize the `"mean"` of their criteria, or the `"worst"` one
      (approximately: a power mean with exponent 16). Default: `"mean"`.

    **Returns:** an `OptimalDesign`: `design` for `hj.run_experiments`, `standard_errors` (g,) of
    the quantities of interest, `cycles_for` and `advice`.

    **Raises:** `DefinitionError` for limits that nothing satisfies, goals that the data do not
    identify, multipliers that are not simple, unstable models, and arguments that do not fit
    together.

    **Example:**

    ```python
    plan = hj.optimal_design(model, design)
    deviations = hj.optimal_design(model, design, limit={"yM": 0.01, "vM": 0.05})
    print(plan.advice)
    ```

    **Before:** `hj.linearize`, `hj.fit_ldtp` or `hj.fit_multipliers`. **After:**
    `hj.run_experiments`, `hj.plot.spectrum`, `hj.plot.standard_errors`.
    """
    models = [model] if isinstance(model, Model) else list(model)
    if not models:
        raise DefinitionError("`model` must be one model or more, not an empty list.")
    if design is None:
        usual = multisine(models[0].n_sections, inputs=models[0].inputs)
    else:
        usual = design
    _check_alike(models, usual)
    # Limits of the powers of all cosines.
    given = as_limits(limit)
    cosines = Candidates.of(usual)
    squares = [mean_squares(each, cosines) for each in models]
    linear = power_limits(given, models, squares, cosines.power_of(usual))

    count = given.experiments(usual, len(cosines.line))
    distortion = None
    limits = linear
    if given.distortion is not None:
        power = cosines.power_of(usual)
        distortion = products(given.distortion, cosines, models[0].inputs, power)
        distortion.require_those_of(models[0])
        limits = limits._replace(curved=distortion.bound)
    limits.require_limits()
    rules = Rules(
        linear=linear,
        distortion=distortion,
        cosines=cosines,
        peak=dict(given.peak),
        seed=seed,
    )
    # The usual design within these limits, and the criterion.
    usual = rules.below_peaks(rules.scaled(usual))
    usual_power = cosines.power_of(usual)
    shown = [*models[0].inputs, *models[0].outputs]
    usual_rms = rms_of(squares, shown, usual_power)
    goal = MultiplierGoal() if isinstance(goal, str) else goal
    errors = make_noise(models[0], noise, usual_rms)
    criterion = criterion_of(goal, models, cosines, errors, usual_power, robust)

    # The best powers: of all cosines, then of those that matter. Then experiments with these.
    before = criterion.bound(usual_power)
    ideal = allocate(criterion, limits, usual_power)
    kept = worthwhile(cosines, ideal.power * ideal.bound.sensitivity, count)
    best = allocate(criterion.only(kept), limits.only(kept), ideal.power[kept])
    use = best.power * limits.only(kept).share(best.power)
    made = to_design(cosines.only(kept), best.power, use, count, usual, seed)
    made = rules.below_peaks(rules.less_distorted(criterion, made))
    # What these experiments reach. (The bound supposes as many experiments as `usual` has.)
    power = cosines.power_of(made)
    after = criterion.only(kept).bound(power[kept])
    shorter = usual.experiments / count
    # (The certificate compares with all designs within the same convex bound of the distortion.)
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
    """**Raises:** `DefinitionError` for models and a design that do not fit together, and for
    models without a steady state."""
    first = models[0]
    for k, model in enumerate(models):
        require_same(f"model {k} and model 0", model, first)
        if (np.abs(model.multipliers) >= 1).any():
            raise DefinitionError(
                f"model {k} is unstable, so that it has no periodic response: give a stable loop, "
                "`model.feedback(controller)`."
            )
    require_equal("design and model", "n_sections", design.n_sections, first.n_sections)
    require_equal("design and model", "inputs", design.inputs, first.inputs)
