"""Adaptive flow of many lanes to their targets, through any number of events.

This is the part that decides: step sizes, which event comes first, when to give up. It is not
differentiated; what it decides is written down as a `Tape`, which `replay` follows.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

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
    seen: Watch
    """The watched functions where the lanes are."""
    aimed: Array
    """Whether the target's level would end the flow at its next falling zero."""
    h: Array
    result: Array
    arrived: Array
    i: Array
    tape: Tape | None


class _Attempt(NamedTuple):
    """A step of every lane, before it is accepted."""

    q: Array
    f1: Array
    error: Array


class _Landing(NamedTuple):
    """Lanes on the zero of the function that they cross."""

    tau: Array
    q: Array
    ok: Array


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
    L = lanes.t.shape[0]
    finite = jnp.isfinite(lanes.t) & jnp.isfinite(lanes.q).all(axis=0) & jnp.isfinite(u).all(axis=0)
    result = update_result(result, ~finite, Result.BAD_INPUT)
    span = target.limit - lanes.t
    seen = watch(s, lanes.t, lanes.chart, lanes.q, u, target, result == Result.OK)
    state = _State(
        lanes,
        seen,
        _aims(seen, span),
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
    G = len(s.transitions)

    # 1. Known times: the step is cut so that it ends on them exactly, in equal pieces.
    scheduled, schedule = next_schedule(s, lanes.t, lanes.chart)
    known = jnp.minimum(target.time, scheduled)
    rest = jnp.maximum(known - lanes.t, 0.0)
    pieces = jnp.ceil(jnp.where(jnp.isfinite(rest), rest / h, 2.0) - 1e-9)
    last = pieces <= 1
    step = jnp.where(jnp.isfinite(rest), rest / jnp.maximum(pieces, 1.0), h)
    step = jnp.where(active, step, 0.0)

    # 2. A step of every lane, and what it crosses first.
    attempt = _attempt(s, lanes, active, u, step, rtol, atol)
    end = watch(s, lanes.t + step, lanes.chart, attempt.q, u, target, active, attempt.f1)
    ready = jnp.concatenate([lanes.armed, state.aimed[None]])
    crossing = first_crossing(seen.value, end.value, step * seen.rate, step * end.rate, ready)
    which = jnp.argmin(crossing.s, axis=0).astype(jnp.int32)
    first = jnp.min(crossing.s, axis=0)
    crosses = jnp.isfinite(first)
    refine = crossing.near.any(axis=0) & ~crosses
    accept = active & (attempt.error <= 1.0) & ~refine

    # 3. Lanes that cross something land on it.
    landing = _land(s, lanes, accept & crosses, u, target, step, span, first, which)
    lands = accept & crosses & landing.ok
    lost = accept & crosses & ~landing.ok
    accept = accept & ~lost
    plain = accept & ~crosses
    moved = jnp.where(lands, landing.tau, step)
    t = jnp.where(plain & last, known, jnp.where(accept, lanes.t + moved, lanes.t))
    q = jnp.where(plain, attempt.q, jnp.where(lands, landing.q, lanes.q))

    # 4. What is there: the watched functions, and whether they count from now on.
    here = jax.lax.cond(
        lands.any(),
        lambda: _merge(lands, watch(s, t, lanes.chart, q, u, target, lands), end),
        lambda: end,
    )
    clear = here.value > ZERO * step * (jnp.abs(seen.rate) + jnp.abs(end.rate))
    chosen = lands & (jnp.arange(G + 1)[:, None] == which)
    ready = ((ready & (here.value > 0)) | (ready & lands) | clear) & ~chosen
    fired = jnp.where(lands & (which < G) & enabled(s, t, q, u, which), which, -1)
    by_clock = plain & last & (scheduled <= target.time)
    fired = jnp.where(by_clock, schedule, fired)
    level = lands & (which == G)
    arrived = (plain & last & ~by_clock) | level | ((fired >= 0) & (fired == target.event))

    slow = _slow(lands, which, here, seen, end)

    # 5. Events.
    pace, zeno = keep_pace(lanes.pace, jnp.where(accept, moved, 0.0), fired >= 0)
    expected = _expected(target.order, lanes.events, fired)
    near = jnp.abs(here.value[:-1]) <= ZERO * span * jnp.abs(here.rate[:-1])
    together = (ready[:-1] & near & (here.rate[:-1] < 0)).any(axis=0)
    new = Lanes(
        t,
        lanes.chart,
        q,
        jnp.where(accept, ready[:-1], lanes.armed),
        lanes.events + (fired >= 0),
        pace,
    )
    aimed = jnp.where(accept, ready[-1], state.aimed)
    new, here, aimed = _reset(s, new, here, aimed, fired, u, target, together, span)
    seen = _merge(accept, here, seen)

    # 6. Step size, and reasons to stop.
    bad = ~jnp.isfinite(attempt.error)
    factor = jnp.where(bad, 0.1, jnp.clip(0.9 * attempt.error ** (-1 / 7), 0.2, 5.0))
    grown = jnp.where(step < h, jnp.maximum(h, step * factor), step * factor)
    again = active & ~accept
    h = jnp.where(plain, grown, h)
    h = jnp.where(again, step * jnp.where(lost | refine, 0.5, factor), h)
    stuck = again & (h < _TINY * span)
    touch = accept & crossing.touch.any(axis=0)
    graze = touch | slow | (stuck & (refine | lost))
    result = update_result(result, graze, Result.GRAZING)
    result = update_result(result, stuck, Result.BLOW_UP)
    result = update_result(result, zeno, Result.ZENO)
    result = update_result(result, (fired >= 0) & ~expected, Result.EVENT_ORDER)
    result = update_result(result, active & ~arrived & (new.t >= target.limit), target.missed)

    tape = state.tape
    if tape is not None:
        code = jnp.where(accept, MOVE, IDLE)
        code = jnp.where(plain & last & ~by_clock, ARRIVE_TIME, code)
        code = jnp.where(level, ARRIVE_LEVEL, jnp.where(fired >= 0, fired, code))
        row = (moved, code.astype(jnp.int32), t, q, new.q, new.chart)
        tape = Tape(*(x.at[state.i].set(y) for x, y in zip(tape, row, strict=True)))
    return _State(new, seen, aimed, h, result, state.arrived | arrived, state.i + 1, tape)


def _attempt(s, lanes, active, u, h, rtol, atol) -> _Attempt:
    empty = _Attempt(lanes.q, jnp.zeros_like(lanes.q), jnp.zeros_like(h))

    def work(a, here, out):
        n = s.dims[a]
        t, q, uu = only(here, lanes.t), only(here, lanes.q[:n]), only(here, u)
        step = rk_step(chart_field(s, a, uu), t, q, jnp.where(here, h, 0.0))
        size = jnp.maximum(jnp.abs(q), jnp.abs(step.q))
        error = jnp.max(jnp.abs(step.error) / (atol + rtol * size), axis=0, initial=0.0)
        finite = jnp.isfinite(step.q).all(axis=0) & ~jnp.isnan(error)
        error = jnp.where(finite, error, jnp.inf)

        def put(x, y):
            return x.at[:n].set(jnp.where(here, y, x[:n]))

        return _Attempt(
            put(out.q, step.q),
            put(out.f1, step.f1),
            jnp.where(here, error, out.error),
        )

    return for_each_chart(s, lanes.chart, active, work, empty)


def _land(s, lanes, mask, u, target, h, span, first, which) -> _Landing:
    L = lanes.t.shape[0]
    empty = _Landing(jnp.zeros(L), lanes.q, jnp.zeros(L, bool))
    # Below this correction `settle` is exact to rounding.
    enough = 1e-6 * h + 1e-13 * span

    def work(a, here, out):
        if not watched(s, a, target):
            return out
        n = s.dims[a]
        t, q, uu = only(here, lanes.t), only(here, lanes.q[:n]), only(here, u)
        index = only(here, target.index)
        chosen = jnp.where(here, which, -1)
        field = chart_field(s, a, uu)

        # Newton by full steps until the two corrections of `settle` are enough.
        def unsettled(carry):
            _, settled, k = carry
            return (k < 8) & (jnp.abs(settled.first) > enough).any()

        def newton(carry):
            tau, settled, k = carry
            tau = jnp.clip(tau + settled.past, 0.0, h)
            end = rk_step(field, t, q, tau).q
            return tau, settle(s, a, target, t + tau, end, uu, index, chosen), k + 1

        tau = jnp.where(here, first, 0.0) * h
        start = Settled(jnp.zeros(L), q, jnp.full(L, jnp.inf))
        tau, settled, _ = jax.lax.while_loop(unsettled, newton, (tau, start, 0))
        tau = tau + settled.past
        ok = (jnp.abs(settled.first) <= enough) & (tau >= -enough) & (tau <= h + enough)
        return _Landing(
            jnp.where(here, tau, out.tau),
            out.q.at[:n].set(jnp.where(here, settled.q, out.q[:n])),
            jnp.where(here, ok, out.ok),
        )

    return for_each_chart(s, lanes.chart, mask, work, empty)


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


def _slow(lands, which, here: Watch, start: Watch, end: Watch):
    """Whether lanes land at a small fraction of the rates at the step's ends."""

    def pick(rate):
        return jnp.abs(jnp.take_along_axis(rate, which[None], axis=0)[0])

    return lands & (pick(here.rate) < _SLOW * jnp.maximum(pick(start.rate), pick(end.rate)))


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


def initial_step(s: Structure, lanes: Lanes, u, span: Float[Array, " L"], rtol: float):
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
