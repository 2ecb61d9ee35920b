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
from .events import ZERO, apply_resets, enabled, keep_pace, next_schedule, rearm
from .hermite import first_crossing
from .lanes import Lanes, for_each_chart, only
from .step import rk_step
from .target import Target
from .watch import Settled, Watch, chart_field, settle, watch, watched


# Codes on a tape. Codes >= 0 name the transition that fires at the end of a move.
IDLE, MOVE, ARRIVE_TIME, ARRIVE_LEVEL = -4, -3, -2, -1

# A crossing slower than this fraction of the function's rate elsewhere in the step is a grazing.
_SLOW = 1e-5
# A step is too long for a watched function if halfway its cubic interpolant misses it by more than
# this fraction of its size.
_BEND = 2e-3
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


class _Approach(NamedTuple):
    """Lanes that have seen a crossing in a step and are about to land on it."""

    on: Bool[Array, " L"]
    which: Int[Array, " L"]
    """The watched function that crosses."""
    tau: Float[Array, " L"]
    """Where the crossing is thought to be, as a time from where the lane is."""
    reach: Float[Array, " L"]
    """Length of the step in which it was seen."""
    rate: Float[Array, " L"]
    """The largest rate of that function at the step's ends."""
    tries: Int[Array, " L"]


class _State(NamedTuple):
    lanes: Lanes
    seen: Watch
    """The watched functions where the lanes are."""
    aimed: Array
    """Whether the target's level would end the flow at its next falling zero."""
    approach: _Approach
    h: Array
    result: Array
    arrived: Array
    i: Array
    tape: Tape | None


class _Attempt(NamedTuple):
    """A step of every lane, before it is accepted."""

    q: Array
    middle: Array
    """The state halfway, by the cubic Hermite interpolant."""
    f: Array
    """The field at its end."""
    error: Array
    past: Array
    """Time from its end to the zero of the function that an approaching lane crosses."""
    first: Array
    """The first of the two corrections that `past` is made of."""


def search(
    s: Structure,
    lanes: Lanes,
    u: Float[Array, "nu L"],
    target: Target,
    *,
    h: Float[Array, " L"],
    result: Int[Array, " L"],
    rtol: Float[Array, ""],
    atol: Float[Array, ""],
    max_steps: int,
    tape: bool,
) -> Found:
    """Flow every lane to its target, or to a result code that says why not.

    Lanes whose `result` is not OK at the start stay where they are.
    """
    L = lanes.t.shape[0]
    finite = jnp.isfinite(lanes.t) & jnp.isfinite(lanes.q).all(axis=0) & jnp.isfinite(u).all(axis=0)
    result = update_result(result, ~finite, Result.BAD_INPUT)
    span = target.limit - lanes.t
    seen = watch(s, lanes.t, lanes.chart, lanes.q, u, target, result == Result.OK)
    state = _State(
        lanes,
        seen,
        _aims(seen, span),
        _no_approach(L),
        jnp.minimum(h, 1.05 * target.hint),
        result,
        jnp.zeros(L, bool),
        jnp.zeros((), jnp.int32),
        _blank_tape(max_steps, lanes) if tape else None,
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
    lanes, seen, h, result = state.lanes, state.seen, state.h, state.result
    approach = state.approach
    G = len(s.transitions)

    # 1. Known times: the step is cut so that it ends on them exactly, in equal pieces.
    scheduled, schedule = next_schedule(s, lanes.t, lanes.chart, target.time)
    known = jnp.minimum(target.time, scheduled)
    rest = jnp.maximum(known - lanes.t, 0.0)
    pieces = jnp.ceil(jnp.where(jnp.isfinite(rest), rest / h, 2.0) - 1e-9)
    last = pieces <= 1
    step = jnp.where(jnp.isfinite(rest), rest / jnp.maximum(pieces, 1.0), h)
    step = jnp.where(active, jnp.where(approach.on, approach.tau, step), 0.0)

    # 2. A step of every lane. Approaching lanes go to their crossing: Newton by full steps until
    # the two corrections of `settle` are exact to rounding.
    attempt = _attempt(s, lanes, active, approach, u, target, step, rtol, atol)
    enough = 1e-6 * approach.reach + 1e-13 * span
    tau = approach.tau + attempt.past
    inside = (tau >= -enough) & (tau <= approach.reach + enough)
    lands = active & approach.on & (jnp.abs(attempt.first) <= enough) & inside
    closer = active & approach.on & ~lands & (approach.tries < 8)
    lost = active & approach.on & ~lands & ~closer
    moved = jnp.where(lands, tau, step)

    # 3. What is at the end of the step, and what was crossed on the way.
    t = jnp.where(last & ~approach.on, jnp.where(active, known, lanes.t), lanes.t + moved)
    end = watch(s, t, lanes.chart, attempt.q, u, target, active, attempt.f)
    ready = jnp.concatenate([lanes.armed, state.aimed[None]])
    crossing = first_crossing(seen.value, end.value, step * seen.rate, step * end.rate, ready)
    zero = ZERO * span * jnp.abs(end.rate)
    chosen = lands & (jnp.arange(G + 1)[:, None] == approach.which)
    # Where a lane lands, another function may have fallen before: then that one comes first.
    s_first = jnp.where(chosen | (lands & (end.value >= -zero)), jnp.inf, crossing.s)
    which = jnp.argmin(s_first, axis=0).astype(jnp.int32)
    first = jnp.min(s_first, axis=0)
    overtaken = lands & jnp.isfinite(first)
    lands = lands & ~overtaken
    chosen = chosen & lands
    fresh = active & ~approach.on & (attempt.error <= 1.0)
    crosses = (fresh & jnp.isfinite(first)) | overtaken
    bent = fresh & _bends(s, lanes, seen, end, attempt, u, target, fresh, step)
    crosses = crosses & ~bent
    refine = bent | (fresh & ~crosses & crossing.near.any(axis=0))
    touch = fresh & ~crosses & crossing.touch.any(axis=0)
    plain = fresh & ~crosses & ~refine
    accept = plain | lands

    # 4. What happens there.
    clear = end.value > zero
    ready = jnp.where(accept, ((ready & ((end.value > 0) | lands)) | clear) & ~chosen, ready)
    guard = lands & (approach.which < G)
    fires = guard & enabled(s, t, attempt.q, u, approach.which)
    by_clock = plain & last & (scheduled <= target.time)
    fired = jnp.where(fires, approach.which, jnp.where(by_clock, schedule, -1))
    level = lands & (approach.which == G)
    on_time = plain & last & ~by_clock
    arrived = on_time | level | ((fired >= 0) & (fired == target.event))
    slow = lands & (jnp.abs(_row(end.rate, approach.which)) < _SLOW * approach.rate)

    pace, zeno = keep_pace(lanes.pace, jnp.where(accept, moved, 0.0), fired >= 0, slow)
    expected = _expected(target.order, lanes.events, fired)
    falls = (jnp.abs(end.value) <= zero) & (end.rate < 0)
    together = (ready & falls)[:-1].any(axis=0)
    new = Lanes(
        jnp.where(accept, t, lanes.t),
        lanes.chart,
        jnp.where(accept, attempt.q, lanes.q),
        ready[:-1],
        lanes.events + (fired >= 0),
        pace,
    )
    seen = _merge(accept, end, seen)
    new, seen, aimed = _reset(s, new, seen, ready[-1], fired, u, target, together, span)

    # 5. The next step, and reasons to stop.
    fastest = jnp.maximum(jnp.abs(_row(state.seen.rate, which)), jnp.abs(_row(end.rate, which)))
    approach = _Approach(
        crosses | closer,
        jnp.where(crosses, which, approach.which),
        jnp.where(crosses, first * step, jnp.clip(tau, 0.0, approach.reach)),
        jnp.where(crosses, step, approach.reach),
        jnp.where(crosses, fastest, approach.rate),
        jnp.where(crosses, 0, approach.tries + 1),
    )
    bad = ~jnp.isfinite(attempt.error)
    factor = jnp.where(bad, 0.1, jnp.clip(0.9 * attempt.error ** (-1 / 7), 0.2, 3.0))
    grown = jnp.where(step < h, jnp.maximum(h, step * factor), step * factor)
    too_long = active & ~state.approach.on & (attempt.error > 1.0)
    h = jnp.where(plain, grown, jnp.where(too_long, step * factor, h))
    h = jnp.where(refine, 0.5 * step, jnp.where(lost, 0.5 * state.approach.reach, h))
    stuck = (too_long | refine | lost) & (h < _TINY * span)
    graze = touch | (slow & ~zeno) | (stuck & (refine | lost))
    result = update_result(result, graze, Result.GRAZING)
    result = update_result(result, stuck, Result.BLOW_UP)
    result = update_result(result, zeno, Result.ZENO)
    result = update_result(result, (fired >= 0) & ~expected, Result.EVENT_ORDER)
    result = update_result(result, active & ~arrived & (new.t >= target.limit), target.missed)

    tape = state.tape
    if tape is not None:
        code = jnp.where(accept, MOVE, IDLE)
        code = jnp.where(on_time, ARRIVE_TIME, code)
        code = jnp.where(level, ARRIVE_LEVEL, jnp.where(fired >= 0, fired, code))
        row = (moved, code.astype(jnp.int32), t, attempt.q, new.q, new.chart)
        tape = Tape(*(x.at[state.i].set(y) for x, y in zip(tape, row, strict=True)))
    arrived = state.arrived | arrived
    return _State(new, seen, aimed, approach, h, result, arrived, state.i + 1, tape)


def _attempt(s, lanes, active, approach: _Approach, u, target, h, rtol, atol) -> _Attempt:
    zero = jnp.zeros_like(h)
    empty = _Attempt(lanes.q, lanes.q, jnp.zeros_like(lanes.q), zero, zero, zero)

    def work(a, here, out):
        n = s.dims[a]
        t, q, uu = only(here, lanes.t), only(here, lanes.q[:n]), only(here, u)
        tau = jnp.where(here, h, 0.0)
        step = rk_step(chart_field(s, a, uu), t, q, tau)
        size = jnp.maximum(jnp.abs(q), jnp.abs(step.q))
        error = jnp.max(jnp.abs(step.error) / (atol + rtol * size), axis=0, initial=0.0)
        finite = jnp.isfinite(step.q).all(axis=0) & ~jnp.isnan(error)
        error = jnp.where(finite, error, jnp.inf)
        middle = 0.5 * (q + step.q) + 0.125 * tau * (step.f0 - step.f1)
        end = Settled(zero, step.q, zero)
        if watched(s, a, target):
            which = jnp.where(here & approach.on, approach.which, -1)
            index = only(here, target.index)
            end = jax.lax.cond(
                (which >= 0).any(),
                lambda: settle(s, a, target, t + tau, step.q, uu, index, which),
                lambda: end,
            )
        return _Attempt(
            out.q.at[:n].set(jnp.where(here, end.q, out.q[:n])),
            out.middle.at[:n].set(jnp.where(here, middle, out.middle[:n])),
            out.f.at[:n].set(jnp.where(here, step.f1, out.f[:n])),
            jnp.where(here, error, out.error),
            jnp.where(here, end.past, out.past),
            jnp.where(here, end.first, out.first),
        )

    return for_each_chart(s, lanes.chart, active, work, empty)


def _no_approach(L: int) -> _Approach:
    none = jnp.zeros(L, jnp.int32)
    zero = jnp.zeros(L)
    return _Approach(jnp.zeros(L, bool), none, zero, zero, zero, none)


def _bends(s, lanes, seen: Watch, end: Watch, attempt, u, target, mask, step):
    """Whether some watched function is not resolved by its cubic interpolant over the step.

    Step control looks at the states only; where those are simple, a guard may still turn many
    times within a step.
    """
    t = lanes.t + 0.5 * step
    true = watch(s, t, lanes.chart, attempt.middle, u, target, mask, attempt.f).value
    cubic = 0.5 * (seen.value + end.value) + 0.125 * step * (seen.rate - end.rate)
    size = jnp.abs(seen.value) + jnp.abs(end.value) + jnp.abs(true)
    return (jnp.abs(true - cubic) > _BEND * size).any(axis=0)


def _reset(s, lanes: Lanes, seen, aimed, fired, u, target, together, span):
    """The lanes after their events, what they see there, and whether they aim at their target."""
    fires = fired >= 0

    def work():
        q, chart = apply_resets(s, lanes.t, lanes.chart, lanes.q, u, fired)
        new = eqx.tree_at(lambda x: (x.q, x.chart), lanes, (q, chart))
        after = watch(s, new.t, chart, q, u, target, fires)
        new = rearm(s, new, after, fired, together, span)
        return new, _merge(fires, after, seen), jnp.where(fires, _aims(after, span), aimed)

    return jax.lax.cond(fires.any(), work, lambda: (lanes, seen, aimed))


def _aims(seen: Watch, span):
    """Whether the target's level is clearly positive, so that its next fall counts."""
    return seen.value[-1] > 1e-10 * span * jnp.abs(seen.rate[-1])


def _merge(mask, new: Watch, old: Watch) -> Watch:
    return Watch(jnp.where(mask, new.value, old.value), jnp.where(mask, new.rate, old.rate))


def _row(x: Float[Array, "W L"], which: Int[Array, " L"]) -> Float[Array, " L"]:
    return jnp.take_along_axis(x, which[None], axis=0)[0]


def _expected(order, events, fired):
    """Whether the next event of each lane is the one that the limit cycle has."""
    if order is None:
        return jnp.ones(fired.shape, bool)
    if order.shape[0] == 0:
        return jnp.zeros(fired.shape, bool)
    return order[events % order.shape[0]] == fired


def _blank_tape(rows: int, lanes: Lanes) -> Tape:
    d, L = lanes.q.shape
    return Tape(
        jnp.zeros((rows, L)),
        jnp.full((rows, L), IDLE, jnp.int32),
        jnp.zeros((rows, L)),
        jnp.zeros((rows, d, L)),
        jnp.zeros((rows, d, L)),
        jnp.zeros((rows, L), jnp.int32),
    )


def initial_step(s: Structure, lanes: Lanes, u, span: Float[Array, " L"], rtol):
    """A cautious first step: a fraction of the time in which the state changes by its size."""

    def work(a, here, out):
        q = only(here, lanes.q[: s.dims[a]])
        f = chart_field(s, a, only(here, u))(only(here, lanes.t), q)
        ratio = jnp.linalg.norm(q, axis=0) / jnp.linalg.norm(f, axis=0)
        ratio = jnp.where(jnp.isfinite(ratio) & (ratio > 0), ratio, jnp.inf)
        h = jnp.minimum(0.1 * ratio * (100 * rtol) ** (1 / 7), 0.01 * span)
        return jnp.where(here, h, out)

    everywhere = jnp.ones(lanes.t.shape[0], bool)
    return for_each_chart(s, lanes.chart, everywhere, work, 0.01 * span)
