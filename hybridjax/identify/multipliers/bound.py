"""How well multipliers can be estimated at all."""

import numpy as np
from jaxtyping import Complex, Float

from ..._core.arguments import require_same
from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Index
from ..._core.execution import one_blas_thread
from ...errors import DefinitionError
from ...linear.htf import HTF
from ...linear.ldtp import LDTP
from .error_weights import check_values, error_weights, require_frequencies
from .multiplier_estimate import MultiplierEstimate
from .variable_projection import group_htf, misfit_of


class MultiplierBound(MultiplierEstimate):
    """The true multipliers, with the smallest covariance that an unbiased estimate can have.

    **Fields:** as of every estimate of multipliers: `multipliers` (d,), `coefficients` (d,) of
    their polynomial and their `covariance` (d, d). `standard_errors` are bounds of rms errors.
    """

    multipliers: Complex[np.ndarray, " d"]
    coefficients: Float[np.ndarray, " d"]
    covariance: Float[np.ndarray, "d d"]

    @property
    def covariance_freedom(self) -> float:
        return np.inf

    def __repr__(self) -> str:
        return f"MultiplierBound({self.show_multipliers()})"


def exact_htf(model: LDTP, htf: HTF) -> HTF:
    """The exact HTFs of a model, with the frequencies, harmonics and variances of others.

    **Raises:** `DefinitionError` if the two do not fit together, or `htf` has no variances.
    """
    require_same("model and HTFs", model, htf)
    if htf.variance is None:
        raise DefinitionError("a bound needs the variances of the HTFs, and these have none.")
    H = model.htf(htf.f, htf.harmonics).H
    return HTF(
        htf.f, H, htf.harmonics, htf.n_sections, htf.inputs, htf.outputs,
        variance=htf.variance,
    )  # fmt: skip


@checked
@one_blas_thread()
def multiplier_bound(model: LDTP, htf: HTF, overhang: Index | None = None) -> MultiplierBound:
    r"""The Cramer-Rao bound of the multipliers of a known model.

    For independent, circular, normal errors of the HTFs, with all numerators unknown: the inverse
    of $J^T J$ at the truth, where J is the derivative of the HTFs in units of their standard
    deviations, less what numerators can imitate. It says before an experiment what the
    experiment can show at best.

    **Arguments:**

    - `model`: the truth. `htf`: its frequencies, harmonics and `variance` count, H does not.
    - `overhang`: degree of the numerators beyond d N; None means N.

    **Raises:** `DefinitionError` if the two do not fit together, `htf` has no variances, or too
    few frequencies to find the multipliers at all.
    """
    exact = exact_htf(model, htf)
    multipliers = model.multipliers
    d, N = len(multipliers), model.n_sections
    size = d * N + (N if overhang is None else overhang) + 1
    require_frequencies(exact, d, size)
    c = np.poly(multipliers).real[1:]
    information = np.zeros((d, d))
    for group in group_htf(exact, error_weights(exact, check_values(exact)), size):
        jacobian = misfit_of(group, c).jacobian.reshape(d, -1)
        information += jacobian @ jacobian.T
    return MultiplierBound(multipliers, c, np.linalg.inv(information))
