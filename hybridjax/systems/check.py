"""Checks of a system: names, shapes of every function, finite parameters."""

import contextlib
import functools as ft
import itertools
import math
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np
from jax.interpreters.partial_eval import dce_jaxpr

from .._core.arguments import require_among
from .._core.executor import is_traced
from ..errors import DefinitionError
from .chart import Chart
from .solver import ByChart
from .structure import (
    Structure,
    hashable,
    jaxprs,
    quoted,
    require_inputs_apart,
)
from .system import HybridSystem, Output, arrays_of, require_positive
from .transition import SAME_TIME, Scheduled, Transition


# Systems that have passed, but for their numbers. (A `Memory` forgets with its object, and each
# value of a parameter makes a new one.)
_passed: dict[Hashable, tuple[str, ...]] = {}


_ARGUMENTS = (
    " (fields, guards, resets and outputs take (t, q, u), after `self` in a class; functions of "
    "`Crossing`, `sliding` and `half_period` take (t, q))"
)


def check_system(system: HybridSystem) -> tuple[str, ...]:
    """Check that a system is well formed: names, shapes of every function, finite parameters.

    **Returns:** the functions that use the time, for messages.

    **Raises:** `DefinitionError`, naming the chart, transition or parameter that is wrong.
    """
    for name, leaf in arrays_of(system).items():
        real = jnp.issubdtype(leaf.dtype, jnp.inexact) and not is_traced(leaf)
        if real and not np.all(np.isfinite(leaf)):
            text = (
                f"parameter `{name}` of {type(system).__name__} is {np.asarray(leaf)}"
            )
            raise DefinitionError(f"{text}; every parameter must be finite.")
    require_positive(system)
    leaves, structure = jax.tree_util.tree_flatten(system)
    parts = ((x.shape, x.dtype) if eqx.is_array(x) else (type(x), x) for x in leaves)
    form = hashable((structure, *parts))
    clocked = _passed.get(form) if form is not None else None
    if clocked is None:
        clocked = tuple(_check_functions(Structure(system)))
        if form is not None:
            _passed[form] = clocked
    return clocked


def _check_functions(s: Structure) -> Iterator[str]:
    """Check all functions; yield the names of those that use the time."""
    system, kind = s.system, type(s.system).__name__
    charts = system.charts()
    for name, items, type_ in (
        ("charts", charts.values() if isinstance(charts, Mapping) else None, Chart),
        ("transitions", system.transitions(), Transition),
        ("outputs", system.outputs(), Output),
    ):
        if not isinstance(items, Iterable) or not all(
            isinstance(x, type_) for x in items
        ):
            several = "a dict {name: chart}" if type_ is Chart else "a list"
            raise DefinitionError(
                f"{kind}.{name}() must return {several} of `{type_.__name__}`."
            )
    if not s.charts:
        raise DefinitionError(f"{kind} has no charts.")
    _check_names(kind, "inputs", system.inputs, system.input_units)
    for name in system.solver.names if isinstance(system.solver, ByChart) else ():
        s.chart_index(name)
    for a, (name, chart) in enumerate(zip(s.names, s.charts, strict=True)):
        _check_names(f"chart '{name}'", "inputs", chart.inputs or ())
        require_among("input", chart.inputs or (), s.inputs, f"chart '{name}': ")
        _check_names(f"chart '{name}'", "states", (*chart.states, *chart.absent))
        _check_names(f"chart '{name}'", "states", chart.states, chart.units)
        s.method(a)
        states = (
            f"the chart has the states {quoted(chart.states)}: return one rate for each"
        )
        field = lambda s, *x, a=a: s.field(a, *x)  # noqa: E731
        yield from _check_shape(
            s, a, f"field of chart '{name}'", field, (s.dims[a],), states
        )
    if len(set(map(str, s.state_names()))) < len(s.state_names()):
        raise DefinitionError(
            f"{kind} gives a state two units: {quoted(s.state_names())}."
        )
    _check_names(kind, "transitions", [tr.name for tr in s.transitions])
    # Transitions of one kind are one program; the first and the last may index beyond the states.
    for g in sorted({g for kind in s.kinds for g in (kind[0], kind[-1])}):
        yield from _check_transition(s, g)
    names = [output.name for output in system.outputs()]
    _check_names(kind, "states and outputs", (*map(str, s.state_names()), *names))
    absent = [name for chart in s.charts for name in chart.absent]
    require_inputs_apart(kind, s.inputs, [*s.state_names(), *absent, *names])
    for output in system.outputs():
        yield from check_output(s, output)


def check_schedules(s: Structure) -> None:
    """**Raises:** `DefinitionError` for two schedules of one chart, or of a chart and of one that
    the first leads to, that are due at the same time.

    Of schedules with the same period, the event that belongs to an earlier period comes first: at
    duty 1, `Scheduled(T, duty * T)` comes before `Scheduled(T)`. Transitions of one clock (see
    `Structure.clocks`) wait for its next tick.
    """
    clocks = [g for g, number in enumerate(s.clocks) if number >= 0]
    for g, h in itertools.combinations(clocks, 2):
        first, second = s.transitions[g], s.transitions[h]
        one_clock = s.clocks[g] == s.clocks[h]
        chain = first.target == second.source or second.target == first.source
        if first.source != second.source and (one_clock or not chain):
            continue
        if not is_traced((first.guard, second.guard)) and _meet(
            first.guard, second.guard
        ):
            raise DefinitionError(
                f"'{first.name}' and '{second.name}' are scheduled for the same time in chart "
                f"'{second.source}', so that their order is not defined: write them as one event, "
                "or give them different times."
            )


def _meet(first: Any, second: Any) -> bool:
    """Test whether the events of two schedules, or if their periods are the same, those of one
    period, have the same time."""
    (a, p), (b, other) = ((float(x.offset), float(x.period)) for x in (first, second))
    same = SAME_TIME * min(p, other)
    if abs(p - other) <= SAME_TIME * p:
        return abs(a - b) <= same
    ratio = p / other if p > other else other / p
    if abs(ratio - round(ratio)) > SAME_TIME * ratio:
        return False  # (they meet by chance)
    return abs(math.remainder(a - b, min(p, other))) <= same


def check_output(s: Structure, output: Output, kind: str = "output") -> Iterator[str]:
    """Check an output in each chart; yield its name in those where it uses the time."""
    for name in () if callable(output.function) else output.function:
        s.chart_index(name)
    for a, name in enumerate(s.names):
        if s.resolve_outputs(output).defined(a):
            what = f"{kind} '{output.name}' in chart '{name}'"
            values = lambda s, *x, a=a: s.resolve_outputs(output)(a, *x)  # noqa: E731
            yield from _check_shape(s, a, what, values, (1,), "", in_flow=False)


def _check_transition(s: Structure, g: int) -> Iterator[str]:
    tr = s.transitions[g]
    a, b = s.chart_index(tr.source), s.chart_index(tr.target)
    of = f"of transition '{tr.name}' ({tr.source} -> {tr.target})"
    if not isinstance(tr.guard, Scheduled):
        guard = lambda s, *x: s.guard(g, *x)  # noqa: E731
        yield from _check_shape(s, a, f"guard {of}", guard, (), "it must be one number")
    holds = lambda s, *x: s.enabled(g, *x)  # noqa: E731
    yield from _check_shape(
        s, a, f"`enabled` {of}", holds, (), "it must be one truth value"
    )
    states = f"chart '{tr.target}' has the states {quoted(s.charts[b].states)}: return one for each"
    yield from _check_shape(
        s, a, f"reset {of}", lambda s, *x: s.reset(g, *x), (s.dims[b],), states
    )


def _check_shape(
    s: Structure,
    a: int,
    what: str,
    function: Callable,
    shape: tuple[int, ...],
    reason: str,
    in_flow: bool = True,
) -> Iterator[str]:
    """Check the shape of a function of a structure and (t, q, u) in chart a. `reason`: why it must
    be this one. Check the precision of a function that takes part in the flow (`in_flow`). Yield
    its name, `what`, if it uses t."""
    shapes = (), (s.dims[a],), (s.nu,)
    with evaluating(what, " (`t`, `q[0]` and `u[0]` are numbers, q and u are arrays)"):
        real = jnp.result_type(float)
        points = [jax.ShapeDtypeStruct(x, real) for x in shapes]
        program, *_ = eqx.filter_make_jaxpr(function)(s, *points)
        _check_indices(ft.partial(function, s), *(np.full(x, 0.5) for x in shapes))
    (actual,) = (x.shape for x in program.out_avals)
    if actual != shape:
        raise DefinitionError(f"the {what} returns shape {actual}, but {reason}.")
    needed, uses = dce_jaxpr(program.jaxpr, [True])
    point = [False] * (len(uses) - 3) + [True] * 3
    kept = [x for x, used in zip(point, uses, strict=True) if used]
    if in_flow and real == np.float64 and (low := _rounded_to(needed, kept)):
        raise DefinitionError(
            f"the {what} is computed in {low}, whose rounding errors are jumps for the accuracy of "
            f"the flow: write `float` in place of `jnp.{low}`."
        )
    if uses[-3] and _depends_on(
        needed, [x == len(uses) - 3 for x in np.flatnonzero(uses)]
    ):
        yield what


def _rounded_to(program: jex.Jaxpr, moving: Sequence[bool]) -> str:
    """A type of few digits in which a program computes with arguments that are `moving`; "" for
    none. (Constants of such a type are exact.)"""
    depends = dict(zip(program.invars, moving, strict=True))
    for equation in program.eqns:
        inputs = [_is_in(depends, x) for x in equation.invars]
        for inner in jaxprs(equation.params):
            same = len(inner.invars) == len(inputs)
            found = _rounded_to(
                inner, inputs if same else [any(inputs)] * len(inner.invars)
            )
            if found:
                return found
        for x in equation.outvars:
            depends[x] = any(inputs)
            kind = (
                np.dtype(x.aval.dtype) if hasattr(x.aval, "dtype") else np.dtype(float)
            )
            low = jnp.issubdtype(kind, jnp.floating) and jnp.finfo(kind).bits < 64
            if low and any(inputs):
                return kind.name
    return ""


def _depends_on(program: jex.Jaxpr, moving: Sequence[bool]) -> bool:
    """Test whether a result of a program depends on arguments that are `moving`, but for products
    with the number zero."""
    return any(_dependence(program, [(x, False) for x in moving]))


def _dependence(
    program: jex.Jaxpr, arguments: Sequence[tuple[bool, bool]]
) -> list[bool]:
    """Whether each result of a program depends on arguments, of which each is given by whether it
    moves, and whether it is the number zero."""
    states = dict(zip(program.invars, arguments, strict=True))

    def state(x) -> tuple[bool, bool]:
        if isinstance(x, jex.Literal):
            return False, bool(np.all(np.asarray(x.val) == 0))
        return states.get(x, (False, False))

    for equation in program.eqns:
        name, inputs = equation.primitive.name, [state(x) for x in equation.invars]
        moves, zeros = any(x for x, _ in inputs), [zero for _, zero in inputs]
        inner = list(jaxprs(equation.params))
        results = [(moves, False)] * len(equation.outvars)
        if name == "mul" and any(zeros):
            results = [(False, True)]
        elif name in _SAME_ZERO and zeros[0]:
            results = [(False, True)]
        elif len(inner) == 1 and len(inner[0].invars) == len(inputs) and name in _CALLS:
            results = [(x, False) for x in _dependence(inner[0], inputs)]
        states.update(zip(equation.outvars, results, strict=True))
    return [state(x)[0] for x in program.outvars]


# Operations that leave zero as it is, and those that call another program.
_SAME_ZERO = ("broadcast_in_dim", "convert_element_type", "reshape", "neg", "squeeze")
_CALLS = ("pjit", "jit", "closed_call", "custom_jvp_call", "custom_vjp_call")


def _is_in(depends: Mapping, x) -> bool:
    return not isinstance(x, jex.Literal) and depends.get(x, False)


def _check_indices(function: Callable, *point: np.ndarray) -> None:
    """Raise `IndexError` for a state or an input by an index that does not exist: JAX would
    silently take the last one, where NumPy's arrays raise."""
    with np.errstate(all="ignore"):
        try:
            jax.eval_shape(lambda: function(*point))
        except IndexError:
            raise
        except Exception:  # functions for arrays of JAX only
            return


@contextlib.contextmanager
def evaluating(what: str, takes: str = "") -> Iterator[None]:
    """A context in which JAX traces a user's function, of which errors say what to write instead.

    **Raises:** `DefinitionError`.
    """
    try:
        yield
    except DefinitionError:
        raise
    except Exception as error:
        takes = _ARGUMENTS if takes and "positional argument" in str(error) else takes
        problem = f"{str(error).rstrip('.')}{takes}."
        if isinstance(error, jax.errors.JAXTypeError):
            problem = (
                "it uses a value that JAX does not know yet: write `jnp.where(a > 0, x, y)` for "
                "`if a > 0`, `jnp.maximum` for `max`, `jnp.sin` for `math.sin` and `np.sin`, and "
                "no `float`."
            )
        raise DefinitionError(f"the {what} cannot be evaluated: {problem}") from error


def _check_names(
    what: str, kind: str, names: Sequence[str], units: Sequence[str] = ()
) -> None:
    """Check that names are distinct, and units as many, or none."""
    if isinstance(names, str) or not all(isinstance(name, str) for name in names):
        raise DefinitionError(
            f"{kind} of {what} must be a tuple of names, not {names!r}."
        )
    if len(set(names)) < len(names):
        raise DefinitionError(f"{what} has {kind} of the same name: {quoted(names)}.")
    if len(units) not in (0, len(names)):
        text = f"{what} has the {kind} {quoted(names)}, but {len(units)} units"
        raise DefinitionError(f"{text}: give one for each, or none.")
