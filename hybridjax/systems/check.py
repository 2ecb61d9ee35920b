"""Checks that a system is well formed: names, shapes of every function, finite parameters,
schedules.

`simulate`, searches and fits call `check_system` before they use a system, and `check_output` for
outputs that users give. Each function of the user is traced once by JAX; `evaluating` turns errors
of the user's code into a `DefinitionError` that says what to write. `_dependence` finds out from
the traced program whether a function uses the time.

If a good system is refused, its error leads to the check: shapes to `_check_shape`, names to
`_check_names` and `_check_all_names`, schedules to `check_schedules`, charts and transitions to
`_check_definition`. If a dependence on the time is missed or invented, look at `_dependence`; if an
error of the user's code gets the wrong advice, at `_problem`. A further check is called in
`_check_functions`. It must not depend on values of parameters: a system that differs from one that
has passed in such values alone is not checked again (`_passed`).
"""

import contextlib
import functools as ft
import itertools
import math
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._core import jax_compat
from .._core.arguments import require_among
from .._core.executor import is_traced
from .._core.jax_compat import Equation, Program, is_variable
from ..errors import DefinitionError, HybridJaxError
from .chart import Chart
from .solver import ByChart
from .structure import (
    Structure,
    hashable,
    quoted,
    require_inputs_apart,
)
from .system import HybridSystem, Output, arrays_of, name_of, require_positive
from .transition import SAME_TIME, Scheduled, Transition


# Classes of systems that have passed, without the values of parameters. (Not a `Memory`, which
# forgets with its object: each value of a parameter makes a new object.)
_passed: dict[Hashable, tuple[str, ...]] = {}


_ARGUMENTS = (
    " (fields, guards, resets and outputs take (t, q, u), after `self` in a class; functions of "
    "`HybridSystem.from_functions` take (t, q, u, p); functions of `Crossing`, `filippov` and "
    "`half_period` take (t, q))"
)


def check_system(system: HybridSystem) -> tuple[str, ...]:
    """Check that a system is well formed: names, shapes of every function, finite parameters.

    **Returns:** the functions that use the time, for messages.

    **Raises:** `DefinitionError`, naming the chart, transition or parameter that is wrong.
    """
    _check_parameters(system)
    leaves, structure = jax.tree_util.tree_flatten(system)
    parts = []
    for x in leaves:
        parts.append((x.shape, x.dtype) if eqx.is_array(x) else (type(x), x))
    form = hashable((structure, *parts))
    if form in _passed:
        return _passed[form]
    clocked = tuple(_check_functions(Structure(system)))
    if form is not None:
        _passed[form] = clocked
    return clocked


def _check_parameters(system: HybridSystem) -> None:
    for name, leaf in arrays_of(system).items():
        if not jnp.issubdtype(leaf.dtype, jnp.inexact) or is_traced(leaf):
            continue
        values = np.asarray(leaf)
        if not np.isfinite(values).all():
            raise DefinitionError(
                f"parameter `{name}` of {name_of(system)} is {values}; every parameter must "
                "be finite."
            )
    require_positive(system)


def _check_functions(s: Structure) -> Iterator[str]:
    """Check all functions; yield the names of those that use the time."""
    _check_definition(s)
    for a in range(len(s.charts)):
        yield from _check_chart(s, a)
    _check_all_names(s)
    # (Transitions of one kind are one program, of which the first and the last member are tested:
    # an index may be beyond the states.)
    ends = set()
    for kind in s.kinds:
        ends |= {kind[0], kind[-1]}
    for g in sorted(ends):
        yield from _check_transition(s, g)
    for output in s.system.outputs():
        yield from check_output(s, output)


def _check_definition(s: Structure) -> None:
    """Check what the methods of a system return, and names of its inputs and of its solver."""
    system = s.system
    kind = name_of(system)
    charts = system.charts()
    if not isinstance(charts, Mapping) or not _are_all(charts.values(), Chart):
        raise DefinitionError(
            f"{kind}.charts() must return a dict {{name: chart}} of `Chart`."
        )
    if not _are_all(system.transitions(), Transition):
        raise DefinitionError(
            f"{kind}.transitions() must return a list of `Transition`."
        )
    if not _are_all(system.outputs(), Output):
        raise DefinitionError(f"{kind}.outputs() must return a list of `Output`.")
    if not s.charts:
        raise DefinitionError(f"{kind} has no charts.")
    _check_names(kind, "inputs", system.inputs, system.input_units)
    if isinstance(system.solver, ByChart):
        for name in system.solver.names:
            s.chart_index(name)


def _are_all(items: Any, type_: type) -> bool:
    return isinstance(items, Iterable) and all(isinstance(x, type_) for x in items)


def _check_chart(s: Structure, a: int) -> Iterator[str]:
    name = s.names[a]
    chart = s.charts[a]
    of = f"chart '{name}'"
    inputs = chart.inputs or ()
    _check_names(of, "inputs", inputs)
    require_among("input", inputs, s.inputs, f"{of}: ")
    _check_names(of, "states", (*chart.states, *chart.absent))
    _check_names(of, "states", chart.states, chart.units)
    s.method(a)

    def field(s, *point):
        return s.field(a, *point)

    states = (
        f"the chart has the states {quoted(chart.states)}: return one rate for each"
    )
    yield from _check_shape(s, a, f"field of {of}", field, (s.dims[a],), states)


def _check_all_names(s: Structure) -> None:
    """Check that no two states, inputs, outputs or transitions have the same name."""
    kind = name_of(s.system)
    states = s.state_names()
    if len(set(map(str, states))) < len(states):
        raise DefinitionError(f"{kind} gives a state two units: {quoted(states)}.")
    _check_names(kind, "transitions", [tr.name for tr in s.transitions])
    outputs = [output.name for output in s.system.outputs()]
    _check_names(kind, "states and outputs", (*map(str, states), *outputs))
    absent = itertools.chain(*(chart.absent for chart in s.charts))
    require_inputs_apart(kind, s.inputs, [*states, *absent, *outputs])


def check_schedules(s: Structure) -> None:
    """**Raises:** `DefinitionError` for two schedules that are due at the same time, of one chart,
    or of a chart and the chart to which the first schedule leads.

    Of schedules with the same period, the event that belongs to an earlier period comes first: at
    duty 1, `Scheduled(T, duty * T)` comes before `Scheduled(T)`. Transitions of one clock (see
    `Structure.clocks`) wait for its next tick.
    """
    clocks = [g for g, number in enumerate(s.clocks) if number >= 0]
    for g, h in itertools.combinations(clocks, 2):
        first = s.transitions[g]
        second = s.transitions[h]
        one_clock = s.clocks[g] == s.clocks[h]
        chain = first.target == second.source or second.target == first.source
        if first.source != second.source and (one_clock or not chain):
            continue
        if is_traced((first.guard, second.guard)):
            continue
        if _meet(first.guard, second.guard):
            raise DefinitionError(
                f"'{first.name}' and '{second.name}' are scheduled for the same time in chart "
                f"'{second.source}', so that their order is not defined: write them as one event, "
                "or give them different times."
            )


def _meet(first: Any, second: Any) -> bool:
    """Test whether events of two schedules have the same time. If the periods are equal, only
    events of the same period are compared."""
    apart = float(first.offset) - float(second.offset)
    shorter, longer = sorted([float(first.period), float(second.period)])
    same = SAME_TIME * shorter
    ratio = longer / shorter
    if ratio - 1 <= SAME_TIME * ratio:
        return abs(apart) <= same
    if abs(ratio - round(ratio)) > SAME_TIME * ratio:
        return False  # (they meet by chance)
    return abs(math.remainder(apart, shorter)) <= same


def check_output(s: Structure, output: Output, kind: str = "output") -> Iterator[str]:
    """Check an output in each chart; yield its name in those where it uses the time."""
    if not callable(output.function):
        for name in output.function:
            s.chart_index(name)
    for a, name in enumerate(s.names):
        if s.resolve_outputs(output).defined(a):
            what = f"{kind} '{output.name}' in chart '{name}'"
            yield from _check_shape(
                s, a, what, ft.partial(_value_of, output, a), (1,), "", in_flow=False
            )


def _value_of(output: Output, a: int, s: Structure, *point: Any) -> Any:
    return s.resolve_outputs(output)(a, *point)


def _check_transition(s: Structure, g: int) -> Iterator[str]:
    tr = s.transitions[g]
    a = s.chart_index(tr.source)
    b = s.chart_index(tr.target)
    of = f"of transition '{tr.name}' ({tr.source} -> {tr.target})"

    def guard(s, *point):
        return s.guard(g, *point)

    def holds(s, *point):
        return s.enabled(g, *point)

    def reset(s, *point):
        return s.reset(g, *point)

    if not isinstance(tr.guard, Scheduled):
        yield from _check_shape(s, a, f"guard {of}", guard, (), "it must be one number")
    yield from _check_shape(
        s, a, f"`enabled` {of}", holds, (), "it must be one truth value"
    )
    states = f"chart '{tr.target}' has the states {quoted(s.charts[b].states)}: return one for each"
    yield from _check_shape(s, a, f"reset {of}", reset, (s.dims[b],), states)


def _check_shape(
    s: Structure,
    a: int,
    what: str,
    function: Callable,
    shape: tuple[int, ...],
    reason: str,
    in_flow: bool = True,
) -> Iterator[str]:
    """Check the shape of a function of a structure and (t, q, u) in chart a, and its precision if
    it takes part in the flow (`in_flow`). Yield its name `what` if it uses t. `reason`: why it must
    have this shape, for the error."""
    shapes = (), (s.dims[a],), (s.nu,)
    with evaluating(what, " (`t`, `q[0]` and `u[0]` are numbers, q and u are arrays)"):
        real = jnp.result_type(float)
        points = [jax.ShapeDtypeStruct(x, real) for x in shapes]
        program, *_ = eqx.filter_make_jaxpr(function)(s, *points)
        _check_indices(ft.partial(function, s), *(np.full(x, 0.5) for x in shapes))
    (result,) = program.out_avals
    if result.shape != shape:
        raise DefinitionError(f"the {what} returns shape {result.shape}, but {reason}.")
    needed, uses = jax_compat.needed_part(program.jaxpr)
    # (The last three arguments are t, q and u; numbers of the system come before.)
    time = len(uses) - 3
    kept = np.flatnonzero(uses)
    if in_flow and real == np.float64:
        low = _rounded_to(needed, list(kept >= time))
        if low:
            raise DefinitionError(
                f"the {what} is computed in {low}, whose rounding errors are jumps for the "
                f"accuracy of the flow: write `float` in place of `jnp.{low}`."
            )
    if uses[time] and _depends_on(needed, list(kept == time)):
        yield what


def _rounded_to(program: Program, moving: Sequence[bool]) -> str:
    """A type of few digits in which a program computes with arguments that are `moving`; "" for
    none. (Constants of such a type are exact.)"""
    depends: dict[Any, bool] = dict(zip(program.invars, moving, strict=True))
    for equation in program.eqns:
        inputs = [is_variable(x) and depends.get(x, False) for x in equation.invars]
        depends |= dict.fromkeys(equation.outvars, any(inputs))
        if not any(inputs):
            continue
        for inner in jax_compat.inner_programs(equation):
            if len(inner.invars) != len(inputs):
                inputs = [True] * len(inner.invars)
            low = _rounded_to(inner, inputs)
            if low:
                return low
        results: list[Any] = equation.outvars
        for x in results:
            bits = jax_compat.bits_of(x)
            if bits is not None and bits < 64:
                return x.aval.dtype.name
    return ""


def _depends_on(program: Program, moving: Sequence[bool]) -> bool:
    """Test whether a result of a program depends on arguments that are `moving`. Products with a
    constant zero do not count."""
    return any(_dependence(program, [(x, False) for x in moving]))


def _dependence(program: Program, arguments: Sequence[tuple[bool, bool]]) -> list[bool]:
    """Whether each result of a program depends on its arguments. An argument is given by two flags:
    whether it moves, and whether it is the number zero."""
    states = dict(zip(program.invars, arguments, strict=True))

    def state(x) -> tuple[bool, bool]:
        if jax_compat.is_constant(x):
            return False, bool(np.all(np.asarray(x.val) == 0))
        return states.get(x, (False, False))

    for equation in program.eqns:
        inputs = [state(x) for x in equation.invars]
        called = _called(equation)
        if jax_compat.gives_zero(equation, [zero for _, zero in inputs]):
            results = [(False, True)]
        elif called is not None:
            results = [(moves, False) for moves in _dependence(called, inputs)]
        else:
            moves = any(moves for moves, _ in inputs)
            results = [(moves, False)] * len(equation.outvars)
        states.update(zip(equation.outvars, results, strict=True))
    return [state(x)[0] for x in program.outvars]


def _called(equation: Equation) -> Program | None:
    """The program that an equation calls with its own arguments, if it does nothing more."""
    calls = (jax_compat.is_call, jax_compat.has_rule, jax_compat.is_hosted)
    inner = jax_compat.inner_programs(equation)
    if len(inner) != 1 or len(inner[0].invars) != len(equation.invars):
        return None
    return inner[0] if any(test(equation) for test in calls) else None


def _check_indices(function: Callable, *point: np.ndarray) -> None:
    """Raise `IndexError` for a state or an input by an index that does not exist: JAX would
    silently take the last one, where NumPy's arrays raise."""
    with np.errstate(all="ignore"):
        try:
            jax.eval_shape(lambda: function(*point))
        except IndexError:
            raise
        except Exception:  # a function for arrays of JAX only
            return


@contextlib.contextmanager
def evaluating(what: str, takes: str = "") -> Iterator[None]:
    """A context in which JAX traces a user's function. Errors of the function become errors that
    say what to write instead.

    **Raises:** `DefinitionError`.
    """
    try:
        yield
    except DefinitionError:
        raise
    except Exception as error:
        problem = _problem(error, takes)
        raise DefinitionError(f"the {what} cannot be evaluated: {problem}.") from error


def _problem(error: Exception, takes: str) -> str:
    """Return what is wrong in a user's function that raised an error.

    **Arguments:** `takes`: what the arguments of the function are, in brackets; "" if unknown.
    """
    text = str(error).rstrip(".")
    if isinstance(error, jax.errors.JAXTypeError):
        return (
            "it uses a value that JAX does not know yet: write `jnp.where(a > 0, x, y)` for "
            "`if a > 0`, `jnp.maximum` for `max`, `jnp.sin` for `math.sin` and `np.sin`, and "
            "no `float`"
        )
    if takes and "positional argument" in text:
        return text + _ARGUMENTS
    if "string indexing" in text:
        return (
            "states and inputs have no names in it: write `y, v = q`, or `q[0]`, in the order of "
            "the chart's `states`"
        )
    if "not subscriptable" in text:
        return f"{text} (parameters are attributes: write `p.k` for `p['k']`)"
    # (Errors of this package already say what to do, and a missing name has nothing to do with the
    # arguments.)
    if isinstance(error, HybridJaxError | NameError | KeyError):
        return text
    return text + takes


def _check_names(
    what: str,
    kind: str,
    names: Sequence[str],
    units: Sequence[str] = (),
) -> None:
    """Check that names are distinct, and units as many, or none."""
    if isinstance(names, str) or not all(isinstance(name, str) for name in names):
        raise DefinitionError(
            f"{kind} of {what} must be a tuple of names, not {names!r}."
        )
    if len(set(names)) < len(names):
        raise DefinitionError(f"{what} has {kind} of the same name: {quoted(names)}.")
    if len(units) not in (0, len(names)):
        raise DefinitionError(
            f"{what} has the {kind} {quoted(names)}, but {len(units)} units: give one for each, "
            "or none."
        )
