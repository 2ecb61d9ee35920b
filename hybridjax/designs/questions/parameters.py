"""Physical parameters as what the harmonic transfer functions depend on."""

import numpy as np

from ...errors import DefinitionError
from ...fitting.fit import identifiability
from ...fitting.observations import ObservedHTF
from ..candidates import Candidates
from ..goals import Parameters
from ..noise import Noise
from ..signals import Model
from .measured import measured
from .question import Question, weighted
from .sensitivities import DirectSensitivities


def about_parameters(goal: Parameters, model: Model, cosines: Candidates, noise: Noise) -> Question:
    """As `question_of`."""
    free = tuple(goal.free)
    wanted = free if goal.wanted is None else tuple(goal.wanted)
    strange = [name for name in wanted if name not in free]
    if strange:
        raise DefinitionError(f"`goal`: '{strange[0]}' is wanted, but not one of `free`, {free}.")
    slopes, candidate = [], []
    for htf, here, _ in measured(model, cosines, goal.harmonics, noise):
        observed = ObservedHTF(htf, goal.sections)
        seen = identifiability(goal.cycle.system, observed, free, guess=goal.cycle)
        if not seen.complete:
            lost = "; ".join(seen.descriptions())
            raise DefinitionError(f"the data cannot see {lost}: leave it out of `free`.")
        slopes.append(seen.sensitivity.T)
        shape = 2, len(htf.harmonics), len(here), htf.H[0, 0].size
        candidate.append(np.broadcast_to(here[:, None], shape).ravel())
    sensitivities = DirectSensitivities(np.concatenate(candidate), np.concatenate(slopes, axis=1))
    rows = np.eye(len(free))[[free.index(name) for name in wanted]]
    rows, names = weighted(rows, wanted, goal.weights)
    return Question(sensitivities, rows, names, free, goal.criterion)
