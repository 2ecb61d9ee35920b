"""A step of a chart, with its derivative columns beside the state.

Steps of explicit methods are those of a solver of diffrax. For implicit methods, this package
solves for the stages, by iterations that carry derivatives.
"""

import functools as ft
from collections.abc import Callable
from typing import Any, ClassVar, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...systems.solver import Method
from ...systems.structure import Structure
from ..runge_kutta import StageEquations, errors, increments


# Change at which Newton's method for the stages of a state ends, relative to its size. Larger: two
# further steps do not reach rounding in the columns. Smaller: they follow too late.
_NEAR = 1e-9

Solver: TypeAlias = Any
"""A solver of diffrax, or an implicit `Method`."""


@ft.lru_cache
def solver_of(method: Method, reverse: bool = False) -> Solver:
    """The solver of diffrax with the coefficients of an explicit method; an implicit one itself.

    **Arguments:** `reverse`: whether reverse mode will differentiate its steps.
    """
    if method.implicit:
        return method
    import diffrax

    a, c = np.array(method.a), np.array(method.c)
    coefficients = diffrax.ButcherTableau(
        a_lower=tuple(a[i, :i] for i in range(1, len(c))),
        b_sol=np.array(method.b),
        b_error=np.array(method.error),
        c=c[1:],
    )

    class Explicit(diffrax.AbstractERK):
        tableau: ClassVar = coefficients
        term_structure: ClassVar = diffrax.AbstractTerm
        interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

        def order(self, terms):
            return round(method.order) - 1

    # (The stages are a loop: unrolled, they compile for twice as long and run 5 to 20 % faster.)
    return Explicit(scan_kind="bounded" if reverse else "lax")


def field(s: Structure, a: int, t, q) -> Float[Array, " n"]:
    """The field of chart a, without inputs."""
    return s.field(a, t, q, jnp.zeros(s.nu))


def rates(
    s: Structure, a: int, t, y: Float[Array, "1+C n"], inputs
) -> Float[Array, "1+C n"]:
    """Rates of a state and of its columns.

    **Arguments:** `inputs`: of each column; None if there are none.
    """
    if len(y) == 1:
        return field(s, a, t, y[0])[None]
    if inputs is None:
        rate, linear = jax.linearize(lambda q: field(s, a, t, q), y[0])
        columns = jax.vmap(linear)(y[1:])
    else:
        at = y[0], jnp.zeros(s.nu)
        rate, linear = jax.linearize(lambda q, u: s.field(a, t, q, u), *at)
        columns = jax.vmap(linear)(y[1:], inputs)
    return jnp.concatenate([rate[None], columns])


def unit_step(solver: Solver, rates: Callable, y: Any) -> tuple[Any, Any]:
    """The end of an explicit step of `rates(t, y)` from t = 0 to 1, and its estimated error."""
    import diffrax

    term = diffrax.ODETerm(lambda t, y, _: rates(t, y))
    times = jnp.zeros(()), jnp.ones(())
    begun = solver.init(term, *times, y, None)
    end, error, _, _, _ = solver.step(term, *times, y, None, begun, False)
    return end, error


def is_implicit(solver: Solver) -> bool:
    return isinstance(solver, Method)


def implicit_step(
    s: Structure,
    a: int,
    method: Method,
    t,
    y: Float[Array, "1+C n"],
    h,
    inputs: Float[Array, "C nu"] | None,
) -> tuple[Float[Array, "1+C n"], Float[Array, " n"]]:
    """A state and its columns after a step of an implicit method from t to t + h, and the state's
    estimated error.

    Newton's method for the stages of the state comes near their solution. Two steps of it follow
    for the state and its columns together, with the same matrix: the second one gives them their
    first derivatives in directions from outside, by the implicit function theorem.
    """
    A = np.array(method.a)
    b = np.array(method.b)
    c = np.array(method.c)

    def lanes(t, q):
        def rate(q):
            return field(s, a, t[0], q)

        return jax.vmap(rate, -1, -1)(q)

    def rates_at(t, y):
        return rates(s, a, t, y.T, inputs).T

    state = y[0][:, None]
    point = (t[None], state, h[None])
    begin = jax.lax.stop_gradient(point)
    near, _, J = increments(method, lanes, *begin, small=_NEAR)
    equations = StageEquations.at(method, lanes, *begin, near)
    # (From here on, the columns stand where lanes do.)
    directions = len(y) - 1
    no_columns = jnp.zeros((*near.shape[:2], directions))
    w = jnp.concatenate([near, no_columns], axis=2)
    for _ in range(2):
        stages = y.T + jnp.tensordot(A, w, 1)
        along = jax.vmap(rates_at)(t + c * h, stages)
        change = equations.solve(h * along - w)
        w = w + change
    change_of_state = jnp.abs(change[..., :1])
    left = jnp.max(change_of_state, axis=0)
    of_state = jax.lax.stop_gradient((w[..., :1], left))
    _, error = errors(method, *of_state, J, begin[2])
    end = y + jnp.tensordot(b, w, 1).T
    return end, error[:, 0]
