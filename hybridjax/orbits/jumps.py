"""Fields that jump on a limit cycle without an event, so that its multipliers would be wrong."""

import itertools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core as jex
from jaxtyping import Float

from .._core.meaning import is_of_package
from ..errors import DefinitionError
from ..systems.structure import Structure
from .coincidence import SAME
from .cycle import LimitCycle


# Operations whose results are whole numbers, or jump where these change.
_DECISIONS = frozenset(
    "lt le gt ge sign floor ceil round rem is_finite convert_element_type".split()
)
# Smallest jump, relative to the field. Smaller: rounding is refused. Larger: multipliers may be
# wrong by as much.
_JUMP = 1e-9
# Points of a step at which decisions are compared. Fewer: narrow pulses are missed. More: time.
_PER_STEP = 16
# Halvings of the distance of two points, after which they are neighboring numbers.
_HALVINGS = 60

Points = tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p n"]]


def check_jumps(cycle: LimitCycle) -> None:
    """**Raises:** `DefinitionError` if the field of a chart jumps on the cycle without an event."""
    s = cycle.structure
    programs = {a: _program(s, a) for a in range(len(s.charts))}
    deciding = {a: x for a, x in programs.items() if any(True for _ in _decisions(x.jaxpr))}
    if not deciding:
        return
    path = cycle.trajectory(1.25)  # beyond its end, which may be where the field jumps
    t, chart, q = path.dense(_PER_STEP)
    events = path.t[path.event >= 0]
    for a, program in deciding.items():
        k = np.flatnonzero((chart[1:] == a) & (chart[:-1] == a) & (np.diff(t) > 0))
        n = s.dims[a]
        jump = _jump(program, (t[k], q[k, :n]), (t[k + 1], q[k + 1, :n]), s.nu, events)
        if jump is None:
            continue
        time, size, decision = jump
        equation = next(itertools.islice(_decisions(program.jaxpr), decision, None))
        raise DefinitionError(
            f"the field of chart '{s.names[a]}' jumps by {size:.3g} at t = {time:.6g}"
            f"{_line_of(equation)}, where the cycle has no event: linearizations would lack the "
            "saltation. Write a chart for each side and a `Transition` between them, or "
            "`hj.sliding` for a surface along which the state may slide."
        )


def _jump(
    program: Any, low: Points, high: Points, nu: int, events: Float[np.ndarray, " e"]
) -> tuple[float, float, int] | None:
    """Return the time and the size of the largest jump between neighboring points of an orbit that
    is no event, and the index of the decision that makes it; `None` if there is none."""
    u = np.zeros(nu)
    run = jax.jit(jax.vmap(lambda t, q: _evaluate(program.jaxpr, program.consts, t, q, u)))
    if not len(low[0]):
        return None
    first, last = (np.asarray(run(*x)[1]) for x in (low, high))
    k = np.flatnonzero((first != last).any(axis=1))
    if not len(k):
        return None
    (t0, q0), (t1, q1), first = (low[0][k], low[1][k]), (high[0][k], high[1][k]), first[k]
    for _ in range(_HALVINGS):
        t, q = (t0 + t1) / 2, (q0 + q1) / 2
        same = np.asarray((run(t, q)[1] == first).all(axis=1))
        t0, t1 = np.where(same, t, t0), np.where(same, t1, t)
        q0, q1 = np.where(same[:, None], q, q0), np.where(same[:, None], q1, q)
    (left, _), (right, last) = run(t0, q0), run(t1, q1)
    jumps = np.abs(np.asarray(right - left)).max(axis=1)
    distance = np.abs(t0[:, None] - events).min(axis=1, initial=np.inf)
    jumps[distance <= SAME * np.ptp(high[0])] = 0.0
    at = int(np.argmax(jumps))
    if jumps[at] <= _JUMP * np.abs(left).max():
        return None
    return float(t0[at]), float(jumps[at]), int(np.argmax(np.asarray(last[at]) != first[at]))


def _program(s: Structure, a: int) -> Any:
    shapes = (), (s.dims[a],), (s.nu,)
    point = [jax.ShapeDtypeStruct(x, jnp.result_type(float)) for x in shapes]
    return jax.make_jaxpr(lambda t, q, u: s.field(a, t, q, u))(*point)


def _inner(equation: Any) -> Any:
    """The program that an equation calls once, with the same arguments."""
    for name in ("jaxpr", "call_jaxpr"):
        inner = equation.params.get(name)
        if inner is not None and equation.primitive.name not in ("scan", "while", "cond"):
            return inner if hasattr(inner, "jaxpr") else jex.ClosedJaxpr(inner, ())
    return None


def _decides(equation: Any) -> bool:
    """Test for decisions that depend on real numbers."""
    name = equation.primitive.name
    if name not in _DECISIONS or not _is_real(equation.invars[0].aval):
        return False
    return name != "convert_element_type" or not _is_real(equation.outvars[0].aval)


def _is_real(aval: Any) -> bool:
    return jnp.issubdtype(aval.dtype, jnp.floating)


def _decisions(program: Any) -> Iterator[Any]:
    for equation in program.eqns:
        if inner := _inner(equation):
            yield from (equation for _ in _decisions(inner.jaxpr))
        elif _decides(equation):
            for _ in range(int(np.prod(equation.outvars[0].aval.shape))):
                yield equation


def _evaluate(program: Any, constants: Any, *arguments: Any) -> tuple[Any, Any]:
    """The results of a program, as one vector, and its decisions as whole numbers."""
    decisions: list[Any] = []
    (value,) = _interpret(program, constants, arguments, decisions)
    return value, jnp.concatenate([jnp.ravel(x).astype(float) for x in decisions])


def _interpret(program: Any, constants: Any, arguments: Any, decisions: list[Any]) -> list[Any]:
    values: dict[Any, Any] = {}
    read: Callable = lambda x: x.val if isinstance(x, jex.Literal) else values[x]  # noqa: E731
    values |= zip(program.constvars, constants, strict=True)
    values |= zip(program.invars, arguments, strict=True)
    for equation in program.eqns:
        given = [read(x) for x in equation.invars]
        if inner := _inner(equation):
            results = _interpret(inner.jaxpr, inner.consts, given, decisions)
        else:
            results = _bind(equation, given)
            if _decides(equation):
                name, (result,) = equation.primitive.name, results
                decisions.append(jnp.trunc(given[0] / given[1]) if name == "rem" else result)
        values |= zip(equation.outvars, results, strict=True)
    return [read(x) for x in program.outvars]


def _bind(equation: Any, given: list[Any]) -> list[Any]:
    """The results of one equation."""
    bound = equation.primitive.get_bind_params(equation.params)
    functions, params = bound if isinstance(bound, tuple) else ((), bound)  # (JAX before 0.10)
    results = equation.primitive.bind(*functions, *given, **params)
    return results if equation.primitive.multiple_results else [results]


def _line_of(equation: Any) -> str:
    """The line of a user's file that wrote an equation, for messages."""
    traceback = equation.source_info.traceback
    for frame in traceback.frames if traceback else ():
        if not is_of_package(frame.file_name):
            return f" ({frame.file_name}:{frame.line_num})"
    return ""
