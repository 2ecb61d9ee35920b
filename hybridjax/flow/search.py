"""Adaptive flow of many lanes to their targets, through any number of events.

This is the part that decides: step sizes, which event comes first, when to give up. It is not
differentiated; what it decides is written down as a `Tape`, which `replay` follows.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core.results import Result, update_result
from ..systems.structure import Structure
from ..systems.transition import Scheduled
from .hermite import first_crossing
from .lanes import by_lane, for_each_chart, guard_rate, Lanes, only, rearm
from .step import midpoint_step, rk_step
from .target import Target


# Codes on a tape. Codes >= 0 name the transition that fires at the end of a move.
IDLE, MOVE, ARRIVE_TIME, ARRIVE_LEVEL = -4, -3, -2, -1

# A crossing slower than this fraction of the guard's rate elsewhere in the step is a grazing.
_SLOW = 1e-5
# Zeno: this many intervals between events in a row shrink, with a sum that has all but converged.
_ZENO_STREAK, _ZENO_REST = 10, 1e-3
# A guard has left zero once it exceeds this fraction of what its rate would carry it in a step.
_CLEAR = 1e-12
# Steps below this fraction of the time allowed are not taken.
_TINY = 1e-13


class Tape(NamedTuple):
    """What was done, one row per iteration and one column per lane."""

    h: Float[Array, "R L"]
    """Length of the move."""
    code: Int[Array, "R L"]
    """How it ended: IDLE (no move), MOVE, ARRIVE_TIME, ARRIVE_LEVEL, or a transition's index."""
    t: Float[Array, "R L"]
    """Time at the end of the move."""
    before: Float[Array, "R d L"]
    """State at the end of the move, before a reset."""
    after: Float[Array, "R d L"]
    """State after the reset."""
    chart: Int[Array, "R L"]
    """Chart after the reset."""


class Found(NamedTuple):
    """Result of a search."""

    lanes: Lanes
    h: Float[Array, " L"]
    """The step size to go on with."""
    result: Int[Array, " L"]
    tape: Tape | None


class _State(NamedTuple):
    lanes: Lanes
    h: Array
    result: Array
    arrived: Array
    aimed: Array
    i: Array
    tape: Tape | None


class _Attempt(NamedTuple):
    """One step of every lane, before it is accepted."""

    q: Array
    error: Array
    s: Array
    """Where in the step the first crossing is, as a fraction; infinity for none."""
    which: Array
    """The transition that crosses first, or the number of transitions for the target's level."""
    refine: Array
    touch: Array
    armed: Array
    aimed: Array


class _Landing(NamedTuple):
    tau: Array
    q: Array
    ok: Array
    slow: Array
    enabled: Array
    together: Array
    armed: Array
    aimed: Array


def search(
    s: Structure,
    lanes: Lanes,
    u: Float[Array, "nu L"],
    target: Target,
    *,
    h: Float[Array, " L"],
    result: Int[Array, " L"],
    rtol: float,
    atol: float,
    max_steps: int,
    tape: bool,
) -> Found:
    """Flow every lane to its target, or to a result code that says why not.

    Lanes whose `result` is not OK at the start stay where they are.
    """
    finite = jnp.isfinite(lanes.t) & jnp.isfinite(lanes.q).all(axis=0) & jnp.isfinite(u).all(axis=0)
    result = update_result(result, ~finite, Result.BAD_INPUT)
    span = target.limit - lanes.t
    h = jnp.minimum(h, 1.05 * target.hint)
    L, d = lanes.t.shape[0], lanes.q.shape[0]
    book = None
    if tape:
        R = max_steps
        book = Tape(
            jnp.zeros((R, L)),
            jnp.full((R, L), IDLE, jnp.int32),
            jnp.zeros((R, L)),
            jnp.zeros((R, d, L)),
            jnp.zeros((R, d, L)),
            jnp.zeros((R, L), jnp.int32),
        )
    state = _State(
        lanes,
        h,
        result,
        jnp.zeros(L, bool),
        _aim(s, lanes, u, target),
        jnp.zeros((), jnp.int32),
        book,
    )

    def active(state):
        return ~state.arrived & (state.result == Result.OK)

    def cond(state):
        return (state.i < max_steps) & active(state).any()

    def body(state):
        return _iterate(s, state, active(state), u, target, span, rtol, atol)

    state = jax.lax.while_loop(cond, body, state)
    result = update_result(state.result, active(state), Result.STEP_LIMIT)
    return Found(state.lanes, state.h, result, state.tape)


def _iterate(s, state, active, u, target, span, rtol, atol) -> _State:
    lanes, h, result = state.lanes, state.h, state.result
    G = len(s.transitions)

    # 1. Known times: the step is cut so that it ends on them exactly, in equal pieces.
    scheduled, schedule = next_schedule(s, lanes.t, lanes.chart)
    known = jnp.minimum(target.time, scheduled)
    rest = jnp.maximum(known - lanes.t, 0.0)
    pieces = jnp.maximum(jnp.ceil(jnp.where(jnp.isfinite(rest), rest / h, 2.0) - 1e-9), 1.0)
    last = pieces == 1
    step = jnp.where(active, jnp.where(jnp.isfinite(rest), rest / pieces, h), 0.0)

    # 2. A step of every lane.
    attempt = _attempt(s, state, active, u, target, step, rtol, atol)
    crosses = jnp.isfinite(attempt.s)
    bad = ~jnp.isfinite(attempt.error)
    accept = active & (attempt.error <= 1.0) & ~attempt.refine

    # 3. Lanes that cross something land on it.
    landing = _land(s, state, accept & crosses, u, target, step, span, attempt)
    lands = accept & crosses & landing.ok
    lost = accept & crosses & ~landing.ok
    accept = accept & ~lost
    plain = accept & ~crosses

    # 4. Move.
    moved = jnp.where(lands, landing.tau, step)
    t = jnp.where(plain, jnp.where(last, known, lanes.t + step), lanes.t)
    t = jnp.where(lands, lanes.t + landing.tau, t)
    q = jnp.where(plain, attempt.q, jnp.where(lands, landing.q, lanes.q))

    # 5. What happens there.
    fired = jnp.where(lands & (attempt.which < G) & landing.enabled, attempt.which, -1)
    by_clock = plain & last & (scheduled <= target.time)
    fired = jnp.where(by_clock, schedule, fired)
    level = lands & (attempt.which == G)
    armed = jnp.where(plain, attempt.armed, jnp.where(lands, landing.armed, lanes.armed))
    aimed = jnp.where(plain, attempt.aimed, jnp.where(lands, landing.aimed, state.aimed))
    before = Lanes(t, lanes.chart, q, armed, lanes.events, lanes.pace)
    pace, zeno = _pace(lanes.pace, jnp.where(accept, moved, 0.0), fired >= 0)
    expected = jnp.ones_like(zeno)
    if target.order is not None:
        n = target.order.shape[0]
        expected = target.order[lanes.events % n] == fired if n else jnp.zeros_like(zeno)
    new, aimed = _reset(s, before, aimed, fired, u, target, landing.together)
    new = eqx.tree_at(lambda x: x.pace, new, pace)

    arrived = (plain & last & ~by_clock) | level | ((fired >= 0) & (fired == target.event))

    # 6. Step size, and reasons to stop.
    factor = jnp.clip(0.9 * attempt.error ** (-1 / 6), 0.2, 5.0)
    factor = jnp.where(bad, 0.1, factor)
    grown = jnp.where(step < h, jnp.maximum(h, step * factor), step * factor)
    again = active & ~accept
    h = jnp.where(accept, jnp.where(lands, h, grown), h)
    h = jnp.where(again, step * jnp.where(lost | attempt.refine, 0.5, factor), h)
    stuck = again & (h < _TINY * span)
    result = update_result(
        result, accept & (attempt.touch | (lands & landing.slow)), Result.GRAZING
    )
    result = update_result(result, stuck & (attempt.refine | lost), Result.GRAZING)
    result = update_result(result, stuck, Result.BLOW_UP)
    result = update_result(result, zeno & (fired >= 0), Result.ZENO)
    result = update_result(result, (fired >= 0) & ~expected, Result.EVENT_ORDER)
    result = update_result(result, active & ~arrived & (new.t >= target.limit), target.missed)

    tape = state.tape
    if tape is not None:
        code = jnp.where(accept, MOVE, IDLE)
        code = jnp.where(plain & last & ~by_clock, ARRIVE_TIME, code)
        code = jnp.where(level, ARRIVE_LEVEL, jnp.where(fired >= 0, fired, code))
        row = (moved, code.astype(jnp.int32), t, q, new.q, new.chart)
        tape = Tape(*(x.at[state.i].set(y) for x, y in zip(tape, row, strict=True)))
    return _State(new, h, result, state.arrived | arrived, aimed, state.i + 1, tape)


def next_schedule(s: Structure, t: Float[Array, " L"], chart: Int[Array, " L"]):
    """Time of the next scheduled event after t (infinity if there is none), and its transition."""
    best, which = jnp.full_like(t, jnp.inf), jnp.full_like(chart, -1)
    for a in range(len(s.charts)):
        for g in s.schedules(a):
            schedule: Scheduled = s.transitions[g].guard
            k = jnp.floor((t - schedule.offset) / schedule.period + 1e-9) + 1
            time = schedule.offset + jax.lax.stop_gradient(k) * schedule.period
            sooner = (chart == a) & (time < best)
            best, which = jnp.where(sooner, time, best), jnp.where(sooner, g, which)
    return best, which


def crossable(s: Structure, a: int, target: Target):
    """The functions of chart a whose zeros matter: pairs (row, function(t, q, u, index)).

    The row is the transition's index, or the number of transitions for the target's level.
    """
    functions = [(g, lambda t, q, u, i, g=g: s.guard(g, t, q, u)) for g in s.guards(a)]
    if target.levels is not None and target.levels.present(s, a):
        levels = target.levels
        functions.append((len(s.transitions), lambda t, q, u, i: levels.level(s, a, i, t, q)))
    return functions


def chart_field(s: Structure, a: int, u):
    """Field of chart a over lanes, as `step` wants it."""
    return lambda t, q: by_lane(lambda t, q, u: s.field(a, t, q, u))(t, q, u)


def rate_of(function, t, q, u, index, f):
    """Value and rate of a crossable function over lanes."""

    def one(t, q, u, i, f):
        return guard_rate(lambda t, q: function(t, q, u, i), t, q, f)

    return by_lane(one)(t, q, u, index, f)


def _attempt(s, state, active, u, target, h, rtol, atol) -> _Attempt:
    lanes = state.lanes
    L = lanes.t.shape[0]
    G = len(s.transitions)
    empty = _Attempt(
        lanes.q,
        jnp.zeros(L),
        jnp.full(L, jnp.inf),
        jnp.full(L, -1, jnp.int32),
        jnp.zeros(L, bool),
        jnp.zeros(L, bool),
        lanes.armed,
        state.aimed,
    )

    def work(a, here, out):
        n = s.dims[a]
        t, q, uu = only(here, lanes.t), only(here, lanes.q[:n]), only(here, u)
        index, hh = only(here, target.index), jnp.where(here, h, 0.0)
        step = rk_step(chart_field(s, a, uu), t, q, hh)
        size = jnp.maximum(jnp.abs(q), jnp.abs(step.q))
        error = jnp.max(jnp.abs(step.error) / (atol + rtol * size), axis=0, initial=0.0)
        error = jnp.where(jnp.isfinite(step.q).all(axis=0), error, jnp.inf)
        error = jnp.where(jnp.isnan(error), jnp.inf, error)

        first, which = jnp.full(L, jnp.inf), jnp.full(L, -1, jnp.int32)
        refine = touch = jnp.zeros(L, bool)
        armed, aimed = lanes.armed, state.aimed
        for row, function in crossable(s, a, target):
            v0, d0 = rate_of(function, t, q, uu, index, step.f0)
            v1, d1 = rate_of(function, t + hh, step.q, uu, index, step.f1)
            d0, d1 = hh * d0, hh * d1
            ready = aimed if row == G else armed[row]
            crossing = first_crossing(v0, v1, d0, d1, ready)
            sooner = crossing.s < first
            first = jnp.where(sooner, crossing.s, first)
            which = jnp.where(sooner, row, which)
            refine, touch = refine | crossing.near, touch | crossing.touch
            clear = v1 > _CLEAR * (jnp.abs(d0) + jnp.abs(d1))
            ready = (ready & (v1 > 0)) | clear
            armed, aimed = (armed, ready) if row == G else (armed.at[row].set(ready), aimed)
        refine = refine & ~jnp.isfinite(first)
        return _Attempt(
            out.q.at[:n].set(jnp.where(here, step.q, out.q[:n])),
            jnp.where(here, error, out.error),
            jnp.where(here, first, out.s),
            jnp.where(here, which, out.which),
            jnp.where(here, refine, out.refine),
            jnp.where(here, touch, out.touch),
            jnp.where(here, armed, out.armed),
            jnp.where(here, aimed, out.aimed),
        )

    return for_each_chart(s, lanes.chart, active, work, empty)


def settle(s, a, t, q, u, index, which, target):
    """Two Newton steps, at the end of a step, onto the zero of the function that crosses.

    From the crossing itself (up to rounding) they change nothing, but carry the derivatives of
    the crossing's time and state exactly, to second order.

    **Returns:** (time past t, state, field there, first correction, rate of the function)
    """
    field = chart_field(s, a, u)

    def correction(t, q, f):
        value, rate = jnp.zeros_like(t), jnp.ones_like(t)
        for row, function in crossable(s, a, target):
            v, r = rate_of(function, t, q, u, index, f)
            value, rate = jnp.where(which == row, v, value), jnp.where(which == row, r, rate)
        return -value / jnp.where(rate == 0, 1.0, rate), rate

    first, _ = correction(t, q, field(t, q))
    q, t = midpoint_step(field, t, q, first), t + first
    f = field(t, q)
    second, rate = correction(t, q, f)
    return first + second, q + second * f, f, first, rate


def _land(s, state, mask, u, target, h, span, attempt) -> _Landing:
    lanes = state.lanes
    L = lanes.t.shape[0]
    G = len(s.transitions)
    no = jnp.zeros(L, bool)
    empty = _Landing(jnp.zeros(L), lanes.q, no, no, ~no, no, lanes.armed, state.aimed)
    # Below this correction `settle` is exact to rounding.
    enough = 1e-6 * h + 1e-13 * span

    def work(a, here, out):
        n = s.dims[a]
        t, q, uu = only(here, lanes.t), only(here, lanes.q[:n]), only(here, u)
        index = only(here, target.index)
        which = jnp.where(here, attempt.which, -1)
        field = chart_field(s, a, uu)

        # Newton by full steps until the two corrections of `settle` are enough.
        def unsettled(carry):
            tau, past, q1, f, first, rate, k = carry
            return (k < 8) & (jnp.abs(first) > enough).any()

        def newton(carry):
            tau, past, *_, k = carry
            tau = jnp.clip(tau + past, 0.0, h)
            return (
                tau,
                *settle(s, a, t + tau, rk_step(field, t, q, tau).q, uu, index, which, target),
                k + 1,
            )

        tau = jnp.where(here, jnp.where(here, attempt.s, 0.0) * h, 0.0)
        start = (tau, jnp.zeros(L), q, q, jnp.full(L, jnp.inf), jnp.zeros(L), 0)
        tau, past, q1, f, first, rate, _ = jax.lax.while_loop(unsettled, newton, start)
        tau = tau + past
        ok = (jnp.abs(first) <= enough) & (tau >= -enough) & (tau <= h + enough)
        t1 = t + tau

        fastest, enabled, together = jnp.abs(rate), ~no, no
        armed, aimed = lanes.armed, state.aimed
        f0 = field(t, q)
        for row, function in crossable(s, a, target):
            chosen = which == row
            _, rate0 = rate_of(function, t, q, uu, index, f0)
            value, rate1 = rate_of(function, t1, q1, uu, index, f)
            fastest = jnp.where(chosen, jnp.maximum(fastest, jnp.abs(rate0)), fastest)
            clear = value > _CLEAR * h * (jnp.abs(rate0) + jnp.abs(rate1))
            ready = ((aimed if row == G else armed[row]) | clear) & ~chosen
            if row == G:
                aimed = ready
                continue
            armed = armed.at[row].set(ready)
            can = by_lane(lambda t, q, u, g=row: s.enabled(g, t, q, u))(t1, q1, uu)
            enabled = jnp.where(chosen, can, enabled)
            near = jnp.abs(value) <= 1e-13 * span * jnp.abs(rate1)
            together = together | (ready & near & (rate1 < 0))
        return _Landing(
            jnp.where(here, tau, out.tau),
            out.q.at[:n].set(jnp.where(here, q1, out.q[:n])),
            jnp.where(here, ok, out.ok),
            jnp.where(here, jnp.abs(rate) < _SLOW * fastest, out.slow),
            jnp.where(here, enabled, out.enabled),
            jnp.where(here, together, out.together),
            jnp.where(here, armed, out.armed),
            jnp.where(here, aimed, out.aimed),
        )

    return jax.lax.cond(
        mask.any(), lambda: for_each_chart(s, lanes.chart, mask, work, empty), lambda: empty
    )


def apply_resets(s: Structure, lanes: Lanes, fired: Int[Array, " L"], u: Float[Array, "nu L"]):
    """States and charts after the transitions `fired` (-1: none)."""
    q, chart = lanes.q, lanes.chart
    for g, transition in enumerate(s.transitions):
        here = fired == g
        n = s.dims[s.chart_index(transition.source)]
        b = s.chart_index(transition.target)

        def work(carry, g=g, n=n, b=b, here=here):
            q, chart = carry
            arguments = only(here, lanes.t), only(here, lanes.q[:n]), only(here, u)
            new = by_lane(lambda t, q, u: s.reset(g, t, q, u))(*arguments)
            new = jnp.zeros_like(q).at[: s.dims[b]].set(new)
            return jnp.where(here, new, q), jnp.where(here, b, chart)

        q, chart = jax.lax.cond(here.any(), work, lambda carry: carry, (q, chart))
    return q, chart


def _reset(s, lanes: Lanes, aimed, fired, u, target, together):
    """The lanes after their events, and whether their target's level is positive there."""
    fires = fired >= 0

    def work():
        q, chart = apply_resets(s, lanes, fired, u)
        new = Lanes(lanes.t, chart, q, lanes.armed, lanes.events + fires, lanes.pace)
        new = rearm(s, new, fires, u, fired, together)
        return new, jnp.where(fires, _aim(s, new, u, target), aimed)

    return jax.lax.cond(fires.any(), work, lambda: (lanes, aimed))


def _pace(pace: Float[Array, "4 L"], moved, event: Bool[Array, " L"]):
    """Bookkeeping for Zeno: do the intervals between events shrink with a sum that converges?"""
    since, gap, streak, total = pace
    since = since + moved
    ratio = jnp.where(gap > 0, since / jnp.where(gap > 0, gap, 1.0), 0.0)
    shrinks = ratio < 0.999
    streak = jnp.where(event, jnp.where(shrinks, streak + 1, 0.0), streak)
    total = jnp.where(event, jnp.where(shrinks, total + since, 0.0), total)
    rest = since * ratio / (1 - jnp.minimum(ratio, 0.999))
    zeno = event & (streak >= _ZENO_STREAK) & (rest <= _ZENO_REST * total)
    pace = jnp.stack([jnp.where(event, 0.0, since), jnp.where(event, since, gap), streak, total])
    return pace, zeno


def _aim(s, lanes: Lanes, u, target: Target) -> Bool[Array, " L"]:
    """Whether the target's level is clearly positive, so that its next fall counts."""
    everywhere = jnp.ones(lanes.t.shape[0], bool)
    if target.levels is None:
        return ~everywhere
    G = len(s.transitions)
    span = target.limit - lanes.t

    def work(a, here, out):
        for row, function in crossable(s, a, target):
            if row == G:
                arguments = only(here, lanes.t), only(here, lanes.q[: s.dims[a]]), only(here, u)
                f = chart_field(s, a, arguments[2])(*arguments[:2])
                value, rate = rate_of(function, *arguments, only(here, target.index), f)
                out = jnp.where(here, value > 1e-10 * span * jnp.abs(rate), out)
        return out

    return for_each_chart(s, lanes.chart, everywhere, work, ~everywhere)


def initial_step(s: Structure, lanes: Lanes, u, span: Float[Array, " L"], rtol: float):
    """A cautious first step: a small fraction of the time in which the state changes by its size."""

    def work(a, here, out):
        n = s.dims[a]
        q = only(here, lanes.q[:n])
        f = chart_field(s, a, only(here, u))(only(here, lanes.t), q)
        ratio = jnp.linalg.norm(q, axis=0) / jnp.linalg.norm(f, axis=0)
        ratio = jnp.where(jnp.isfinite(ratio) & (ratio > 0), ratio, jnp.inf)
        h = jnp.minimum(0.1 * ratio * rtol ** (1 / 6) / 0.01 ** (1 / 6), 0.01 * span)
        return jnp.where(here, h, out)

    everywhere = jnp.ones(lanes.t.shape[0], bool)
    return for_each_chart(s, lanes.chart, everywhere, work, 0.01 * span)
