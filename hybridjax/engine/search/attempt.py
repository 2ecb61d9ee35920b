"""One step of every lane, before it is accepted: where it leads, and how far it can be trusted."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..._core.executor import Array, cond, namespace, put
from ..._core.lanes import pick, take_rows
from ..._core.precision import at_precision
from ...systems.structure import Structure
from ..events import width
from ..hermite import NEAR, control_points, root_near_end
from ..lanes import Lanes, for_each_chart, only
from ..settings import Settings, size, tolerance
from ..solver.step import Step, rounding_error
from ..watch import ChartFlow, Watch, chart_flow, nothing, write
from .aim import Aim
from .state import State, Task


# A crossing slower than this part of the function's rate elsewhere in the step is a grazing. Twice
# as much calls crossings grazing whose times are still right to five digits.
SLOW = 1e-5
# A step is too long for a watched function if halfway its cubic interpolant misses it by more than
# this part of its size. Twice as much makes fewer steps, and misses the narrower dips.
_BEND = 2e-3
# A lane lands if its crossing is nearer to the end of the step than this part of its length,
# measured from where the zero was thought to be. Twice as much asks a method of order 4 to go
# further, so that more landings are rejected as too rough.
_LANDING_REACH = 0.25
# It lands if the last correction is at most this part of the way from the step's start, or that of
# the time allowed (in double and in single precision). Corrections square their error: twice as
# much still leaves a crossing right to 1e-11 of the way, of which a replay makes rounding errors.
_LAST_CORRECTION = 1e-6
_LAST_CORRECTION_OF_SPAN = 1e-14, 5e-6
# From the end of a step that is at most this part of the one in which the zero was seen, the cubic
# between its ends is a worse guess of the zero than Newton's. Twice as much: hardly a difference.
_SHORT_STEP = 1e-3
# The error of a derivative is seen by a step that starts aside, by this part of the state's size.
# Twice as much: less rounding, more of second derivatives.
_ASIDE = 1e-4


class Attempt(NamedTuple):
    """A step of every lane."""

    q: Float[Array, "d L"]
    """The state at its end: on the zero that the lane aims at, if it lands."""
    seen: Watch
    """The watched functions there."""
    error: Float[Array, " L"]
    """Estimate of the step's error, relative to the tolerance."""
    past: Float[Array, " L"]
    """Time from the end of the step aimed for to the zero, as far as is known."""
    lands: Bool[Array, " L"]
    slow: Bool[Array, " L"]
    """The zero that the lane lands on is not crossed in falling, or at a vanishing speed."""
    bent: Bool[Array, " L"]
    """A watched function is not resolved by its cubic interpolant over the step.

    Step control looks at the states only; where those are simple, a guard may still turn many
    times within a step."""
    along: Float[Array, "d L"] | None
    """See `State`."""
    calm: Bool[Array, " L"]
    """No watched function comes near to a zero, save the one that the lane lands on."""


class _Home(NamedTuple):
    """Where lanes are after they tried to land."""

    q: Float[Array, "n L"]
    f: Float[Array, "n L"]
    past: Float[Array, " L"]
    lands: Bool[Array, " L"]
    rough: Float[Array, " L"]
    """Error of the way from the step's end to the zero, relative to the tolerance."""


def attempt(
    s: Structure,
    state: State,
    aim: Aim,
    task: Task,
    *,
    unroll: bool,
    in_step: bool,
    tangents: Bool[Array, ""] | bool,
) -> Attempt:
    """Let the active lanes step, and land those that come close to the zero they aim at.

    With `in_step`, all lanes are thought to go equally far from the same time, to no zero; then
    what depends on time only is computed once. With `tangents`, errors are also those of a
    derivative: where the state rests, it has none of its own. An explicit step is asked for that of
    a deviation that begins with the step; an implicit one for that of a deviation that began with
    the flow or at the last event, and may have died out since, as it does where a chart is stiff.
    """
    lanes, ready, L = state.lanes, state.ready, state.lanes.t.shape[0]
    xp = namespace(lanes.t)
    zero, no, yes = xp.zeros(L), xp.zeros(L, bool), xp.ones(L, bool)
    empty = Attempt(lanes.q, nothing(s, lanes.t), zero, zero, no, no, no, state.along, yes)

    def work(a, here, out):
        n = s.dims[a]
        flow = chart_flow(s, a, here, task.u, task.target)
        t, q = only(here, lanes.t), only(here, lanes.q[:n])
        tau = xp.where(here, aim.step, 0.0)
        if in_step:
            t, tau = t[:1], aim.step[xp.argmax(here)][None]
        # (A branch of its own, lest XLA masks the states again in every stage.)
        some = here.any()
        follows, along = tangents is not False and flow.method.implicit, out.along
        if follows:
            before = only(here, along[:n])
            step, deviation, change = cond(
                some & tangents,
                lambda: flow.step_along(t, q, tau, before),
                lambda: (flow.step(t, q, tau, unroll), before, xp.zeros_like(q)),
            )
            along = put(along, slice(n), xp.where(here, deviation, along[:n]))
        else:
            step = cond(some, lambda: flow.step(t, q, tau, unroll), lambda: Step(q, q, q, q))
        rounding = xp.zeros_like(q)
        if task.settings.scale is None:
            rounding = cond(
                some,
                lambda: rounding_error(flow.field, t + tau, step.q, step.f1),
                lambda: xp.zeros_like(q),
            )
        allowed = tolerance(task.settings, a, q, tau, step, rounding)
        error = xp.max(xp.abs(step.error) / allowed, axis=0, initial=0.0)
        if tangents is not False:
            own = size(task.settings, a, q, step.q)
            if follows:
                own = own * xp.maximum(1.0, xp.max(xp.abs(deviation) / own, axis=0))
            else:
                own = _ASIDE * own
                near = cond(
                    some & tangents,
                    lambda: flow.step(t, q + own * _aside(n), tau, unroll).error,
                    lambda: step.error,
                )
                change = near - step.error
            change = xp.max(xp.abs(change) / (task.settings.rtol * own), axis=0, initial=0.0)
            error = xp.maximum(error, xp.where(xp.isfinite(change), change, 0.0))
        gain = flow.method.gain
        if gain != 1:
            error = error**gain * task.settings.rtol ** (gain - 1)
        finite = xp.isfinite(step.q).all(axis=0) & ~xp.isnan(error)
        error = xp.where(finite, error, xp.inf)
        rows = flow.rows
        if not rows:
            end = xp.where(here, step.q, out.q[:n])
            error = xp.where(here, error, out.error)
            return out._replace(q=put(out.q, slice(n), end), error=error, along=along)

        before = Watch(*(take_rows(x, rows) for x in state.seen))
        which = xp.where(here, aim.which, -1)
        home, moved = _Home(step.q, step.f1, zero, no, zero), tau
        if not in_step:
            home = cond(
                (which >= 0).any(),
                lambda: _go_home(
                    flow.only(which >= 0), before, which, step, allowed, t, tau, aim.reach, task
                ),
                lambda: home,
            )
            moved = tau + xp.where(home.lands, home.past, 0.0)
        after = cond(some, lambda: flow.watch(t + moved, home.q, home.f), lambda: before)
        ends = before.value, after.value, moved * before.rate, moved * after.rate

        middle = 0.5 * (q + home.q) + 0.125 * moved * (step.f0 - home.f)
        true = flow.watch(t + 0.5 * moved, middle, home.f).value
        cubic = 0.5 * (ends[0] + ends[1]) + 0.125 * (ends[2] - ends[3])
        around = xp.abs(ends[0]) + xp.abs(ends[1]) + xp.abs(true)
        fastest = xp.maximum(xp.abs(before.rate), xp.abs(after.rate))
        bent = xp.abs(true - cubic) > _BEND * around + width(t, task.span, fastest)
        bent = bent.any(axis=0)

        points = control_points(*ends)
        low = xp.minimum(xp.minimum(points[0], points[1]), xp.minimum(points[2], points[3]))
        high = xp.maximum(xp.maximum(points[0], points[1]), xp.maximum(points[2], points[3]))
        scale = xp.maximum(xp.abs(ends[0]), xp.abs(ends[1]))
        own = (np.array(rows)[:, None] == which) & home.lands
        armed = take_rows(ready, rows)
        far = xp.where(armed, low > NEAR * scale, high <= 0)
        fastest = xp.maximum(xp.abs(ends[2]), xp.abs(ends[0]))
        # (By rounding, the zero may lie a little before the start.)
        slow = (own & (xp.abs(moved) * after.rate > -SLOW * fastest)).any(axis=0)
        return Attempt(
            put(out.q, slice(n), xp.where(here, home.q, out.q[:n])),
            write(out.seen, rows, here, after),
            xp.where(here, error + home.rough, out.error),
            xp.where(here, home.past, out.past),
            xp.where(here, home.lands, out.lands),
            xp.where(here, slow, out.slow),
            xp.where(here, bent, out.bent),
            along,
            xp.where(here, (far | own).all(axis=0) & ~bent & ~slow, out.calm),
        )

    return for_each_chart(s, lanes.chart, state.active, work, empty)


def deviation(s: Structure, lanes: Lanes, settings: Settings) -> Float[Array, "d L"]:
    """A deviation of every lane, as large as its states."""

    def work(a, here, out):
        n = s.dims[a]
        own = size(settings, a, only(here, lanes.q[:n])) * _aside(n)
        return put(out, slice(n), xp.where(here, own, out[:n]))

    xp = namespace(lanes.q)
    return for_each_chart(s, lanes.chart, xp.ones(len(lanes.t), bool), work, xp.zeros_like(lanes.q))


def _aside(n: int) -> Float[np.ndarray, "n 1"]:
    """A direction of n states that no system is made for."""
    return np.cos(1.0 + np.arange(n))[:, None]


def _go_home(
    flow: ChartFlow,
    before: Watch,
    which: Int[Array, " L"],
    step: Step,
    allowed: Float[Array, "n #L"],
    t: Float[Array, " L"],
    tau: Float[Array, " L"],
    reach: Float[Array, " L"],
    task: Task,
) -> _Home:
    """From the end of a step of length tau onto the zero of `which`, on either side of it."""
    xp, after = namespace(tau), flow.watch(t + tau, step.q, step.f1)
    v0, r0, v1, r1 = (pick(x, flow.rows, which) for x in (*before, *after))
    by_cubic = tau * (root_near_end(v0, v1, tau * r0, tau * r1) - 1)
    by_newton = -v1 / xp.where(r1 == 0, 1.0, r1)
    first = xp.where(tau > _SHORT_STEP * reach, by_cubic, by_newton)
    near = (which >= 0) & (xp.abs(first) <= reach)
    first = xp.where(near, first, 0.0)
    end = flow.settle(t + tau, step.q, step.f1, which, first)
    share = xp.abs(first) / xp.where(reach > 0, reach, 1.0)
    rough = xp.max(end.error / allowed * xp.where(share > 0, share, 0.0) ** 2, axis=0)
    rounding = at_precision(*_LAST_CORRECTION_OF_SPAN) * task.span
    fine = xp.abs(end.last) <= _LAST_CORRECTION * xp.abs(tau + end.past) + rounding
    lands = near & fine & (share <= _LANDING_REACH) & (xp.abs(rough) <= 1.0)
    return _Home(
        xp.where(lands, end.q, step.q),
        xp.where(lands, end.f, step.f1),
        xp.where(near, end.past, by_newton),
        lands,
        xp.where(lands, xp.abs(rough), 0.0),
    )
