"""A state-space model fitted to harmonic transfer functions or series, with its uncertainty."""

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
from ..denominator import multipliers_of
from ..multiplier_estimate import MultiplierEstimate
from .characteristic import characteristic_slopes
from .coordinates import LocalCoordinates
from .frequency import transfer, transfer_slopes
from .minimize import Minimum
from .noise import noise_spectrum
from .normal_equations import Spread
from .prediction.predictor import Predictor


# Cost, in units of the expected, above which a `repr` says that a model misfits. Doubled: errors
# 1.4 times as large as their variances say go unmentioned.
_TOO_LARGE = 2.0


class LDTPFit(MultiplierEstimate):
    r"""A linear periodic model with the likelihood's maximum, and how sure it is.

    **Fields:**

    - `model`: the fitted `LDTP`. The coordinates of its states are arbitrary; multipliers and HTFs
      do not depend on them, and have standard errors.
    - `multipliers` (d,): by decreasing modulus, d the smallest dimension of any x[n].
      `coefficients` (d,): of their polynomial.
    - `covariance` (d, d): of the coefficients, with `covariance_freedom` degrees of freedom
      (infinite where variances were given). `standard_errors`, `contains` and `ellipse` give what
      follows for multipliers. Infinite where the data do not show all coefficients.
    - `unknowns`: how many numbers were fitted, without the choice of coordinates.
    - `cost`: sum of squares of the misfit in units of the errors' standard deviations, and
      `freedom`, the number that it is expected to be. A cost of more says that the dimensions are
      too few, or the minimum only a local one. Where no variances were given, as always for series,
      the unit is what the misfit itself says, and the two are equal: `hj.validate` tells then.
    - `result`: code of `Result`, OK or NOT_CONVERGED.
    - `harmonics` (M,): those that were fitted; of series, all N.
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
    _hidden: Float[np.ndarray, "P h"]
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

        The variance is that of the fit, to first order. It is infinite where the data say nothing,
        as it may be at harmonics that were not fitted.
        """
        f = np.atleast_1d(np.asarray(f, float))
        harmonics = (
            self.harmonics if harmonics is None else check_harmonics(harmonics, self.n_sections)
        )
        H = transfer(self._coordinates.model, f, harmonics)
        variance, spread = np.zeros(H.shape), Spread(self._root, self._hidden)
        for rows, slopes in transfer_slopes(self._coordinates, f, harmonics):
            variance[:, rows] = spread.variance(slopes)
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
        """Of outputs one step ahead, as `hj.validate` uses it; None where no noise was fitted."""
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
        if self.cost > _TOO_LARGE * self.freedom:
            about += (
                " (errors are larger than their variances: too few dimensions, or a local minimum "
                "that another guess avoids)"
            )
        if self.noise is not None:
            size = np.sqrt((np.asarray(self.noise.D) ** 2).sum(axis=2).mean(axis=0))
            each = zip(self.outputs, size, strict=True)
            shown = ", ".join(f"{name} {number(x, 3, unit_of(name))}" for name, x in each)
            about = f"errors one step ahead {shown}"
        return f"{about}; {self.unknowns} unknowns, {self.n_sections} sections{state}"


def finished(
    found: Minimum,
    model: LDTP,
    scale: Float[np.ndarray, " ny"],
    harmonics: tuple[int, ...],
    freedom: int,
    known: bool,
    noise: LDTP | None = None,
) -> LDTPFit:
    """The fit that ends at a minimum.

    **Arguments:** `model`, with the outputs in their own units, which are `scale`; `known`, whether
    the variance of errors was, or the misfit says it.
    """
    c, slopes = characteristic_slopes(found.coordinates)
    spread = found.equations.spread(1.0 if known else found.cost / freedom)
    return LDTPFit(
        model=model,
        multipliers=multipliers_of(c),
        coefficients=c,
        covariance=spread.covariance(slopes),
        covariance_freedom=np.inf if known else float(freedom),
        cost=found.cost if known else float(freedom),
        freedom=freedom,
        result=Result.OK if found.converged else Result.NOT_CONVERGED,
        harmonics=harmonics,
        noise=noise,
        _coordinates=found.coordinates,
        _root=spread.root,
        _hidden=spread.hidden,
        _scale=scale,
    )
