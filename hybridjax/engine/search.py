"""Adaptive flow of many lanes to their targets, through any number of events.

This is the part that decides: step sizes, which event comes first, when to give up. It is not
differentiated; what it decides is written down as a `Tape`, which `replay` follows.

In each iteration every lane takes a step of its own. As long as no watched function comes near to
a zero in any lane, little has to be kept (`_calmly`); the rest is done only where it is needed.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core.per_lane import shared
from .._core.precision import at_precision
from .._core.results import Result, update_result
from ..systems.structure import Structure
from .aim import Aim, Approach, State, Way, take_aim
from .attempt import SLOW, Attempt, attempt
from .events import apply_resets, arm, enabled, keep_pace, rearm, width
from .hermite import CubicCrossing, first_crossing
from .lanes import Lanes
from .settings import Settings
from .stride import Stride
from .tape import ARRIVE_LEVEL, ARRIVE_TIME, IDLE, MOVE, Tape, blank_tape, write_row
from .target import Target
from .watch import Watch, pick, watch


# Steps below this fraction of the time allowed (in double and in single precision) are not taken.
_TINY = 1e-13, 1e-6
# Attempts to land on a crossing before the step in which it was seen is halved.
_TRIES = 8


class Moved(NamedTuple):
    """Lanes at the end of a piece of flow."""

    lanes: Lanes
    h: Float[Array, " L"]
    """Step size to go on with."""
    error: Float[Array, " L"]
    """Sum of the steps' error estimates, relative to the tolerance."""
    result: Int[Array, " L"]
    """`Result` codes. A lane that failed stands where it failed."""


def search(
    s: Structure,
    lanes: Lanes,
    u: Float[Array, "nu L"],
    target: Target,
    *,
    stride: Stride,
    result: Int[Array, " L"],
    settings: Settings,
    tape: bool,
    glide: bool,
    new_input: bool,
    tangents: Bool[Array, ""] | bool,
) -> tuple[Moved, Tape | None]:
    """Flow every lane to its target, or to a result code that says why not.

    Lanes whose `result` is not OK at the start stay where they are. With `glide`, one step of all
    lanes is tried first: if it brings all of them home, nothing else is done. With `new_input`,
    guards are armed for the input u, which may have jumped. With `tangents`, steps are also short
    enough for the derivatives of a replay.
    """
    L = lanes.t.shape[0]
    finite = jnp.isfinite(lanes.t) & jnp.isfinite(lanes.q).all(axis=0) & jnp.isfinite(u).all(axis=0)
    result = update_result(result, ~finite, Result.BAD_INPUT)
    span = target.limit - lanes.t
    seen = watch(s, lanes.t, lanes.chart, lanes.q, u, target, result == Result.OK)
    none = jnp.zeros(L, jnp.int32)
    state = State(
        arm(s, lanes, seen, span) if new_input else lanes,
        seen,
        _aims(seen, span),
        Approach(jnp.zeros(L, bool), none, *jnp.zeros((3, L)), none),
        stride.h,
        jnp.zeros(L),
        result,
        jnp.zeros(L, bool),
        jnp.zeros((), jnp.int32),
    )
    blank = blank_tape(settings.max_steps, lanes) if tape else None

    def active(state):
        return ~state.arrived & (state.result == Result.OK)

    def attempted(state, unroll=False, in_step=False):
        """Aims, ways, and an attempt in all active lanes, and which of them it leaves calm."""
        aim, way = take_aim(s, state, active(state), target, stride)
        ready = jnp.concatenate([state.lanes.armed, state.aimed[None]])
        here, where = (state.lanes, state.seen, ready, active(state)), (u, target)
        new = attempt(s, *here, aim, *where, settings, span, unroll, in_step, tangents)
        calm = new.calm & (new.error <= stride.slack) & ~state.approach.on & (way.schedule < 0)
        calm = calm & ~(new.lands & (aim.which < len(s.transitions)))
        return calm, aim, way, new

    def going(carry):
        state, _ = carry
        return (state.i < settings.max_steps) & active(state).any()

    def body(carry):
        state, tape = carry
        calm, *made = attempted(state)
        state, row = jax.lax.cond(
            (calm | ~active(state)).all(),
            lambda: _calmly(state, active(state), *made, target, stride),
            lambda: _eventfully(s, state, active(state), *made, u, target, stride, span),
        )
        return state, None if tape is None else write_row(tape, state.i - 1, row)

    def all_the_way():
        end, tape = jax.lax.while_loop(going, body, (state, blank))
        result = update_result(end.result, active(end), Result.STEP_LIMIT)
        return Moved(end.lanes, end.h, end.error, result), tape

    def in_one_step():
        end, row = _calmly(state, active(state), aim, way, new, target, stride)
        tape = None if blank is None else write_row(blank, state.i, row)
        return Moved(end.lanes, end.h, end.error, end.result), tape

    if not glide:
        return all_the_way()
    levels = shared(target.levels)
    clock = levels is None or not any(levels.present(s, a) for a in range(len(s.charts)))
    calm, aim, way, new = attempted(state, unroll=True, in_step=clock)
    home = calm & (new.lands | way.last)
    if clock:
        home = home & _alike(state.lanes.t, active(state)) & _alike(aim.step, active(state))
    return jax.lax.cond((home | ~active(state)).all(), in_one_step, all_the_way)


def _alike(x: Float[Array, " L"], mask: Bool[Array, " L"]) -> Bool[Array, " L"]:
    """Which lanes have the same number as the first lane of `mask`."""
    return x == x[jnp.argmax(mask)]


def _calmly(
    state: State, active, aim: Aim, way: Way, new: Attempt, target, stride
) -> tuple[State, Tape]:
    """Nothing happened to any lane, except perhaps that it arrived."""
    lanes = state.lanes
    level, on_time = active & new.lands, way.last
    moved = aim.step + jnp.where(level, new.past, 0.0)
    t = jnp.where(way.last, way.known, lanes.t + moved)
    arrived = level | on_time
    lanes = Lanes(t, lanes.chart, new.q, lanes.armed, lanes.events, lanes.pace.at[0].add(moved))
    h = jnp.where(active, _next_step(state.h, aim.step, new.error / stride.slack), state.h)
    late = active & ~arrived & (t >= target.limit)
    code = jnp.where(on_time, ARRIVE_TIME, jnp.where(level, ARRIVE_LEVEL, MOVE))
    code = jnp.where(active, code, IDLE).astype(jnp.int32)
    row = Tape(moved, code, t, new.q, new.q, lanes.chart)
    end = State(
        lanes,
        _merge(active, new.seen, state.seen),
        state.aimed,
        state.approach,
        h,
        state.error + jnp.where(active, new.error, 0.0),
        update_result(state.result, late, target.missed),
        state.arrived | arrived,
        state.i + 1,
    )
    return end, row


def _eventfully(
    s, state: State, active, aim: Aim, way: Way, new: Attempt, u, target, stride, span
) -> tuple[State, Tape]:
    """Find out what happened to each lane, and let it happen."""
    lanes, seen, end, approach = state.lanes, state.seen, new.seen, state.approach
    G = len(s.transitions)
    near = new.error <= stride.slack

    # 1. Which approaches succeed.
    tau = approach.tau + new.past
    enough = 1e-6 * approach.reach + at_precision(1e-13, 1e-6) * span
    inside = (tau >= -enough) & (tau <= approach.reach + enough)
    falling = _of(end.rate, aim.which) < 0
    lands = active & new.lands & falling & jnp.where(approach.on, inside, near)
    closer = active & approach.on & ~lands & (approach.tries < _TRIES)
    lost = active & approach.on & ~lands & ~closer
    moved = aim.step + jnp.where(new.lands, new.past, 0.0)
    t = jnp.where(way.last, way.known, jnp.where(active, lanes.t + moved, lanes.t))

    # 2. What was crossed on the way.
    ready = jnp.concatenate([lanes.armed, state.aimed[None]])
    fresh = active & ~approach.on & near
    crossing = _crossing(fresh | lands, seen, end, moved, ready)
    zero = width(t, span, end.rate)
    chosen = lands & (jnp.arange(G + 1)[:, None] == aim.which)
    old = lands & (jnp.abs(end.value) <= zero)
    s_first = jnp.where(chosen | old, jnp.inf, crossing.s)
    which = jnp.argmin(s_first, axis=0).astype(jnp.int32)
    first = jnp.min(s_first, axis=0)
    bent = fresh & new.bent
    crosses = ((fresh | lands) & jnp.isfinite(first)) & ~bent
    refine = bent | ((fresh | lands) & ~crosses & (crossing.near & ~chosen).any(axis=0))
    touch = fresh & ~crosses & (crossing.touch & ~chosen).any(axis=0)
    lands = lands & ~crosses & ~refine
    chosen = chosen & lands
    plain = fresh & ~crosses & ~refine & ~lands
    accept = plain | lands

    # 3. What happens there.
    clear = end.value > zero
    ready = jnp.where(accept, ((ready & ((end.value > 0) | lands)) | clear) & ~chosen, ready)
    guard = lands & (aim.which < G)
    fires = guard & enabled(s, t, new.q, u, aim.which)
    by_clock = plain & (way.schedule >= 0)
    fired = jnp.where(fires, aim.which, jnp.where(by_clock, way.schedule, -1))
    level = lands & (aim.which == G)
    on_time = plain & way.last & ~by_clock
    arrived = on_time | level | ((fired >= 0) & (fired == target.event))
    speed = jnp.abs(_of(end.rate, aim.which))
    slow = lands & (new.slow | (approach.on & (speed < SLOW * approach.rate)))
    pace, zeno = keep_pace(lanes.pace, jnp.where(accept, moved, 0.0), fired >= 0, slow)
    expected = _expected(target.order, lanes.events, fired)
    falls = (jnp.abs(end.value) <= zero) & (end.rate < 0)
    together = (ready & falls)[:-1].any(axis=0)
    after = Lanes(
        jnp.where(accept, t, lanes.t),
        lanes.chart,
        jnp.where(accept, new.q, lanes.q),
        ready[:-1],
        lanes.events + (fired >= 0),
        pace,
    )
    seen = _merge(accept, end, seen)
    after, seen, aimed = _reset(s, after, seen, ready[-1], fired, u, target, together, span)

    # 4. The next step, and reasons to stop.
    fastest = jnp.maximum(jnp.abs(_of(state.seen.rate, which)), jnp.abs(_of(end.rate, which)))
    approach = Approach(
        crosses | closer,
        jnp.where(crosses, which, approach.which),
        jnp.where(crosses, first * moved, jnp.clip(tau, 0.0, approach.reach)),
        jnp.where(crosses, moved, approach.reach),
        jnp.where(crosses, fastest, approach.rate),
        jnp.where(crosses, 0, approach.tries + 1),
    )
    adapted = _next_step(state.h, aim.step, new.error / stride.slack)
    too_long = active & ~state.approach.on & ~near
    h = jnp.where(plain | too_long, adapted, state.h)
    h = jnp.where(fired >= 0, jnp.maximum(h, stride.h), h)
    h = jnp.where(refine, 0.5 * aim.step, jnp.where(lost, 0.5 * aim.reach, h))
    stuck = (too_long | refine | lost) & (h < at_precision(*_TINY) * span)
    graze = touch | (slow & ~zeno) | (stuck & (refine | lost))
    result = update_result(state.result, graze, Result.GRAZING)
    result = update_result(result, stuck, Result.BLOW_UP)
    result = update_result(result, zeno, Result.ZENO)
    result = update_result(result, (fired >= 0) & ~expected, Result.EVENT_ORDER)
    result = update_result(result, active & ~arrived & (after.t >= target.limit), target.missed)

    code = jnp.where(accept, MOVE, IDLE)
    code = jnp.where(on_time, ARRIVE_TIME, code)
    code = jnp.where(level, ARRIVE_LEVEL, jnp.where(fired >= 0, fired, code))
    row = Tape(moved, code.astype(jnp.int32), t, new.q, after.q, after.chart)
    error = state.error + jnp.where(accept, new.error, 0.0)
    arrived = state.arrived | arrived
    return State(after, seen, aimed, approach, h, error, result, arrived, state.i + 1), row


def _crossing(some, seen: Watch, end: Watch, moved, ready) -> CubicCrossing:
    """What was crossed on the way. (In a branch, so that it is not computed anew by every user.)"""

    def look():
        return first_crossing(seen.value, end.value, moved * seen.rate, moved * end.rate, ready)

    def nothing():
        no = jnp.zeros_like(ready)
        return CubicCrossing(jnp.full_like(end.value, jnp.inf), no, no)

    return jax.lax.cond(some.any(), look, nothing)


def _next_step(h, step, error):
    """The step after one of length `step` with this error, where h was allowed.

    The estimate is of order 7; three square roots are cheaper than that power, and nearly it.
    """
    factor = jnp.clip(0.9 / jnp.sqrt(jnp.sqrt(jnp.sqrt(error))), 0.2, 3.0)
    factor = jnp.where(jnp.isfinite(error), factor, 0.1)
    return jnp.where((step < h) & (error <= 1), jnp.maximum(h, step * factor), step * factor)


def _reset(s, lanes: Lanes, seen, aimed, fired, u, target, together, span):
    """The lanes after their events, what they see there, and whether they aim at their target."""
    fires = fired >= 0

    def work():
        q, chart = apply_resets(s, lanes.t, lanes.chart, lanes.q, u, fired)
        new = eqx.tree_at(lambda x: (x.q, x.chart), lanes, (q, chart))
        after = watch(s, new.t, chart, q, u, target, fires)
        residue = jnp.abs(_of(seen.value, fired))
        new = rearm(s, new, after, fired, together, span, u, residue)
        return new, _merge(fires, after, seen), jnp.where(fires, _aims(after, span), aimed)

    return jax.lax.cond(fires.any(), work, lambda: (lanes, seen, aimed))


def _aims(seen: Watch, span):
    """Whether the target's level is clearly positive, so that its next fall counts."""
    return seen.value[-1] > at_precision(1e-10, 1e-6) * span * jnp.abs(seen.rate[-1])


def _merge(mask, new: Watch, old: Watch) -> Watch:
    return Watch(jnp.where(mask, new.value, old.value), jnp.where(mask, new.rate, old.rate))


def _of(x: Float[Array, "W L"], which: Int[Array, " L"]) -> Float[Array, " L"]:
    """Each lane's entry in the row `which`; 0 for -1."""
    return pick(x, range(len(x)), which)


def _expected(order, events, fired):
    """Whether the next event of each lane is the one that the limit cycle has."""
    if order is None:
        return jnp.ones(fired.shape, bool)
    if not order:
        return jnp.zeros(fired.shape, bool)
    return jnp.array(order)[events % len(order)] == fired
