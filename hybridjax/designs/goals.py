"""What one wants to know."""

from typing import Literal

import equinox as eqx

from .._core import limits
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, Index, NonNegative, Positive, SignalNames
from ..errors import DefinitionError
from ..linear.frequency_response import Harmonics
from ..orbits.cycle import LimitCycle
from ..sections.families import FamilyLike, as_family


Criterion = Literal["A", "D"]


@checked
class Multipliers(eqx.Module):
    """The Floquet multipliers.

    **Arguments:**

    - `which`: index of the only multiplier to ask for, as `model.multipliers` has them; None asks
      for all, a conjugate pair once.
    - `part`: `"position"`, real and imaginary parts, or `"modulus"`.
    - `criterion`: `"A"`, the sum of the variances, or `"D"`, the volume of the ellipsoid.
    - `weights`: of the wanted quantities in a sum that is asked for instead of themselves (the
      c-criterion), in the order of `OptimalDesign.names` without them.
    - `estimator`: the function that will find them. `"fit_multipliers"` leaves all numerators
      free, `"fit_ldtp"` the matrices of a model of this model's (minimal) dimensions.
    - `harmonics`: those of the fit; None means -2 to 2 for `fit_multipliers`, all for `fit_ldtp`.
      `overhang`: of `fit_multipliers`.
    """

    which: Index | None = eqx.field(static=True, default=None)
    part: Literal["position", "modulus"] = eqx.field(static=True, default="position")
    criterion: Criterion = eqx.field(static=True, default="A")
    weights: tuple[float, ...] | None = eqx.field(static=True, default=None)
    estimator: Literal["fit_multipliers", "fit_ldtp"] = eqx.field(
        static=True, default="fit_multipliers"
    )
    harmonics: Harmonics | None = eqx.field(static=True, default=None)
    overhang: Index | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        _check_weights(self.weights)
        if self.harmonics is not None:
            _check_harmonics(self.harmonics)


@checked
class Parameters(eqx.Module):
    """Physical parameters, as `fit_model` finds them from HTFs: their relative errors.

    The derivatives are exact, through the limit cycle and its sections; they compile at the first
    call, for a minute or so.

    **Arguments:**

    - `cycle`: of the system whose parameters are looked for; `sections`: the family.
    - `free`: names of all parameters that are unknown; `wanted`: those one asks for, None for all.
    - `criterion` and `weights`: as for `Multipliers`; a difference of two relative errors is that
      of a ratio of parameters. `harmonics`: those of the HTFs.
    """

    cycle: LimitCycle
    sections: FamilyLike
    free: SignalNames = eqx.field(static=True)
    wanted: SignalNames | None = eqx.field(static=True, default=None)
    criterion: Criterion = eqx.field(static=True, default="A")
    weights: tuple[float, ...] | None = eqx.field(static=True, default=None)
    harmonics: Harmonics = eqx.field(static=True, default=(-2, -1, 0, 1, 2))

    def __check_init__(self):
        _check_weights(self.weights)
        _check_harmonics(self.harmonics)
        as_family(self.sections)


@checked
class FrequencyResponse(eqx.Module):
    """Harmonic transfer functions in a band, as `fit_ldtp` finds them with the model's dimensions.

    The mean of the variance over the band, relative to the mean square there of each output's
    transfer functions (all the harmonics asked for).

    **Arguments:** `band`, frequencies of the input, cycles per period; `wanted`, the harmonics one
    asks for; `harmonics`, those of the fit, None for all.
    """

    band: tuple[NonNegative, Positive] = eqx.field(static=True)
    wanted: Harmonics = eqx.field(static=True, default=(0,))
    harmonics: Harmonics | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        if not self.band[0] < self.band[1]:
            raise DefinitionError(f"`band` must rise, not {self.band}.")
        _check_harmonics(self.wanted)
        if self.harmonics is not None:
            _check_harmonics(self.harmonics)


@checked
class ImpulseResponse(eqx.Module):
    """Responses to a push of one section, as `fit_ldtp` finds them with the model's dimensions.

    The mean of the variance over all sections of the output, relative to the mean square of each
    output's response.

    **Arguments:** `lags`, how many sections after the push are asked for, from 0 on; `harmonics`,
    those of the fit, None for all.
    """

    lags: Count = eqx.field(static=True)
    harmonics: Harmonics | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        if self.harmonics is not None:
            _check_harmonics(self.harmonics)


@checked
class Order(eqx.Module):
    """Whether there are as many multipliers as the model has, or fewer.

    The misfit of the best model with fewer (T-optimality: Atkinson and Fedorov, Biometrika 62,
    1975), as large as possible in units of the noise's variance: all numerators are free, as in
    `fit_multipliers`. The standard error is relative to the misfit: one over its root.

    **Arguments:** `fewer`, the number of multipliers of the rival; `harmonics` and `overhang`:
    those of the fit.
    """

    fewer: Index = eqx.field(static=True)
    harmonics: Harmonics = eqx.field(static=True, default=(-2, -1, 0, 1, 2))
    overhang: Index | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        _check_harmonics(self.harmonics)


Goal = Multipliers | Parameters | FrequencyResponse | ImpulseResponse | Order


def _check_weights(weights: tuple[float, ...] | None) -> None:
    """**Raises:** `DefinitionError` where all are zero, or there are none."""
    if weights is not None and not any(weights):
        raise DefinitionError("`weights` of a goal must not all be zero.")


def _check_harmonics(harmonics: Harmonics) -> None:
    """**Raises:** `DefinitionError` for harmonics that no number of sections has."""
    given = [harmonics] if isinstance(harmonics, int) else list(harmonics)
    if not given or len(set(given)) < len(given):
        raise DefinitionError(f"`harmonics` must be distinct and at least one: {harmonics}.")
    if max(map(abs, given)) > limits.SECTIONS:
        raise DefinitionError(f"`harmonics` must lie within {limits.SECTIONS}, not {harmonics}.")
