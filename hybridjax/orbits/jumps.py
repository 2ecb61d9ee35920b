"""Fields that jump on a limit cycle without an event, so that its multipliers would be wrong."""

import math
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core as jex
from jaxtyping import Float

from .._core.compilation import quick_jit
from .._core.meaning import is_of_package
from ..errors import DefinitionError
from ..systems.structure import Structure
from .coincidence import SAME
from .cycle import LimitCycle


# Operations on real numbers whose results jump. (Others decide if their results are no reals.)
_DECISIONS = frozenset("sign floor ceil round rem atan2".split())
_KINKS = re.compile(rf"= ({'|'.join(_DECISIONS)}|max|min|abs|clamp|select_n|cond)\b")
# Smallest jump, relative to the field. Smaller: rounding is refused. Larger: multipliers may be
# wrong by as much.
_JUMP = 1e-9
# Points of a step at which decisions are compared, besides the extrema of what they depend on.
# Fewer: extrema are missed. More: time.
_PER_STEP = 16
# Halvings of the distance of two points, after which they are neighboring numbers.
_HALVINGS = 52
# Changes of decisions between two points that are looked at. Fewer: jumps are missed behind others.
# More: time.
_CHANGES = 8

Points = Float[np.ndarray, "P 1+n"]
"""Times and states."""


class _Decision(NamedTuple):
    equation: Any
    value: Any
    """The decision, as a number."""
    argument: Any
    """A real number on which it depends, of the same shape."""


def check_jumps(cycle: LimitCycle) -> None:
    """**Raises:** `DefinitionError` if the field of a chart jumps on the cycle without an event."""
    s = cycle.structure
    decisions = {a: lines for a in range(len(s.charts)) if (lines := lines_of_decisions(s, a))}
    if not decisions:
        return
    path = cycle.trajectory(1.25)  # beyond its end, which may be where the field jumps
    t, chart, q = path.dense(_PER_STEP)
    events = path.t[path.event >= 0]
    for a, lines in decisions.items():
        k = np.flatnonzero((chart[1:] == a) & (chart[:-1] == a) & (np.diff(t) > 0))
        points = np.column_stack([t, q[:, : s.dims[a]]])
        for time, jump, j in _jumps(s, a, points[k], points[k + 1]) if len(k) else ():
            if np.abs(time - events).min(initial=np.inf) > SAME * np.ptp(t):
                raise DefinitionError(
                    f"the field of chart '{s.names[a]}' jumps by {jump:.3g} at t = {time:.6g}"
                    f"{lines[j]}, where the cycle has no event: linearizations would lack the "
                    "saltation. Write a chart for each side and a `Transition` between them, or "
                    "`hj.sliding` for a surface along which the state may slide."
                )


def has_kinks(s: Structure) -> bool:
    """Test whether a field has operations with kinks or jumps, where many steps are rejected."""
    return any(_KINKS.search(str(_program(s, a))) for a in range(len(s.charts)))


def lines_of_decisions(s: Structure, a: int) -> list[str]:
    """The lines of code that make the decisions of the field of a chart, one for each decision."""
    lines: list[str] = []

    def note(*point):
        for x in _interpret(_program(s, a), point)[1]:
            lines.extend([_line_of(x.equation)] * x.value.size)

    jax.eval_shape(note, *_point(s, a))
    return lines


def _point(s: Structure, a: int) -> list[jax.ShapeDtypeStruct]:
    real = jnp.result_type(float)
    return [jax.ShapeDtypeStruct(shape, real) for shape in ((), (s.dims[a],), (s.nu,))]


def _program(s: Structure, a: int) -> jex.ClosedJaxpr:
    return jax.make_jaxpr(lambda t, q, u: s.field(a, t, q, u))(*_point(s, a))


def _jumps(s: Structure, a: int, low: Points, high: Points):
    """Yield the times and sizes of jumps between neighboring points of an orbit, and the index of
    the decision that makes each."""
    along = high - low
    rows = 4 ** math.ceil(math.log(len(low), 4) + 1)  # few lengths, since each is compiled

    def at(x, along=None):
        fill = [(0, -len(x) % rows), (0, 0)]
        dx = np.pad(0 * x if along is None else along, fill)
        return [np.asarray(y)[: len(x)] for y in _at(s, a, np.pad(x, fill, "edge"), dx)]

    (values, _, begin), (_, _, end) = at(low, along), at(high, along)
    # A decision may change and change back around an extremum of what it depends on.
    k, j = np.nonzero(begin * end < 0)
    if len(k):
        pick = np.arange(len(k)), j
        rises = lambda x: begin[k, j] * at(x, along[k])[2][pick] > 0  # noqa: E731
        extrema, _ = _bisect(low[k], high[k], rises)
        low, high = np.concatenate([low, extrema]), np.concatenate([high, high[k]])
        order = np.argsort(low[:, 0], kind="stable")
        low, high = low[order], high[order]
        inside = low[1:, 0] < high[:-1, 0]
        high[:-1][inside] = low[1:][inside]
    slow = np.abs(low[:, 1:]).max(axis=0) / (high[-1, 0] - low[0, 0])
    slow = np.pad(slow, (0, values.shape[1] - len(slow)))
    limit = _JUMP * np.maximum(np.abs(values).max(axis=0), slow)
    for _ in range(_CHANGES):
        first, last = (at(x)[1] for x in (low, high))
        k = np.flatnonzero((first != last).any(axis=1))
        if not len(k):
            return
        low, high, first = low[k], high[k], first[k]
        left, right = _bisect(low, high, lambda x, old=first: (at(x)[1] == old).all(axis=1))
        (before, _, _), (after, last, _) = at(left), at(right)
        jump = np.abs(after - before)
        for i in np.flatnonzero((jump > limit).any(axis=1)):
            yield left[i, 0], jump[i].max(), int(np.argmax(last[i] != first[i]))
        low = right


def _bisect(low: Points, high: Points, is_low: Callable) -> tuple[Points, Points]:
    """Neighboring points between which a property of the lower ones ends."""
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        same = is_low(middle)[:, None]
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return low, high


@quick_jit
def _at(s: Structure, a: int, points, along):
    """At points, the field with its derivatives by the inputs, all decisions, and the rates of what
    these depend on, along a direction."""

    def at(x, dx):
        def run(x, u):
            (value,), decisions = _interpret(_program(s, a), (x[0], x[1:], u))
            flat = [(jnp.ravel(d.value) * 1.0, jnp.ravel(d.argument)) for d in decisions]
            return value, *map(jnp.concatenate, zip(*flat, strict=True))

        u = jnp.zeros(s.nu)
        gains = jnp.ravel(jax.jacfwd(lambda u: run(x, u)[0])(u))
        (value, decisions, _), (_, _, rates) = jax.jvp(lambda x: run(x, u), (x,), (dx,))
        return jnp.concatenate([value, gains]), decisions, rates

    return jax.vmap(at)(points, along)


def _interpret(program: jex.ClosedJaxpr, arguments: Any) -> tuple[list[Any], list[_Decision]]:
    """The results of a program, and its decisions."""
    values: dict[Any, Any] = {}
    read: Callable = lambda x: x.val if isinstance(x, jex.Literal) else values[x]  # noqa: E731
    values |= zip(program.jaxpr.constvars, program.consts, strict=True)
    values |= zip(program.jaxpr.invars, arguments, strict=True)
    decisions: list[_Decision] = []
    for equation in program.jaxpr.eqns:
        results, new = _step(equation, [read(x) for x in equation.invars])
        values |= zip(equation.outvars, results, strict=True)
        decisions += new
    return [read(x) for x in program.jaxpr.outvars], decisions


def _step(equation: Any, given: list[Any]) -> tuple[list[Any], list[_Decision]]:
    """The results of an equation, and its decisions."""
    name, params = equation.primitive.name, equation.params
    if name == "cond":
        ends = [_interpret(x, given[1:]) for x in params["branches"]]
        index = jnp.clip(given[0], 0, len(ends) - 1)
        results = [jnp.stack(x)[index] for x in zip(*(x for x, _ in ends), strict=True)]
        return results, [x for _, decisions in ends for x in decisions]
    if name in ("scan", "while"):
        return _loop(equation, given)
    inner = next((params[x] for x in ("jaxpr", "call_jaxpr") if params.get(x) is not None), None)
    if inner is not None:
        inner = inner if hasattr(inner, "jaxpr") else jex.ClosedJaxpr(inner, ())
        results, decisions = _interpret(inner, given)
        decisions = [x._replace(equation=equation) for x in decisions]
    else:
        results, decisions = _bind(equation, given), []
        value = next((x for x in results if not _is_real(x)), None)
        if given and any(map(_is_real, given)) and (name in _DECISIONS or value is not None):
            decisions = [_decision(equation, given, results[0] if value is None else value)]
    return results, decisions


def _decision(equation: Any, given: list[Any], value: Any) -> _Decision:
    name = equation.primitive.name
    if name == "rem":
        argument = given[0] / given[1]
        value = jnp.round((given[0] - value) / given[1])
    elif name == "atan2":
        argument = given[0]
        value = (given[0] < 0) & (given[1] < 0)
    else:
        reals = [x for x in given if _is_real(x)]
        argument = reals[0] - reals[1] if len(reals) == 2 else reals[0]
    value = jnp.where(jnp.isnan(value), 0.0, value)
    if jnp.shape(argument) != jnp.shape(value):
        argument = jnp.zeros(jnp.shape(value))
    return _Decision(equation, value, argument)


def _loop(equation: Any, given: list[Any]) -> tuple[list[Any], list[_Decision]]:
    """A loop with one decision: a number that each of its decisions, and each round, changes."""
    params = equation.params

    def once(program, given, total):
        results, decisions = _interpret(program, given)
        weighed = [jnp.sum(x.value * (1 + jnp.arange(x.value.size))) for x in decisions]
        return results, 0.99 * total + 1.0 + sum(weighed)

    if equation.primitive.name == "scan":
        n, m = params["num_consts"], params["num_consts"] + params["num_carry"]

        def body(carry, xs):
            results, total = once(params["jaxpr"], [*given[:n], *carry[0], *xs], carry[1])
            return (results[: m - n], total), results[m - n :]

        begin = given[n:m], jnp.zeros(())
        options = params["length"], params["reverse"]
        (carry, total), ys = jax.lax.scan(body, begin, given[m:], *options)
        results = [*carry, *ys]
    else:
        n, m = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
        goes_on: Any = lambda x: _interpret(params["cond_jaxpr"], [*given[:n], *x[0]])[0][0]  # noqa: E731
        round_: Any = lambda x: once(params["body_jaxpr"], [*given[n:m], *x[0]], x[1])  # noqa: E731
        results, total = jax.lax.while_loop(goes_on, round_, (given[m:], jnp.zeros(())))
    return results, [_Decision(equation, total, jnp.zeros(()))]


def _is_real(x: Any) -> bool:
    return jnp.issubdtype(jnp.result_type(x), jnp.floating)


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
