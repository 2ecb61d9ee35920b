"""How well multipliers can be estimated by a fit of the state-space model itself."""

import numpy as np

from ..._core.boundary.checked import checked
from ...linear.htf import HTF
from ...linear.ldtp import LDTP
from ..denominator import multipliers_of
from ..htf_errors import check_values, error_weights
from ..multiplier_estimate import MultiplierEstimate
from ..multipliers import exact_htf
from ..series.realization import realize
from .characteristic import characteristic_slopes
from .coordinates import local_coordinates
from .frequency import FrequencyProblem
from .periodic_model import PeriodicModel


# Periods of the impulse response from which a minimal model is made, and the lags at least.
# Doubled: states that are seen later, and half as well, count.
_PERIODS, _LAGS = 4, 17


@checked
def ldtp_bound(model: LDTP, htf: HTF) -> MultiplierEstimate:
    r"""The Cramer-Rao bound of the multipliers for whoever knows the dimensions of the states.

    As `multiplier_bound`, for independent, circular, normal errors of the HTFs, but with the
    matrices A[n], B[n], C[n] (and D[n], where the model has any) unknown instead of free
    numerators: what `fit_ldtp` can reach. The square of the ratio of the two standard errors says
    how many times the strides the structure is worth.

    **Arguments:**

    - `model`: the truth; only its minimal part counts. `htf`: its frequencies, harmonics and
      `variance` count, H does not.

    **Returns:** as many multipliers as the smallest state of the minimal model has coordinates.

    **Raises:** `DefinitionError` if the two do not fit together, or `htf` has no variances.
    """
    exact = exact_htf(model, htf)
    lags = max(_PERIODS * model.n_sections, _LAGS - 1) + 1
    minimal = realize(np.asarray(model.impulse_response(lags)))
    scale = check_values(exact)
    problem = FrequencyProblem.of(exact, error_weights(exact, scale), scale)
    direct = bool(np.asarray(model.D).any())
    coordinates = local_coordinates(PeriodicModel.of(minimal, scale), direct)
    c, slopes = characteristic_slopes(coordinates)
    spread = problem.linearize(coordinates).spread()
    return MultiplierEstimate(multipliers_of(c), c, spread.covariance(slopes), np.inf)
