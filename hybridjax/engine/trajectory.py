"""Single trajectories with their events, dense enough to plot."""

import dataclasses
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from .._core.boundary.arrays import Reals
from .._core.boundary.checked import checked, checked_methods
from .._core.boundary.kinds import Count, Duration, Numbers, Scalar, StepCount
from .._core.compilation.compile import host_first
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
from .move import record
from .search.first_step import initial_step
from .settings import SIMULATION, Settings
from .tape import IDLE
from .target import until
from .watch import slopes


# Rows of a tape that is filled in one compiled call. Twice as many: twice the memory, half the
# calls for long trajectories.
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
    time derivatives; `event`, the transition that fired there or -1; `result`, what became of it.
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
    def events(self) -> list[Event]:
        """The events in order of time."""
        s = Structure(self.system)
        found = []
        for k in np.flatnonzero(self.event >= 0):
            tr = s.transitions[self.event[k]]
            a, b = s.chart_index(tr.source), s.chart_index(tr.target)
            before = dict(zip(s.charts[a].states, self.before[k].tolist(), strict=False))
            after = dict(zip(s.charts[b].states, self.after[k].tolist(), strict=False))
            found.append(Event(float(self.t[k]), tr.name, tr.source, tr.target, before, after))
        return found

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
        t, chart, q = self.dense(per_step)
        return (t, *_evaluate(self.system, names, t, chart, q))

    def __repr__(self):
        s, fired = Structure(self.system), self.event[self.event >= 0]
        counts = ((int(np.sum(fired == g)), tr.name) for g, tr in enumerate(s.transitions))
        events = ", ".join(f"{count} {name}" for count, name in counts if count) or "no events"
        span = f"t = {number(self.t[0])} to {number(self.t[-1], unit=self.system.time_unit)}"
        return (
            f"Trajectory({type(self.system).__name__}: {span}, {len(self.t) - 1} steps; {events}; "
            f"ends in {s.names[self.chart[-1]]}: {self.result.message})"
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
    """Follow one trajectory through any number of events.

    **Arguments:**

    - `chart`, `state`, `time`: where it starts. A guard that is zero there is not an event.
    - `duration`: how long it lasts, in the system's unit of time.
    - `input`: a constant input (nu,), or a function of time that returns one. Zero by default.
    - `settings`: accuracy of the flow; 1e-10 by default. Without a `scale`, errors are judged
        against the size that each state has in the step at hand, whatever its unit.
    - `max_steps`: bound on the number of steps, rounded up to a multiple of 512.
    - `throw`: raise if the trajectory ends early; otherwise its `result` says why it did.

    **Raises:** `DefinitionError` for bad arguments; `ComputationError` for grazing, Zeno, blow-up
    and the step limit, if `throw`.
    """
    require_x64(system, settings)
    settings = Settings() if settings is None else settings
    system = settings.system(system)
    check_system(system)
    s = Structure(system)
    a = s.chart_index(chart)
    start = Guess(chart, state, time)
    if start.state.shape != (s.dims[a],):
        raise DefinitionError(
            f"chart '{chart}' has the states {', '.join(s.charts[a].states)}, so the start needs "
            f"shape ({s.dims[a]},); it has {start.state.shape}."
        )
    settings = settings.filled(SIMULATION)
    u = _constant_input(s, input)[:, None]
    if callable(input):
        system = Driven(system, input)

    span = np.array([duration], float)
    end = np.asarray(start.time) + span
    lanes, h = _start(system, np.array([start.time]), a, start.state, u, span, settings)
    rows = [(lanes.t, lanes.q, lanes.q, lanes.chart, np.full(1, -1))]
    steps = 0
    while True:
        moved, tape = _piece(system, lanes, u, end, settings, h)
        tape = jax.tree_util.tree_map(np.asarray, tape)
        used = tape.code[:, 0] != IDLE
        rows.append(
            (tape.t[used], tape.before[used, :, 0].T, tape.after[used, :, 0].T)
            + (tape.chart[used, 0], tape.code[used, 0])
        )
        lanes, h, steps = moved.lanes, moved.h, steps + _ROWS
        result = Result(int(np.asarray(moved.result)[0]))
        if result != Result.STEP_LIMIT or steps >= max_steps:
            break
    t, before, after, charts, event = (
        np.concatenate([np.asarray(x[k]).reshape(shape) for x in rows], axis=-1)
        for k, shape in ((0, -1), (1, (s.d, -1)), (2, (s.d, -1)), (3, -1), (4, -1))
    )
    source = np.concatenate([charts[:1], charts[:-1]])
    trajectory = Trajectory(
        system,
        t,
        charts,
        before.T,
        after.T,
        _slopes(system, t, source, before, u).T,
        _slopes(system, t, charts, after, u).T,
        event,
        result,
    )
    if throw and result != Result.OK:
        raise ComputationError(
            f"the trajectory stopped at t = {t[-1]:.6g} in chart '{s.names[charts[-1]]}': "
            f"{result.message}. Use `throw=False` to look at it."
        )
    return trajectory


def _constant_input(s: Structure, input) -> np.ndarray:
    """The constant part of an input, after a look at its shape; zero for a function of time."""
    if callable(input):
        shape = jax.eval_shape(lambda t: jnp.asarray(input(t), float), jnp.zeros(())).shape
    else:
        value = np.asarray(0.0 if input is None else input, float)
        shape = value.shape
    if shape not in ((), (s.nu,)):
        raise DefinitionError(
            f"the input has shape {shape}, but {type(s.system).__name__} has the {s.nu} inputs "
            f"({', '.join(s.system.inputs)}): give one number for each."
        )
    if callable(input):
        return np.zeros(s.nu)
    return np.broadcast_to(value, (s.nu,))


@host_first
def _start(system, t, a, state, u, span, settings):
    s, xp = Structure(system), namespace(t)
    q = put(xp.zeros((s.d, 1)), (slice(len(state)), 0), state)
    lanes = start_lanes(s, t, xp.full(1, a, xp.int32), q)
    return lanes, initial_step(s, lanes, u, span, settings)


@host_first
def _piece(system, lanes, u, end, settings, h):
    settings = dataclasses.replace(settings, max_steps=_ROWS)
    return record(Structure(system), lanes, u, until(end), settings, h)


def _slopes(system, t, chart, q, u) -> np.ndarray:
    """Fields at states (d, n). Filled up to whole pieces, so that few lengths are compiled."""
    n = t.shape[0]
    t, chart, q = (
        np.concatenate([x, np.repeat(x[..., -1:], -n % _ROWS, -1)], -1) for x in (t, chart, q)
    )
    return np.asarray(_fields(system, t, chart, q, u))[:, :n]


@host_first
def _fields(system, t, chart, q, u):
    s = Structure(system)
    return slopes(s, t, chart, q, namespace(u).broadcast_to(u, (s.nu, t.shape[0])))


def _evaluate(system, names, t, chart, q):
    """Outputs (p,) each at points of trajectories, NaN where not defined."""
    require_x64()
    s = Structure(system)
    items = tuple(s.resolve_outputs(names).items)
    values = np.full((len(names), t.shape[0]), np.nan)
    for a in np.unique(chart):
        here = chart == a
        values[:, here] = kernels.values(s, int(a), items, t[here], q[here, : s.dims[a]].T)
    return values
