"""Functions in users' programs that XLA computes badly, replaced by our own.

A function that a user has written with `jnp` is traced, and in its program (a jaxpr) the equations
for sin, cos, tan, arctan, arctan2, arcsin and arccos are replaced by those of `trigonometry`, and
the factorizations behind `jnp.linalg` by those of `factorizations` (docs/how-to/speed-up.md:
reasons, accuracy). If a later JAX renames these equations, they are not found and not replaced:
results are right, and slower.

A further function is a line in `_TRIGONOMETRY` or `_FACTORIZATIONS`, and the name of its primitive
one in `_FUNCTIONS` (`jax_compat.py`). What is put in must have the arguments, results and types of
what it replaces; equations with derivative rules of their own must be left alone.

If a rewritten program gives other results, look at the function that was put in (`trigonometry.py`,
`factorizations.py`); if it is as slow as before, at the names of equations (`function_of` in
`jax_compat.py`) and at the conditions in `_ours` and `_solved`.
"""

import functools as ft
from collections.abc import Callable, Sequence
from typing import Any
from weakref import WeakKeyDictionary

import jax
import jax.numpy as jnp

from .. import jax_compat
from ..executor import on_cpu
from ..jax_compat import ClosedProgram, Equation, Program, function_of, is_variable
from . import factorizations
from .trigonometry import arccos, arcsin, arctan, arctan2, cos, sin, tan


_TRIGONOMETRY: dict[str, Callable] = {
    "sin": sin,
    "cos": cos,
    "tan": tan,
    "arctan2": arctan2,
    "arctan": arctan,
    "arcsin": arcsin,
    "arccos": arccos,
}
_FACTORIZATIONS: dict[str, Callable] = {
    "cholesky": factorizations.cholesky,
    "triangular_solve": factorizations.triangular_solve,
    "lu": factorizations.lu,
}


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
        whole, shapes = trace(*arguments)
        program = whole.jaxpr
        if trigonometry and by_row:
            program = _row_by_row(program)
        program = _replaced(program, trigonometry)
        run = jax_compat.as_function(jax_compat.with_program(whole, program))
        values = map(jnp.asarray, run(*jax.tree_util.tree_leaves(arguments)))
        structure = jax.tree_util.tree_structure(shapes)
        return jax.tree_util.tree_unflatten(structure, values)

    return call


def _number(equation: Equation) -> int:
    """The number of our trigonometric functions in an equation."""
    if function_of(equation) in _TRIGONOMETRY:
        return 1
    if not jax_compat.is_outer(equation):
        return 0
    programs = jax_compat.inner_programs(equation)
    return sum(_number(inner) for program in programs for inner in program.eqns)


def _row_by_row(program: Program) -> Program:
    """A program that puts the numbers of a vector in their places one after the other, if more than
    one of our functions is behind them.

    XLA compiles a concatenation into one loop. With two sines in it, XLA does not find vector
    instructions for that loop.
    """
    equations = []
    behind: dict[Any, frozenset] = {}
    for k, equation in enumerate(program.eqns):
        functions = frozenset((k, j) for j in range(_number(equation)))
        for v in equation.invars:
            if is_variable(v):
                functions |= behind.get(v, frozenset())
        behind |= dict.fromkeys(equation.outvars, functions)
        if function_of(equation) == "vector" and len(functions) > 1:
            if len(_shape(equation.outvars[0])) == 1:
                equation = _in_place_of(equation, _rows)
        equations.append(equation)
    return jax_compat.with_equations(program, equations)


@jax.jit
def _rows(*parts):
    count = sum(x.size for x in parts)
    kind = jnp.result_type(*parts)
    rows = jnp.zeros(count, kind)
    start = 0
    for part in map(jnp.atleast_1d, parts):
        rows = jax.lax.dynamic_update_slice(rows, part, (start,))
        start += len(part)
    return rows


def _replaced(program: Program, trigonometry: bool) -> Program:
    """A program of the same type with our functions; itself if there is nothing to replace."""
    # Solutions of linear systems are replaced as a whole; then nothing may need their factors.
    factors = set()
    for equation in program.eqns:
        if function_of(equation) == "lu":
            factors.update(equation.outvars)
    solved = [_solved(equation, factors) or equation for equation in program.eqns]
    if factors:
        solved = _without_unused_factors(program, solved)
    # All others one by one, also in the programs inside of them.
    equations = [_replaced_equation(equation, trigonometry) for equation in solved]
    if list(map(id, equations)) == list(map(id, program.eqns)):
        return program
    return jax_compat.with_equations(program, equations)


def _without_unused_factors(
    program: Program, equations: list[Equation]
) -> list[Equation]:
    """The equations, without factorizations whose results no other equation uses."""
    needed = set(filter(is_variable, program.outvars))
    for equation in equations:
        needed.update(filter(is_variable, equation.invars))
    return [
        x
        for x in equations
        if function_of(x) != "lu" or not needed.isdisjoint(x.outvars)
    ]


def _replaced_equation(equation: Equation, trigonometry: bool) -> Equation:
    ours = _ours(equation, trigonometry)
    if ours is not None:
        return ours
    if not jax_compat.is_outer(equation):
        return equation
    old = equation.params
    new = {name: _replaced_option(x, trigonometry) for name, x in old.items()}
    if all(new[name] is old[name] for name in old):
        return equation
    return jax_compat.with_options(equation, new)


def _solved(equation: Equation, factors: set) -> Equation | None:
    """Our equation in place of the solution of a linear system by factors L and U, if it is one."""
    if function_of(equation) != "solve":
        return None
    system = jax_compat.solved_by(equation)
    if system is None:
        return None
    matrix, right, constants, product = system
    by_factors = all(v in factors for v in constants if is_variable(v))
    if not constants or not by_factors or function_of(product) != "product":
        return None
    rows = _shape(matrix)
    if len(rows) != 2 or rows[-1] > factorizations.UNROLLED_PIVOTED:
        return None
    summed = (1,), (len(_shape(right)) - 1,)
    contracted, batch = product.params["dimension_numbers"]
    if tuple(map(tuple, contracted)) != summed or batch != ((), ()):
        return None
    return _in_place_of(equation, factorizations.solve, arguments=[matrix, right])


def _ours(equation: Equation, trigonometry: bool) -> Equation | None:
    """Our equation in place of one of JAX, if we have one for its types."""
    function = function_of(equation)
    types: list[Any] = [v.aval for v in equation.invars]
    if function in _FACTORIZATIONS:
        rows, columns = types[0].shape[-2:]
        square = rows == columns and 0 < rows <= factorizations.MOST_ROWS
        if not square or not jnp.issubdtype(types[0].dtype, jnp.floating):
            return None
        form = jax_compat.form_of_factors(equation)
        return _in_place_of(equation, _FACTORIZATIONS[function], form)
    if not trigonometry or function not in _TRIGONOMETRY:
        return None
    if jax_compat.is_rounded(equation):
        return None
    if any(x.dtype != jnp.float64 for x in types):
        return None
    return _in_place_of(equation, _TRIGONOMETRY[function])


def _in_place_of(
    equation: Equation,
    function: Callable,
    options: tuple = (),
    arguments: Sequence[Any] = (),
) -> Equation:
    """The equation of one of our functions with the variables of another one."""
    arguments = arguments or equation.invars
    ours = _equation(function, tuple(v.aval for v in arguments), options)
    return jax_compat.in_place_of(equation, ours, arguments)


def _shape(v: Any) -> tuple[int, ...]:
    return v.aval.shape


def _replaced_option(value: Any, trigonometry: bool) -> Any:
    if jax_compat.is_closed(value):
        return _replaced_program(value, trigonometry)
    if not isinstance(value, tuple):
        return value
    items = [_replaced_option(x, trigonometry) for x in value]
    if all(new is old for new, old in zip(items, value, strict=True)):
        return value
    # (A solver's programs come as a tuple with names.)
    return getattr(type(value), "_make", tuple)(items)


# JAX traces an inner jit once and keeps it: what becomes of it is kept as well, since JAX's caches
# of its derivatives and its batched form go by the identity of a program.
_REPLACED: dict[bool, WeakKeyDictionary] = {
    True: WeakKeyDictionary(),
    False: WeakKeyDictionary(),
}


def _replaced_program(whole: ClosedProgram, trigonometry: bool) -> ClosedProgram:
    replaced = _REPLACED[trigonometry]
    if whole not in replaced:
        program = _replaced(whole.jaxpr, trigonometry)
        # None: unchanged. (The program itself as the value would keep its own key alive.)
        replaced[whole] = None
        if program is not whole.jaxpr:
            replaced[whole] = jax_compat.with_program(whole, program)
    return replaced[whole] or whole


@ft.lru_cache(maxsize=256)
def _equation(function: Callable, avals: tuple, options: tuple = ()) -> Equation:
    """The equation that applies one of our functions to arguments of these types."""
    applied = ft.partial(function, **dict(options))
    (equation,) = jax.make_jaxpr(lambda *arguments: applied(*arguments))(*avals).eqns
    return equation
