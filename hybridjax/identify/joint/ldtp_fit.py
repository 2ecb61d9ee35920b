"""A state-space model fitted to harmonic transfer functions, with its uncertainty."""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Scalar, Vector
from ..._core.results import Result
from ..._core.signal import unit_of
from ..._core.text import number
from ...errors import DefinitionError
from ...linear.frequency_response import Harmonics, check_harmonics
from ...linear.htf import HTF
from ...linear.ldtp import LDTP
from ..multipliers.multiplier_estimate import MultiplierEstimate
from .coordinates import LocalCoordinates
from .frequency import transfer, transfer_slopes
from .noise import noise_spectrum
from .prediction.predictor import Predictor


class LDTPFit(MultiplierEstimate):
    r"""A linear periodic model with the likelihood's maximum, and how sure it is.

    **Fields:**

    - `model`: the fitted `LDTP`. The coordinates of its states are arbitrary; multipliers and HTFs
      do not depend on them, and have standard errors.
    - `multipliers` (d,): by decreasing modulus, d the smallest dimension of any x[n].
      `coefficients` (d,): of their polynomial.
    - `covariance` (d, d): of the coefficients, with `covariance_freedom` degrees of freedom
      (infinite where variances were given). `standard_errors`, `contains` and `ellipse` give what
      follows for multipliers.
    - `unknowns`: how many numbers were fitted, without the choice of coordinates.
    - `cost`: sum of squares of the misfit in units of the errors' standard deviations, and
      `freedom`, the number that it is expected to be. Where no variances were given the unit is
      what the misfit itself says, and the two are equal.
    - `result`: code of `Result`, OK or NOT_CONVERGED.
    - `harmonics` (M,): those that were fitted.
    - `noise`: what makes the noise of the outputs of independent white inputs with variance one, as
      an `LDTP`; None where it was not fitted, that is for HTFs.
    """

    model: LDTP
    multipliers: Complex[np.ndarray, " d"]
    coefficients: Float[np.ndarray, " d"]
    covariance: Float[np.ndarray, "d d"]
    covariance_freedom: float = eqx.field(static=True)
    cost: float = eqx.field(static=True)
    freedom: int = eqx.field(static=True)
    result: int = eqx.field(static=True)
    harmonics: tuple[int, ...] = eqx.field(static=True)
    noise: LDTP | None
    _coordinates: LocalCoordinates
    _root: Float[np.ndarray, "P r"]
    _scale: Float[np.ndarray, " ny"]

    @property
    def unknowns(self) -> int:
        return self._coordinates.size

    @property
    def n_sections(self) -> int:
        return self.model.n_sections

    @property
    def inputs(self) -> tuple[str, ...]:
        return self.model.inputs

    @property
    def outputs(self) -> tuple[str, ...]:
        return self.model.outputs

    @checked
    def htf(self, f: Scalar | Vector, harmonics: Harmonics | None = None) -> HTF:
        """The HTFs of the fitted model at frequencies f (F,), cycles per period, and variances.

        The variance is that of the fit, to first order. It is large where the data say nothing.
        """
        f = np.atleast_1d(np.asarray(f, float))
        harmonics = (
            self.harmonics if harmonics is None else check_harmonics(harmonics, self.n_sections)
        )
        H = transfer(self._coordinates.model, f, harmonics)
        variance = np.zeros(H.shape)
        for rows, slopes in transfer_slopes(self._coordinates, f, harmonics):
            spread: Any = np.tensordot(self._root.T, slopes, 1)
            variance[:, rows] = (np.abs(spread) ** 2).sum(axis=0)
        size = self._scale[:, None]
        return HTF(
            f, H * size, harmonics, self.n_sections, self.inputs, self.outputs, "fit",
            variance=variance * size**2,
        )  # fmt: skip

    @checked
    def noise_spectrum(
        self, f: Scalar | Vector, harmonics: Harmonics | None = None
    ) -> Float[np.ndarray, "M F ny"]:
        """The spectrum of the fitted noise where the harmonics of lines f (F,) lie, as
        `hj.identify.noise_spectrum` gives it.

        **Raises:** `DefinitionError` if no noise was fitted.
        """
        if self.noise is None:
            raise DefinitionError(
                "no noise was fitted: HTFs tell its variance at their own lines only "
                "(`HTF.variance`); fit to series."
            )
        return noise_spectrum(self.noise, f, harmonics)

    @property
    def predictor(self) -> Predictor | None:
        """Of outputs one step ahead; None where no noise was fitted."""
        if self.noise is None:
            return None
        model, size = self._coordinates.model, self._scale[:, None]
        D = np.asarray(self.noise.D)
        model = model._replace(
            C=[size * C for C in model.C],
            D=[size * x for x in model.D],
            K=[K / size.T if K.shape[1] else K for K in model.K],
        )
        return Predictor(model, D @ D.swapaxes(1, 2), self.inputs, self.outputs)

    def __repr__(self) -> str:
        return f"LDTPFit(multipliers {self.show_multipliers()}; {self._about()})"

    def _about(self) -> str:
        state = "" if self.result == Result.OK else f"; {Result(self.result).message}"
        about = f"misfit {self.cost:.6g}, expected {self.freedom}"
        if self.noise is not None:
            size = np.sqrt((np.asarray(self.noise.D) ** 2).sum(axis=2).mean(axis=0))
            each = zip(self.outputs, size, strict=True)
            shown = ", ".join(f"{name} {number(x, 3, unit_of(name))}" for name, x in each)
            about = f"errors one step ahead {shown}"
        return f"{about}; {self.unknowns} unknowns, {self.n_sections} sections{state}"
