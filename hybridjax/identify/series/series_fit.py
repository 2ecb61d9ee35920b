"""A periodic system with one denominator, fitted to recorded series."""

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import PeriodCount, Scalar, Vector
from ..._core.results import Result
from ..._core.signal import unit_of
from ..._core.text import number
from ...linear.frequency_response import Harmonics, check_harmonics
from ...linear.htf import HTF
from ..denominator import chi
from ..multiplier_estimate import MultiplierEstimate


class SeriesFit(MultiplierEstimate):
    r"""A periodic system with one denominator in $q^{-N}$, fitted to recorded series.

    $$\chi(q^{-N})\, y[n] = \sum_{r=0}^{R-1} b_{n \bmod N}[r]\, u[n-r], \qquad
    \chi(q^{-N}) = 1 + c_1 q^{-N} + \ldots + c_d q^{-dN} = \prod_i (1 - \lambda_i q^{-N})$$

    which is exact for a periodic system with d non-zero multipliers, if R is large enough.

    **Fields:**

    - `multipliers` (d,): by decreasing modulus. `coefficients` (d,): c_1 to c_d.
    - `covariance` (d, d): of the coefficients, estimated with `covariance_freedom` degrees of
      freedom. `standard_errors`, `contains` and `ellipse` give what follows for multipliers.
    - `numerators` (N, R, ny, nu): b at each section. Combinations of inputs that were not
      excited have none.
    - `slopes` (d, N, R, ny, nu): their derivatives with respect to c.
    - `roots` (N, ny, R, nu, r): a square root of their covariance given c, for noise of variance 1.
    - `noise` (ny,): standard deviation of what the numerators do not explain.
    - `distortion`: whether a part of second order was taken into account.
    - `result`: code of `Result`, OK or NOT_CONVERGED.
    - `n_sections`, `inputs`, `outputs`. `lead`: the first lag of the numerators is -lead, where the
      records say so.
    """

    multipliers: Complex[np.ndarray, " d"]
    coefficients: Float[np.ndarray, " d"]
    covariance: Float[np.ndarray, "d d"]
    numerators: Float[np.ndarray, "N R ny nu"]
    slopes: Float[np.ndarray, "d N R ny nu"]
    roots: Float[np.ndarray, "N ny R nu r"]
    noise: Float[np.ndarray, " ny"]
    covariance_freedom: float = eqx.field(static=True)
    result: int = eqx.field(static=True)
    n_sections: int = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    lead: int = eqx.field(static=True, default=0)
    distortion: bool = eqx.field(static=True, default=False)

    @checked
    def impulse_response(self, n_lags: PeriodCount) -> Float[np.ndarray, "N lags ny nu"]:
        """Markov parameters: the response at section n to a unit input r sections earlier."""
        N, R = self.numerators.shape[:2]
        h = np.zeros((N, max(self.lead + n_lags, R), *self.numerators.shape[2:]))
        h[:, :R] = self.numerators
        for r in range(N, h.shape[1]):
            for j, c in enumerate(self.coefficients[: r // N], 1):
                h[:, r] -= c * h[:, r - j * N]
        return h[:, self.lead : self.lead + n_lags]

    @checked
    def htf(self, f: Scalar | Vector, harmonics: Harmonics | None = None) -> HTF:
        r"""The harmonic transfer functions at frequencies f (F,), cycles per period, and variances.

        Only where the inputs had power; elsewhere the variance is large, or there is none at
        all. It is that of white noise of the numerators, and of c as its covariance says.
        """
        f = np.atleast_1d(np.asarray(f, float))
        harmonics = check_harmonics(harmonics, self.n_sections)
        N, R, ny, nu = self.numerators.shape
        powers = np.exp(-2j * np.pi / N * f[:, None] * (np.arange(R) - self.lead))
        period_delay = np.exp(-2j * np.pi * f)
        below = chi(period_delay, self.coefficients)
        n = np.arange(N)
        to_harmonics = np.exp(-2j * np.pi * np.outer(harmonics, n) / N) / N

        def sum_up(b):  # (..., N, R, ny, nu) -> (..., M, F, ny, nu)
            G = np.einsum("fr,...nrij->...nfij", powers, b) / below[:, None, None]
            return np.einsum("mn,...nfij->...mfij", to_harmonics, G)

        H = sum_up(self.numerators)
        delays = period_delay ** np.arange(1, len(self.coefficients) + 1)[:, None]
        slope = sum_up(self.slopes) - (delays / below)[:, None, :, None, None] * H
        by_c = np.einsum("amfij,ab,bmfij->mfij", slope, self.covariance, slope.conj()).real
        spread = np.tensordot(powers, self.roots, axes=(1, 2))  # (F, N, ny, nu, r)
        by_b = (np.abs(spread) ** 2).sum(axis=(1, 4)) / N**2 / np.abs(below)[:, None, None] ** 2
        variance = by_c + by_b * self.noise[:, None] ** 2
        variance = np.where(np.isnan(variance), np.inf, variance)  # nothing is known
        return HTF(f, H, harmonics, N, self.inputs, self.outputs, "series fit", variance=variance)

    def __repr__(self) -> str:
        return f"SeriesFit(multipliers {self.show_multipliers()}; {self._about()})"

    def _about(self) -> str:
        state = "" if self.result == Result.OK else f"; {Result(self.result).message}"
        noise = ", ".join(
            f"{name} {number(x, 3, unit_of(name))}"
            for name, x in zip(self.outputs, self.noise, strict=True)
        )
        return f"noise {noise}; {self.n_sections} sections, {self.numerators.shape[1]} lags{state}"
