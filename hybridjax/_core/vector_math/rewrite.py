"""Functions in users' programs that XLA computes badly, replaced by our own.

A function that a user has written with `jnp` is traced, and in its program (a jaxpr) the equations
for sin, cos, tan, arctan, arctan2, arcsin and arccos are replaced by those of `trigonometry`, and
the factorizations behind `jnp.linalg` by those of `factorizations`
(docs/how-to/speed-up.md: reasons, accuracy). Only the public `jax.extend.core` is used.
Where a later JAX has another name for what is looked for here, nothing is replaced, and all is as
slow as it would be without.
"""

import functools as ft
from collections.abc import Callable
from typing import Any
from weakref import WeakKeyDictionary

import jax
import jax.extend.core as jex
import jax.numpy as jnp
from jax.extend.core import primitives

from ..executor import on_cpu
from . import factorizations
from .trigonometry import arccos, arcsin, arctan, arctan2, cos, sin, tan


_TRIGONOMETRY = {
    primitives.sin_p: sin,
    primitives.cos_p: cos,
    primitives.tan_p: tan,
    primitives.atan2_p: arctan2,
    primitives.atan_p: arctan,
    primitives.asin_p: arcsin,
    primitives.acos_p: arccos,
}
_FACTORIZATIONS = {
    primitives.cholesky_p: factorizations.cholesky,
    primitives.triangular_solve_p: factorizations.triangular_solve,
    primitives.lu_p: factorizations.lu,
}
# Primitives whose inner programs are replaced too. Functions with derivative rules of their own
# are left alone.
_OUTER = ("jit", "pjit", "cond", "while", "scan", "custom_linear_solve")


def vectorized(
    function: Callable, *, trigonometry: bool = True, by_row: bool = True
) -> Callable:
    """`function` with the functions of `factorizations`, and if wanted with those of
    `trigonometry`, in place of those of `jnp`.

    It is traced anew at every call, so it may close over tracers. What is written with `jax.lax`
    counts too, and so does what is inside of `jit`, `cond`, `while_loop` and `scan`. Away from
    CPU `function` is called as it is.

    **Arguments:** `function`, from pytrees of arrays or numbers to a pytree of arrays or numbers.
    `by_row`: whether vectors are put together row by row, which is faster unless a program keeps
    them apart from what is done with them.

    **Returns:** a function with the same arguments that returns arrays of the same shapes, dtypes
    and weak types as `jax.jit(function)` would.
    """

    @ft.wraps(function, updated=())
    def call(*arguments: Any) -> Any:
        if not on_cpu():
            return function(*arguments)
        # A new function every time: a program of earlier parameters is never taken for this one.
        trace = jax.make_jaxpr(
            lambda *arguments: function(*arguments), return_shape=True
        )
        program, shapes = trace(*arguments)
        separate = trigonometry and by_row
        jaxpr = _row_by_row(program.jaxpr) if separate else program.jaxpr
        program = program.replace(jaxpr=_replaced(jaxpr, trigonometry))
        values = jex.jaxpr_as_fun(program)(*jax.tree_util.tree_leaves(arguments))
        values = [v if isinstance(v, jax.Array) else jnp.asarray(v) for v in values]
        return jax.tree_util.tree_unflatten(
            jax.tree_util.tree_structure(shapes), values
        )

    return call


def _number(eqn: jex.JaxprEqn) -> int:
    """Return the number of our trigonometric functions in an equation."""
    if eqn.primitive in _TRIGONOMETRY:
        return 1
    if eqn.primitive.name not in _OUTER:
        return 0
    return sum(
        _number(inner) for program in jaxprs(eqn.params) for inner in program.eqns
    )


def jaxprs(params: dict[str, Any]) -> list[jex.Jaxpr]:
    """Return the programs among the parameters of an equation, or in tuples of these.
    (`jax.extend.core` has a function for it since JAX 0.10.)"""
    parts = (x if isinstance(x, tuple) else (x,) for x in params.values())
    programs = [
        x.jaxpr if isinstance(x, jex.ClosedJaxpr) else x for part in parts for x in part
    ]
    return [x for x in programs if isinstance(x, jex.Jaxpr)]


def _row_by_row(jaxpr: jex.Jaxpr) -> jex.Jaxpr:
    """Return a program that puts the numbers of a vector in their places one after the other, if
    more than one of our functions is behind them.

    XLA compiles a concatenation into one loop. With two sines in it, XLA does not find vector
    instructions for that loop.
    """
    eqns = []
    behind: dict[jex.Var, frozenset] = {}
    for k, eqn in enumerate(jaxpr.eqns):
        sources = [
            behind.get(v, frozenset()) for v in eqn.invars if isinstance(v, jex.Var)
        ]
        functions = frozenset((k, j) for j in range(_number(eqn))).union(*sources)
        behind |= dict.fromkeys(eqn.outvars, functions)
        vector = (
            eqn.primitive.name in ("stack", "concatenate")
            and len(_shape(eqn.outvars[0])) == 1
        )
        if vector and len(functions) > 1:
            eqn = _in_place_of(eqn, _rows)
        eqns.append(eqn)
    return jaxpr.replace(eqns=eqns)


@jax.jit
def _rows(*parts):
    out, start = jnp.zeros(sum(x.size for x in parts), jnp.result_type(*parts)), 0
    for x in map(jnp.atleast_1d, parts):
        out = jax.lax.dynamic_update_slice(out, x, (start,))
        start += len(x)
    return out


def _replaced(jaxpr: jex.Jaxpr, trigonometry: bool) -> jex.Jaxpr:
    """A program of the same type with our functions; itself if there is nothing to replace."""
    factors = {
        v: e for e in jaxpr.eqns if e.primitive is primitives.lu_p for v in e.outvars
    }
    solved = [_solved(eqn, factors) or eqn for eqn in jaxpr.eqns]
    places = (
        [*jaxpr.outvars, *(v for eqn in solved for v in eqn.invars)] if factors else []
    )
    needed = {v for v in places if isinstance(v, jex.Var)}
    eqns = [
        _replaced_equation(eqn, trigonometry)
        for eqn in solved
        if eqn.primitive is not primitives.lu_p or not needed.isdisjoint(eqn.outvars)
    ]
    same = list(map(id, eqns)) == list(map(id, jaxpr.eqns))
    return jaxpr if same else jaxpr.replace(eqns=eqns)


def _replaced_equation(eqn: jex.JaxprEqn, trigonometry: bool) -> jex.JaxprEqn:
    if (ours := _ours(eqn, trigonometry)) is not None:
        return ours
    if eqn.primitive.name in _OUTER:
        params = {
            k: _replaced_parameter(x, trigonometry) for k, x in eqn.params.items()
        }
        if any(params[name] is not value for name, value in eqn.params.items()):
            return eqn.replace(params=params)
    return eqn


def _solved(eqn: jex.JaxprEqn, factors: dict) -> jex.JaxprEqn | None:
    """Our equation in place of the solution of a linear system by factors L and U, if it is one."""
    if eqn.primitive is not primitives.linear_solve_p:
        return None
    times, lengths = eqn.params["jaxprs"].matvec, eqn.params["const_lengths"]
    matrix, *_, right = eqn.invars
    constants = eqn.invars[lengths.matvec + lengths.vecmat :][: lengths.solve]
    by_factors = bool(constants) and all(
        v in factors for v in constants if isinstance(v, jex.Var)
    )
    product = times.jaxpr.eqns[0]
    if (
        lengths.matvec != 1
        or not by_factors
        or product.primitive is not primitives.dot_general_p
    ):
        return None
    (left, last), batch = product.params["dimension_numbers"]
    n, axes = _shape(matrix)[-1], len(_shape(right))
    shared = len(_shape(matrix)) == 2 and (tuple(left), tuple(last)) == (
        (1,),
        (axes - 1,),
    )
    if not shared or batch != ((), ()) or n > factorizations.UNROLLED_PIVOTED:
        return None
    if product.invars != times.jaxpr.invars:
        return None
    return _in_place_of(eqn, factorizations.solve, invars=[matrix, right])


def _ours(eqn: jex.JaxprEqn, trigonometry: bool) -> jex.JaxprEqn | None:
    """Our equation in place of one of JAX, if we have one for its types."""
    avals: list[Any] = [v.aval for v in eqn.invars]
    if eqn.primitive in _FACTORIZATIONS:
        rows, columns = avals[0].shape[-2:]
        square = rows == columns and 0 < rows <= factorizations.MOST_ROWS
        if not square or not jnp.issubdtype(avals[0].dtype, jnp.floating):
            return None
        names = {"left_side", "lower", "transpose_a", "unit_diagonal"} & set(eqn.params)
        options = tuple((name, eqn.params[name]) for name in sorted(names))
        return _in_place_of(eqn, _FACTORIZATIONS[eqn.primitive], options)
    if not trigonometry or eqn.primitive not in _TRIGONOMETRY:
        return None
    if eqn.params.get("accuracy") is not None or any(
        x.dtype != jnp.float64 for x in avals
    ):
        return None
    return _in_place_of(eqn, _TRIGONOMETRY[eqn.primitive])


def _in_place_of(
    eqn: jex.JaxprEqn, function: Callable, options: tuple = (), invars: Any = None
) -> jex.JaxprEqn:
    """The equation of one of our functions with the variables of another one."""
    invars = invars or eqn.invars
    new = _equation(function, tuple(v.aval for v in invars), options)
    return new.replace(invars=invars, outvars=eqn.outvars, source_info=eqn.source_info)


def _shape(v: Any) -> tuple[int, ...]:
    return v.aval.shape


def _replaced_parameter(value: Any, trigonometry: bool) -> Any:
    if isinstance(value, jex.ClosedJaxpr):
        return _replaced_program(value, trigonometry)
    if not isinstance(value, tuple):
        return value
    items = [_replaced_parameter(x, trigonometry) for x in value]
    same = all(new is old for new, old in zip(items, value, strict=True))
    # (A solver's programs come as a tuple with names.)
    return value if same else getattr(type(value), "_make", tuple)(items)


# JAX traces an inner jit once and keeps it: what becomes of it is kept as well, since JAX's caches
# of its derivatives and its batched form go by the identity of a program.
_REPLACED: dict[bool, WeakKeyDictionary] = {
    flag: WeakKeyDictionary() for flag in (False, True)
}


def _replaced_program(program: jex.ClosedJaxpr, trigonometry: bool) -> jex.ClosedJaxpr:
    replaced = _REPLACED[trigonometry]
    if program not in replaced:
        jaxpr = _replaced(program.jaxpr, trigonometry)
        # None: unchanged. (The program itself as the value would keep its own key alive.)
        replaced[program] = (
            None if jaxpr is program.jaxpr else program.replace(jaxpr=jaxpr)
        )
    return replaced[program] or program


@ft.lru_cache(maxsize=256)
def _equation(function: Callable, avals: tuple, options: tuple = ()) -> jex.JaxprEqn:
    """The equation that applies one of our functions to arguments of these types."""
    (eqn,) = jax.make_jaxpr(lambda *arguments: function(*arguments, **dict(options)))(
        *avals
    ).eqns
    return eqn
