"""The quantities of interest for which a design is optimized: multipliers, physical parameters, or
responses in a band.

Users make a goal and give it to `optimal_design`. A goal has data only; its criterion is in
`criteria.py`. A new goal is a class here, a member of `Goal`, and a branch of `criterion_of` there.

`__check_init__` refuses what is wrong without a model; what does not fit a model is refused in
`criteria.py` and `matrices.py`. There, too, is the cause of a wrong standard error. Harmonics of a
goal are those that its estimator will get: standard errors hold for these only.
"""

from typing import Literal

import equinox as eqx

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Index, NonNegative, Positive, SignalNames
from ..errors import DefinitionError
from ..linear.frequency_response import Harmonics
from ..orbits.cycle import LimitCycle
from ..sections.families import FamilyLike, as_family


@checked
class MultiplierGoal(eqx.Module):
    """The Floquet multipliers as goal: the criterion is the sum of their variances.

    **Arguments:**

    - `which`: index of a single multiplier, in the order of `model.multipliers`. Default: all of
      them, each conjugate pair once.
    - `part`: `"position"`, real and imaginary parts, or `"modulus"`. Default: `"position"`.
    - `estimator`: the function that will estimate them. The unknowns of `"fit_multipliers"` are the
      multipliers and all numerators, those of `"fit_ldtp"` the matrices of a model with the
      (minimal) dimensions of this model. Default: `"fit_multipliers"`.
    - `harmonics`: harmonics that the estimator uses. Default: -2 to 2 for `fit_multipliers`, all
      for `fit_ldtp`.
    - `extra_lags`: argument of `fit_multipliers`.

    **Example:**

    ```python
    goal = hj.designs.MultiplierGoal(0, "modulus")
    print(hj.optimal_design(model, design, goal=goal).standard_errors)
    ```

    **After:** `hj.optimal_design`.
    """

    which: Index | None = eqx.field(static=True, default=None)
    part: Literal["position", "modulus"] = eqx.field(static=True, default="position")
    estimator: Literal["fit_multipliers", "fit_ldtp"] = eqx.field(
        static=True, default="fit_multipliers"
    )
    harmonics: Harmonics | None = eqx.field(static=True, default=None)
    extra_lags: Index | None = eqx.field(static=True, default=None)

    @property
    def fitted_harmonics(self) -> Harmonics:
        """Harmonics of `fit_multipliers`."""
        return (-2, -1, 0, 1, 2) if self.harmonics is None else self.harmonics


@checked
class ParameterGoal(eqx.Module):
    """The relative errors of physical parameters that `fit_model` estimates from HTFs, as goal.

    The derivatives are exact, through the limit cycle and its sections; they compile at the first
    call, for a minute or so.

    **Arguments:**

    - `cycle`: limit cycle of the system with these parameters; `sections`: the family of sections.
    - `free`: names of all unknown parameters. `quantities`: those whose errors matter. Default:
      all.
    - `harmonics`: harmonics of the HTFs. Default: -2 to 2.

    **Example:**

    ```python
    goal = hj.designs.ParameterGoal(cycle, sections, ("k", "b"), quantities="k")
    ```

    **Before:** `hj.find_limit_cycle`. **After:** `hj.optimal_design`.
    """

    cycle: LimitCycle
    sections: FamilyLike
    free: SignalNames = eqx.field(static=True)
    quantities: SignalNames | None = eqx.field(static=True, default=None)
    harmonics: Harmonics = eqx.field(static=True, default=(-2, -1, 0, 1, 2))

    def __check_init__(self):
        as_family(self.sections)


@checked
class ResponseGoal(eqx.Module):
    """Harmonic transfer functions in a band, estimated by `fit_ldtp` with the model's dimensions.

    The criterion is the mean of the variance over the band, relative to the mean square there of
    each output's transfer functions (of all harmonics of interest).

    **Arguments:** `frequencies`: the lowest and the highest input frequency, cycles per period.
    `quantities`: the harmonics of interest. Default: 0. `harmonics`: those that the estimator uses.
    Default: all.

    **Example:**

    ```python
    goal = hj.designs.ResponseGoal((0.1, 1.0))
    print(hj.optimal_design(model, design, goal=goal).criterion)
    ```

    **After:** `hj.optimal_design`.
    """

    frequencies: tuple[NonNegative, Positive] = eqx.field(static=True)
    quantities: Harmonics = eqx.field(static=True, default=(0,))
    harmonics: Harmonics | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        if not self.frequencies[0] < self.frequencies[1]:
            raise DefinitionError(
                f"`frequencies` must be two ascending frequencies, not {self.frequencies}."
            )


Goal = MultiplierGoal | ParameterGoal | ResponseGoal
