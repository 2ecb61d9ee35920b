"""Sizes of states: what counts as 1 in each, so that no result depends on the user's units.

Every size is one number for each name of a state, whatever chart it is in. On a cycle it is the
state's largest modulus there. Before the cycle is known it is what the field at the guess makes of
the state in the time of its fastest mode, or of its clock if that is faster. Wherever rounding
errors of the field move a state by more than that, as they do a state that a symmetry keeps at
zero, the size is so large that they are tolerated.
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from .._core.precision import real
from ..engine import kernels
from ..engine.lanes import Lanes
from ..errors import DefinitionError
from ..systems.structure import Structure
from ..systems.system import HybridSystem


Sizes = dict[str, float]

# A size is at least this many times the error by which rounding moves the state in one period.
# Steps are judged by errors of 1e-12 sizes, and by the change of these errors where states are
# moved by 1e-4 sizes: both must be well above rounding. Doubled, states that are small compared to
# what moves them are computed half as accurately.
_TIMES_ROUNDING = 5e13
# Without a clock, the period may be so many times that of the fastest mode at the guess. Doubled,
# sizes of states that rest are guessed twice as large.
_MODES = 20.0
# Shifts of states and of times by which rounding errors of the field are seen, in their rounding
# errors: odd ones and even ones, of several sizes. Doubled, the errors seen are at most doubled.
_SHIFTS = np.array([-4.7, -3.1, -1.9, -0.8, 1.1, 2.3, 3.6, 5.2])
# So many rounding errors of time, as in a phase omega * t, are none of the field: they
# move it as its derivative by time says. Doubled, rounding is seen a little less.
_TIME_ROUNDING = 2.0
# Phases of the clock at which rounding errors of the field are seen at a guess: an odd number, lest
# they be those of a symmetry. Doubled, a state that rounding moves is found more surely.
_PHASES = 7


class GuessSizes(NamedTuple):
    """What a guess says of the cycle near it."""

    sizes: Sizes
    time: float
    """In which the states change by their sizes: one over the rate of the fastest mode, or over the
    clock's if that is faster."""
    points: Float[np.ndarray, "A d"]
    """A state in every chart that resets lead to; NaN in the others."""


def sizes_near(
    system: HybridSystem,
    chart: int,
    t: float,
    q: Float[np.ndarray, " d"],
    period: float | None,
) -> GuessSizes:
    """Sizes of all states, from the field at a guess and at the states that resets make of it.

    **Arguments:** `chart`, index of the guess's chart; `q`, padded; `period` of the clock.
    """
    s = Structure(system)
    points = _reached(s, chart, t, q)
    reached = np.flatnonzero(np.isfinite(points).all(axis=1))
    reached = np.roll(reached, -int(np.argmax(reached == chart)))  # the guess's chart first
    phases = np.zeros(1) if period is None else period * np.arange(_PHASES) / _PHASES
    R, n = len(reached), len(phases)
    times, states = np.repeat(float(t) + phases, R), np.tile(points[reached].T, n)
    seen = _look(s, np.tile(reached, n), times, states)
    near = _Seen(*(x[..., :R] for x in seen))
    time = _time_scale(near)
    turn = _MODES * time
    if period is not None:
        turn, time = period, min(time, period / (2 * np.pi))
    size = np.abs(near.q) + time * np.abs(near.f) + time**2 * np.abs(near.change)
    floor = _floor(seen, turn).reshape(s.d, n, R).max(axis=1)
    return GuessSizes(_by_name(s, reached, np.maximum(size, floor)), time, points)


def sizes_on(
    system: HybridSystem,
    t: Float[Array, " K"],
    chart: Int[Array, " K"],
    q: Float[Array, "d K"],
    period: float,
) -> Sizes:
    """Sizes of all states, from points of a cycle."""
    s = Structure(system)
    seen = _look(s, np.asarray(chart), np.asarray(t), np.asarray(q))
    size = np.maximum(np.abs(seen.q), _floor(seen, period))
    return _by_name(s, np.asarray(chart), size)


def given_sizes(s: Structure, scale: Mapping[str, float] | None) -> Sizes:
    """Sizes by name, as users give them.

    **Raises:** `DefinitionError` for a state that does not exist.
    """
    given = dict(scale or {})
    unknown = [name for name in given if name not in s.state_names()]
    if unknown:
        raise DefinitionError(
            f"`scale` names {unknown[0]!r}, which is no state; states are "
            f"{', '.join(s.state_names())}."
        )
    return given


def scale_of(
    s: Structure, sizes: Mapping[str, float], otherwise: Float[ArrayLike, "A d"] | None = None
) -> Float[Array, "A d"]:
    """Sizes by chart, padded, as `Settings.scale` takes them; for states whose names are not among
    the `sizes`, those of another such array, or 1."""
    scale = np.full((len(s.charts), s.d), np.nan)
    for a, chart in enumerate(s.charts):
        scale[a, : s.dims[a]] = [sizes.get(name, np.nan) for name in chart.states]
    if otherwise is None:
        return real(np.where(np.isnan(scale), 1.0, scale))
    return jnp.where(np.isnan(scale), otherwise, scale)


def sizes_of(s: Structure, scale: Float[Array, "A d"]) -> Sizes:
    """Sizes by name, from `Settings.scale`."""
    scale = np.asarray(scale)
    charts = list(enumerate(s.charts))
    return {n: float(scale[a, k]) for a, c in reversed(charts) for k, n in enumerate(c.states)}


class _Seen(NamedTuple):
    """The field at some points."""

    q: Float[np.ndarray, "d K"]
    f: Float[np.ndarray, "d K"]
    change: Float[np.ndarray, "d K"]
    """Derivative of the field along the flow."""
    derivative: Float[np.ndarray, "d d K"]
    """Of the field by the state."""
    rounding: Float[np.ndarray, "d K"]
    """By how much rounding errors change the field, seen at states and times that all but agree."""


def _look(s: Structure, chart: Int[np.ndarray, " K"], t, q) -> _Seen:
    seen = _Seen(q, *np.zeros((2, *q.shape)), np.zeros((s.d, *q.shape)), np.zeros(q.shape))
    for a in np.unique(chart):
        n, here = s.dims[a], np.flatnonzero(chart == a)
        own = _field(s, int(a), t[here], q[:n, here])
        for whole, part in zip(seen[1:], own, strict=True):
            whole[(*map(slice, part.shape[:-1]), here)] = part
    return seen


def _field(s: Structure, a: int, t, q):
    """What `_Seen` says of the field at points of chart a."""
    n, eps = len(q), np.finfo(float).eps
    # First none, then states (not all by the same part, since a common factor may cancel), then t.
    shifts = np.zeros((n, 1 + 2 * len(_SHIFTS)))
    shifts[:, 1 : len(_SHIFTS) + 1] = [np.roll(_SHIFTS, k) for k in range(n)]
    moved = q[..., None] * (1 + eps * shifts[:, None])
    later = t[:, None] * (1 + eps * np.append(np.zeros(len(_SHIFTS) + 1), _SHIFTS))
    u = np.zeros((s.nu, 1))
    seen = kernels.field(s, a, later.ravel(), moved.reshape(n, -1), u).reshape(n, -1, *later.shape)
    fields, by_time, derivative = seen[:, 0], seen[:, 1, :, :1], seen[:, 2 : 2 + n, :, 0]
    f = fields[..., 0]
    change = by_time[..., 0] + np.einsum("ijk,jk->ik", derivative, f)
    smooth = np.einsum("ijk,jks->iks", derivative, moved - q[..., None])
    smooth = smooth + by_time * (later - t[:, None])
    off = np.abs(fields - f[..., None] - smooth)
    off[..., len(_SHIFTS) + 1 :] -= _TIME_ROUNDING * eps * np.abs(by_time * t[:, None])
    rounding = np.max(off, axis=-1)  # not negative: without a shift there is none
    return f, change, derivative, rounding


def _reached(s: Structure, chart: int, t: float, q) -> Float[np.ndarray, "A d"]:
    """A state in every chart, by resets from the guess's; NaN in charts that none leads to."""
    points = np.full((len(s.charts), s.d), np.nan)
    points[chart], known = q, {chart}
    for _ in s.charts:
        for g, transition in enumerate(s.transitions):
            a, b = s.chart_index(transition.source), s.chart_index(transition.target)
            if a in known and b not in known:
                before = points[a, : s.dims[a], None]
                point = np.array([t]), before, np.zeros((s.nu, 1))
                after = kernels.reset(s, s.member(g), *point)[:, 0, 0]
                points[b], known = np.pad(after, (0, s.d - len(after))), known | {b}
    return points


def _time_scale(near: _Seen) -> float:
    """The time of the fastest mode of the field's derivative at the first point (the guess) that
    has one; in free flight none has, and the time is that in which a state changes by its size."""
    for derivative in np.moveaxis(near.derivative, -1, 0):
        if (rate := np.max(np.abs(np.linalg.eigvals(derivative)))) > 0:
            return 1 / float(rate)
    q, f, change = (np.abs(x[:, 0]) for x in (near.q, near.f, near.change))
    with np.errstate(divide="ignore", invalid="ignore"):
        times = np.concatenate([np.sqrt(q / change), q / f])
    return float(min(times[(times > 0) & (times < np.inf)], default=1.0))


def _floor(seen: _Seen, time: float) -> Float[np.ndarray, "d K"]:
    return _TIMES_ROUNDING * time * seen.rounding


def _by_name(s: Structure, chart: Int[np.ndarray, " K"], size: Float[np.ndarray, "d K"]) -> Sizes:
    """The largest size of each state in any chart; 1 for one that is zero everywhere."""
    sizes = dict.fromkeys(s.state_names(), 0.0)
    for a, column in zip(chart, size.T, strict=True):
        for name, x in zip(s.charts[a].states, column, strict=False):
            if np.isfinite(x):
                sizes[name] = max(sizes[name], float(x))
    return {name: size if size > 0 else 1.0 for name, size in sizes.items()}


# A chart is stiff if its fastest mode decays to more than this power of e in one turn: an explicit
# method, stable for about 4 of them in a step, then takes hundreds of steps wherever the motion is
# slow. Doubled, charts are called stiff from twice as many steps on.
_STIFF = 1000.0
# Modes that are slower than the fastest one by more than this stand still, up to rounding. Doubled,
# a search waits half as long at most.
_ROUNDING = 1e-9


def stiff_charts(s: Structure, legs: Lanes, period: float) -> dict[str, float]:
    """The charts with explicit methods that are stiff on a cycle, each with the rate of its fastest
    mode. `legs`: states at equal distances in time, of a turn in this period."""
    found, step = {}, period / len(np.ravel(legs.t))
    for a, t, q in points(s, legs):
        rates = fastest(s, a, t, q)
        method = s.method(a)
        if step * rates.sum() > _STIFF and not (method and method.implicit):
            found[s.names[a]] = float(rates.max())
    return found


def fastest(
    s: Structure, a: int, t: Float[np.ndarray, " P"], q: Float[np.ndarray, "n P"]
) -> Float[np.ndarray, " P"]:
    """The rates at which the fastest modes of chart a decay; 0 where none does."""
    derivative = kernels.field(s, a, t, q, np.zeros((s.nu, 1)))[:, 2 : 2 + len(q)]
    rates = -np.linalg.eigvals(np.moveaxis(derivative, -1, 0)).real
    return np.maximum(rates.max(axis=1, initial=0.0), 0.0)


def has_implicit(s: Structure) -> bool:
    """Whether an implicit method goes through a chart."""
    methods = map(s.method, range(len(s.charts)))
    return any(method is not None and method.implicit for method in methods)


def slow_time(s: Structure, t: float, states: Float[np.ndarray, "A d"]) -> float:
    """The time in which the slowest mode changes, of the charts with implicit methods: steps of
    these need not be as short as the fastest one. 0 where there are none.

    **Arguments:** `states`, one in every chart; NaN where none is known.
    """
    times = [0.0]
    for a, state in enumerate(states):
        q = state[: s.dims[a]]
        if (method := s.method(a)) and method.implicit and np.isfinite(q).all():
            times.append(1 / _slowest_and_fastest(s, a, t, q)[0])
    return max(times)


def stiff_mode(s: Structure, a: int, t: float, q: Float[np.ndarray, " n"]) -> float | None:
    """The rate of the fastest mode of a chart with an explicit method, if the slowest one is slower
    by far."""
    method = s.method(a)
    slowest, fastest = _slowest_and_fastest(s, a, t, q)
    stiff = fastest > _STIFF * slowest > 0 and not (method and method.implicit)
    return fastest if stiff else None


def _slowest_and_fastest(s: Structure, a: int, t: float, q) -> tuple[float, float]:
    """Rates of the modes at a state, without those that stand still."""
    derivative = kernels.field(s, a, np.array([t]), q[:, None], np.zeros((s.nu, 1)))
    rates = np.abs(np.linalg.eigvals(derivative[:, 2 : 2 + len(q), 0]))
    moving = rates[rates > _ROUNDING * rates.max()]
    return float(moving.min(initial=np.inf)), float(moving.max(initial=0.0))


def points(s: Structure, legs: Lanes) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Charts, times and states at the beginnings of the pieces of a turn, as far as it came."""
    t, chart, q = map(np.asarray, (legs.t, legs.chart, legs.q))
    for a in np.unique(chart):
        here = (chart == a) & np.isfinite(q).all(axis=0)
        if here.any():
            yield int(a), t[here], q[: s.dims[a], here]
