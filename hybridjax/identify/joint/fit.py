"""Maximum likelihood for the matrices of a linear periodic model."""

from typing import Annotated, Literal

from ..._core.arguments import Numbers
from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Order, StepCount
from ..._core.boundary.values import Integers
from ..._core.precision import require_x64
from ...errors import DefinitionError
from ...experiments.record import RecordedData
from ...linear.htf import HTF
from ...linear.ldtp import LDTP
from .ldtp_fit import LDTPFit
from .to_htf import fit_to_htf
from .to_series import fit_to_series


@checked
def fit_ldtp(
    data: HTF | RecordedData,
    guess: LDTP | Order | Annotated[Numbers, Integers("N", sign="positive")],
    *,
    noise: Literal["output", "innovations"] = "output",
    start: Literal["free", "cycle"] = "free",
    direct: bool = True,
    max_steps: StepCount = 50,
) -> LDTPFit:
    r"""Fit the matrices A[n], B[n], C[n], D[n] of a periodic model by maximum likelihood.

    *To HTFs*, with independent, circular, normal errors of the variances given:

    $$V(A, B, C, D) = \sum \frac{2}{v}\, | H_m(\omega) - \hat H_m(\omega; A, B, C, D) |^2$$

    over all frequencies, harmonics, outputs and inputs. `fit_multipliers` gives each of the
    transfer functions a numerator of its own; here they follow from fewer numbers, and
    multipliers are more exact (`hj.identify.ldtp_bound` says by how much).

    *To series*, with normal errors e of predictions one step ahead:

    $$x[n+1] = A[n] x[n] + B[n] u[n] + K[n] e[n], \qquad y[n] = C[n] x[n] + D[n] u[n] + e[n]$$

    $V = \sum_n T_n \log \det S[n]$ with S[n] the covariance of the $T_n$ errors at section n
    (Ljung, *System Identification*, 1999, for each section). With `noise="output"` K is zero and S
    the same at all sections: white noise of sensors. With "innovations" the noise is whatever
    periodic process the states can make: noise that drives the system (every such system has this
    form, by Kalman's filter), and, with more states, colored noise.

    By Levenberg and Marquardt's iteration, with exact derivatives, in local coordinates in which
    the choice of states does not count (McKelvey, Helmersson and Ribarits 2004).

    ```python
    fit = hj.fit_ldtp(estimate, dims)
    ```

    **Arguments:**

    - `data`: HTFs, estimated, with harmonics as many as can be had: few of them determine few of
      the matrices' entries; without variances each output counts relative to its misfit. Or series,
      as for `fit_series`.
    - `guess`: the dimension of the state at each section or at all: the fit begins with what
      `hj.identify.realize` makes of HTFs, and with a subspace method for series. Or the model to
      begin with, observable, which has these dimensions. Too few bias the multipliers: the misfit
      shows it where variances are known (`cost` beside `freedom`), `hj.validate` for series. The
      iteration finds the nearest minimum, which the same numbers show not to be the lowest.
    - `noise`: of series, see above; "output" for HTFs.
    - `start`: of series. "free": the state at the start of each record is unknown; "cycle": zero.
      "free" for HTFs, which have none.
    - `direct`: whether outputs may depend on the input at their own section; if not, D = 0.
    - `max_steps`: of the iteration.

    **Raises:** `DefinitionError` if the two do not fit together, for NaN in the HTFs, variances
    that are not positive, a guess with a state that outputs never show, or fewer numbers in the
    data than unknowns; for records with `lead`.
    """
    require_x64()
    if isinstance(data, HTF):
        if noise == "innovations":
            raise DefinitionError("HTFs tell nothing of innovations: give the series.")
        if start == "cycle":
            raise DefinitionError(
                "HTFs have no start, the response is periodic: leave `start` out."
            )
        return fit_to_htf(data, guess, direct, max_steps)
    return fit_to_series(data, guess, noise == "innovations", start == "free", direct, max_steps)
