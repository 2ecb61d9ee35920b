"""Runge-Kutta methods by which charts are integrated: those of diffrax, and `Radau` of this
package.

`as_method` converts any of these to a `Method`: the coefficients, in the form that
`engine/runge_kutta.py` uses. `solvers` checks what a user gives for a system (one solver, or one
for each chart). A further kind of solver is a case in `_as_method`. A `Method` must hold tuples,
numbers and text only: solvers are compared and hashed.

If a solver is refused, look at the conditions in `_as_method`; if its errors are of the wrong
order, at its coefficients (`_from_tableau`, `_radau`) and at `Method.order`.
"""

import functools as ft
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._core.boundary.checked import checked
from .._core.boundary.values import show
from ..errors import DefinitionError


if TYPE_CHECKING:
    import diffrax

Row = tuple[float, ...]


class Method(NamedTuple):
    """A Runge-Kutta method whose first stage is explicit: with increments w_i = h f(t + c_i h, y_i)
    at y_i = q + sum_j a_ij w_j, a step ends at q + sum_i b_i w_i."""

    name: str
    a: tuple[Row, ...]
    b: Row
    c: Row
    error: Row
    """Weights of the increments in the estimate of the error."""
    order: float
    """The error that controls the steps grows as this power of the step length."""
    gain: float = 1.0
    """The error is the estimate to this power."""
    rough: Row = ()
    """Weights of the increments in an estimate of one order less, needed if `gain` is not 1."""
    filter: float = 0.0
    """The estimate is multiplied by (1 - h g J)^-1, with this g."""

    @property
    def implicit(self) -> bool:
        return bool(np.any(np.triu(np.array(self.a))))


@checked
class Radau(eqx.Module):
    """The implicit Radau IIA method of order 2 `stages` - 1, for stiff charts at high accuracy.

    E. Hairer and G. Wanner, Solving Ordinary Differential Equations II, 2nd ed. (1996), sections
    IV.5 and IV.8: collocation at the Radau points, L-stable and stiffly accurate. The embedded
    error estimate has order `stages`. Where the solution is smooth, a power of this estimate gives
    the error of the step.

    **Arguments:** `stages`, 3, 5 or 7.

    **Example:**

    ```python
    stiff = hj.models.VanDerPol(mu=100.0, solver=hj.systems.Radau())
    ```

    **After:** `hj.HybridSystem`, `hj.orbits.Settings`.
    """

    stages: Literal[3, 5, 7] = eqx.field(static=True, default=5)


if TYPE_CHECKING:
    Solver = diffrax.AbstractSolver | Radau
else:  # diffrax takes a third of a second to import; `as_method` looks at what is given.
    Solver = Any


class ByChart(NamedTuple):
    """Solvers of some charts, by name."""

    names: tuple[str, ...]
    solvers: tuple[Any, ...]

    def __repr__(self):
        return ", ".join(
            f"{name}: {solver}" for name, solver in zip(*self, strict=True)
        )

    def get(self, name: str) -> Any:
        return dict(zip(*self, strict=True)).get(name)


def solvers(
    given: Solver | Method | ByChart | Mapping[str, Solver] | None,
) -> Solver | Method | ByChart | None:
    """A solver as it is, and solvers by the names of charts in a form that can be compared.

    **Raises:** `DefinitionError` for an object that is no solver.
    """
    each = list(given.values()) if isinstance(given, Mapping) else [given]
    for solver in each:
        if not isinstance(solver, Method | eqx.Module | ByChart | None):
            raise _no_solver(solver)
    if isinstance(given, Mapping):
        return ByChart(tuple(given), tuple(given.values()))
    return given


def as_method(solver: Any) -> Method:
    """The Runge-Kutta method of a solver.

    **Raises:** `DefinitionError` for an object that is no Runge-Kutta method with an error
    estimate.
    """
    if not isinstance(solver, Method | eqx.Module):
        raise _no_solver(solver)
    return _as_method(solver)


@ft.lru_cache
def _as_method(solver: Any) -> Method:
    if isinstance(solver, Method):
        return solver
    if isinstance(solver, Radau):
        return _radau(solver.stages)
    import diffrax

    name = type(solver).__name__
    if isinstance(solver, diffrax.ImplicitEuler):
        return Method(
            name, ((0.0, 0.0), (0.0, 1.0)), (0.0, 1.0), (0.0, 1.0), (-0.5, 0.5), 2.0
        )
    tableau = getattr(solver, "tableau", None)
    single = getattr(solver, "term_structure", None) in (
        diffrax.AbstractTerm,
        diffrax.ODETerm,
    )
    adaptive = isinstance(solver, diffrax.AbstractAdaptiveSolver)
    if not (single and adaptive and isinstance(tableau, diffrax.ButcherTableau)):
        raise _no_solver(solver)
    return _from_tableau(name, tableau, float(solver.order(None)))  # pyright: ignore


def _no_solver(given: Any) -> DefinitionError:
    return DefinitionError(
        "a solver must be `hj.systems.Radau()` or a Runge-Kutta method of diffrax with an error "
        "estimate, an explicit first stage and one vector field, "
        "such as `diffrax.Kvaerno5()` (stiff) or "
        f"`diffrax.Tsit5()`, not {show(given)}."
    )


def _from_tableau(name: str, tableau: "diffrax.ButcherTableau", order: float) -> Method:
    """The method of a tableau of diffrax, which lists the lower triangle without its first row.

    **Raises:** `DefinitionError` for an implicit first stage.
    """
    a = np.zeros((tableau.num_stages, tableau.num_stages))
    for k, row in enumerate(tableau.a_lower):
        a[k + 1, : k + 1] = row
    if tableau.a_diagonal is not None:
        a += np.diag(tableau.a_diagonal)
    if a[0, 0] != 0 or tableau.c1 != 0:
        raise _no_solver(name)
    return _method(
        name, a, tableau.b_sol, np.array((0.0, *tableau.c)), tableau.b_error, order
    )


def _method(name: str, a, b, c, error, order: float, **controls: Any) -> Method:
    """A method from arrays of coefficients."""
    rows = tuple(tuple(map(float, row)) for row in a)
    b, c, error = (tuple(map(float, x)) for x in (b, c, error))
    return Method(name, rows, b, c, error, order, **controls)


def _radau(s: int) -> Method:
    """The method of `Radau` with s implicit stages, behind an explicit first stage of weight 0."""
    from scipy import special

    # The Radau points are 1 and zeros of a Jacobi polynomial.
    roots, _ = special.roots_jacobi(s - 1, 1, 0)
    c = np.append((1 + roots) / 2, 1.0)
    # Integrals of the Lagrange polynomials from 0 to each point.
    x, weights = np.polynomial.legendre.leggauss(s)
    rows = []
    for end in c:
        values = [_lagrange(c, end * (1 + z) / 2) for z in x]
        rows.append(end / 2 * weights @ values)
    a = np.array(rows)
    eigenvalues = np.linalg.eigvals(a)
    gamma = float(eigenvalues[np.argmin(np.abs(eigenvalues.imag))].real)
    # The quadrature formula of order s that has the weight gamma at the start of the step.
    powers = np.vander(c, s, increasing=True).T
    is_first = np.arange(s) == 0
    moments = 1 / np.arange(1, s + 1) - gamma * is_first
    other_weights = np.linalg.solve(powers, moments)
    error = np.concatenate([[gamma], other_weights - a[-1]])
    full = np.pad(a, ((1, 0), (1, 0)))
    return _method(
        f"Radau({s})",
        full,
        full[-1],
        np.concatenate([[0.0], c]),
        error,
        2.0 * s,
        gain=2 * s / (s + 1),
        filter=gamma,
        rough=tuple(-_lagrange(c, 0.0) @ full[1:]),
    )


def _lagrange(c: Float[np.ndarray, " s"], x: float) -> Float[np.ndarray, " s"]:
    """Values at x of the Lagrange polynomials at the points c."""
    others = [np.delete(c, j) for j in range(len(c))]
    return np.array(
        [np.prod((x - o) / (y - o)) for y, o in zip(c, others, strict=True)]
    )
