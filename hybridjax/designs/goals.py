"""The quantities of interest for which a design is optimized."""

from typing import Literal

import equinox as eqx

from .._core import limits
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, Index, NonNegative, Positive, SignalNames
from ..errors import DefinitionError
from ..linear.frequency_response import Harmonics
from ..orbits.cycle import LimitCycle
from ..sections.families import FamilyLike, as_family


_FEW = (-2, -1, 0, 1, 2)


@checked
class Multipliers(eqx.Module):
    """The Floquet multipliers: the sum of their variances.

    **Arguments:**

    - `which`: index of a single multiplier, in the order of `model.multipliers`. Default: all of
      them, each conjugate pair once.
    - `part`: `"position"`, real and imaginary parts, or `"modulus"`. Default: `"position"`.
    - `weights`: coefficients of a weighted sum of the quantities that replaces them (the
      c-criterion), in the order of `OptimalDesign.names` without weights.
    - `estimator`: the function that will estimate them. `"fit_multipliers"` leaves all numerators
      free, `"fit_ldtp"` the matrices of a model with this model's (minimal) dimensions.
      Default: `"fit_multipliers"`.
    - `harmonics`: harmonics that the estimator uses. Default: -2 to 2 for `fit_multipliers`, all
      for `fit_ldtp`.
    - `overhang`: argument of `fit_multipliers`.
    """

    which: Index | None = eqx.field(static=True, default=None)
    part: Literal["position", "modulus"] = eqx.field(static=True, default="position")
    weights: tuple[float, ...] | None = eqx.field(static=True, default=None)
    estimator: Literal["fit_multipliers", "fit_ldtp"] = eqx.field(
        static=True, default="fit_multipliers"
    )
    harmonics: Harmonics | None = eqx.field(static=True, default=None)
    overhang: Index | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        if self.weights is not None and not any(self.weights):
            raise DefinitionError("`weights` of a goal must not all be zero.")
        _check_harmonics(self.harmonics)

    @property
    def fitted_harmonics(self) -> Harmonics:
        """Harmonics of `fit_multipliers`."""
        return _FEW if self.harmonics is None else self.harmonics


@checked
class Parameters(eqx.Module):
    """Physical parameters, estimated by `fit_model` from HTFs: their relative errors.

    The derivatives are exact, through the limit cycle and its sections; they compile at the first
    call, for a minute or so.

    **Arguments:**

    - `cycle`: limit cycle of the system with these parameters; `sections`: the family of sections.
    - `free`: names of all unknown parameters. `wanted`: those whose errors matter. Default: all.
    - `harmonics`: harmonics of the HTFs. Default: -2 to 2.
    """

    cycle: LimitCycle
    sections: FamilyLike
    free: SignalNames = eqx.field(static=True)
    wanted: SignalNames | None = eqx.field(static=True, default=None)
    harmonics: Harmonics = eqx.field(static=True, default=_FEW)

    def __check_init__(self):
        _check_harmonics(self.harmonics)
        as_family(self.sections)


@checked
class FrequencyResponse(eqx.Module):
    """Harmonic transfer functions in a band, estimated by `fit_ldtp` with the model's dimensions.

    The criterion is the mean of the variance over the band, relative to the mean square there of
    each output's transfer functions (of all wanted harmonics).

    **Arguments:** `band`: frequencies of the input, cycles per period. `wanted`: the harmonics of
    interest. Default: 0. `harmonics`: those that the estimator uses. Default: all.
    """

    band: tuple[NonNegative, Positive] = eqx.field(static=True)
    wanted: Harmonics = eqx.field(static=True, default=(0,))
    harmonics: Harmonics | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        if not self.band[0] < self.band[1]:
            raise DefinitionError(f"`band` must rise, not {self.band}.")
        _check_harmonics(self.wanted)
        _check_harmonics(self.harmonics)


@checked
class ImpulseResponse(eqx.Module):
    """Responses to an input at one section, estimated by `fit_ldtp` with the model's dimensions.

    The criterion is the mean of the variance over all sections of the output, relative to the mean
    square of each output's response.

    **Arguments:** `lags`: number of sections after the input, from 0 on. `harmonics`: those that
    the estimator uses. Default: all.
    """

    lags: Count = eqx.field(static=True)
    harmonics: Harmonics | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        _check_harmonics(self.harmonics)


Goal = Multipliers | Parameters | FrequencyResponse | ImpulseResponse


def _check_harmonics(harmonics: Harmonics | None) -> None:
    """**Raises:** `DefinitionError` for harmonics that no number of sections has."""
    if harmonics is None:
        return
    given = [harmonics] if isinstance(harmonics, int) else list(harmonics)
    if not given or len(set(given)) < len(given):
        raise DefinitionError(f"`harmonics` must be distinct and at least one: {harmonics}.")
    if max(map(abs, given)) > limits.SECTIONS:
        raise DefinitionError(f"`harmonics` must lie within {limits.SECTIONS}, not {harmonics}.")
