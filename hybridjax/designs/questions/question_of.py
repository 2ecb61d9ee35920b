"""Goals as questions to the data: unknowns, what cosines say of them, and what is wanted."""

import numpy as np
from jaxtyping import Float

from ..candidates import Candidates
from ..goals import Goal, Multipliers
from ..noise import Noise
from .measured import Model
from .multipliers import about_multipliers
from .parameters import about_parameters
from .question import AbstractQuestion


def question_of(
    goal: Goal,
    model: Model,
    cosines: Candidates,
    noise: Noise,
    power: Float[np.ndarray, " K"],
) -> AbstractQuestion:
    """**Arguments:** `power` of the cosines in the usual design: what it does not show counts as
    unseen.

    **Raises:** `DefinitionError` for multipliers that do not exist or are not simple, parameters
    that do not exist, and combinations that the data cannot see, which are named.
    """
    if isinstance(goal, Multipliers):
        return about_multipliers(goal, model, cosines, noise, power)
    return about_parameters(goal, model, cosines, noise)
