"""The flow from any state through any events, differentiable.

`flow` works in three stages:

1. `requested` checks the arguments and writes them down as a `Request`.
2. A single flow that JAX does not trace is computed by `_on_host`: it is that of `simulate`, with
   its checks, and has a trajectory. All others are computed by the compiled program of
   `flow_program.py`, which takes many lanes and makes fewer checks.
3. `_result` makes the `Flow`, and `_require_ends` raises the error of one that failed.

Both ways of stage 2 must give the same numbers: compare them first if one is wrong. If a start is
refused, look at `_begun`; if an end is, at `_target_of`, to which a further kind of end is added.
If an error should not be raised, look at the code in `result`, which `_require_ends` puts into
words: codes come from the engine, from `_on_host`, and in programs from `flow_program._passage`.
"""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from .._core.arguments import require_among
from .._core.boundary.checked import checked, checked_methods
from .._core.boundary.kinds import Count, Duration, Numbers, Scalar, StepCount
from .._core.boundary.values import Reals
from .._core.executor import Array, is_traced, namespace, to_host
from .._core.findings import Finding, print_findings, warn_of
from .._core.meaning import current, require_as_made
from .._core.precision import require_x64
from .._core.results import Result
from .._core.showable import Showable
from .._core.text import folded, how_many, number, signal_values
from ..engine.flow import Events, Passage, Samples
from ..engine.lanes import Lanes, lane_at, nan_where, start_lanes
from ..engine.search.state import Moved
from ..engine.settings import Settings
from ..engine.target import Target, toward, until as until_time
from ..engine.trajectory import (
    Event,
    Trajectory,
    constant_input,
    guards_reached,
    integrate,
    states_at,
)
from ..errors import ComputationError, DefinitionError
from ..systems.check import check_schedules, check_system
from ..systems.quotient import check_symmetry
from ..systems.start import StateLike, SystemLike, guess_of, system_of
from ..systems.structure import Structure
from ..systems.system import Driven, Guess, HybridSystem, name_of
from ..systems.transition import SAME_TIME
from .coincidence import all_commute, groups_on
from .crossing import AtEvent, Crossing, to_section
from .cycle import LimitCycle
from .flow_program import Request, is_late, passage_of, sampled_passage


# Error of a step relative to the sizes of states. Larger: derivatives, which are those of the
# steps, are less accurate than values. Smaller: rounding is all that steps could still avoid.
_ACCURACY = 1e-12
# Steps of a flow, accepted or rejected. Fewer: more flows end early. More: programs keep longer
# records.
MOST_STEPS = 1024
# A crossing after a smaller part of the longest duration may be lost in the rounding of times,
# which is relative to this duration. Larger: users are sent to `within` where a guard is touched.
# Smaller: they are told of a touch where there is none.
_MUCH_SHORTER = 1e-4


@checked_methods
class Flow(Showable, eqx.Module):
    """The end of a flow, and the events on the way. For many flows, all arrays have a leading axis.

    States are padded with zeros to the largest chart's dimension d, unless the number of states at
    the end is known while JAX traces the flow: it is known if all charts have the same number, and
    right after an event. All numbers of a flow that failed are NaN, and so are those of events that
    did not happen.

    **Fields:** `t`, `state`, `chart`: time, state (n,) and index of the chart at the end;
    `flow["y"]` is a state by its name. `result`: a `Result` code. `event_times` (E,), `event_index`
    (E,): times of the first E events, and indices of their transitions (-1 for none). `before`,
    `after` (E, d): the states before and after their resets. `count`: number of all events.
    `trajectory`: steps and dense states, of a single flow that JAX does not trace; otherwise None.
    `findings`: doubts about its start and end.
    """

    t: Float[Array, "*L"]
    state: Float[Array, "*L n"]
    chart: Int[Array, "*L"]
    result: Int[Array, "*L"]
    event_times: Float[Array, "*L E"]
    event_index: Int[Array, "*L E"]
    before: Float[Array, "*L E d"]
    after: Float[Array, "*L E d"]
    count: Int[Array, "*L"]
    trajectory: Trajectory | None
    structure: Structure
    lanes: Lanes
    """Where it ended."""
    request: Request

    @property
    def findings(self) -> tuple[Finding, ...]:
        return () if self.trajectory is None else self.trajectory.findings

    @property
    def events(self) -> list[Event]:
        """The events in order of time, of a single flow that JAX does not trace.

        **Raises:** `DefinitionError` for other flows.
        """
        return self.require_trajectory().events

    def require_trajectory(self) -> Trajectory:
        """Return the trajectory.

        **Raises:** `DefinitionError` if there is none.
        """
        if self.trajectory is None:
            raise DefinitionError(
                "only a single flow outside of `jax.jit` keeps its steps: read `event_times`, "
                "`event_index`, `before`, `after` and `at(times)` here."
            )
        return self.trajectory

    def __getitem__(self, name: str) -> Float[Array, "*L"]:
        """A state at the end by its name, `flow["yM"]`, differentiable as `state` is; NaN in charts
        without it.

        **Raises:** `DefinitionError` for a state that no chart has.
        """
        s = self.structure
        require_among("state", [name], s.state_names())
        index = [
            chart.states.index(name) if name in chart.states else -1
            for chart in s.charts
        ]
        xp = namespace(self.state)
        places = xp.asarray(index)[self.chart]
        place = xp.maximum(places, 0)[..., None]
        values = xp.take_along_axis(self.state, place, axis=-1)[..., 0]
        lanes = nan_where(xp.atleast_1d(places < 0), xp.atleast_1d(values)[None])
        return lanes[0].reshape(values.shape)

    @property
    def system(self) -> HybridSystem:
        return self.structure.system

    @property
    def lane_results(self) -> Int[Array, " L"]:
        """The codes, also of a single flow on an axis."""
        return namespace(self.result).atleast_1d(self.result)

    def at(
        self, times: Annotated[Numbers, Reals("K")] | Scalar
    ) -> tuple[Int[Array, "*LK"], Float[Array, "*LK d"]]:
        """Charts and states, padded to d numbers, at some times, as accurate as the flow itself and
        differentiable like it. They are NaN at times before its start and after its end, and at all
        times if events coincide whose order matters.

        **Arguments:** `times` (K,), or one.

        **Returns:** `charts` (K,), their indices, and `states` (K, d); at one time without that
        axis.

        **Raises:** `DefinitionError` if the system's code has changed since.
        """
        require_x64(self)
        require_as_made(self.system, "this flow was computed")
        if not np.ndim(times):
            charts, states = self.at(namespace(times).asarray(times)[None])
            return charts[..., 0], states[..., 0, :]
        if self.trajectory is not None and not is_traced(times):
            return self._on_steps(np.asarray(times))
        samples = sampled_passage(self.request, jnp.asarray(times)).samples
        depends = jnp.asarray(self.lane_results) == Result.SIMULTANEOUS
        chart = jnp.moveaxis(samples.chart, -1, 0)
        q = jnp.moveaxis(nan_where(depends, samples.q), -1, 0)
        return (chart, q) if self.request.many else (chart[0], q[0])

    def _on_steps(
        self, times: Float[np.ndarray, " K"]
    ) -> tuple[Int[Array, " K"], Float[Array, "K d"]]:
        """The same from the recorded steps of a single flow."""
        path = self.require_trajectory()
        chart, states = states_at(path, np.asarray(self.request.u), times)
        if path.result == Result.SIMULTANEOUS:
            states = np.full_like(states, np.nan)
        return jnp.asarray(chart), jnp.asarray(states)

    def __repr__(self):
        name = name_of(self.system)
        if is_traced(self.t) or np.ndim(self.t):
            shape = "traced" if is_traced(self.t) else f"of {len(self.t)} starts"
            failed = ""
            if not is_traced(self.result):
                failed = f", {int(np.sum(np.asarray(self.result) != 0))} failed"
            return folded(f"Flow({name}, {shape}{failed})")
        end = number(float(self.t), unit=self.system.time_unit)
        chart = self.structure.names[int(self.chart)]
        states = self.structure.by_name(int(self.chart), np.asarray(self.state))
        count = int(self.count)
        many = how_many(count, "event", "events")
        text = folded(
            f"Flow({name}: to t = {end} in {chart}, {signal_values(states, states.values())}; "
            f"{many}: {Result(int(self.result)).message})"
        )
        return "\n".join([text, *print_findings(self.findings, "  ").splitlines()])


@checked
def flow(
    system: SystemLike,
    start: Guess | Flow | LimitCycle | StateLike,
    until: Scalar | str | AtEvent | Crossing | None = None,
    *,
    events: Count | None = None,
    within: Duration | None = None,
    input: Callable[[Any], Any] | Annotated[Numbers, Reals()] | None = None,
    settings: Settings | None = None,
    max_events: Count = 16,
    max_steps: StepCount | None = None,
    throw: bool = True,
) -> Flow:
    """Integrate from any state, through any events, to a time, an event or a section.

    The result has exact derivatives of first and second order, in forward and reverse mode, with
    respect to the state and the time at the start, parameters, a constant input, the time of the
    end and the value of a `Crossing`. It works inside of `jax.jit`, `jax.vmap` and `jax.grad`. At
    an event the derivative follows from the saltation matrix: it is that of neighboring
    trajectories that meet the same events in the same order.

    **Arguments:**

    - `system`: a `HybridSystem`. If the start is a state, it may also be the vector field (t, q) of
      a single chart without events.
    - `start`: a `Guess` with the chart, the state (n,) and the time (Default: 0), or the `Flow`
      that ended there. A `Guess` with states (L, n) starts L flows. If only one chart has such
      states, a state (n,) suffices, as numbers or by name. `cycle.state` and the states of an event
      know their chart and time. A `LimitCycle` starts at its `anchor`.
    - `until`: a time (no duration: a flow from `event.after` that lasts 0.6 has the end
      `event.time + 0.6`); the name of an event, or `AtEvent(name)`: right after its reset; or a
      `Crossing`: at its level. `events`: right after so many events, in place of `until`.
    - `within`: the longest duration, required for all ends other than a time. Do not make it much
      longer than the flow: times are rounded to 1e-12 of it, and events fail if it is 1e5 times too
      long.
    - `input`: a constant input (nu,), or a function of time that returns one. Default: 0; after a
      `Flow`, its input.
    - `settings`: accuracy of the flow. Default: 1e-12, relative to each state in the current step.
    - `max_events`: number of events of which times and states are kept. Default: 16.
    - `max_steps`: largest number of steps. Default: 1024, or that of `settings` if it is larger.
    - `throw`: raise an error if the flow ends early. Default: True. With False, and where JAX
      traces an argument, `result` has the reason, and times and states are NaN.

    **Returns:** a `Flow`: `t`, `state` and `chart` at the end, `flow["y"]`; `event_times`,
    `event_index`, `before` and `after` of the first `max_events` events; `result`; and
    `at(times)`.

    **Raises:** `DefinitionError` for bad arguments; `ComputationError` if the end is not reached,
    for grazing, Zeno, blow-up and the limit on steps, if `throw`.

    **Example:**

    ```python
    start = hj.Guess("flight", (2.0, 1.0, 0.0, 0.0))
    landing = hj.flow(hopper, start, "touchdown", within=5.0)
    print(landing.t, landing["yM"])

    import jax

    def height(k):
        return hj.flow(hopper.replace(k=k), start, 3.0)["yM"]

    print(jax.grad(height)(10.0))
    ```

    **Before:** a model, `hj.models` or `hj.HybridSystem`. **After:** `jax.grad`, `jax.vmap`.
    """
    request = requested(
        system, start, until, events, within, input, settings, max_events, max_steps
    )
    if request.many or is_traced(request):
        found = _result(request, passage_of(request), None)
    else:
        found = _on_host(request)
    if throw and not is_traced(found.result):
        _require_ends(found)
    return found


def requested(
    system: SystemLike,
    start: Guess | Flow | LimitCycle | StateLike,
    until: Any,
    events: int | None,
    within: Any,
    input: Any,
    settings: Settings | None,
    max_events: int,
    max_steps: int | None,
) -> Request:
    """What is asked for.

    **Raises:** `DefinitionError` in the cases of `flow`.
    """
    require_x64(system, start, settings)
    settings = Settings() if settings is None else settings
    begin = None if isinstance(start, Flow | LimitCycle) else start
    system = settings.system(system_of(system, begin))
    settings = settings.filled(_ACCURACY)
    if max_steps is None:
        max_steps = max(MOST_STEPS, settings.max_steps)
    settings = Settings(settings.rtol, settings.atol, max_steps, settings.scale)
    check_system(system)
    check_symmetry(system)
    constant = constant_input(system, input)
    drive = input if callable(input) else None
    u = constant[:, None]
    if isinstance(start, Flow) and input is None:
        before = start.request
        u = before.u
        drive = before.system.drive if isinstance(before.system, Driven) else None
    if drive is not None:
        system = current(Driven(system, drive))
    s = Structure(system)
    check_schedules(s)
    lanes, many, result = _begun(s, start)
    if is_traced(system, lanes, until, within, u):
        lanes = jax.tree_util.tree_map(jnp.asarray, lanes)
    target, ends_in = _target_of(s, lanes, until, events, within)
    return Request(
        system=system,
        lanes=lanes,
        result=result,
        u=u,
        target=target,
        settings=settings,
        most_events=max_events,
        new_input=not isinstance(start, Flow) or input is not None,
        many=many,
        ends_in=ends_in,
    )


def _begun(
    s: Structure, start: Guess | Flow | LimitCycle | StateLike
) -> tuple[Lanes, bool, Int[Array, " L"]]:
    """Lanes at the start, whether they are many, and their codes.

    **Raises:** `DefinitionError` for a start that is none of the system.
    """
    if isinstance(start, Flow):
        _require_start(start, s)
        return start.lanes, start.request.many, start.lane_results
    if isinstance(start, LimitCycle):
        start = _at_anchor(start)
    if not isinstance(start, Guess):
        start = guess_of(s, start, "`start`")
    lanes, many = _lanes_of(s, start)
    result = namespace(lanes.t).full(lanes.t.shape, Result.OK, np.int32)
    return lanes, many, result


def _require_start(start: Flow, s: Structure) -> None:
    """**Raises:** `DefinitionError` for a flow that failed, or of a system with other charts."""
    if start.structure.names != s.names or start.structure.dims != s.dims:
        raise DefinitionError(
            "`start` is a flow of a system with other charts: give a `hj.Guess`."
        )
    if is_traced(start.result) or start.request.many:
        return
    if start.result != Result.OK:
        raise DefinitionError(
            f"the flow that ended at `start` failed ({Result(int(start.result)).message}): nothing "
            "can go on from there."
        )


def _at_anchor(cycle: LimitCycle) -> Guess:
    """The state of a limit cycle where it begins."""
    state = tuple(cycle.state.values())
    anchor = to_host(cycle.anchor)
    name = cycle.structure.names[int(anchor.chart[0])]
    return Guess(name, state, anchor.t[0])


def _lanes_of(s: Structure, start: Guess) -> tuple[Lanes, bool]:
    """Lanes at the start, and whether they are many.

    **Raises:** `DefinitionError` for a chart or a number of states that the system does not have.
    """
    a = s.chart_index(start.chart)
    q = start.state
    many = q.ndim == 2
    if not many and not is_traced(start):
        return lane_at(s, start.chart, q, start.time, "`start`"), False
    if q.shape[-1] != s.dims[a]:
        raise DefinitionError(
            f"`start` must give values for the {s.dims[a]} states "
            f"{', '.join(s.charts[a].states)} of chart '{start.chart}'; got an array of shape "
            f"{q.shape}."
        )
    if not q.size:
        raise DefinitionError("`start` has no states: give one state (n,), or (L, n).")
    states = jnp.atleast_2d(q).T
    states = jnp.pad(states, ((0, s.d - len(states)), (0, 0)))
    L = states.shape[1]
    t = jnp.broadcast_to(start.time, L)
    lanes = start_lanes(s, t, jnp.full(L, a, jnp.int32), states)
    return jax.tree_util.tree_map(jnp.asarray, lanes), many


def _target_of(
    s: Structure, lanes: Lanes, until: Any, events: int | None, within: Any
) -> tuple[Target, int | None]:
    """The end of a flow, and its chart, if it is known.

    **Raises:** `DefinitionError` for an end that does not exist, or lies before the start, and for
    one that needs a longest duration.
    """
    if (until is None) == (events is None):
        raise DefinitionError(
            "flow needs one end: `until`, a time, the name of an event or a `hj.Crossing`; or "
            "`events`, a number of events. For example `hj.flow(system, start, 3.0)`, or "
            '`hj.flow(system, start, "impact", within=10.0)`.'
        )
    xp = namespace(lanes.t)
    at_time = not isinstance(until, str | AtEvent | Crossing) and until is not None
    if at_time:
        if within is not None:
            raise DefinitionError(
                "`within` is for ends that are no times: the flow until a time takes as long as it "
                "takes."
            )
        time = xp.broadcast_to(xp.asarray(until, float), lanes.t.shape)
        if not is_traced(time, lanes.t) and np.any(np.asarray(time) < lanes.t):
            raise DefinitionError(
                f"the flow ends at t = {float(np.min(time)):.9g}, before its start at t = "
                f"{float(np.max(lanes.t)):.9g}: give a later `until`."
            )
        return until_time(time), _only_chart(s)
    name = until.name if isinstance(until, AtEvent) else until
    if isinstance(name, str):
        # (A misspelled event is named before the missing `within`.)
        g = s.transition_index(name)
    if within is None:
        raise DefinitionError(
            "flow to an event or a section needs the longest duration to wait for it: "
            "`within=10.0`, in the system's unit of time."
        )
    never = xp.full(lanes.t.shape, np.inf)
    limit = lanes.t + within
    if events is not None:
        target = toward(never, -1, limit)
        count = xp.full(lanes.t.shape, events, xp.int32)
        return dataclasses.replace(target, count=count), _only_chart(s)
    if isinstance(until, Crossing):
        until.check(s)
        return to_section(toward(never, -1, limit), until), _only_chart(s, until)
    return toward(never, g, limit), s.chart_index(s.transitions[g].target)


def _only_chart(s: Structure, section: Crossing | None = None) -> int | None:
    """A chart with as many states as the one at the end has, if that is known."""
    charts = range(len(s.charts))
    if section is not None:
        charts = [a for a in charts if section.in_chart(s, a)]
    dims = {s.dims[a] for a in charts}
    return next(iter(charts)) if len(dims) == 1 else None


def sampled(request: Request, times: Float[Array, " K"]) -> tuple[Flow, Samples]:
    """A flow as a program, and samples of it."""
    passage = sampled_passage(request, times)
    return _result(request, passage, None), passage.samples


def _orders_differ(path: Trajectory, span: float) -> bool:
    """Test whether events of a path coincide that lead elsewhere in another order."""
    s = path.structure
    rows = np.flatnonzero(path.event >= 0)
    scale = np.ones((len(s.dims), s.d))
    for a in np.unique(path.chart).tolist():
        size = np.abs(path.after[path.chart == a]).max(axis=0)
        scale[a] = np.where(size > 0, size, 1.0)
    return not all_commute(groups_on(path, rows, span, scale))


def _result(request: Request, passage: Passage, path: Trajectory | None) -> Flow:
    """The result of lanes at their ends."""
    s = Structure(request.system)
    moved = passage.moved
    xp = namespace(moved.lanes.t)
    failed = moved.result != Result.OK
    n = s.d if request.ends_in is None else s.dims[request.ends_in]
    end = xp.concatenate([moved.lanes.t[None], moved.lanes.q[:n]])
    end = nan_where(failed, end)
    events = passage.events

    def of_lanes(x):
        x = xp.moveaxis(x, -1, 0)
        return x if request.many else x[0]

    return Flow(
        t=of_lanes(end[0]),
        state=of_lanes(end[1:]),
        chart=of_lanes(moved.lanes.chart),
        result=of_lanes(moved.result),
        event_times=of_lanes(events.t),
        event_index=of_lanes(events.transition),
        before=of_lanes(events.before),
        after=of_lanes(events.after),
        count=of_lanes(moved.lanes.events),
        trajectory=path,
        structure=s,
        lanes=moved.lanes,
        request=request,
    )


def _on_host(request: Request) -> Flow:
    """A single flow, without a program, and checked."""
    s = Structure(request.system)
    lanes = request.lanes._replace(events=request.lanes.events * 0)
    settings = request.settings
    path, end = integrate(
        s,
        lanes,
        np.asarray(request.u),
        request.target,
        settings,
        settings.max_steps,
        request.new_input,
    )
    span = float(request.target.limit[0] - lanes.t[0])
    if path.result == Result.OK and is_late(request.target, lanes, end)[0]:
        path = dataclasses.replace(path, result=Result.SECTION_MISSED)
    if path.result == Result.OK and _orders_differ(path, span):
        path = dataclasses.replace(path, result=Result.SIMULTANEOUS)
    if path.result == Result.OK and np.isfinite(request.target.time[0]):
        doubts = tuple(_ends_at_an_event(path, s, end, np.asarray(request.u), span))
        warn_of(doubts)
        path = dataclasses.replace(path, findings=path.findings + doubts)
    a = int(path.chart[-1])
    request = dataclasses.replace(request, ends_in=a)
    code = np.array([path.result], np.int32)
    rows = np.flatnonzero(path.event >= 0)
    end = end._replace(events=np.array([len(rows)], np.int32))
    rows = rows[: request.most_events]

    def padded(x, empty):
        more = request.most_events - len(rows)
        widths = [(0, more)] + [(0, 0)] * (x.ndim - 1)
        return np.pad(x[rows], widths, constant_values=empty)[..., None]

    events = Events(
        padded(path.event, -1),
        padded(path.t, np.nan),
        padded(path.before, np.nan),
        padded(path.after, np.nan),
        padded(path.event < 0, False),
        padded(path.event * 0 - 1, -1),
    )
    nothing = np.zeros(1)
    charts = np.zeros((0, 1), np.int32)
    none = Samples(charts, np.zeros((0, s.d, 1)))
    passage = Passage(
        Moved(
            lanes=end,
            h=nothing,
            error=nothing,
            result=code,
        ),
        events,
        none,
    )
    return _result(request, passage, path)


def _ends_at_an_event(
    path: Trajectory, s: Structure, end: Lanes, u: np.ndarray, span: float
) -> Iterator[Finding]:
    """A doubt about a flow to a time at which an event happens, too, but for rounding."""
    instant = SAME_TIME * span
    reached = guards_reached(s, end, u, instant)
    found = [x.transition for x in reached if x.at_zero]
    rows = np.flatnonzero(path.event >= 0)
    at_end = rows[path.t[-1] - path.t[rows] <= instant]
    found += path.event[at_end].tolist()
    for g in dict.fromkeys(found):
        name = s.transitions[g].name
        text = (
            f"the flow ends at the time of '{name}', up to rounding, which decides whether this "
            "event happens. End a little sooner or later, or at the event."
        )
        yield Finding("ends at an event", text)


def _about_missed(found: Flow, k: int) -> str:
    """The end that flow k did not reach."""
    target = found.request.target
    begin = float(found.request.lanes.t[k])
    limit = float(target.limit[k])
    within = f"within {number(limit - begin, unit=found.system.time_unit)}"
    if target.count is not None:
        times = np.atleast_2d(found.event_times)[k]
        happened = int(np.sum(times <= limit))
        if happened == len(times):
            # (The times of later events are not kept.)
            happened = int(np.atleast_1d(found.count)[k])
        wanted = int(np.broadcast_to(target.count, target.limit.shape)[k])
        return f"{happened} of {wanted} events happened {within}"
    g = int(np.broadcast_to(target.event, target.limit.shape)[k])
    if g >= 0:
        event = found.structure.transitions[g].name
        return f"the event '{event}' did not happen {within}"
    return f"the section was not crossed {within}"


def _require_ends(found: Flow) -> None:
    """**Raises:** `ComputationError` for the first flow that did not reach its end."""
    codes = np.atleast_1d(np.asarray(found.result))
    failed = np.flatnonzero(codes != Result.OK)
    if not len(failed):
        return
    k = int(failed[0])
    message = Result(int(codes[k])).message
    if codes[k] == Result.SECTION_MISSED:
        message = _about_missed(found, k)
    if codes[k] == Result.STEP_LIMIT:
        most = found.request.settings.max_steps
        message = f"{most} steps did not suffice; a larger `max_steps` may"
    if found.request.many:
        raise ComputationError(
            f"{len(failed)} of {len(codes)} flows did not reach their end, first start {k}: "
            f"{message}. `throw=False` returns the others."
        )
    lanes = found.lanes
    if codes[k] == Result.SECTION_MISSED:
        causes = "".join(f" One cause may be that {x.text}" for x in found.findings)
        raise ComputationError(
            f"{message}: give a longer `within`, or another end.{causes} `throw=False` returns the "
            "flow."
        )
    if codes[k] == Result.SIMULTANEOUS:
        raise ComputationError(
            f"{message}, and its derivatives may depend on the order. `throw=False` returns the "
            "events."
        )
    begin = found.request.lanes.t[0]
    longest = found.request.target.limit[0] - begin
    if codes[k] == Result.GRAZING and lanes.t[0] - begin < _MUCH_SHORTER * longest:
        remedy = "give a shorter `within`"
        if np.isfinite(found.request.target.time[0]):
            remedy = "end at an earlier time, and go on from that flow"
        raise ComputationError(
            f"the flow stopped at t = {float(lanes.t[0]):.6g}, much sooner than after its longest "
            f"duration ({float(longest):.3g}), by which times are rounded: {remedy}, or a guard or "
            "section is touched tangentially there (grazing)."
        )
    where = ""
    if not is_traced(lanes):
        chart = found.structure.names[int(lanes.chart[0])]
        where = f" at t = {float(lanes.t[0]):.6g} in chart '{chart}'"
    raise ComputationError(
        f"the flow stopped{where}: {message}. `throw=False` returns it."
    )
