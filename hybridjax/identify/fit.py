"""`Fit`: the base class of all fits to data.

It has the fields and methods that every fit shares: multipliers, covariance, intervals, findings,
and how a fit is printed. Subclasses say what their numbers are (`_estimates`), how they are
summarized (`_summary`, `_page`), and which model can be simulated (`_linear_model`).

The order of what is printed, and the form of intervals, are those of all fits: a change here
changes every fit. If a number is wrong, look at the subclass.
"""

from abc import abstractmethod
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Probability
from .._core.findings import Finding, print_findings
from .._core.html import card, text
from .._core.results import Result
from .._core.showable import WithMultipliers
from ..errors import DefinitionError
from ..linear.ldtp import LDTP


class Fit(WithMultipliers, eqx.Module):
    """A fit to data.

    **Fields** of all fits:

    - `multipliers` (d,): the Floquet multipliers, by decreasing modulus.
    - `covariance` (p, p): covariance of the p fitted numbers, which are parameters, or the
      coefficients of the polynomial whose roots are the multipliers. `covariance_dof`: degrees of
      freedom with which it was estimated; infinite where it is exact.
    - `model`: the fitted system, which simulates: an `LDTP` or a `HybridSystem`; None where only
      multipliers and responses were fitted.
    - `noise`: standard deviation of the noise of each output; None if the data come with variances,
      or if nothing determines it.
    - `dof`: degrees of freedom of the residuals: numbers in the data less unknowns.
    - `result`: code of `Result`, OK or NOT_CONVERGED.
    - `findings`: the reasons to doubt the fit, as `Finding`s; empty if there are none.

    All fits have `modulus`, `standard_errors` and `interval`; `compare(other)`, which compares with
    a truth or with another fit and has a `p_value`; `contains(truth)`, whether a truth lies in the
    confidence region of a level; `plot` and `to_pandas`. `hj.save` writes them.
    """

    if TYPE_CHECKING:
        # (Fields of some fits, and properties of others: neither can be declared for all of them.)
        @property
        def multipliers(self) -> Complex[np.ndarray, " d"]: ...
        @property
        def covariance(self) -> Float[np.ndarray, "p p"]: ...
        @property
        def covariance_dof(self) -> float: ...
        @property
        def model(self) -> Any: ...
        @property
        def noise(self) -> Float[np.ndarray, " ny"] | None: ...
        @property
        def cost(self) -> float: ...
        @property
        def dof(self) -> float: ...
        @property
        def result(self) -> int: ...

        # (The arguments of these two depend on the type of fit.)
        def compare(self, *args: Any, **options: Any) -> Any: ...
        def contains(self, *args: Any, **options: Any) -> Any: ...

    @property
    @abstractmethod
    def standard_errors(self) -> Float[np.ndarray, " k"]:
        """Standard error of each estimated number."""

    @abstractmethod
    def _estimates(self) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
        """Return the real numbers for which `interval` gives bounds, and the standard errors of
        these numbers."""

    def _linear_model(self, data: Any) -> Any:
        """Return the `LDTP` that is simulated on data to validate the fit.

        **Raises:** `DefinitionError` for a fit that has no model, or none with the data's sections.
        """
        if isinstance(self.model, LDTP):
            return self.model
        raise DefinitionError(
            f"{type(self).__name__} has no model that can be simulated: validate that of "
            "`hj.fit_series` or `hj.fit_ldtp`."
        )

    @abstractmethod
    def _summary(self) -> str:
        """Return the part of the `repr` before the findings."""

    @abstractmethod
    def _page(self) -> tuple[str, ...]:
        """Return what the fit belongs to, and the parts of its page (HTML) before the findings."""

    @checked
    def interval(self, level: Probability = 0.95) -> Float[np.ndarray, "k 2"]:
        """Return bounds that hold each true value with this probability, to first order.

        The values are the moduli of the multipliers. For a fit of physical parameters,
        they are the parameters. Bounds are infinite where the data do not determine a
        value.

        **Example:**

        ```python
        low, high = fit.interval(0.95)[0]
        print(f"modulus {fit.modulus[0]:.3f}, 95 %: {low:.3f} to {high:.3f}")
        ```
        """
        from scipy import special  # (a fifth of a second)

        values, errors = self._estimates()
        tail = (1 + level) / 2
        reach = special.ndtri(tail)
        if np.isfinite(self.covariance_dof):
            reach = special.stdtrit(self.covariance_dof, tail)
        margins = reach * errors
        return np.stack([values - margins, values + margins], axis=1)

    def __repr__(self) -> str:
        return "\n".join(filter(None, [self._summary(), self._shown_findings()]))

    def _repr_html_(self) -> str:
        belongs_to, *parts = self._page()
        return card(
            type(self).__name__, belongs_to, *parts, text(self._shown_findings())
        )

    def _shown_findings(self) -> str:
        return print_findings(self.findings, "  ")


class WithCost:
    """A fit that minimizes a sum of squares."""

    if TYPE_CHECKING:
        cost: float
        dof: float

    @property
    def chi2_per_dof(self) -> float:
        """Chi-square (`cost`) per degree of freedom (`dof`): about 1 if the model and the standard
        deviations of the data are right."""
        return self.cost / self.dof if self.dof else np.nan


def not_converged(result: int) -> list[Finding]:
    """Return a finding about the result of an iteration that did not end at a minimum."""
    if result == Result.OK:
        return []
    return [Finding("no convergence", f"{Result(result).message}.")]
