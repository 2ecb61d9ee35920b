"""A step of a chart, with its derivative columns beside the state.

The step is that of a solver of diffrax. Of an implicit one, the stages are solved for by this
package, whose iterations carry derivatives.
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
from ..runge_kutta import take_step


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
    """A state and its columns after a step of an implicit method from t to t + h, as derivatives of
    the whole step, and the state's estimated error."""

    def whole(q, u):
        def of_lane(t, q):
            return s.field(a, t, q, u)

        def lanes(t, q):
            return jax.vmap(lambda q: of_lane(t[0], q), -1, -1)(q)

        end = take_step(method, lanes, t[None], q[:, None], h[None], still=lanes)
        return end.q[:, 0], end.error[:, 0]

    still = jnp.zeros(s.nu)
    if inputs is None:
        step = jax.linearize(lambda q: whole(q, still), y[0], has_aux=True)
        end, linear, error = step
        columns = jax.vmap(linear)(y[1:])
    else:
        end, linear, error = jax.linearize(whole, y[0], still, has_aux=True)
        columns = jax.vmap(linear)(y[1:], inputs)
    return jnp.concatenate([end[None], columns]), error
