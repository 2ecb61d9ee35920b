"""Trigonometric functions in users' programs, replaced by those of `trigonometry`.

A function that a user has written with `jnp` is traced, and in its program (a jaxpr) the equations
for sin, cos, tan, arctan, arctan2, arcsin and arccos are replaced; docs/vector-math.md says why,
and how accurate that is. Only the public `jax.extend.core` is used. Where a later JAX has another
name for what is looked for here, nothing is replaced, and all is as slow as it would be without.
"""

import functools as ft
from collections.abc import Callable
from typing import Any
from weakref import WeakKeyDictionary

import jax
import jax.extend.core as jex
import jax.numpy as jnp
from jax.extend.core import primitives

from ..boundary.checked import checked
from ..device import on_cpu
from .trigonometry import arccos, arcsin, arctan, arctan2, cos, of_one_type, sin, tan


_OURS = {
    primitives.sin_p: sin,
    primitives.cos_p: cos,
    primitives.tan_p: tan,
    primitives.atan2_p: arctan2,
    primitives.atan_p: arctan,
    primitives.asin_p: arcsin,
    primitives.acos_p: arccos,
}
# With up to so many of our functions behind it, a vector is concatenated from its numbers. Twice as
# many: XLA makes a loop without vector instructions of a field with two sines.
_TOGETHER = 1
# Primitives whose inner programs are replaced too. Functions with derivative rules of their own
# are left alone.
_OUTER = ("jit", "pjit", "cond", "while", "scan")


_enabled = True


@checked
def enable_vector_math(enabled: bool = True) -> None:
    """Whether trigonometric functions in fields, guards, resets and outputs are computed for
    several lanes at once, for this process: they are, unless this is called with `False`.

    On CPU, `jnp.sin` and its relatives take 8 to 22 ns for every number in double precision; what
    replaces them takes 2 to 3 ns and is accurate to 1.5 to 3.3 units in the last place (see
    docs/vector-math.md). Switched off, users' functions are computed as they are written.

    What JAX compiled under the other setting is dropped, all of this process's programs.
    """
    global _enabled
    if bool(enabled) != _enabled:
        _enabled = bool(enabled)
        jax.clear_caches()


def is_enabled() -> bool:
    return _enabled


def vectorized(function: Callable) -> Callable:
    """`function` with the functions of `trigonometry` in place of those of `jnp`.

    It is traced anew at every call, so it may close over tracers. What is written with `jax.lax`
    counts too, and so does what is inside of `jit`, `cond`, `while_loop` and `scan`. Away from
    CPU, and after `enable_vector_math(False)`, `function` is called as it is.

    **Arguments:** `function`, from pytrees of arrays or numbers to a pytree of arrays or numbers.

    **Returns:** a function with the same arguments that returns arrays of the same shapes, dtypes
    and weak types as `jax.jit(function)` would.
    """

    @ft.wraps(function, updated=())
    def call(*arguments: Any) -> Any:
        if not _enabled or not on_cpu():
            return function(*arguments)
        # A new function every time: a program of earlier parameters is never taken for this one.
        trace = jax.make_jaxpr(lambda *arguments: function(*arguments), return_shape=True)
        program, shapes = trace(*arguments)
        program = program.replace(jaxpr=_replaced(_row_by_row(program.jaxpr)))
        values = jex.jaxpr_as_fun(program)(*jax.tree_util.tree_leaves(arguments))
        values = [v if isinstance(v, jax.Array) else jnp.asarray(v) for v in values]
        return jax.tree_util.tree_unflatten(jax.tree_util.tree_structure(shapes), values)

    return call


def _number(eqn: jex.JaxprEqn) -> int:
    """How many of our functions there are in an equation."""
    if eqn.primitive in _OURS:
        return 1
    if eqn.primitive.name not in _OUTER:
        return 0
    items = [x for value in eqn.params.values() for x in _as_tuple(value)]
    inner = [x.jaxpr.eqns for x in items if isinstance(x, jex.ClosedJaxpr)]
    return sum(_number(eqn) for eqns in inner for eqn in eqns)


def _row_by_row(jaxpr: jex.Jaxpr) -> jex.Jaxpr:
    """A program that puts the numbers of a vector in their places one after the other, if more
    than a few of our functions are behind them.

    What is concatenated is compiled into one loop. With more than a few of our functions in it,
    XLA does not find vector instructions for that loop.
    """
    eqns = []
    behind: dict[jex.Var, frozenset] = {}
    for k, eqn in enumerate(jaxpr.eqns):
        sources = [behind.get(v, frozenset()) for v in eqn.invars if isinstance(v, jex.Var)]
        functions = frozenset((k, j) for j in range(_number(eqn))).union(*sources)
        behind |= dict.fromkeys(eqn.outvars, functions)
        vector = eqn.primitive.name in ("stack", "concatenate") and eqn.outvars[0].aval.ndim == 1
        if vector and len(functions) > _TOGETHER:
            rows = _equation(_rows, tuple(v.aval for v in eqn.invars))
            eqn = rows.replace(invars=eqn.invars, outvars=eqn.outvars, source_info=eqn.source_info)
        eqns.append(eqn)
    return jaxpr.replace(eqns=eqns)


@jax.jit
def _rows(*parts):
    out, start = jnp.zeros(sum(x.size for x in parts), jnp.result_type(*parts)), 0
    for x in map(jnp.atleast_1d, parts):
        out = jax.lax.dynamic_update_slice(out, x, (start,))
        start += len(x)
    return out


def _replaced(jaxpr: jex.Jaxpr) -> jex.Jaxpr:
    """A program of the same type with our functions; itself if there is nothing to replace."""
    eqns = [_replaced_equation(eqn) for eqn in jaxpr.eqns]
    changed = any(new is not old for new, old in zip(eqns, jaxpr.eqns, strict=True))
    return jaxpr.replace(eqns=eqns) if changed else jaxpr


def _replaced_equation(eqn: jex.JaxprEqn) -> jex.JaxprEqn:
    if eqn.primitive in _OURS and eqn.params.get("accuracy") is None:
        avals = tuple(v.aval for v in eqn.invars)
        if of_one_type(*(aval.dtype for aval in avals)):
            ours = _equation(_OURS[eqn.primitive], avals)
            return ours.replace(invars=eqn.invars, outvars=eqn.outvars, source_info=eqn.source_info)
    if eqn.primitive.name in _OUTER:
        params = {name: _replaced_parameter(value) for name, value in eqn.params.items()}
        if any(params[name] is not value for name, value in eqn.params.items()):
            return eqn.replace(params=params)
    return eqn


def _replaced_parameter(value: Any) -> Any:
    if isinstance(value, jex.ClosedJaxpr):
        return _replaced_program(value)
    if any(isinstance(item, jex.ClosedJaxpr) for item in _as_tuple(value)):
        items = tuple(_replaced_program(item) for item in value)
        same = all(new is old for new, old in zip(items, value, strict=True))
        return value if same else items
    return value


def _as_tuple(value: Any) -> tuple:
    return value if type(value) is tuple else (value,)


# JAX traces an inner jit once and keeps it: what becomes of it is kept as well, since JAX's caches
# of its derivatives and its batched form go by the identity of a program.
_KNOWN: WeakKeyDictionary = WeakKeyDictionary()


def _replaced_program(program: jex.ClosedJaxpr) -> jex.ClosedJaxpr:
    if program not in _KNOWN:
        jaxpr = _replaced(program.jaxpr)
        # None: unchanged. (The program itself as the value would keep its own key alive.)
        _KNOWN[program] = None if jaxpr is program.jaxpr else program.replace(jaxpr=jaxpr)
    found = _KNOWN[program]
    return program if found is None else found


@ft.lru_cache(maxsize=256)
def _equation(function: Callable, avals: tuple) -> jex.JaxprEqn:
    """The equation that applies one of our functions to arguments of these types."""
    (eqn,) = jax.make_jaxpr(function)(*avals).eqns
    return eqn
