"""The fit of a linear periodic model to harmonic transfer functions."""

import numpy as np

from ..._core.arguments import require_same
from ...errors import DefinitionError
from ...linear.htf import HTF
from ...linear.ldtp import LDTP
from ..htf_errors import ROUNDING, check_values, error_weights
from ..series.realization import given_dims, realize
from .coordinates import local_coordinates
from .frequency import FrequencyProblem
from .ldtp_fit import LDTPFit, finished
from .minimize import minimize
from .periodic_model import PeriodicModel


# The iteration begins with every fourth line, where these are so many equations for each unknown.
# Doubled: first steps cost half as much, and narrow resonances may be missed; fewer data are
# thinned.
_THINNED, _EQUATIONS = 4, 16
# It ends there with this decrease of the cost for each unknown. Doubled: one step less with some
# lines, and up to one more with all.
_COARSE_GAIN = 0.05


def fit_to_htf(htf: HTF, guess, direct: bool, max_steps: int) -> LDTPFit:
    """As `fit_ldtp`."""
    scale = check_values(htf)
    start = guess
    if not isinstance(guess, LDTP):
        start = realize(htf, np.array(given_dims(guess, htf.n_sections, "guess")))
    require_same("guess and data", start, htf)
    problem = FrequencyProblem.of(htf, error_weights(htf, scale), scale)
    model = PeriodicModel.of(start, scale)
    if not direct:
        model = model._replace(D=[0.0 * D for D in model.D])
    unknowns = local_coordinates(model, direct).size
    freedom = problem.residuals - unknowns
    if freedom < 1:
        raise DefinitionError(
            f"the HTFs hold {problem.residuals} numbers, too few for {unknowns} unknowns."
        )
    if not np.isfinite(problem.cost(model)):
        raise DefinitionError("the guess is resonant at a frequency of the HTFs.")
    share = min(_THINNED, problem.residuals // (_EQUATIONS * unknowns))
    if share > 1:
        some = problem.thinned(share)
        model = minimize(some, model, direct, max_steps, _COARSE_GAIN).coordinates.model
    found = minimize(problem, model, direct, max_steps)
    if htf.variance is None:
        # Once more with the outputs weighted by what their misfit says.
        square = (np.abs(problem.errors(found.coordinates.model)) ** 2).mean(axis=(0, 1, 3))
        noise = np.maximum(np.sqrt(square / 2), ROUNDING)
        problem = problem._replace(weight=problem.weight / noise[:, None])
        found = minimize(problem, found.coordinates.model, direct, max_steps)
    fitted = found.coordinates.model.to_ldtp(scale, htf.inputs, htf.outputs)
    return finished(found, fitted, scale, htf.harmonics, freedom, htf.variance is not None)
