"""`identify_model`: all steps from a system to estimated multipliers, in one call.

It calls public functions one after the other (limit cycle, sections, design, experiments, HTFs,
fit), and returns their results as a `ModelIdentification`. Only the size of the inputs is computed
here (`_small_design`). To find a wrong step, call the functions one by one.
"""

from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, cast

import equinox as eqx
import numpy as np

from .._core.arguments import Numbers
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Order, Seed
from .._core.boundary.values import Reals
from .._core.findings import Finding
from .._core.progress import say, working
from ..engine.trajectory import observed
from ..errors import DefinitionError
from ..experiments.data import ExperimentData
from ..experiments.design.design import Design
from ..experiments.design.multisine import multisine
from ..experiments.noise import add_noise
from ..experiments.stored import run_experiments
from ..linear.htf import HTF
from ..linear.ldtp import LDTP
from ..orbits.checks import default_outputs
from ..orbits.cycle import LimitCycle
from ..orbits.find import find_limit_cycle
from ..sections.linearization import linearize
from ..sections.place import as_placed
from ..sections.placed import SectionsLike
from ..systems.system import HybridSystem, OutputNames, name_of
from .htf_estimate import estimate_htf
from .multiplier_estimate import MultiplierComparison, OfFit
from .multipliers import StructuredFit, fit_multipliers


# Predicted deviations of the outputs, relative to half of their range on the cycle. Larger:
# distortion biases estimates. Smaller: the accuracy of integration limits them.
_DEVIATION = 1e-3
# Number of points in each step of the orbit, from which the range of the outputs is taken. Fewer:
# the range is too small. More: time.
_PER_STEP = 8
# Number of periods of the design, and number of its versions with other random phases. More: time.
# Fewer: H is known at few lines, and its variances are uncertain.
_PERIODS = 16
_REALIZATIONS = 4


class ModelIdentification(OfFit, eqx.Module):
    """The results of `identify_model`, step by step.

    **Fields:** `cycle`; `model`, the exact linearization; `design`, `data` of its experiments,
    `htf`, estimated from them, and `fit`, whose multipliers `comparison` compares with the exact
    ones. It has `multipliers`, `modulus`, `standard_errors`, `interval`, `contains` and `compare`
    of the fit. Functions that take a fit, data or an HTF take it, too.
    """

    cycle: LimitCycle
    model: LDTP
    design: Design
    data: ExperimentData
    htf: HTF
    fit: StructuredFit

    _stands_for: ClassVar = ("fit", "data", "htf")

    @property
    def comparison(self) -> MultiplierComparison:
        """The estimated multipliers beside the exact ones."""
        return self.fit.compare(self.model)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Doubts about the cycle and the fit."""
        return (*self.cycle.findings, *self.fit.findings)

    def __repr__(self) -> str:
        name = name_of(self.cycle.system)
        return f"ModelIdentification({name}; {self.data.summary()})\n{self.fit}\n{self.comparison}"


@checked
@working("identify_model")
def identify_model(
    system: HybridSystem | LimitCycle,
    sections: SectionsLike,
    outputs: OutputNames | None = None,
    *,
    order: Order | None = None,
    noise: Annotated[Numbers, Reals(sign="nonnegative")] | None = None,
    design: Design | None = None,
    seed: Seed = 0,
) -> ModelIdentification:
    """Identify the multipliers of a system from simulated experiments, with defaults for all steps:
    limit cycle, design, experiments, HTFs and fit.

    **Arguments:**

    - `system`: a system with a guess of its own, or a limit cycle.
    - `sections`: as in `linearize`.
    - `outputs`: names or `Output`s. Default: all states that every chart defines.
    - `order`: the number of multipliers. Default: that of the exact model.
    - `noise`: standard deviation of measurement noise that is added to the outputs, one number, or
      one for each. Default: none.
    - `design`: the experiments. Default: four realizations of odd multisines over 16 periods, so
      small that outputs deviate by about 0.1 % of half their range.
    - `seed`: of phases and noise. Default: 0.

    **Returns:** `ModelIdentification`, with the results of all steps.

    **Raises:** `DefinitionError` for a system without inputs, and in the cases of the functions
    that make the steps; `ComputationError` for an unstable cycle.

    **Example:**

    ```python
    result = hj.identify_model(hj.models.VerticalHopper(), hj.ClockPhase(8), "yM")
    print(result)
    ```

    **Before:** a system. **After:** `result.fit.interval()`, `hj.validate`, or the same steps one
    by one.
    """
    say("limit cycle")
    cycle = system if isinstance(system, LimitCycle) else find_limit_cycle(system)
    if not cycle.structure.inputs:
        raise DefinitionError(
            "identify_model excites inputs, but the system has none: use `cycle.multipliers`."
        )
    placed = as_placed(cycle, sections)
    names = default_outputs(cycle.structure) if outputs is None else outputs
    say("linearization")
    model = linearize(cycle, placed, names)
    if design is None:
        design = _small_design(cycle, model, cast(Sequence, names), seed)
    say("experiments")
    data = run_experiments(cycle, placed, design, names, start="periodic")
    if noise is not None:
        data = add_noise(data, std=noise, seed=seed)
    say("fit")
    htf = estimate_htf(data)
    fit = fit_multipliers(htf, model.rank() if order is None else order)
    return ModelIdentification(cycle, model, design, data, htf, fit)


def _small_design(
    cycle: LimitCycle, model: LDTP, outputs: Sequence[Any], seed: int
) -> Design:
    """Return a design that makes the outputs deviate by a small part of their range."""
    N = model.n_sections
    plain = multisine(N, _PERIODS, lines="odd", seed=seed, inputs=model.inputs)
    lines = np.unique(plain.line / plain.periods)
    H = np.asarray(model.htf(lines).H)
    # (Power of the response to inputs of rms 1: the sum over all harmonics, averaged over the
    # lines.)
    power = (np.abs(H) ** 2).sum(axis=(0, 3))
    gain = np.sqrt(power.mean(axis=0))
    orbit = cycle.trajectory()
    values = observed(orbit.structure, outputs, *orbit.dense(_PER_STEP))
    ranges = [np.nanmax(x) - np.nanmin(x) for x in values]
    reach = np.array(ranges) / 2
    moves = (reach > 0) & (gain > 0)
    if not moves.any():
        raise DefinitionError(
            "the inputs do not move the outputs: name other `outputs`, or give a `design`."
        )
    rms = _DEVIATION * (reach[moves] / gain[moves]).min()
    return plain.scaled(float(rms)).realizations(_REALIZATIONS, seed)
