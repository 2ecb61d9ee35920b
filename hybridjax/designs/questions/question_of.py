"""Goals as questions to the data: unknowns, what cosines say of them, and what is wanted."""

from typing import Literal

import numpy as np
from jaxtyping import Float

from ...errors import DefinitionError
from ..candidates import Candidates
from ..goals import FrequencyResponse, Goal, ImpulseResponse, Multipliers, Order, Parameters
from ..noise import Noise
from ..signals import Model
from .average import Average
from .multipliers import about_multipliers
from .order import about_order
from .parameters import about_parameters
from .question import AbstractQuestion
from .responses import about_frequencies, about_impulses


# Exponents of the mean over models. Doubled, for the worst one: of ten models the criterion is up
# to 7 % smaller than the largest, instead of 13 %, and steps are shorter.
_EXPONENT = {"mean": 1.0, "worst": 16.0}


def question_of(
    goal: Goal,
    models: list[Model],
    cosines: Candidates,
    noise: Noise,
    power: Float[np.ndarray, " K"],
    robust: Literal["mean", "worst"],
) -> AbstractQuestion:
    """About one model, or several.

    **Arguments:** `power` of the cosines in the usual design: what it does not show counts as
    unseen.

    **Raises:** `DefinitionError` for multipliers that do not exist or are not simple, parameters
    that do not exist, and combinations that the data cannot see, which are named.
    """
    if isinstance(goal, Parameters) and len(models) > 1:
        raise DefinitionError(
            "a goal of parameters is about the one cycle that it holds: give one `model`."
        )
    each = [_about(goal, one, cosines, noise, power) for one in models]
    return each[0] if len(each) == 1 else Average(tuple(each), each[0].names, _EXPONENT[robust])


def _about(
    goal: Goal, model: Model, cosines: Candidates, noise: Noise, power: Float[np.ndarray, " K"]
) -> AbstractQuestion:
    if isinstance(goal, Multipliers):
        return about_multipliers(goal, model, cosines, noise, power)
    if isinstance(goal, FrequencyResponse):
        return about_frequencies(goal, model, cosines, noise, power)
    if isinstance(goal, ImpulseResponse):
        return about_impulses(goal, model, cosines, noise, power)
    if isinstance(goal, Order):
        return about_order(goal, model, cosines, noise)
    return about_parameters(goal, model, cosines, noise)
