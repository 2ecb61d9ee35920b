"""Single trajectories with their events, dense enough to plot."""

import dataclasses
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from .._core.boundary.checked import checked, checked_methods
from .._core.boundary.kinds import Count, Duration, Numbers, Scalar, StepCount
from .._core.boundary.values import Reals
from .._core.compilation import host_first
from .._core.executor import namespace, put
from .._core.precision import require_x64
from .._core.results import Result
from .._core.text import number
from ..errors import ComputationError, DefinitionError
from ..systems.check import check_system
from ..systems.structure import Structure
from ..systems.system import Driven, Guess, HybridSystem
from . import kernels
from .cubic import interpolate
from .lanes import start_lanes
from .move import Options, move
from .search.search import initial_step
from .settings import SIMULATION, Settings
from .tape import IDLE
from .target import until
from .watch import slopes


# Rows of a tape that is filled in one compiled call. Higher: more memory. Lower: more calls for a
# long trajectory.
_ROWS = 512


class Event(NamedTuple):
    """One event of a trajectory."""

    time: float
    name: str
    source: str
    target: str
    before: dict[str, float]
    """State before the reset, by name."""
    after: dict[str, float]
    """State after the reset, by name."""


@checked_methods
class Trajectory(eqx.Module):
    """A hybrid trajectory: steps, events, and interpolation between steps.

    **Fields:** `t`, the ends of the steps; `chart`, the chart after each; `before` and `after`,
    the states at each before and after an event's reset; `slope_before`, `slope_after`, their
    time derivatives; `event`, the transition that fired there or -1; `result`, the reason of its
    end.
    """

    system: HybridSystem
    t: Float[np.ndarray, " n"]
    chart: Int[np.ndarray, " n"]
    before: Float[np.ndarray, "n d"]
    after: Float[np.ndarray, "n d"]
    slope_before: Float[np.ndarray, "n d"]
    slope_after: Float[np.ndarray, "n d"]
    event: Int[np.ndarray, " n"]
    result: Result = eqx.field(static=True)

    @property
    def structure(self) -> Structure:
        """The system by the indices of its charts and transitions."""
        return Structure(self.system)

    @property
    def events(self) -> list[Event]:
        """The events in order of time."""
        events, charts, transitions = [], self.system.charts(), self.system.transitions()
        for k in np.flatnonzero(self.event >= 0):
            tr = transitions[self.event[k]]
            before = dict(zip(charts[tr.source].states, self.before[k].tolist(), strict=False))
            after = dict(zip(charts[tr.target].states, self.after[k].tolist(), strict=False))
            events.append(Event(float(self.t[k]), tr.name, tr.source, tr.target, before, after))
        return events

    def dense(self, per_step: Count = 8) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Times (p,), charts (p,) and states (p, d), with `per_step` points in every step.

        Between steps the cubic Hermite interpolant is used. At an event both sides appear, with
        the same time.
        """
        h = np.diff(self.t)[:, None]
        x = np.linspace(0.0, 1.0, per_step + 1)[None, :]
        q0, q1 = self.after[:-1, None], self.before[1:, None]
        d0, d1 = self.slope_after[:-1, None], self.slope_before[1:, None]
        q = interpolate(x[..., None], h[..., None], q0, q1, d0, d1)
        t = self.t[:-1, None] + h * x
        chart = np.broadcast_to(self.chart[:-1, None], t.shape)
        keep = np.ones(t.shape, bool)
        keep[1:, 0] = self.event[1:-1] >= 0  # a step's start repeats the last end, but for resets
        return t[keep], chart[keep], q[keep]

    def __call__(self, *names: str, per_step: Count = 8) -> tuple[np.ndarray, ...]:
        """Times and the named states or outputs (at zero input), dense enough to plot.

        Values are NaN in charts where they are not defined.
        """
        require_x64()
        t, chart, q = self.dense(per_step)
        s = self.structure
        items = tuple(s.resolve_outputs(names).items)
        values = np.full((len(names), t.shape[0]), np.nan)
        for a in np.unique(chart):
            at = chart == a
            values[:, at] = kernels.values(s, int(a), items, t[at], q[at, : s.dims[a]].T)
        return (t, *values)

    def __repr__(self):
        fired, system = self.event[self.event >= 0], self.system
        counts = ((np.sum(fired == g), tr.name) for g, tr in enumerate(system.transitions()))
        events = ", ".join(f"{count} {name}" for count, name in counts if count) or "no events"
        span = f"t = {number(self.t[0])} to {number(self.t[-1], unit=system.time_unit)}"
        return (
            f"Trajectory({type(system).__name__}: {span}, {len(self.t) - 1} steps; {events}; "
            f"ends in {[*system.charts()][self.chart[-1]]}: {self.result.message})"
        )


@checked
def simulate(
    system: HybridSystem,
    chart: str,
    state: Annotated[Numbers, Reals("n")],
    duration: Duration,
    *,
    time: Scalar = 0.0,
    input: Callable[[Any], Any] | Annotated[Numbers, Reals()] | None = None,
    settings: Settings | None = None,
    max_steps: StepCount = 100_000,
    throw: bool = True,
) -> Trajectory:
    """Integrate one trajectory through any number of events.

    **Arguments:**

    - `chart`, `state`, `time`: the start. A guard that is zero there is not an event.
    - `duration`: length in the system's unit of time.
    - `input`: a constant input (nu,), or a function of time that returns one. Default: 0.
    - `settings`: accuracy of the flow. Without a `scale`, errors are judged against the size that
        each state has in the step at hand, whatever its unit. Default: 1e-10.
    - `max_steps`: bound on the number of steps, rounded up to a multiple of 512. Default: 100 000.
    - `throw`: raise an error if the trajectory ends early. Default: True; with False, its `result`
        has the reason.

    **Raises:** `DefinitionError` for bad arguments; `ComputationError` for grazing, Zeno, blow-up
    and the step limit, if `throw`.
    """
    require_x64(system, settings)
    settings = Settings() if settings is None else settings
    system = settings.system(system)
    check_system(system)
    constant = _constant_input(system, input)
    s = Structure(Driven(system, input) if callable(input) else system)
    a, start = s.chart_index(chart), Guess(chart, state, time)
    if start.state.shape != (s.dims[a],):
        raise DefinitionError(
            f"chart '{chart}' has the states {', '.join(s.charts[a].states)}, so the start needs "
            f"shape ({s.dims[a]},); it has {start.state.shape}."
        )
    settings = dataclasses.replace(settings.filled(SIMULATION), max_steps=_ROWS)
    u, span = constant[:, None], np.array([duration], float)
    end = np.asarray(start.time) + span
    lanes, h = _start(s, np.array([start.time]), a, start.state, u, span, settings)
    q = np.asarray(lanes.q).T
    rows = [(lanes.t, q, q, lanes.chart, np.full(1, -1))]
    steps = 0
    while True:
        moved, tape = _piece(s, lanes, u, end, settings, h)
        tape = jax.tree_util.tree_map(lambda x: np.asarray(x)[..., 0], tape)
        used = tape.code != IDLE
        rows.append(
            tuple(getattr(tape, x)[used] for x in ("t", "before", "after", "chart", "code"))
        )
        lanes, h, steps = moved.lanes, moved.h, steps + _ROWS
        result = Result(int(np.asarray(moved.result)[0]))
        if result != Result.STEP_LIMIT or steps >= max_steps:
            break
    t, before, after, charts, event = (np.concatenate(x) for x in zip(*rows, strict=True))
    source = np.concatenate([charts[:1], charts[:-1]])
    left, right = _slopes(s, t, source, before, u), _slopes(s, t, charts, after, u)
    trajectory = Trajectory(s.system, t, charts, before, after, left, right, event, result)
    if throw and result != Result.OK:
        raise ComputationError(
            f"the trajectory stopped at t = {t[-1]:.6g} in chart '{s.names[charts[-1]]}': "
            f"{result.message}. `throw=False` returns it up to there."
        )
    return trajectory


def _constant_input(system: HybridSystem, input) -> np.ndarray:
    """The constant part of an input of the right shape; zero for a function of time."""
    nu = len(system.inputs)
    if callable(input):
        shape = jax.eval_shape(lambda t: jnp.asarray(input(t), float), jnp.zeros(())).shape
    else:
        shape = np.shape(0.0 if input is None else input)
    if shape not in ((), (nu,)):
        raise DefinitionError(
            f"the input has shape {shape}, but {type(system).__name__} has the {nu} inputs "
            f"({', '.join(system.inputs)}): give one number for each."
        )
    value = 0.0 if input is None or callable(input) else np.asarray(input, float)
    return np.broadcast_to(value, (nu,))


@host_first
def _start(s, t, a, state, u, span, settings):
    xp = namespace(t)
    q = put(xp.zeros((s.d, 1)), (slice(len(state)), 0), state)
    lanes = start_lanes(s, t, xp.full(1, a, xp.int32), q)
    return lanes, initial_step(s, lanes, u, span, settings)


@host_first
def _piece(s, lanes, u, end, settings, h):
    return move(s, lanes, u, until(end), settings, h, options=Options(tape=True))


def _slopes(s: Structure, t, chart, q, u) -> np.ndarray:
    """Fields at states (n, d). Filled up to whole pieces, so that few lengths are compiled."""
    n = t.shape[0]
    filled = (np.concatenate([x, np.repeat(x[-1:], -n % _ROWS, 0)]) for x in (t, chart, q))
    return np.asarray(_fields(s, *filled, u))[:, :n].T


@host_first
def _fields(s, t, chart, q, u):
    return slopes(s, t, chart, q.T, namespace(u).broadcast_to(u, (s.nu, t.shape[0])))
