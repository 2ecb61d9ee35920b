"""One step of a chart: the end of the step, and its estimated error.

A step moves an array y (1 + C, n), whose rows are

| row | | obeys |
|---|---|---|
| 0 | the state q | q' = f(t, q, 0) |
| 1 to C | columns v: derivatives of q in some directions | v' = f_q v + f_u w, with w in `inputs` |

`unit_step` takes explicit steps, with a solver of diffrax; `rates` has the right sides above.
`implicit_step` solves for the stages of an implicit method, by iterations that carry derivatives.
If states are right and derivatives are wrong, look in `rates`, or in the two last Newton steps of
`implicit_step`. If states themselves are wrong, compare with `take_step` in `runge_kutta.py`, which
has the same coefficients. `bodies.py` calls these functions. The state must stay in row 0, and the
Newton steps of an implicit step must stay two: the second one gives the derivatives.
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
from ..runge_kutta import StageEquations, errors, increments, with_derivatives


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
    # (Importing diffrax takes a second, which only programs need.)
    import diffrax

    a = np.array(method.a)
    c = np.array(method.c)
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


def is_implicit(solver: Solver) -> bool:
    return isinstance(solver, Method)


# Right sides.


def field(s: Structure, a: int, t, q: Float[Array, " n"]) -> Float[Array, " n"]:
    """The field of chart a, without inputs."""
    return s.field(a, t, q, jnp.zeros(s.nu))


def rates(
    s: Structure,
    a: int,
    t,
    y: Float[Array, "1+C n"],
    inputs: Float[Array, "C nu"] | None,
) -> Float[Array, "1+C n"]:
    """Rates of a state and of its columns.

    **Arguments:** `inputs`: the constant input in the direction of each column; None for columns
    without inputs.
    """
    q = y[0]
    columns = y[1:]
    if not len(columns):
        return field(s, a, t, q)[None]
    if inputs is None:
        rate, derivative = jax.linearize(lambda q: field(s, a, t, q), q)
        column_rates = jax.vmap(derivative)(columns)
    else:
        no_input = jnp.zeros(s.nu)
        rate, derivative = jax.linearize(lambda q, u: s.field(a, t, q, u), q, no_input)
        column_rates = jax.vmap(derivative)(columns, inputs)
    return jnp.concatenate([rate[None], column_rates])


# Steps.


def unit_step(solver: Solver, rates: Callable, y: Any) -> tuple[Any, Any]:
    """The end of an explicit step of `rates(t, y)` from t = 0 to 1, and its estimated error."""
    import diffrax

    term = diffrax.ODETerm(lambda t, y, _: rates(t, y))
    times = jnp.zeros(()), jnp.ones(())
    solver_state = solver.init(term, *times, y, None)
    end, error, _, _, _ = solver.step(term, *times, y, None, solver_state, False)
    return end, error


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

    The unknowns are the increments w of all stages. They are found in two parts:

    1. Newton's method for the state alone comes near its increments. It carries no derivatives.
    2. Two Newton steps for the state and its columns together, with one matrix. The second one
       gives the increments their first derivatives in directions from outside, by the implicit
       function theorem.
    """

    # (`runge_kutta.py` has lanes on the last axis. Here, the only lane is the state.)
    def field_of_lane(t, q):
        def rate(q):
            return field(s, a, t[0], q)

        return jax.vmap(rate, -1, -1)(q)

    state = y[0][:, None]
    begin = jax.lax.stop_gradient((t[None], state, h[None]))
    near, _, jacobian = increments(method, field_of_lane, *begin, small=_NEAR)
    equations = StageEquations.at(method, field_of_lane, *begin, near)

    # From here on, the state and its columns take the place of lanes, on the last axis.
    def rates_of_stage(t, stage):
        return rates(s, a, t[0], stage.T, inputs).T

    columns = len(y) - 1
    no_increments = jnp.zeros((*near.shape[:2], columns))
    w = jnp.concatenate([near, no_increments], axis=2)
    start = t[None], y.T, h[None]
    w, change = with_derivatives(method, rates_of_stage, start, equations, w)
    end = y + jnp.tensordot(np.array(method.b), w, 1).T

    last_change = jnp.max(jnp.abs(change[..., :1]), axis=0)
    of_state = jax.lax.stop_gradient((w[..., :1], last_change))
    _, error = errors(method, *of_state, jacobian, begin[2])
    return end, error[:, 0]
