"""Maximum likelihood for the matrices of a linear periodic model."""

import numpy as np

from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import StepCount
from ..._core.precision import require_x64
from ..._core.results import Result
from ...errors import DefinitionError
from ...linear.htf import HTF
from ...linear.ldtp import LDTP
from ..multipliers.denominator import multipliers_of
from ..multipliers.error_weights import ROUNDING, check_values, error_weights
from .characteristic import characteristic_slopes
from .coordinates import local_coordinates
from .frequency import FrequencyProblem
from .ldtp_fit import LDTPFit
from .minimize import minimize
from .periodic_model import PeriodicModel


@checked
def fit_ldtp(htf: HTF, start: LDTP, *, direct: bool = True, max_steps: StepCount = 50) -> LDTPFit:
    r"""Fit the matrices A[n], B[n], C[n], D[n] of a periodic model to all HTFs together.

    Maximum likelihood for independent, circular, normal errors of the HTFs with the variances
    given:

    $$V(A, B, C, D) = \sum \frac{2}{v}\, | H_m(\omega) - \hat H_m(\omega; A, B, C, D) |^2$$

    over all frequencies, harmonics, outputs and inputs. `fit_multipliers` gives each of the
    transfer functions a numerator of its own; here they follow from fewer numbers, and
    multipliers are more exact (`hj.identify.ldtp_bound` says by how much). By Levenberg and
    Marquardt's iteration, with exact derivatives, in local coordinates in which the choice of
    states does not count (McKelvey, Helmersson and Ribarits 2004).

    ```python
    start = hj.identify.realize(estimate, dims)
    fit = hj.fit_ldtp(estimate, start)
    ```

    **Arguments:**

    - `htf`: estimated, with harmonics as many as can be had: few of them determine few of the
      matrices' entries. Without variances each output counts relative to its misfit.
    - `start`: where the iteration begins, and the dimension of the state at each section. It must
      be observable, as what `hj.identify.realize` gives is. Too few dimensions bias the
      multipliers; the misfit shows it where variances are known.
    - `direct`: whether outputs may depend on the input at their own section; if not, D = 0.
    - `max_steps`: of the iteration.

    **Raises:** `DefinitionError` if the two do not fit together, for NaN in the HTFs, variances
    that are not positive, a start with a state that outputs never show, or fewer numbers in the
    HTFs than unknowns.
    """
    require_x64()
    for name in ("n_sections", "inputs", "outputs"):
        if getattr(start, name) != getattr(htf, name):
            raise DefinitionError(
                f"`start` and HTFs have different {name}: {getattr(start, name)} and "
                f"{getattr(htf, name)}."
            )
    scale = check_values(htf)
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
        raise DefinitionError("`start` is resonant at a frequency of the HTFs.")
    found = minimize(problem, model, direct, max_steps)
    if htf.variance is None:
        # Once more with the outputs weighted by what their misfit says.
        square = (np.abs(problem.errors(found.coordinates.model)) ** 2).mean(axis=(0, 1, 3))
        noise = np.maximum(np.sqrt(square / 2), ROUNDING)
        problem = problem._replace(weight=problem.weight / noise[:, None])
        found = minimize(problem, found.coordinates.model, direct, max_steps)
    c, slopes = characteristic_slopes(found.coordinates)
    unit = 1.0 if htf.variance is not None else found.cost / freedom
    root = np.sqrt(unit) * found.equations.covariance_root()
    return LDTPFit(
        model=found.coordinates.model.to_ldtp(scale, htf.inputs, htf.outputs),
        multipliers=multipliers_of(c),
        coefficients=c,
        covariance=slopes @ root @ (slopes @ root).T,
        covariance_freedom=np.inf if htf.variance is not None else float(freedom),
        cost=found.cost / unit,
        freedom=freedom,
        result=Result.OK if found.converged else Result.NOT_CONVERGED,
        harmonics=htf.harmonics,
        noise=None,
        _coordinates=found.coordinates,
        _root=root,
        _scale=scale,
    )
