"""Single trajectories with their events, dense enough to plot: `simulate` and `Trajectory`.

`simulate` checks the arguments (`_start_of`) and calls `integrate`. This calls the search piece by
piece (`_piece`), reads the moves from the tapes (`recorded`), and makes the checks that programs
leave out: starts beyond a guard (`begins_beyond`), guards on which a reset ends (`_passed`), and
pulses (`unresolved.py`). Between the ends of steps, states follow cubics (`Trajectory.at`).

If steps or events are wrong, look at the search (`search/`); if states between steps are, at
`Trajectory.at`. If a trajectory ends without need, its `result` says where to look: `GUARD_PASSED`
comes from `_passed`, `PULSE_PASSED` from `unresolved.py`, all others from the search. If a good
start has a finding, look at `guards_reached`.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any, NamedTuple, NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from .._core.boundary.checked import checked, checked_methods
from .._core.boundary.kinds import Count, Duration, Numbers, Scalar, StepCount
from .._core.boundary.members import leading_on
from .._core.boundary.values import Reals
from .._core.compilation import at_ease, host_first
from .._core.executor import is_traced, namespace
from .._core.findings import Finding, print_findings, warn_of
from .._core.meaning import current, require_as_made
from .._core.precision import require_x64
from .._core.results import Result
from .._core.showable import Showable
from .._core.text import folded, number, signal_values
from ..errors import ComputationError, DefinitionError
from ..systems.check import check_schedules, check_system, evaluating
from ..systems.quotient import check_symmetry
from ..systems.start import StateLike, SystemLike, guess_of, own_guess, system_of
from ..systems.structure import Structure
from ..systems.system import Driven, Guess, HybridSystem, name_of
from . import kernels
from .cubic import interpolate
from .events import INSTANT
from .lanes import IDLE, Lanes, Tape, lane_at
from .move import Options, move
from .settings import ROUNDING, SIMULATION, Settings
from .target import Target, until
from .unresolved import passed_over
from .watch import slopes


# Values and rates of a guard are zero below this part of their terms. Smaller: rounding hides a
# reset that ends on a guard. Larger: one that ends close to it is reported.
_SAME = 1e-9
# The moment in which a guard at rest begins to fall, as a part of the whole time. Smaller: rounding
# hides it. Larger: a guard that falls later is reported.
_MOMENT = 1e-6
# The highest power of time with which a guard at rest is noticed to fall. Higher: more evaluations
# at each start. Lower: what is pushed through a chain of states is not noticed.
_HIGHEST_POWER = 5


@leading_on
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

    def __repr__(self) -> str:
        before = signal_values(self.before, self.before.values())
        after = signal_values(self.after, self.after.values())
        return folded(
            f"Event({self.name} at t = {number(self.time)}: {self.source} to {self.target}; "
            f"before {before}; after {after})"
        )


@checked_methods
class Trajectory(Showable, eqx.Module):
    """A hybrid trajectory: steps, events, and interpolation between steps.

    **Fields:** `t`, the ends of the steps; `chart`, the chart after each; `before` and `after`,
    the states at each before and after an event's reset; `slope_before`, `slope_after`, their
    time derivatives; `event`, the transition that fired there or -1; `result`, the reason of its
    end; `findings`, doubts about the start.
    """

    structure: Structure
    t: Float[np.ndarray, " n"]
    chart: Int[np.ndarray, " n"]
    before: Float[np.ndarray, "n d"]
    after: Float[np.ndarray, "n d"]
    slope_before: Float[np.ndarray, "n d"]
    slope_after: Float[np.ndarray, "n d"]
    event: Int[np.ndarray, " n"]
    result: Result = eqx.field(static=True)
    findings: tuple[Finding, ...] = eqx.field(static=True, default=())

    @property
    def system(self) -> HybridSystem:
        return self.structure.system

    def until(self, k: int, result: Result) -> "Trajectory":
        """The trajectory up to row k, where it ends for this reason."""
        to = slice(k + 1)
        return Trajectory(
            self.structure,
            self.t[to],
            self.chart[to],
            self.before[to],
            self.after[to],
            self.slope_before[to],
            self.slope_after[to],
            self.event[to],
            result,
            self.findings,
        )

    @property
    def events(self) -> list[Event]:
        """The events in order of time."""
        require_as_made(self.system, "this trajectory was computed")
        events = []
        s = self.structure
        for k in np.flatnonzero(self.event >= 0):
            tr = s.transitions[self.event[k]]
            source = s.chart_index(tr.source)
            time = float(self.t[k])
            before = s.by_name(source, self.before[k], time)
            target = s.chart_index(tr.target)
            after = s.by_name(target, self.after[k], time)
            events.append(
                Event(
                    time=time,
                    name=tr.name,
                    source=tr.source,
                    target=tr.target,
                    before=before,
                    after=after,
                )
            )
        return events

    def dense(self, per_step: Count = 32) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Times (p,), charts (p,) and states (p, d), with `per_step` points in every step.

        Between steps the cubic Hermite interpolant is used. At an event both sides appear, with
        the same time.
        """
        duration = np.diff(self.t)[:, None, None]
        fractions = np.linspace(0.0, 1.0, per_step + 1)
        part = fractions[None, :, None]
        states = interpolate(
            part,
            duration,
            self.after[:-1, None],
            self.before[1:, None],
            self.slope_after[:-1, None],
            self.slope_before[1:, None],
        )
        since = (duration * part)[..., 0]
        times = self.t[:-1, None] + since
        chart_of_step = self.chart[:-1, None]
        charts = np.broadcast_to(chart_of_step, times.shape)
        # (The start of a step repeats the end of the last one, but for resets.)
        is_new = np.ones(times.shape, bool)
        is_new[1:, 0] = self.event[1:-1] >= 0
        # (-1, the last row, if the trajectory ends with a reset; else no row.)
        ends_with_reset = self.event[-1:] >= 0
        final_reset = np.flatnonzero(ends_with_reset) - 1
        t = np.append(times[is_new], self.t[final_reset])
        chart = np.append(charts[is_new], self.chart[final_reset])
        state = np.vstack([states[is_new], self.after[final_reset]])
        return t, chart, state

    def at(
        self, t: Annotated[Numbers, Reals("p")] | Scalar
    ) -> tuple[Int[np.ndarray, "*p"], Float[np.ndarray, "*p d"]]:
        """Charts (p,) and states (p, d) at times (p,), by the cubic Hermite interpolant. For a
        single time they have no axis p. At the time of an event, they are those after the event.

        **Raises:** `DefinitionError` for times before its begin or after its end.
        """
        t = np.asarray(t)
        if not t.ndim:
            charts, single = self.at(t[None])
            return charts[0], single[0]
        begin = self.t[0]
        end = self.t[-1]
        if len(t) and not begin <= t.min() <= t.max() <= end:
            raise DefinitionError(f"times must lie between {begin:.9g} and {end:.9g}.")
        k = np.searchsorted(self.t, t, side="right") - 1
        j = np.minimum(k + 1, len(self.t) - 1)
        duration = (self.t[j] - self.t[k])[:, None]
        since = t[:, None] - self.t[k, None]
        # (A time at the very end lies in a step without duration.)
        part = np.divide(
            since, duration, out=np.zeros_like(duration), where=duration > 0
        )
        states = interpolate(
            part,
            duration,
            self.after[k],
            self.before[j],
            self.slope_after[k],
            self.slope_before[j],
        )
        return self.chart[k], states

    def __call__(self, *names: str, per_step: Count = 32) -> tuple[np.ndarray, ...]:
        """Times and the named states or outputs (at zero input), dense enough to plot.

        Values are NaN in charts where they are not defined.
        """
        require_x64()
        point = self.dense(per_step)
        return (point[0], *observed(self.structure, names, *point))

    def __getitem__(self, name: object):
        """**Raises:** `DefinitionError` with the call that has a signal."""
        signal = name if isinstance(name, str) else "name"
        raise DefinitionError(
            f"a signal has values at its own times: write `t, {signal} = trajectory('{signal}')`."
        )

    def __repr__(self):
        s = self.structure
        system = self.system
        events = []
        for g, transition in enumerate(s.transitions):
            count = np.sum(self.event == g)
            if count:
                events.append(f"{count} {transition.name}")
        begin = number(self.t[0])
        end = number(self.t[-1], unit=system.time_unit)
        text = folded(
            f"Trajectory({name_of(system)}: t = {begin} to {end}, {len(self.t) - 1} steps; "
            f"{', '.join(events) or 'no events'}; ends in {s.names[self.chart[-1]]}: "
            f"{self.result.message})"
        )
        findings = print_findings(self.findings, "  ").splitlines()
        return "\n".join([text, *findings])


def states_at(
    path: Trajectory, u: Float[np.ndarray, "nu 1"], times: Float[np.ndarray, " p"]
) -> tuple[Int[np.ndarray, " p"], Float[np.ndarray, "p d"]]:
    """Charts (p,) and states (p, d) at times (p,), under a constant input, as accurate as the
    trajectory: by a step from the end of the last one before each time. States are NaN before its
    begin and after its end.
    """
    s = path.structure
    begin = path.t[0]
    end = path.t[-1]
    late = INSTANT * (end - begin) + ROUNDING * np.abs(end)
    within = (times >= begin) & (times <= end + late)
    row = np.searchsorted(path.t, times, side="right") - 1
    # (No step is taken to times outside, where a state may leave all bounds.)
    row = np.where(within, row, 0)
    since = np.where(within, times - path.t[row], 0.0)
    chart = path.chart[row]
    states = np.zeros((len(times), s.d))
    for a in np.unique(chart).tolist():
        n = s.dims[a]
        here = np.flatnonzero(chart == a)
        t = path.t[row[here]]
        q = path.after[row[here], :n].T
        step = kernels.step(s, a, t, q, u, since[here])
        states[here, :n] = step.q.T
    states[~within] = np.nan
    return chart, states


def observed(
    s: Structure,
    names: Sequence[str],
    t: Float[np.ndarray, " p"],
    chart: Int[np.ndarray, " p"],
    q: Float[np.ndarray, "p d"],
) -> Float[np.ndarray, "n p"]:
    """States or outputs at zero input; NaN in charts where they are not defined.

    **Raises:** `DefinitionError` if the system's code has changed since.
    """
    require_as_made(s.system, "this trajectory was computed")
    items = tuple(s.resolve_outputs(names).items)
    shape = (len(names), len(t))
    values = np.full(shape, np.nan)
    for a in np.unique(chart):
        at = chart == a
        states = s.charts[a].states
        if all(item in states for item in items):  # (without compiling a function)
            columns = [states.index(item) for item in items]
            values[:, at] = q[at].T[columns]
            continue
        u = np.zeros((s.nu, 1))
        state = q[at, : s.dims[a]].T
        point = t[at], state, u
        rows = kernels.outputs(s, int(a), items, *point)
        values[:, at] = rows[:, 0]
    return values


@checked
def simulate(
    system: SystemLike,
    chart: str | Guess | StateLike | None = None,
    state: Annotated[Numbers, Reals()] | None = None,
    duration: Duration | None = None,
    *,
    time: Scalar | None = None,
    input: Callable[[Any], Any] | Annotated[Numbers, Reals()] | None = None,
    settings: Settings | None = None,
    max_steps: StepCount = 100_000,
    throw: bool = True,
) -> Trajectory:
    """Integrate one trajectory through any number of events.

    **Arguments:**

    - `system`: a `HybridSystem`. If the start is a state, it may also be the vector field (t, q) of
        a single chart without events.
    - `chart`, `state`, `time`: the start, given by the name of a chart, its states (n,) in order,
        and the time (Default: 0). A guard that is zero or negative there is not an event: a ball
        that starts below the floor falls on. `findings` of the trajectory list such guards. A start
        at the time of a scheduled event lies after its reset. A `Guess` can replace all three:
        `hj.simulate(system, guess, duration)`. If only one chart has such states, a state suffices:
        `(1.0, 0.0)` or `{"y": 1.0, "v": 0.0}`. `cycle.state` and the states of an event know
        their chart and time. Default: the model's own guess.
    - `duration`: length in the system's unit of time.
    - `input`: a constant input (nu,), or a function of time that returns one. Default: 0.
    - `settings`: accuracy of the flow. Without a `scale`, errors are relative to the magnitude of
        each state in the current step, in any unit. Default: 1e-10.
    - `max_steps`: largest number of steps, rounded up to a multiple of `settings.max_steps`.
        Default: 100 000.
    - `throw`: raise an error if the trajectory ends early. Default: True; with False, its `result`
        has the reason.

    **Returns:** a `Trajectory`: the ends of its steps `t` (n,), the states `before` and `after`
    events (n, d), `events` with their names and times, and `at(t)`, which interpolates.

    **Raises:** `DefinitionError` for bad arguments; `ComputationError` for grazing, Zeno, blow-up
    and the step limit, if `throw`.

    **Example:**

    ```python
    trajectory = hj.simulate(hopper, "flight", (2.0, 1.0, 0.0, 0.0), 3.0)
    print(trajectory.result, [event.name for event in trajectory.events])
    ```

    **Before:** a model, `hj.models` or `hj.HybridSystem`. **After:** `hj.find_limit_cycle`,
    `hj.plot.animate`; `hj.flow`, which has derivatives.
    """
    require_x64(system, settings)
    settings = Settings() if settings is None else settings
    system = system_of(system, state if chart is None else chart)
    system = settings.system(system)
    check_system(system)
    check_symmetry(system)
    constant = constant_input(system, input)
    s = Structure(current(Driven(system, input)) if callable(input) else system)
    check_schedules(s)
    start, length = _start_of(s, chart, state, duration, time)
    begin = lane_at(s, start.chart, start.state, start.time, "`state`")
    settings = settings.filled(SIMULATION)
    target = until(begin.t + float(length))
    u = constant[:, None]
    path, _ = integrate(s, begin, u, target, settings, max_steps)
    if throw and path.result != Result.OK:
        raise ComputationError(
            f"the trajectory stopped at t = {path.t[-1]:.6g} in chart '{s.names[path.chart[-1]]}': "
            f"{path.result.message}. `throw=False` returns it up to there."
        )
    return path


def integrate(
    s: Structure,
    begin: Lanes,
    u: Float[np.ndarray, "nu 1"],
    target: Target,
    settings: Settings,
    max_steps: int,
    new_input: bool = True,
) -> tuple[Trajectory, Lanes]:
    """Integrate one trajectory to its target on the host, and check it. It ends where a check
    fails, with the reason as its `result`.

    **Returns:** the trajectory, and the lane at its end.
    """
    lanes = begin
    tapes = []
    steps = 0
    h = None
    result = Result.STEP_LIMIT
    while result == Result.STEP_LIMIT and steps < max_steps:
        moved, tape = _piece(s, lanes, u, target, settings, h, new_input or steps > 0)
        tapes.append(tape)
        lanes = moved.lanes
        h = moved.h
        steps = steps + settings.max_steps
        result = Result(int(np.asarray(moved.result)[0]))
    path = recorded(s, begin, tapes, u, result)
    if new_input:
        doubts = tuple(begins_beyond(s, begin, u, path.t[-1] - path.t[0]))
        path = dataclasses.replace(path, findings=doubts)
    warn_of(path.findings)
    passed = _passed(s, path.t, path.chart, path.before, path.after, path.event, u)
    if passed is not None:
        path = path.until(passed, Result.GUARD_PASSED)
    pulse = passed_over(path, u[:, 0], settings)
    if pulse is not None:
        path = path.until(pulse[0], Result.PULSE_PASSED)
    return path, lanes


def _start_of(
    s: Structure,
    chart: str | Guess | StateLike | None,
    state: Any,
    duration: Any,
    time: Any,
) -> tuple[Guess, Any]:
    """Return the start and the duration, from a chart with a state, from a guess, or from a state
    of the only chart that it fits.

    **Raises:** `DefinitionError` where one of them is missing, or would be dropped.
    """
    if isinstance(chart, str):
        return _start_in_chart(chart, state, duration, time), duration
    if chart is None:
        if duration is None:
            _refuse_missing("duration")
        start = own_guess(s.system) if state is None else state
        length = duration
    else:
        if state is not None and duration is not None:
            raise DefinitionError(
                "simulate: after a guess or a state, give the duration alone: "
                "`hj.simulate(system, guess, duration)`."
            )
        # (The duration takes the place of the state.)
        start = chart
        length = state if duration is None else duration
    if length is None or np.ndim(length) or not length > 0:
        raise DefinitionError(
            "simulate: after a guess or a state, give the duration, a positive number: "
            "`hj.simulate(system, guess, duration)`."
        )
    if not isinstance(start, Guess):
        return guess_of(s, start, "the state", time), length
    if time is not None:
        raise DefinitionError(
            "simulate: a guess has its own time: `hj.Guess(chart, state, time)`, without `time`."
        )
    return start, length


def _start_in_chart(chart: str, state: Any, duration: Any, time: Any) -> Guess:
    """Return the start in a chart.

    **Raises:** `DefinitionError` without a state or a duration, and for several states.
    """
    if state is None or duration is None:
        _refuse_missing("state" if state is None else "duration")
    if np.ndim(state) != 1:
        raise DefinitionError(
            f"simulate: `state` must be of shape (n,), not of shape {np.shape(state)}."
        )
    return Guess(chart, state, 0.0 if time is None else time)


def _refuse_missing(missing: str) -> NoReturn:
    raise DefinitionError(
        f"simulate needs `{missing}`: `hj.simulate(system, chart, state, duration)`, or "
        "`hj.simulate(system, guess, duration)`."
    )


def recorded(
    s: Structure, begin: Lanes, tapes: Sequence[Tape], u: np.ndarray, result: Result
) -> Trajectory:
    """The trajectory of one lane, from the tapes of its pieces, under a constant input (nu, 1), or
    under another one in each piece (nu, pieces)."""
    state = begin.q.T
    no_event = np.full(1, -1)
    rows = [(begin.t, state, state, begin.chart, no_event)]
    for tape in tapes:
        lane = jax.tree_util.tree_map(lambda x: np.asarray(x)[..., 0], tape)
        columns = lane.t, lane.before, lane.after, lane.chart, lane.code
        is_move = lane.code != IDLE
        rows.append(tuple(x[is_move] for x in columns))
    joined = [np.concatenate(x) for x in zip(*rows, strict=True)]
    t, before, after, chart, event = joined
    source = np.append(chart[:1], chart[:-1])
    u_before = u
    u_after = u
    if u.shape[1] > 1:
        counts = [len(x) for x, *_ in rows[1:]]
        of_step = np.repeat(u, counts, axis=1)
        u_before = np.hstack([of_step[:, :1], of_step])
        last = of_step[:, -1:]
        u_after = np.hstack([of_step, last])
    with at_ease():
        slope_before = slopes(s, t, source, before.T, u_before).T
        slope_after = slopes(s, t, chart, after.T, u_after).T
    return Trajectory(
        s, t, chart, before, after, slope_before, slope_after, event, result
    )


def constant_input(system: HybridSystem, input: Any) -> Any:
    """The constant part of an input of the right shape; zero for a function of time."""
    names = system.inputs
    nu = len(names)
    value = np.asarray(0.0)
    if callable(input):
        with evaluating("input, a function of t alone,"):
            shape = jax.eval_shape(lambda t: jnp.asarray(input(t), float), value).shape
    else:
        if input is not None:
            value = input if is_traced(input) else np.asarray(input, float)
        shape = value.shape
    if shape not in ((), (nu,)):
        raise DefinitionError(
            f"the input has shape {shape}, but {name_of(system)} has the inputs "
            f"({', '.join(names)}): give one number for each."
        )
    return namespace(value).broadcast_to(value, (nu,))


def begins_beyond(
    s: Structure, begin: Lanes, u: np.ndarray, span: float
) -> Iterator[Finding]:
    """Doubts about a start, of a flow that takes a time `span`, at which guards are beyond zero, or
    at zero and fall, or begin to."""
    for reached in guards_reached(s, begin, u, moment=_MOMENT * span):
        transition = s.transitions[reached.transition]
        name = transition.name
        if reached.rests:
            text = (
                f"the start is at rest on the guard of '{name}', and then goes beyond it: this "
                "event does not happen there. What rests there, as a ball on the ground, needs a "
                "chart of its own; what moves away from there needs a start after the reset."
            )
            yield Finding("on a guard", text)
        elif reached.at_zero:
            text = (
                f"the start lies on the guard of '{name}', and goes beyond it: this event does not "
                "happen there. Start a little before it, or after its reset."
            )
            yield Finding("on a guard", text)
        else:
            value = transition.sign * reached.value
            text = (
                f"the start lies beyond the guard of '{name}' (its value is {value:.3g}; the event "
                f"happens where it is {transition.direction} through zero), so that this event "
                "cannot happen before the guard has come back."
            )
            yield Finding("beyond a guard", text)


class ReachedGuard(NamedTuple):
    """A guard that has, or gets at once, the sign that it has after its event."""

    transition: int
    value: float
    at_zero: bool
    """Whether it is at zero, and not beyond it."""
    rests: bool
    """Whether it is at zero, and does not move there."""


def guards_reached(
    s: Structure,
    lane: Lanes,
    u: np.ndarray,
    instant: float = 0.0,
    moment: float = 0.0,
) -> Iterator[ReachedGuard]:
    """The guards of a lane that are beyond zero, or fall to zero within an `instant`, and those at
    rest at zero that begin to fall within a `moment`, as the height of a ball on the ground."""
    a = int(lane.chart[0])
    guards = s.guards(a)
    n = s.dims[a]
    if not guards:
        return
    q = lane.q[:n]
    point = np.append(lane.t, q)
    rows, flow = _along(s, a, point, u)
    begins = np.zeros(len(guards), bool)
    if moment:
        begins = _begin_to_fall(s, a, point, flow, u, moment)
    for g, row, begin in zip(guards, rows, begins, strict=True):
        holds = kernels.enabled(s, s.member(g), lane.t, q, u)
        if not holds.all():
            continue
        value = float(row[0])
        slope = row[1 : 2 + n]
        noise = _SAME * np.abs(slope * point).sum()
        rate = slope @ flow
        noise_of_rate = _SAME * np.abs(slope * flow).sum()
        falls = rate < -noise_of_rate
        rests = abs(rate) <= noise_of_rate
        if value < -noise:
            yield ReachedGuard(g, value, at_zero=False, rests=False)
        elif falls and value <= noise - instant * rate:
            yield ReachedGuard(g, value, at_zero=True, rests=False)
        elif begin and rests and value <= noise:
            yield ReachedGuard(g, value, at_zero=True, rests=True)


def _along(
    s: Structure, a: int, point: Float[np.ndarray, " n1"], u: np.ndarray
) -> tuple[Float[np.ndarray, "g n2"], Float[np.ndarray, " n1"]]:
    """The guards of chart a at a time and state, with their slopes, and the flow of both."""
    t = point[:1]
    q = point[1:, None]
    first = np.zeros(1, np.int32)
    values = kernels.watched(s, a, None, t, q, u, first)
    field = kernels.field(s, a, t, q, u)
    return values[..., 0], np.append(1.0, field[:, 0, 0])


def _begin_to_fall(
    s: Structure,
    a: int,
    point: Float[np.ndarray, " n1"],
    flow: Float[np.ndarray, " n1"],
    u: np.ndarray,
    moment: float,
) -> Bool[np.ndarray, " g"]:
    """Whether each guard of chart a falls as soon as it moves, from a time and state at which it is
    at rest. A guard that moves with the power k of time does so after k - 1 steps of Euler's."""
    falls = np.zeros(len(s.guards(a)), bool)
    rests = ~falls
    for _ in range(_HIGHEST_POWER - 1):
        point = point + moment * flow
        rows, flow = _along(s, a, point, u)
        slopes = rows[:, 1 : 1 + len(point)]
        noise = _SAME * np.abs(slopes * flow).sum(axis=1)
        rate = slopes @ flow
        falls = falls | (rests & (rate < -noise))
        rests = rests & (np.abs(rate) <= noise)
    return falls


def _passed(s: Structure, t, charts, before, after, event, u) -> int | None:
    """The first event whose reset ends on a guard through which the state then goes, though it
    cannot count. (It may go through one that it was crossing.)"""
    passed: list[int] = []
    events = np.flatnonzero(event[:-1] >= 0)
    dims = np.array(s.dims)
    for a in np.unique(charts[events]).tolist():
        if not s.guards(a):
            continue
        n = s.dims[a]
        rows = events[charts[events] == a]
        magnitude = np.abs(after[:, :n])
        sizes = magnitude.max(axis=0)
        # Values of the guards before the event, after it, and at the end of the next step.
        begin = before[rows, :n].T
        state = after[rows, :n].T
        end = before[rows + 1, :n].T
        value_before = _guards_at(s, a, t[rows], begin, u)[:, 0]
        guard = _guards_at(s, a, t[rows], state, u)
        value = guard[:, 0]
        later = t[rows + 1]
        value_later = _guards_at(s, a, later, end, u)[:, 0]

        # Their rates along the field after the event.
        slope = guard[:, 2 : 2 + n]
        rows_of_field = kernels.field(s, a, t[rows], state, u)
        field = rows_of_field[:, 0]
        along = np.einsum("gnk,nk->gk", slope, field)
        rate = guard[:, 1] + along

        # (Zeros are parts of the terms of values and rates.)
        steepness = np.abs(slope)
        zero = _SAME * np.einsum("gnk,n->gk", steepness, sizes)
        zero_rate = _SAME * np.einsum("gnk,nk->gk", steepness, np.abs(field))

        is_still = np.abs(rate) <= zero_rate
        had_guard = dims[charts[rows - 1]] == n
        was_on_guard = np.abs(value_before) <= zero
        crosses = had_guard & was_on_guard & ~is_still
        is_on_guard = np.abs(value) <= zero
        through = is_on_guard & (value_later < 0) & ~crosses
        passed += rows[through.any(axis=0)].tolist()
    return min(passed, default=None)


def _guards_at(s: Structure, a: int, t, q, u):
    """The guards of chart a at some points, with their derivatives."""
    first = np.zeros(1, np.int32)
    return kernels.watched(s, a, None, t, q, u, first)


@host_first
def _piece(s, lanes, u, target, settings, h, new_input: bool):
    options = Options(tape=True, new_input=new_input)
    return move(s, lanes, u, target, settings, h, options=options)
