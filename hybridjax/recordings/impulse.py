"""Phase-dependent impulse responses: what a brief push at each phase does, and for how long."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..errors import DefinitionError
from ..identify.series.fit import SeriesFit
from .sampling import SectionData
from .spectra import input_band


class ImpulseResponses(eqx.Module):
    r"""Outputs after a brief push of area 1, for each phase at which it acts.

    The impulse response of a periodic system depends on two times; neuromechanics calls it the
    phase-dependent impulse response function (Kiemel, Logan and Jeka, arXiv 1607.01746, 2016).

    **Fields:**

    - `values` (N, lags, ny, nu): `[m, r]` is the response r sections after section m, at which the
      push acts, divided by its area: input times time.
    - `errors`: their standard errors.
    - `phase` (N,), of the push, and `lag` (lags,), since then, both in cycles.
    - `width`: standard deviation of the push, in cycles; 0 for one that lasts for one section.
    - `period`, `inputs`, `outputs`.
    """

    values: Float[np.ndarray, "N lags ny nu"]
    errors: Float[np.ndarray, "N lags ny nu"]
    phase: Float[np.ndarray, " N"]
    lag: Float[np.ndarray, " lags"]
    width: float = eqx.field(static=True)
    period: float = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)

    def __repr__(self) -> str:
        return (
            f"ImpulseResponses({len(self.phase)} phases, {self.lag[-1]:.3g} cycles, width "
            f"{self.width:.2g}; {', '.join(self.inputs)} -> {', '.join(self.outputs)})"
        )


def impulse_responses(
    fit: SeriesFit,
    data: SectionData,
    cycles: int | float = 3,
    *,
    width: int | float | None = None,
) -> ImpulseResponses:
    """The responses of a fit to a push at each phase, with standard errors.

    **Arguments:**

    - `fit` of the `data`, whose period gives the area of an input that is held for one section.
    - `cycles`: how long responses are followed.
    - `width`: standard deviation of the push (Gaussian), in cycles. By default so wide that it has
      no frequencies beyond the band in which the inputs had power, since what the system
      does with these cannot be known. 0: the push is held for one section.

    **Raises:** `DefinitionError` if fit and data have different sections or names.
    """
    for name in ("n_sections", "inputs", "outputs"):
        if getattr(fit, name) != getattr(data, name):
            raise DefinitionError(
                f"fit and data have different {name}: {getattr(fit, name)} and "
                f"{getattr(data, name)}."
            )
    N, R, ny, nu = fit.numerators.shape
    lags = round(cycles * N) + 1
    if width is None:
        # The spectrum of the push is down to 4 % at the edge of the narrowest band.
        edge = min(input_band(data))
        width = 2.5 / (2 * np.pi * edge) if edge < 0.9 * N / 2 else 0.0
    if lags < 2 or width < 0:
        raise DefinitionError(f"cycles and width must be positive, not {cycles} and {width}.")
    reach = int(np.ceil(3 * width * N))
    push = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(width * N, 1e-9)) ** 2)
    push /= push.sum()
    longest, d = max(fit.lead + lags + reach, R), len(fit.coefficients)
    # The responses, what they owe to each coefficient, and to noise in the numerators: all obey
    # the same recursion from cycle to cycle.
    h = np.zeros((longest, N, ny, nu))
    h[:R] = fit.numerators.swapaxes(0, 1)
    slope = np.zeros((longest, d, N, ny, nu))
    slope[:R] = fit.slopes.transpose(2, 0, 1, 3, 4)
    root = np.zeros((longest, N, ny, nu, fit.roots.shape[4]))
    root[:R] = fit.roots.transpose(2, 0, 1, 3, 4)
    for r in range(N, longest):
        for j, c in enumerate(fit.coefficients[: r // N], 1):
            before = r - j * N
            h[r] -= c * h[before]
            slope[r] -= c * slope[before]
            slope[r, j - 1] -= h[before]
            root[r] -= c * root[before]

    def pushed(x):  # the push begins `reach` sections before its middle, and ends as much later
        out = np.zeros((lags, *x.shape[1:]))
        for k, weight in zip(range(-reach, reach + 1), push, strict=True):
            first = max(0, k - fit.lead)
            out[first:] += weight * x[first - k + fit.lead : lags - k + fit.lead]
        return out

    h, slope, root = pushed(h), pushed(slope), pushed(root)
    by_b = (root**2).sum(axis=4) * fit.noise[:, None] ** 2
    by_c = np.einsum("ranij,ab,rbnij->rnij", slope, fit.covariance, slope)
    errors = np.sqrt(by_b + by_c)
    step = data.period / N
    # From the section of the response to that of the push.
    m, r = np.arange(N)[:, None], np.arange(lags)
    place = (r, (m + r) % N)
    return ImpulseResponses(
        h[place] / step,
        errors[place] / step,
        np.arange(N) / N,
        np.arange(lags) / N,
        float(width),
        data.period,
        fit.inputs,
        fit.outputs,
    )
