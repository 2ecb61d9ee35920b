"""One step of every lane, before it is accepted or rejected.

`search.py` calls `attempt(state, aim, task)` in each iteration, and gets an `Attempt`: the state at
the end of the step, its error, and how well the watched functions (guards, and the level of the
target section) are known along the step. If a lane aims at a crossing and its step comes close to
it, `land` moves the end of the step onto the zero. The cubic Hermite interpolant of each watched
function stands for this function along the step, and `margin` is the estimated error of the
interpolant. If steps are too long or too short, look at `_errors`; if events are missed, look at
`_margin` and `_clearance`; if a good crossing is called grazing, look at `SLOW`, and at
`_is_shallow` in `outcome.py`. The two corrections of a landing (`ChartFlow.locate`) must stay those
of a replay, which differentiates them.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..._core.executor import cond, namespace, put
from ..._core.lanes import pick, put_rows, take_rows
from ...systems.structure import Structure
from ..arrays import AnyTimes, Array, Mask, Padded, States, Times
from ..cubic import NEAR, bounds, halfway_cubic, root_near_end
from ..events import INSTANT, width
from ..lanes import Lanes, for_each_chart, only
from ..runge_kutta import Step, rounding_error
from ..settings import Settings, size, tolerance
from ..watch import ChartFlow, Watch, chart_flow, no_events, write
from .state import Aim, Attempt, State, Task


Flags = Bool[Array, "W L"]
Present = Bool[Array, ""]

# A crossing slower than this part of the function's rate elsewhere in the step is a grazing.
# Higher: crossings whose times are right to five digits are called grazing. Lower: derivatives of
# crossing times lose more digits before a grazing is reported.
SLOW = 1e-5
# A step is too long for a watched function if the error of its interpolant exceeds this part of the
# function's magnitude. Higher: functions that turn many times within a step are not noticed, and
# events are missed. Lower: more steps (at 4e-3, the hopper takes twice as many at a tolerance of
# 1e-4).
_BEND = 2e-2
# The margin of an interpolant is this many times its error halfway. Higher: more steps. Lower: near
# an extremum the error may be larger than the margin, and events are missed.
_CAUTION = 2.0
# The error of a derivative is estimated by a step from a state that is shifted by this part of its
# size. Higher: second derivatives contribute. Lower: rounding errors do, and steps are then too
# short where 1e-12 is asked for.
_ASIDE = 3e-3
# A lane lands if the time between the crossing and the end of the step is less than this part of
# the expected time to the crossing. Higher: the last correction (of order 4) is longer, and more
# landings are rejected as inaccurate. Lower: more steps until a lane lands.
_LANDING_REACH = 0.25
# In a chart with an implicit method, a landing may add only this part of the error that a step may
# have, since no later step damps the error of a landing before the section. Higher: sections have
# errors that nobody reports. Lower: more steps until a lane lands.
_LANDING_PART = 1e-2
# Accuracy of a landing, as a part of the step: its last correction is no longer (or lasts at most
# an instant), and the zero lies no farther beyond the step in which the crossing was met. Each
# correction squares the error. Higher: the two corrections of a replay do not reach rounding.
# Lower: landings are repeated.
LANDING = 1e-6
# Attempts to land on a crossing before the step is halved. Higher: attempts take time where the
# interpolant gives no good guess of the crossing. Lower: steps are halved too early.
LANDING_TRIES = 8


class Landing(NamedTuple):
    """Ends of steps. Of lanes that land, these are the zeros themselves."""

    q: States
    f: States
    past: Times
    """Time from the end of the step to the zero, as far as is known."""
    lands: Mask
    error: Times
    """Error of the correction from the step's end to the zero, relative to the tolerance."""
    middle: States
    """State halfway from the start of the step to the zero."""
    rate: States
    """Rate of the state halfway."""


def land(
    flow: ChartFlow,
    before: Watch,
    q: States,
    step: Step,
    allowed: States,
    t: Times,
    aim: Aim,
    span: Times,
) -> Landing:
    """The zero of the function aimed at, before or beyond the end of a step from (t, q).

    **Arguments:** `before`: watched functions at the start of the step. `allowed`: errors that the
    landing may have.
    """
    xp = namespace(t)
    tau = aim.step
    which = aim.which
    after = flow.watch(t + tau, step.q, step.f1)
    v0, r0, v1, r1 = (pick(x, flow.rows, which) for x in (*before, *after))
    by_cubic = tau * (root_near_end(v0, v1, tau * r0, tau * r1) - 1)
    by_newton = -v1 / xp.where(r1 == 0, 1.0, r1)
    # (After a very short step, Newton's guess is better than that of the cubic.)
    first = xp.where(tau > 1e-3 * aim.reach, by_cubic, by_newton)
    near = (which >= 0) & (xp.abs(first) <= aim.reach)
    first = xp.where(near, first, 0.0)
    end = flow.locate(t + tau, step.q, step.f1, which, first)
    share = xp.abs(first) / xp.where(aim.reach > 0, aim.reach, 1.0)
    # (The correction is an explicit step: where modes die out within it, its error estimate has no
    # order.)
    weight = (
        1 / _LANDING_PART
        if flow.method.implicit
        else xp.where(share > 0, share, 0.0) ** 2
    )
    error = xp.max(end.error / allowed * weight, axis=0)
    fine = xp.abs(end.last) <= LANDING * xp.abs(tau + end.past) + INSTANT * span
    lands = near & fine & (share <= _LANDING_REACH) & (xp.abs(error) <= 1.0)
    middle, rate = _halfway(q, step, end.q, end.f, tau, tau + end.past)
    return Landing(
        xp.where(lands, end.q, step.q),
        xp.where(lands, end.f, step.f1),
        xp.where(near, end.past, by_newton),
        lands,
        xp.where(lands, xp.abs(error), 0.0),
        xp.where(lands, middle, step.middle),
        xp.where(lands, rate, step.rate),
    )


def attempt(state: State, aim: Aim, task: Task) -> Attempt:
    """Let the active lanes take a step. Lanes that come close to the zero at which they aim land on
    it."""
    s = task.s
    lanes = state.lanes
    L = state.lanes.t.shape[0]
    xp = namespace(lanes.t)
    zero = xp.zeros(L)
    no = xp.zeros(L, bool)
    yes = xp.ones(L, bool)
    nothing = no_events(s, lanes.t)
    empty = Attempt(
        lanes.q, nothing, nothing.rate, zero, zero, no, no, no, state.along, yes
    )

    def work(a, here, out):
        # A step of chart a, and its error.
        flow = chart_flow(s, a, here, task.u, task.target)
        n = s.dims[a]
        rows = flow.rows
        present = here.any()
        t = only(here, lanes.t)
        q = only(here, lanes.q[:n])
        tau = xp.where(here, aim.step, 0.0)
        old_along = None if out.along is None else only(here, out.along[:n])
        step, along, change = _step(flow, present, t, q, tau, old_along, task)
        allowed, error = _errors(flow, t, q, tau, step, change, along, task)
        if along is not None and out.along is not None:
            along = put(out.along, slice(n), xp.where(here, along, out.along[:n]))
            out = out._replace(along=along)
        end = Landing(step.q, step.f1, zero, no, zero, step.middle, step.rate)
        if rows:
            # Lanes that aim at a zero land on it. Then, what is known of the watched functions.
            before = Watch(*(take_rows(x, rows) for x in state.watched))
            which = xp.where(here, aim.which, -1)
            goal = aim._replace(which=which, step=tau)
            plain = end
            landing = flow.only(which >= 0)
            end = cond(
                (which >= 0).any(),
                lambda: land(landing, before, q, step, allowed, t, goal, task.span),
                lambda: plain,
            )
            moved = tau + xp.where(end.lands, end.past, 0.0)

            def watch_end():
                return flow.watch(t + moved, end.q, end.f)

            after = cond(present, watch_end, lambda: before)
            margin = _margin(flow, before, after, end, t, moved, task.span)
            bent = _bent(before, after, margin)
            chosen = (np.array(rows)[:, None] == which) & end.lands
            # (Where events coincide, the step to the second event is a rounding error, from which
            # no speed of the crossing can be computed.)
            judged = chosen & (xp.abs(before.value) > width(t, task.span, before.rate))
            ready = take_rows(state.ready, rows)
            touching = take_rows(state.touching(task.settings), rows)
            far, slow = _clearance(
                before, after, margin, moved, ready, judged, touching
            )
            calm = (far | chosen).all(axis=0) & ~bent & ~slow
            out = out._replace(
                watched=write(out.watched, rows, here, after),
                margin=put_rows(out.margin, rows, here, margin),
                past=xp.where(here, end.past, out.past),
                lands=xp.where(here, end.lands, out.lands),
                slow=xp.where(here, slow, out.slow),
                bent=xp.where(here, bent, out.bent),
                calm=xp.where(here, calm, out.calm),
            )
        return out._replace(
            q=put(out.q, slice(n), xp.where(here, end.q, out.q[:n])),
            error=xp.where(here, error + end.error, out.error),
        )

    return for_each_chart(s, lanes.chart, state.active, work, empty)


def _step(
    flow: ChartFlow,
    present: Present,
    t: AnyTimes,
    q: States,
    tau: AnyTimes,
    along: States | None,
    task: Task,
) -> tuple[Step, States | None, States | None]:
    """A step. Where derivatives matter, also the change of its error by a deviation of the state,
    and, for implicit methods, the deviation after the step.

    With an explicit method, the deviation begins with the step. With an implicit method, it began
    with the flow or at the last event: in a stiff chart it may have died out since.
    """

    # (In a branch: otherwise XLA would mask the states again in every stage.)
    def plain():
        return flow.step(t, q, tau)

    if along is not None and flow.method.implicit:
        return cond(
            present,
            lambda: flow.step_along(t, q, tau, along),
            lambda: (plain(), along, namespace(q).zeros_like(q)),
        )
    step = cond(present, plain, lambda: Step(*(q for _ in Step._fields)))
    if not task.tangents:
        return step, None, None
    shift = _ASIDE * size(task.settings, flow.a, q, step.q)
    shifted = cond(
        present,
        lambda: flow.step(t, q + shift * _direction(len(q)), tau).estimate,
        lambda: step.estimate,
    )
    return step, None, shifted - step.estimate


def _errors(
    flow: ChartFlow, t, q: States, tau, step: Step, change, along, task: Task
) -> tuple[States, AnyTimes]:
    """The error that a step may have, and the error of the step relative to this. The error of a
    derivative of the state is included, since a state at rest has no error of its own."""
    xp = namespace(q)
    settings = task.settings
    a = flow.a
    assert settings.rtol is not None
    rounding = xp.zeros_like(q)
    if settings.scale is None:
        # (At the start of the step, since a bad step may end anywhere.)
        rounding = rounding_error(flow.field, t, q, step.f0)
    allowed = tolerance(settings, a, q, tau, step, rounding)
    motion = step.error if change is None else step.estimate
    error = xp.max(xp.abs(motion) / allowed, axis=0, initial=0.0)
    if change is not None:
        scale = size(settings, a, q, step.q)
        if settings.scale is None:
            # (Relative to a state that happens to be small, no error would be small enough.)
            scale = xp.broadcast_to(xp.max(scale, axis=0), scale.shape)
        if along is None:
            scale = _ASIDE * scale
        else:
            scale = scale * xp.maximum(1.0, xp.max(xp.abs(along) / scale, axis=0))
        change = xp.max(xp.abs(change) / (settings.rtol * scale), axis=0, initial=0.0)
        error = xp.maximum(error, xp.where(xp.isfinite(change), change, 0.0))
        gain = flow.method.gain
        error = error**gain * settings.rtol ** (gain - 1) if gain != 1 else error
    finite = xp.isfinite(step.q).all(axis=0) & ~xp.isnan(error)
    return allowed, xp.where(finite, error, xp.inf)


def _halfway(
    q: States, step: Step, end: States, f: States, tau: Times, moved: Times
) -> tuple[States, States]:
    """The state and its rate halfway from q to the `end`, where the field is f. `moved` is the
    length of the way to the end, and tau the length of the step, which is a little longer or
    shorter.

    The values of the cubic are corrected by the difference between the step's own middle and its
    cubic. The difference grows as h^4, and that of the rates as h^3.
    """
    xp = namespace(q)
    middle, rate = halfway_cubic(q, step.q, step.f0, step.f1, tau)
    bend = step.middle - middle
    twist = step.rate - rate
    share = moved / xp.where(tau == 0, 1.0, tau)
    middle, rate = halfway_cubic(q, end, step.f0, f, moved)
    return middle + bend * share**4, rate + twist * share**3


def _margin(
    flow: ChartFlow,
    before: Watch,
    after: Watch,
    end: Landing,
    t: AnyTimes,
    moved: AnyTimes,
    span: Times,
) -> Float[Array, "W L"]:
    """The margin: how far watched functions may be from their cubic interpolants. It is computed
    from the differences of values and rates halfway, less rounding errors."""
    xp = namespace(moved)
    true = flow.watch(t + 0.5 * moved, end.middle, end.rate)
    d0 = moved * before.rate
    d1 = moved * after.rate
    value = 0.5 * (before.value + after.value) + 0.125 * (d0 - d1)
    slope = 1.5 * (after.value - before.value) - 0.25 * (d0 + d1)
    missing = xp.abs(true.value - value) + 0.5 * xp.abs(moved * true.rate - slope)
    fastest = xp.maximum(xp.abs(before.rate), xp.abs(after.rate))
    return _CAUTION * xp.maximum(missing - width(t, span, fastest), 0.0)


def _bent(before: Watch, after: Watch, margin: Float[Array, "W L"]) -> Mask:
    """Test whether the margin of a watched function is too large, or NaN."""
    xp = namespace(margin)
    size = xp.abs(before.value) + xp.abs(after.value)
    bent = (margin > _BEND * size) | xp.isnan(margin)
    return (bent | xp.isnan(after.value) | xp.isnan(after.rate)).any(axis=0)


def _clearance(
    before: Watch,
    after: Watch,
    margin: Float[Array, "W L"],
    moved: AnyTimes,
    armed: Flags,
    judged: Flags,
    touching: Float[Array, "W L"],
) -> tuple[Flags, Mask]:
    """Test whether watched functions stay away from zero, by bounds of their interpolants and
    margins. Also find lanes that land at a vanishing speed, on zeros that are `judged`."""
    xp = namespace(moved)
    ends = before.value, after.value, moved * before.rate, moved * after.rate
    low, high = bounds(*ends, margin)
    near = NEAR * xp.maximum(xp.abs(ends[0]), xp.abs(ends[1]))
    far = xp.where(armed, low > xp.maximum(near, touching), high <= 0)
    fastest = xp.maximum(xp.abs(ends[2]), xp.abs(ends[0]))
    # (With rounding errors, the zero may lie a little before the start.)
    return far, (judged & (xp.abs(moved) * after.rate > -SLOW * fastest)).any(axis=0)


def deviation(s: Structure, lanes: Lanes, settings: Settings) -> Padded:
    """A deviation of every lane, as large as its states."""

    def work(a, here, out):
        n = s.dims[a]
        scaled = size(settings, a, only(here, lanes.q[:n])) * _direction(n)
        return put(out, slice(n), xp.where(here, scaled, out[:n]))

    xp = namespace(lanes.q)
    return for_each_chart(
        s, lanes.chart, xp.ones(len(lanes.t), bool), work, xp.zeros_like(lanes.q)
    )


def _direction(n: int) -> Float[np.ndarray, "n 1"]:
    """A direction of n states that no system is aligned with."""
    return np.cos(1.0 + np.arange(n))[:, None]
