"""Sizes (characteristic magnitudes) of states, and time scales of modes.

Errors are measured in sizes, so that no result depends on the user's units. Searches call
`sizes_near` before the cycle is known and `sizes_on` once it is known; `scale_of` puts sizes into
`Settings.scale`. Each name of a state must have one size in all charts, since `sizes_of` reads it
from the first chart that has the state. On a cycle, it is the largest modulus of the state. Before
the cycle is known, it is the modulus at the guess, plus the change of the state by the field there
in the time of the fastest mode or of the clock. A size is at least large enough that rounding
errors of the field do not count: this matters for states that a symmetry keeps at zero.

`stiff_charts` and `slow_time` estimate time scales from the eigenvalues of the field's derivative.

If steps are too long or too short in one state, look at its size: before the cycle is known, at
`sizes_near` (the modes in `_time_scale`), and then at `sizes_on`. If a chart counts as stiff and is
not, look at `stiff_charts` and `STIFF`.
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float, Int

from .._core.arguments import require_among
from .._core.executor import Array, is_tracer, to_host
from .._core.precision import real
from ..engine import kernels
from ..engine.lanes import Lanes
from ..systems.structure import Structure


Sizes = dict[str, float]

# A size is at least this many times the error that rounding causes in the state over one period.
# (Steps have errors of 1e-12 sizes.) Smaller: rounding makes steps very short. Larger: states that
# are small compared to their rates lose accuracy.
_TIMES_ROUNDING = 5e13
# Without a clock, the assumed period, in units of the time scale of the fastest mode at the guess.
# Smaller: rounding shortens steps. Larger: states at rest get sizes that hide errors.
_MODES = 20.0
# Shifts of states and times (in units of their rounding errors) at which the field is evaluated to
# measure its rounding errors. They are odd and even, and of different magnitudes, since equal
# shifts may cancel.
_SHIFTS = np.array([-4.7, -3.1, -1.9, -0.8, 1.1, 2.3, 3.6, 5.2])
# A chart is stiff if the rate of its fastest mode, times the period, exceeds this. Smaller: an
# implicit method is used where an explicit one is faster. Larger: explicit methods take thousands
# of steps.
STIFF = 1000.0
# Rates of modes, and singular values of factors (in sizes of the states), count as zero below this
# part of the largest one. Larger: slow modes and small multipliers are lost. Smaller: rounding
# errors are taken for modes and multipliers.
ROUNDING = 1e-9


class GuessSizes(NamedTuple):
    """Sizes near a guess."""

    sizes: Sizes
    time: float
    """Time scale of the states: the inverse of the rate of the fastest mode, or of the clock's
    angular frequency if that is larger."""
    points: Float[np.ndarray, "A d"]
    """A state in every chart to which resets lead; NaN in other charts."""


def sizes_near(
    s: Structure, chart: int, t: float, q: Float[np.ndarray, " d"], period: float | None
) -> GuessSizes:
    """Sizes of all states, from the field at a guess, and at the states after resets from the
    guess.

    **Arguments:** `chart`, index of the guess's chart; `q`, padded; `period` of the clock.
    """
    points = _reached(s, chart, t, q)
    is_reached = np.isfinite(points).all(axis=1)
    reached = np.flatnonzero(is_reached)
    # The guess's chart comes first.
    place_of_guess = int(np.argmax(reached == chart))
    reached = np.roll(reached, -place_of_guess)
    R = len(reached)

    # An odd number of phases of the clock, since an even number may coincide with a symmetry.
    phases = np.zeros(1)
    if period is not None:
        phases = period * np.arange(7) / 7
    times = np.repeat(float(t) + phases, R)
    charts = np.tile(reached, len(phases))
    fields = _fields(s, charts, times, points[charts].T)

    states = points[reached].T
    near = _Fields(*(x[..., :R] for x in fields))
    time = _time_scale(states, near)
    turn = _MODES * time
    if period is not None:
        turn = period
        time = min(time, period / (2 * np.pi))

    by_rate = time * np.abs(near.f)
    by_change = time**2 * np.abs(near.change)
    size = np.abs(states) + by_rate + by_change
    floor = _TIMES_ROUNDING * turn * fields.rounding
    floor = floor.reshape(s.d, len(phases), R).max(axis=1)
    sizes = _by_name(s, reached, np.maximum(size, floor))
    return GuessSizes(sizes, time, points)


def sizes_on(s: Structure, lanes: Lanes, period: float) -> Sizes:
    """Sizes of all states, from points of a cycle."""
    t = np.asarray(lanes.t)
    chart = np.asarray(lanes.chart)
    q = np.asarray(lanes.q)
    rounding = _fields(s, chart, t, q).rounding
    floor = _TIMES_ROUNDING * period * rounding
    size = np.maximum(np.abs(q), floor)
    return _by_name(s, chart, size)


def in_sizes(
    matrix: Float[Array, "*L n d"],
    sizes: Float[Array, "*L d"],
    after: Float[Array, "*L n"] | None = None,
) -> Float[Array, "*L n d"]:
    """A matrix of derivatives of states by states, in units of their sizes.

    **Arguments:** `sizes` of the states by which the derivative is taken; `after`, sizes of the
    states whose derivative it is. Default: the same.
    """
    rows = sizes if after is None else after
    return matrix * sizes[..., None, :] / rows[..., :, None]


def given_sizes(s: Structure, scale: Mapping[str, float] | None) -> Sizes:
    """Sizes by name, as users give them.

    **Raises:** `DefinitionError` for a state that does not exist.
    """
    require_among("state", scale or (), s.state_names(), "`scale`: ")
    return dict(scale or {})


def scale_of(
    s: Structure,
    sizes: Mapping[str, float],
    otherwise: Float[ArrayLike, "A d"] | None = None,
) -> Float[Array, "A d"]:
    """Sizes by chart, padded, as in `Settings.scale`. States that are not named in `sizes` get
    their entry of a default array, or 1."""
    scale = np.full((len(s.charts), s.d), np.nan)
    for a, chart in enumerate(s.charts):
        for row, name in enumerate(chart.states):
            scale[a, row] = sizes.get(name, np.nan)
    others: ArrayLike = 1.0
    if otherwise is not None:
        others = to_host(otherwise)
    xp = jnp if is_tracer(others) else np
    is_missing = np.isnan(scale)
    return real(xp.where(is_missing, others, scale))


def sizes_of(s: Structure, scale: Float[Array, "A d"]) -> Sizes:
    """Sizes by name, from `Settings.scale`."""
    sizes: Sizes = {}
    # (A state that several charts have takes the size of the first.)
    for a in reversed(range(len(s.charts))):
        names = s.charts[a].states
        values = np.asarray(scale)[a].tolist()
        sizes |= dict(zip(names, values, strict=False))
    return sizes


def stiff_charts(s: Structure, pieces: Lanes, period: float) -> dict[str, float]:
    """The charts with explicit methods that are stiff on a cycle, each with the rate of its fastest
    mode. `pieces`: states at equal distances in time along one period."""
    stiff = {}
    step = period / len(np.ravel(pieces.t))
    for a, t, q in points(s, pieces):
        rates = fastest(s, a, t, q)
        decay = step * rates.sum()
        if decay > STIFF and not is_implicit(s, a):
            stiff[s.names[a]] = float(rates.max())
    return stiff


def fastest(
    s: Structure, a: int, t: Float[np.ndarray, " P"], q: Float[np.ndarray, "n P"]
) -> Float[np.ndarray, " P"]:
    """The rates at which the fastest modes of chart a decay; 0 if no mode decays."""
    rates = np.real(_modes(s, a, t, q))
    return -rates.min(axis=1, initial=0.0)


def is_implicit(s: Structure, a: int) -> bool:
    """True if chart a is integrated by an implicit method."""
    return s.method(a).implicit


def has_implicit(s: Structure) -> bool:
    """True if some chart is integrated by an implicit method."""
    return any(is_implicit(s, a) for a in range(len(s.charts)))


def slow_time(s: Structure, t: float, states: Float[np.ndarray, "A d"]) -> float:
    """The time scale of the slowest mode of the charts with implicit methods; 0 for none.

    **Arguments:** `states`, a state in every chart, or NaN.
    """
    times = [0.0]
    for a, state in enumerate(states):
        q = state[: s.dims[a]]
        if is_implicit(s, a) and np.isfinite(q).all():
            time = np.array([t])
            (modes,) = _modes(s, a, time, q[:, None])
            rates = np.abs(modes)
            decays = rates > ROUNDING * rates.max()
            slowest = rates[decays].min(initial=np.inf)
            times.append(1 / slowest)
    return max(times)


def points(s: Structure, pieces: Lanes) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Iterate over charts, times and states at the beginnings of the pieces of a turn, up to the
    piece that failed."""
    t = np.asarray(pieces.t)
    chart = np.asarray(pieces.chart)
    q = np.asarray(pieces.q)
    is_reached = np.isfinite(q).all(axis=0)
    for a in np.unique(chart).tolist():
        n = s.dims[a]
        rows = (chart == a) & is_reached
        if rows.any():
            yield a, t[rows], q[:n, rows]


def _modes(s: Structure, a: int, t, q) -> np.ndarray:
    """Eigenvalues of the field's derivative at points of chart a."""
    u = np.zeros((s.nu, 1))
    expanded = kernels.field(s, a, t, q, u)
    derivative = expanded[:, 2 : 2 + len(q)]
    return np.linalg.eigvals(np.moveaxis(derivative, -1, 0))


class _Fields(NamedTuple):
    """The field at K points."""

    f: Float[np.ndarray, "d K"]
    change: Float[np.ndarray, "d K"]
    """Derivative of the field along the flow."""
    derivative: Float[np.ndarray, "d d K"]
    """Derivative of the field with respect to the state."""
    rounding: Float[np.ndarray, "d K"]
    """Change of the field by rounding errors, from states and times that differ by rounding."""


def _fields(s: Structure, chart: Int[np.ndarray, " K"], t, q) -> _Fields:
    """The field at K points of any charts, padded with zeros."""
    zeros = np.zeros(q.shape)
    derivative = np.zeros((s.d, *q.shape))
    out = _Fields(zeros, zeros.copy(), derivative, zeros.copy())
    for a in np.unique(chart).tolist():
        n = s.dims[a]
        rows = np.flatnonzero(chart == a)
        of_chart = _fields_of_chart(s, a, t[rows], q[:n, rows])
        out.f[:n, rows] = of_chart.f
        out.change[:n, rows] = of_chart.change
        out.derivative[:n, :n, rows] = of_chart.derivative
        out.rounding[:n, rows] = of_chart.rounding
    return out


def _fields_of_chart(s: Structure, a: int, t, q) -> _Fields:
    """The field at K points of chart a. Its rounding errors follow from shifts of states and times:
    what a smooth field would change by them is subtracted."""
    n, K = q.shape
    times, states = _shifted(t, q)
    u = np.zeros((s.nu, 1))
    in_columns = states.reshape(n, -1)
    expanded = kernels.field(s, a, times.ravel(), in_columns, u)
    expanded = expanded.reshape(n, -1, K, times.shape[1])
    values = expanded[:, 0]
    # (The first point is not shifted.)
    f = values[..., 0]
    by_time = expanded[:, 1, :, 0]
    derivative = expanded[:, 2 : 2 + n, :, 0]
    change = by_time + np.einsum("ijk,jk->ik", derivative, f)

    # The change of the field by the shifts, less that of a smooth field.
    shifts = states - q[..., None]
    delays = times - t[:, None]
    by_shifts = np.einsum("ijk,jks->iks", derivative, shifts)
    by_delays = by_time[..., None] * delays
    smooth = by_shifts + by_delays
    error = np.abs(values - f[..., None] - smooth)
    in_state, in_time = np.split(error, [1 + len(_SHIFTS)], axis=-1)

    # (The rounding error of the time itself, as in a phase omega * t, is not counted.)
    of_time = 2 * np.finfo(float).eps * np.abs(by_time * t)
    in_time = in_time - of_time[..., None]
    # If the field jumps with the clock near a time, only the shifts to one side of this time see
    # the jump.
    earlier, later = np.split(in_time, 2, axis=-1)
    with_earlier = earlier.max(axis=-1)
    with_later = later.max(axis=-1)
    with_time = np.minimum(with_earlier, with_later)
    with_state = in_state.max(axis=-1)
    return _Fields(
        f=f,
        change=change,
        derivative=derivative,
        rounding=np.maximum(with_state, with_time),
    )


def _shifted(t: Float[np.ndarray, " K"], q: Float[np.ndarray, "n K"]):
    """Times (K, S) and states (n, K, S) without a shift, with shifted states, and with shifted
    times."""
    eps = np.finfo(float).eps
    none = np.zeros(len(_SHIFTS))
    of_time = np.concatenate([[0.0], none, _SHIFTS])
    of_states = []
    for k in range(len(q)):
        # (States get different shifts, since equal ones may cancel.)
        shifts = np.roll(_SHIFTS, k)
        of_states.append(np.concatenate([[0.0], shifts, none]))
    parts = 1 + eps * np.array(of_states)
    times = t[:, None] * (1 + eps * of_time)
    states = q[..., None] * parts[:, None]
    return times, states


def _reached(s: Structure, chart: int, t: float, q) -> Float[np.ndarray, "A d"]:
    """A state in every chart, by resets from the guess; NaN in charts to which no reset leads."""
    states = np.full((len(s.charts), s.d), np.nan)
    states[chart] = q
    reached = {chart}
    time = np.array([t])
    u = np.zeros((s.nu, 1))
    for _ in s.charts:
        for g, transition in enumerate(s.transitions):
            a = s.chart_index(transition.source)
            b = s.chart_index(transition.target)
            if a in reached and b not in reached:
                before = states[a, : s.dims[a], None]
                expanded = kernels.reset(s, s.member(g), time, before, u)
                after = expanded[:, 0, 0]
                states[b] = np.pad(after, (0, s.d - len(after)))
                reached.add(b)
    return states


def _time_scale(q: Float[np.ndarray, "d K"], near: _Fields) -> float:
    """The time scale of the fastest mode of the field's derivative, at the first point that has a
    mode (the guess comes first). If there is none, as in free flight, the time in which a state
    changes by its own magnitude."""
    for derivative in np.moveaxis(near.derivative, -1, 0):
        modes = np.linalg.eigvals(derivative)
        fastest_rate = np.max(np.abs(modes))
        if fastest_rate > 0:
            return 1 / float(fastest_rate)
    size = np.abs(q[:, 0])
    speed = np.abs(near.f[:, 0])
    acceleration = np.abs(near.change[:, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        by_acceleration = np.sqrt(size / acceleration)
        by_speed = size / speed
    times = np.concatenate([by_acceleration, by_speed])
    moves = (times > 0) & (times < np.inf)
    return float(min(times[moves], default=1.0))


def _by_name(
    s: Structure, chart: Int[np.ndarray, " K"], size: Float[np.ndarray, "d K"]
) -> Sizes:
    """The largest size of each state in any chart; 1 for a state that is zero everywhere."""
    sizes = dict.fromkeys(s.state_names(), 0.0)
    for a, column in zip(chart, size.T, strict=True):
        states = s.charts[a].states
        for name, x in zip(states, column.tolist(), strict=False):
            if np.isfinite(x):
                sizes[name] = max(sizes[name], x)
    for name, largest in sizes.items():
        if largest == 0:
            sizes[name] = 1.0
    return sizes
