"""`cramer_rao`: the smallest standard errors of multipliers that an experiment allows, before it is
made.

It takes the exact model and HTFs with the variances that they will have, and returns a
`MultiplierEstimate`. With the matrices as unknowns (`fit_ldtp`), `_with_matrices` computes the
bound; otherwise it is that of `fit_multipliers`.

Nothing may be fitted here: the derivatives are those at the true model, whose HTFs are computed in
`_exact_htf`. If a bound is wrong for both estimators, look at the `variance` of the HTFs; if for
one only, at `residuals_of` in `variable_projection.py`, or at `_with_matrices`.
"""

import dataclasses
from typing import Literal

import numpy as np

from .._core.arguments import require_same
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Index
from .._core.execution import one_blas_thread
from ..errors import DefinitionError
from ..linear.htf import HTF
from ..linear.ldtp import LDTP
from . import variable_projection as varpro, weights
from .denominator import coefficients_of, multipliers_of
from .joint.frequency import FrequencyProblem
from .multiplier_estimate import MultiplierEstimate
from .periodic import PeriodicModel, characteristic_slopes, local_coordinates
from .realization import default_horizon, realized


@checked
@one_blas_thread()
def cramer_rao(
    model: LDTP,
    htf: HTF,
    *,
    estimator: Literal["fit_multipliers", "fit_ldtp"] = "fit_multipliers",
    extra_lags: Index | None = None,
) -> MultiplierEstimate:
    r"""Return the Cramer-Rao bound of the multipliers of a known model.

    The errors of the HTFs are independent, circular and Gaussian. The bound is the best
    accuracy that an experiment can reach. It is computed before the experiment.

    **Arguments:**

    - `model`: the true system. `htf`: frequencies, harmonics and `variance` of the experiment; its
      H is not used.
    - `estimator`: the estimation function for which the bound holds. The unknowns of
      "fit_multipliers" are the multipliers and all numerators. The bound is then the
      inverse of $J^T J$, where J is the derivative of the HTFs in units of their
      standard deviations, projected orthogonally to all changes of the numerators. The
      unknowns of "fit_ldtp" are the matrices A[n], B[n], C[n] (and D[n], if the model
      has any) of the minimal part of the model. The square of the ratio of the two
      standard errors is the factor by which "fit_multipliers" needs more data than
      "fit_ldtp". Default: "fit_multipliers".
    - `extra_lags`: degree of the numerators beyond d N, of "fit_multipliers". Default: N.

    **Returns:** `hj.identify.MultiplierEstimate`: the true `multipliers` (d,) with the smallest
    `covariance` (d, d) of an unbiased estimate. `standard_errors` (d,) are bounds of rms errors.
    For "fit_ldtp", d is the smallest dimension of the state of the minimal model.

    **Raises:** `DefinitionError` if `model` and `htf` do not fit together, or if `htf`
    has no variances or too few frequencies to find the multipliers.

    **Example:**

    ```python
    exact = hj.experiments.simulate_experiments(model, design.realizations(4), start="periodic")
    noisy = hj.experiments.add_noise(exact, std=1e-5)
    bound = hj.identify.cramer_rao(model, hj.estimate_htf(noisy))
    print(bound.standard_errors)
    ```

    **Before:** `hj.linearize`, `hj.estimate_htf`. **After:** `hj.optimal_design`,
    `hj.fit_multipliers`.
    """
    exact = _exact_htf(model, htf)
    if estimator == "fit_ldtp":
        return _with_matrices(model, exact)
    multipliers = model.multipliers
    c = coefficients_of(multipliers)
    groups = varpro.grouped(exact, len(c), extra_lags)
    _, J = varpro.residuals_of(groups, c)
    return MultiplierEstimate(multipliers, c, np.linalg.inv(J.T @ J), np.inf)


def _with_matrices(model: LDTP, exact: HTF) -> MultiplierEstimate:
    """Return the bound if the matrices of the minimal model are the unknowns."""
    lags = 2 * default_horizon(model.n_sections) + 1
    minimal = realized(np.asarray(model.impulse_response(lags)))
    scale = weights.check_values(exact)
    problem = FrequencyProblem.of(exact, weights.error_weights(exact, scale), scale)
    direct = bool(np.asarray(model.D).any())
    coordinates = local_coordinates(PeriodicModel.of(minimal, scale), direct)
    c, slopes = characteristic_slopes(coordinates)
    spread = problem.linearize(coordinates).spread()
    return MultiplierEstimate(multipliers_of(c), c, spread.covariance(slopes), np.inf)


def _exact_htf(model: LDTP, htf: HTF) -> HTF:
    """Return the HTFs of a model with the frequencies, harmonics and variances of others.

    **Raises:** `DefinitionError` if the two do not fit together, or `htf` has no variances.
    """
    require_same("model and HTFs", model, htf)
    if htf.variance is None:
        raise DefinitionError(
            "a bound needs HTFs with variances: estimate them from several realizations or "
            "windows (`repeats`)."
        )
    return dataclasses.replace(
        model.htf(htf.frequencies, htf.harmonics), variance=htf.variance
    )
