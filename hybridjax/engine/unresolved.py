"""Find fields that jump, and pulses that are so short that integration steps pass over them.

Three callers ask: `trajectory.py` tests each step of a simulation (`passed_over`),
`orbits/checks.py` looks for jumps along a cycle (`jumps`), and searches ask whether pulses are
possible at all (`may_have_pulses`, from the operations in the program of the field). A step passes
over a pulse if the polynomial through eight values of a rate misses a part of its integral over the
step (`_passing`). A *gain* is a derivative of the field by an input.

If a good field is refused, or a pulse is passed over in silence, look at the limits in `_passing`;
if a field is never tested, at `sudden`, which reads its program; if a jump is not found, at
`jumps`. The columns of `values_at` must stay in their order, by which `column_name` names them.
"""

import functools as ft
from collections.abc import Callable, Iterator
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from .._core import jax_compat
from .._core.compilation import kind
from .._core.reading import is_of_package
from ..systems.solver import Method
from ..systems.structure import Structure
from . import kernels
from .cubic import interpolate
from .settings import ROUNDING, Settings


# A word of `jax_compat.suddenness`. Near a pole, a function decays as the inverse of the distance
# or its square, so slowly that a few points in a step notice it, unless the program has higher
# powers.
POLES = frozenset(["pole"])
# Number of intervals into which a step is divided, with four points in each. On cycles there are
# four times as many; if only poles are possible, there are few. Fewer: short pulses are missed.
# More: time.
_PIECES = 64
_FEW = 8
# The integrals over a step of a rate and of the polynomial through eight of its values may differ
# by `_SAME` times the accuracy. For a gain, they may differ by the part `_SAME_GAIN` of the
# integral over all steps, since steps do not end at kinks of gains. Smaller: kinks are refused.
# Larger: pulses with this effect are missed.
_SAME = 1e3
_SAME_GAIN = 1e-5
# A guard falls below zero if it is negative by more than this part of its largest value. Smaller: a
# guard that only comes near zero counts as falling. Larger: small falls between steps are missed.
_NEAR = 1e-5
# Number of points in one call, and number of steps whose points are in memory at once. Fewer: more
# calls. More: few points take longer, and many points take more memory.
_POINTS = 1024
# Operations with jumps or kinks.
_KINKS = frozenset(["decision", "kink"])
# A field jumps if its relative change between two points exceeds `_JUMP`, and is more than `_STEEP`
# times the distance of the points (in periods and magnitudes of the states). Smaller `_JUMP`:
# rounding errors count as jumps. Larger: multipliers have errors of this size. Smaller `_STEEP`:
# steep functions count as jumps although steps resolve them. Larger: multipliers are wrong near
# steep functions that steps do not resolve.
_JUMP = 1e-8
_STEEP = 1e7
# How often an interval is replaced by one of its quarters: the quarter in which the change of the
# field differs most from the changes in the others. Fewer: a jump is missed if the field also
# changes a lot elsewhere in the step. More: time.
_QUARTERS = 20

Points = Float[np.ndarray, "P 1+n"]
"""Times and states."""


def program_of(s: Structure, a: int, function: Callable | None = None):
    """The program of a function of chart a. Default: its field."""
    if function is None:
        function = ft.partial(s.field, a)
    shapes = (), (s.dims[a],), (s.nu,)
    real = jnp.result_type(float)
    point = [jax.ShapeDtypeStruct(shape, real) for shape in shapes]
    return jax.make_jaxpr(function)(*point).jaxpr


def sudden(program: jax_compat.Program) -> Iterator[tuple[str, Any]]:
    """Iterate over the operations of a program that depend on its arguments and may jump or have
    pulses. Yields the kind of operation (a word of `jax_compat.suddenness`), and the equation or
    call in the program."""
    moving = set(program.invars)
    for equation in program.eqns:
        moves = [jax_compat.is_variable(x) and x in moving for x in equation.invars]
        if not any(moves):
            continue
        moving.update(equation.outvars)
        if jax_compat.solves_scalars_only(equation):
            yield "pole", equation
            continue
        for call in jax_compat.inner_programs(equation):
            for how, _ in sudden(call):
                yield how, equation
        for how in jax_compat.suddenness(equation, moves):
            yield how, equation


def may_be_sudden(s: Structure, a: int, function: Callable) -> frozenset[str]:
    """The kinds of `sudden` operations in a function (structure, chart, *point) of a module."""
    key = function, a, kind(s)
    if key not in _sudden:
        program = program_of(s, a, ft.partial(function, s, a))
        names = frozenset(name for name, _ in sudden(program))
        _sudden[key] = frozenset() if names == {"power"} else names
    return _sudden[key]


_sudden: dict[tuple, frozenset[str]] = {}


def passed_over(
    path: Any, u: Float[np.ndarray, " nu"], settings: Settings, linear: bool = False
) -> tuple[int, str] | None:
    """The first step of a `Trajectory` that passes over a pulse, and the name of the rate, gain or
    guard that has the pulse; None if there is no such step.

    **Arguments:** `linear`: whether the path is linearized, so that steps must resolve jumps, too.
    """
    s = path.structure
    passed = []
    is_step = np.diff(path.t) > 0
    chart = path.chart[:-1]
    for a in np.unique(chart).tolist():
        rows = np.flatnonzero((chart == a) & is_step)
        if len(rows) and may_have_pulses(s, a):
            wrong = np.argwhere(_passing(path, a, rows, u, settings, linear))
            for k, j in wrong[:1].tolist():
                passed.append((int(rows[k]), column_name(s, a, j)))
    return min(passed, default=None)


def _passing(
    path: Any, a: int, rows, u, settings: Settings, linear: bool
) -> np.ndarray:
    """Test which steps in chart a, given by the rows at which they begin, pass over a pulse of each
    rate, gain and guard: the polynomial through eight of its values in the step misses the
    pulse."""
    # What the polynomials miss, in parts that fit into memory. Columns: n rates, then gains.
    s = path.structure
    n = s.dims[a]
    m = n * (1 + s.nu)
    only_poles = may_have_pulses(s, a) <= POLES
    samples = _samples(s.method(a), only_poles, linear)
    with_guards = bool(may_be_sudden(s, a, _guards))
    parts = []
    for k in np.split(rows, range(_POINTS, len(rows), _POINTS)):
        points = _points_within(path, k, samples.nodes, n)
        values = values_at(s, a, points.reshape(-1, 1 + n), u, with_guards)
        values = values.reshape(*points.shape[:2], -1)
        seen = values[:, :8, :m]
        rates = values[:, 8:, :m]
        guards = values[:, 8:, m:]
        beside = rates - samples.polynomial @ seen
        duration = np.diff(path.t)[k, None]
        lacks = duration * np.abs(samples.weights @ beside)
        if linear and len(k) > 1 and not only_poles:
            error = _errors_of_gains(k, rates[:, :, n:], duration, samples.probes)
            of_gains = lacks[:-1, n:]
            lacks[:-1, n:] = np.maximum(of_gains, error)
        part = _Part(
            moved=duration * (samples.weights @ np.abs(rates)),
            lacks=lacks,
            beside=np.abs(beside).max(axis=1),
            largest=np.abs(rates).max(axis=1),
            falls=_falls(guards),
        )
        parts.append(part)
    whole = _Part(*map(np.concatenate, zip(*parts, strict=True)))

    # What they may miss, relative to the magnitudes of all steps.
    accuracy = np.max(np.asarray(settings.rtol))
    if settings.scale is None:
        usual = np.abs(path.after[rows]).max(axis=0)
    else:
        usual = settings.scale[a]
    size = whole.moved.sum(axis=0)
    usual_states = usual[:n]
    size[:n] = np.maximum(size[:n], usual_states)
    same = np.repeat([_SAME * accuracy, _SAME_GAIN], [n, m - n])
    allowed = same * size + ROUNDING * size.max()
    wrong = whole.lacks > allowed
    if linear:
        fastest = whole.largest[:, :n].max(axis=0)
        usual_rate = usual[:n] / np.ptp(path.t)
        fastest = np.maximum(fastest, usual_rate)
        # (The square root of the accuracy, which is the error at a kink. Less: kinks are refused.
        # More: multipliers are wrong near steep functions that steps do not resolve.)
        steep = np.sqrt(accuracy) * fastest
        is_steep = whole.beside[:, :n] > steep
        wrong[:, :n] |= is_steep
    return np.concatenate([wrong, whole.falls], axis=1)


def _errors_of_gains(
    k: Int[np.ndarray, " K"],
    gains: Float[np.ndarray, "K f j"],
    duration: Float[np.ndarray, "K 1"],
    probes: Float[np.ndarray, "p f2"],
) -> Float[np.ndarray, "K-1 j"]:
    """Errors of the gains, by the probes (see `_probes`) of two steps in a row; 0 where the two
    steps do not follow each other.

    **Arguments:** `k`: the rows of the steps.
    """
    both = [gains[:-1], gains[1:]]
    pairs = np.concatenate(both, axis=1)
    errors = np.abs(np.einsum("pf,kfj->kpj", probes, pairs))
    error = duration[:-1] * errors.max(axis=1, initial=0.0)
    follows = np.diff(k)[:, None] == 1
    return np.where(follows, error, 0.0)


class _Samples(NamedTuple):
    """The points at which a step is evaluated: the eight points of a polynomial, then F points in
    many small intervals."""

    nodes: np.ndarray
    """Parts of the step (8 + F, 1)."""
    polynomial: np.ndarray
    """Matrix (F, 8) from values at the eight points to values of the polynomial at the F points."""
    weights: np.ndarray
    """Weights of the F points in an integral over the step."""
    probes: np.ndarray
    """See `_probes`."""


def _samples(method: Method, only_poles: bool, linear: bool) -> _Samples:
    """The points at which steps of a method are evaluated."""
    pieces = 4 * _PIECES if linear else _PIECES
    if only_poles:
        pieces = _FEW
    legendre = np.polynomial.legendre
    coarse, _ = legendre.leggauss(8)
    inner, weights = legendre.leggauss(4)
    number = np.arange(pieces)[:, None]
    within_pieces = number + (inner + 1) / 2
    fine = 2 * within_pieces.ravel() / pieces - 1
    coefficients = np.linalg.inv(legendre.legvander(coarse, 7))
    of_step = np.tile(weights / 2 / pieces, pieces)
    return _Samples(
        nodes=(np.append(coarse, fine)[:, None] + 1) / 2,
        polynomial=legendre.legvander(fine, 7) @ coefficients,
        weights=of_step,
        probes=_probes(method, (fine + 1) / 2, of_step),
    )


class _Part(NamedTuple):
    """Results for K steps (rows) and each rate and gain, or each guard (columns)."""

    moved: np.ndarray
    """Integrals of the absolute values."""
    lacks: np.ndarray
    """Part of the integrals that the polynomial, or a step of the method, misses."""
    beside: np.ndarray
    """Largest distance of the values from the polynomial."""
    largest: np.ndarray
    """Largest absolute value."""
    falls: np.ndarray
    """Whether a guard falls below zero."""


def _points_within(
    path: Any, k: np.ndarray, nodes: np.ndarray, n: int
) -> Float[np.ndarray, "K F 1+n"]:
    """Times and states at nodes of the steps that begin at rows k of a path."""
    begin = path.t[k, None, None]
    h = np.diff(path.t)[k, None, None]
    q = interpolate(
        nodes,
        h,
        path.after[k, None, :n],
        path.before[k + 1, None, :n],
        path.slope_after[k, None, :n],
        path.slope_before[k + 1, None, :n],
    )
    t = begin + h * nodes
    return np.concatenate([t, q], axis=2)


def _falls(values: np.ndarray) -> np.ndarray:
    """Test in which steps guards fall below zero while they are enabled. `values`: (K, F, guards
    and predicates)."""
    guards, enabled = np.split(values, 2, axis=2)
    largest = np.abs(guards).max(axis=(0, 1))
    is_low = guards < -_NEAR * largest
    was_positive = np.maximum.accumulate(guards, 1) > 0
    falls = is_low & was_positive & (enabled > 0)
    return falls.any(axis=1)


def _probes(method: Method, within: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Weights of the samples in two successive steps, one row for each trial step within them. A
    row times the samples of a rate is the error of the integral over the trial step if the method
    computes it from its stages. (Experiments and linearizations take other steps than the cycle, up
    to 1.5 times as long.)"""
    t = np.concatenate([within, 1 + within])
    rows = []
    for begin, length in product(np.arange(5) / 4, (1.0, 1.5)):
        if begin + length > 2:
            continue
        stages = begin + length * np.array(method.c)
        inside = (t > begin) & (t < begin + length)
        # (The value at a stage lies between those of two samples.)
        left = np.searchsorted(t, stages) - 1
        left = np.clip(left, 0, len(t) - 2)
        right = left + 1
        of_stage = length * np.array(method.b)
        since = stages - t[left]
        of_right = of_stage * since / (t[right] - t[left])
        of_left = of_stage - of_right
        row = -np.tile(weights, 2) * inside
        np.add.at(row, left, of_left)
        np.add.at(row, right, of_right)
        rows.append(row)
    return np.stack(rows)


def column_name(s: Structure, a: int, j: int) -> str:
    """The name of a column of `values_at`."""
    n = s.dims[a]
    states = s.charts[a].states
    if j < n:
        return f"rate of '{states[j]}'"
    row, column = divmod(j - n, max(s.nu, 1))
    if row < n and s.nu:
        return f"gain from '{s.inputs[column]}' to the rate of '{states[row]}'"
    guard = j - n * (1 + s.nu)
    transition = s.transitions[s.guards(a)[guard]]
    return f"guard of '{transition.name}'"


def values_at(
    s: Structure, a: int, points: Points, u: Float[np.ndarray, " nu"], guards=False
):
    """The field of chart a at points, and its derivatives by the inputs (gains); with `guards`,
    also the guards and whether their predicates hold."""

    lanes = kernels.POINTS if may_have_pulses(s, a) <= POLES else kernels.WIDE

    def at(x):
        t = x[:, 0]
        q = x[:, 1:].T
        point = (t, q, u[:, None])
        n = s.dims[a]
        by = kernels.field(s, a, *point, lanes=lanes)
        by_input = by[:, 2 + n :]
        rows = [by[:, 0], by_input.reshape(-1, len(x))]
        if guards:
            first = np.zeros(1, int)
            watched = kernels.watched(s, a, None, *point, first, lanes=lanes)
            rows.append(watched[:, 0])
            for guard in s.guards(a):
                enabled = kernels.enabled(s, s.member(guard), *point, lanes=lanes)
                rows.append(enabled[None])
        return np.concatenate(rows).T

    blocks = np.split(points, range(_POINTS, len(points), _POINTS))
    return np.concatenate([at(block) for block in blocks])


def may_have_pulses(s: Structure, a: int) -> frozenset[str]:
    """How the field or a guard of chart a may jump or have pulses."""
    return may_be_sudden(s, a, Structure.field) | may_be_sudden(s, a, _guards)


def may_jump(s: Structure, a: int) -> bool:
    """Test whether the field of chart a may jump."""
    return bool(may_be_sudden(s, a, Structure.field) - POLES)


def _guards(s: Structure, a: int, *point: Any) -> Any:
    return s.guard_values(s.guard_kinds(a), *point)


def jumps(
    s: Structure, a: int, low: Points, high: Points, sizes: Float[np.ndarray, " 1+n"]
):
    """Yield times at which the field or a gain jumps within intervals of an orbit, the column of
    `values_at` that jumps, and the jump."""
    n = s.dims[a]
    m = n * (1 + s.nu)
    quarters = np.arange(1, 4)[:, None, None] / 4

    def at(points):
        no_input = np.zeros(s.nu)
        return values_at(s, a, points, no_input)[:, :m]

    def limits(first):
        """Magnitudes of the field and the gains, relative to which changes are judged."""
        signs = (-1.0) ** np.arange(1 + n)
        shifted = low * (1 + 2e-15 * signs)
        changes = np.abs(at(shifted) - first)
        # (A quantile: not the change at a jump.)
        rounding = np.nanquantile(changes, 0.9, axis=0)
        largest = np.nanmax(np.abs(first), axis=0)
        limit = np.maximum(largest, rounding / _JUMP)
        rate_of_size = sizes[1:] / sizes[0]
        limit[:n] = np.maximum(limit[:n], rate_of_size)
        largest_gain = limit[n:].max(initial=0.0)
        least = _SAME_GAIN * largest_gain
        limit[n:] = np.maximum(limit[n:], least)
        limit[n:] += np.finfo(float).tiny
        return limit

    first = at(low)
    last = at(high)
    limit = limits(first)
    for _ in range(_QUARTERS):
        between = low + quarters * (high - low)
        points = np.stack([low, *between, high])
        inside = at(np.concatenate(between))
        inside = inside.reshape(3, *first.shape)
        values = np.nan_to_num(np.stack([first, *inside, last]))
        changes = np.diff(values, axis=0)
        change = np.abs(changes) / limit
        lengths = np.abs(np.diff(points, axis=0) / sizes)
        distance = lengths.max(axis=2, keepdims=True)
        usual = changes.mean(axis=0)
        uneven = np.abs(changes - usual) / limit
        # The quarter of each interval in which the change of the field differs most from the other
        # quarters.
        worst = uneven.max(axis=2).argmax(axis=0)
        here = np.arange(len(low))
        low = points[worst, here]
        high = points[worst + 1, here]
        first = values[worst, here]
        last = values[worst + 1, here]
        is_steep = change > _STEEP * distance
        is_jump = (change > _JUMP) & is_steep
        for i, j in np.argwhere(is_jump[worst, here]):
            largest_change = change[worst[i], i, j] * limit[j]
            yield low[i, 0], j, largest_change
        keep = uneven.max(axis=(0, 2)) > _JUMP
        if not keep.any():
            return
        low = low[keep]
        high = high[keep]
        first = first[keep]
        last = last[keep]


def has_kinks(s: Structure) -> bool:
    """Test whether a field has operations with kinks or jumps, where many steps are rejected."""
    charts = range(len(s.charts))
    return any(may_be_sudden(s, a, Structure.field) & _KINKS for a in charts)


def lines_of_jumps(s: Structure, a: int) -> list[str]:
    """The lines of code at which the field of a chart may jump. If there are decisions (`where`,
    comparisons), only their lines."""
    decisions = []
    others = []
    for name, equation in sudden(program_of(s, a)):
        if name == "decision":
            decisions.append(_line_of(equation))
        elif name != "power":
            others.append(_line_of(equation))
    lines = dict.fromkeys(decisions or others)
    return [line for line in lines if line]


def _line_of(equation: Any) -> str:
    """The line of a user's file that wrote an equation, for messages."""
    for file, line in jax_compat.lines_of(equation):
        if not is_of_package(file):
            return f" ({file}:{line})"
    return ""
