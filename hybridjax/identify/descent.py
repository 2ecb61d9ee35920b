"""Least squares: nonlinear by scipy's trust-region method (`least_squares`), and linearized
(`NormalEquations`, `Spread`).

Fits with eliminated linear unknowns call `least_squares` with a function that returns residuals and
their Jacobian. `fit_ldtp` makes its own steps from `NormalEquations`. If a fit ends too early or
too late, look at `settled_gain`, and at the scaling of the unknowns in `least_squares`; if a step
raises the cost, at signs: `least_squares` takes the derivatives of residuals, `NormalEquations`
those of predictions, which are the opposite. If an error bar is infinite, look at `Spread`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Inexact


Coefficients = Float[np.ndarray, " d"]
Gradient = tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n d"]]
"""Residuals, and their Jacobian."""

# Singular values, steps and numbers below this, relative to the largest of their kind, are rounding
# errors. Smaller: rounding counts as information; larger: information of exact data is lost.
ROUNDING = 1e-12
# If the leading coefficient of a null vector, relative to its largest entry, is below this, c would
# overflow: the solution of the linearized problem is not used.
NO_LEADING_COEFFICIENT = 1e-8
# A descent ends if the expected relative decrease of the cost is below this. Coefficients then
# differ from the minimum by 1e-7 standard errors, times the square root of the number of residuals.
# Smaller: steps are lost in rounding.
_SETTLED_GAIN = 1e-14
# If a descent has decreased the cost by more than this, in units of the new cost, it begins again
# with new scales. Smaller: a start that is far away decides how close the end is; larger: descents
# begin again in vain.
_MUCH_LOWER = 0.5
# Options of a rough fit: its number of steps, and the decrease of the cost, in units of the noise,
# below which it ends. More steps or a smaller decrease: the fit follows noise. Fewer or larger: the
# fit hardly moves.
ROUGH: dict[str, Any] = {"max_steps": 4, "settled_gain": 5.0}


def positive(size: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Return `size` with 1 in place of 0, as a divisor."""
    return np.where(size > 0, size, 1.0)


def without(
    basis: Float[np.ndarray, "*b n r"], x: Float[np.ndarray, "*b n k"]
) -> Float[np.ndarray, "*b n k"]:
    """Return columns without their part in an orthonormal basis."""
    return x - basis @ (basis.mT @ x)


def least_squares(
    linearize: Callable[[Coefficients], Gradient],
    start: Coefficients,
    max_steps: int = 50,
    settled_gain: float = 0.0,
) -> tuple[Coefficients, bool]:
    """Minimize a sum of squares.

    The unknowns are transformed so that, at the start, the Jacobian has orthonormal columns. The
    square of the gradient is then the decrease of the cost that a step is expected to make. If this
    decrease does not matter, no step is tried, so that a descent from a minimum takes one
    evaluation.

    **Arguments:** `linearize(c)` returns the residuals (n,) and their Jacobian (n, d).
    `max_steps`: default 50. `settled_gain`: a decrease of the sum that does not matter.

    **Returns:** the last coefficients, and whether they are a minimum.
    """
    from scipy import optimize  # (a third of a second)

    last: dict[bytes, Gradient] = {}

    def at(c: Coefficients) -> Gradient:
        key = c.tobytes()
        if key not in last:
            last.clear()
            with np.errstate(all="ignore"):
                last[key] = linearize(c)
        return last[key]

    c = start
    while True:
        residual, jacobian = at(c)
        cost = float(residual @ residual)
        if not np.isfinite(cost) or not np.isfinite(jacobian).all():
            return c, False
        if cost == 0 or not jacobian.any():
            return c, True
        unit = np.sqrt(cost)
        _, size, combinations = np.linalg.svd(jacobian, full_matrices=False)
        visible = np.maximum(size, ROUNDING * size[0])
        to_c = unit * combinations.T / visible
        end = optimize.least_squares(
            lambda x: at(c + to_c @ x)[0] / unit,  # noqa: B023
            np.zeros(to_c.shape[1]),
            # (SciPy declares no types: pyright takes those of the defaults.)
            lambda x: at(c + to_c @ x)[1] @ to_c / unit,  # noqa: B023  # pyright: ignore[reportArgumentType]
            gtol=np.sqrt(max(_SETTLED_GAIN, settled_gain / cost)),
            xtol=ROUNDING,
            ftol=None,  # pyright: ignore[reportArgumentType]
            max_nfev=max_steps + 1,
        )
        c = c + to_c @ end.x
        max_steps -= end.nfev - 1
        if end.status < 1 or max_steps < 1 or 2 * end.cost > _MUCH_LOWER:
            return c, bool(end.status > 0)


class NormalEquations:
    """Linearized least squares for residuals r with the derivatives -J.

    **Arguments:** `gram` (P, P), $J^T J$. `gradient` (P,), $J^T r$.
    """

    def __init__(
        self, gram: Float[np.ndarray, "P P"], gradient: Float[np.ndarray, " P"]
    ):
        self.gradient = gradient
        size = np.sqrt(np.maximum(np.diag(gram), 0))
        self._size = positive(size)
        self._values, self._vectors = np.linalg.eigh(
            gram / self._size / self._size[:, None]
        )
        self._slope = self._vectors.T @ (gradient / self._size)
        self._shown = self._values > ROUNDING * self._values[-1]

    def step(self, damping: float) -> tuple[Float[np.ndarray, " P"], float]:
        """Return a Levenberg-Marquardt step and the decrease of the cost expected from it.

        Without damping, undetermined combinations of unknowns do not change.
        """
        values = np.maximum(self._values, 0) + damping
        if not damping:
            values = np.where(self._shown, values, np.inf)
        part = self._slope / values
        return self._vectors @ part / self._size, float(part @ self._slope)

    def spread(self, unit: float = 1.0) -> "Spread":
        """Return the uncertainty of the solution, for errors with the variance `unit`."""
        vectors = self._vectors / self._size[:, None]
        least = ROUNDING * self._values[-1]
        root = vectors * np.sqrt(unit / np.maximum(self._values, least))
        return Spread(root[:, self._shown], root[:, ~self._shown])


class Spread(NamedTuple):
    """The uncertainty of combinations of unknowns."""

    root: Float[np.ndarray, "P r"]
    """R with $R R^T = v (J^T J)^+$, without undetermined combinations."""
    hidden: Float[np.ndarray, "P h"]
    """A lower bound of such a root for the undetermined combinations, with the smallest eigenvalue
    above rounding."""

    def variance(
        self, slopes: Inexact[np.ndarray, "P *rest"]
    ) -> Float[np.ndarray, "*rest"]:
        """Return the variance of numbers with these derivatives; infinite if undetermined."""
        shown, hidden = (
            (np.abs(np.tensordot(x.T, slopes, 1)) ** 2).sum(axis=0)
            for x in (self.root, self.hidden)
        )
        return np.where(hidden > shown, np.inf, shown)

    def covariance(self, slopes: Float[np.ndarray, "d P"]) -> Float[np.ndarray, "d d"]:
        """Return the covariance of numbers with these derivatives. If one variance is infinite, all
        entries are."""
        if np.isinf(self.variance(slopes.T)).any():
            return np.full((len(slopes), len(slopes)), np.inf)
        half = slopes @ self.root
        return half @ half.T
