"""Differentiable flow: the moves on a tape, integrated again.

The decisions of a search (step sizes, the order of events) are fixed here; only smooth arithmetic
is left, so that this function has exact derivatives in forward and reverse mode. The times of
crossings follow from two Newton steps on the true guard, which is the saltation formula.
"""

import dataclasses
import functools as ft

import jax
import jax.numpy as jnp

from ..systems.structure import Structure
from ..systems.transition import Scheduled
from .arrays import Index, Inputs, Mask, Padded, Times
from .events import apply_resets, scheduled_time
from .lanes import Lanes, constant, for_each_chart, needed, only
from .runge_kutta import Step, take_step
from .tape import ARRIVE_LEVEL, ARRIVE_TIME, IDLE, Tape
from .target import Target
from .watch import ChartFlow


# Rows of a tape that are skipped, or computed again by reverse mode, together. Higher: empty rows
# are computed. Lower: reverse mode stores more states.
_BLOCK = 16


def replay(
    s: Structure, lanes: Lanes, u: Inputs, target: Target, tape: Tape, unroll: bool = False
) -> tuple[Times, Padded]:
    """Times and states at the end of a recorded piece of flow, differentiable."""
    h, code = tape.h, tape.code
    scheduled = jnp.array([isinstance(tr.guard, Scheduled) for tr in s.transitions] + [False])

    def row(carry, row):
        h, code = row

        def move(carry):
            t, q, chart = carry
            by_clock = (code >= 0) & scheduled[code]
            due = scheduled_time(s, code, t + h)
            h1 = jnp.where(code == ARRIVE_TIME, target.time - t, jnp.where(by_clock, due - t, h))
            which = jnp.where(code == ARRIVE_LEVEL, len(s.transitions), code)
            which = jnp.where(by_clock, -1, which)
            begin = lanes._replace(t=t, q=q, chart=chart)
            moving = code != IDLE
            t, q = _advance(s, begin, moving, u, target, h1, which, unroll)
            q, chart = apply_resets(s, t, chart, q, u, jnp.maximum(code, -1))
            return t, q, chart

        return jax.lax.cond((code != IDLE).any(), move, lambda carry: carry, carry), None

    @ft.partial(jax.checkpoint, prevent_cse=False)
    def block(carry, rows):
        follow = lambda carry: jax.lax.scan(row, carry, rows)[0]  # noqa: E731
        return jax.lax.cond((rows[1] != IDLE).any(), follow, lambda carry: carry, carry), None

    # Most tapes are empty but for their beginning: empty blocks of rows are skipped, and reverse
    # mode keeps no more of a block than where it starts.
    rows, L = h.shape
    fill = ((0, -rows % _BLOCK), (0, 0))
    h = jnp.pad(h, fill).reshape(-1, _BLOCK, L)
    code = jnp.pad(code, fill, constant_values=IDLE).reshape(-1, _BLOCK, L)
    (t, q, _), _ = jax.lax.scan(block, (lanes.t, lanes.q, lanes.chart), (h, code))
    return t, q


def _advance(
    s: Structure,
    lanes: Lanes,
    moving: Mask,
    u: Inputs,
    target: Target,
    h: Times,
    which: Index,
    unroll: bool,
) -> tuple[Times, Padded]:
    """A step of every lane that moves, ended on the zero of its crossing function, if any."""
    t, q, chart = lanes.t, lanes.q, lanes.chart

    def work(a, here, out):
        t_out, q_out = out
        n = s.dims[a]
        system, levels = needed(here, (s, target.levels))
        goal = dataclasses.replace(target, levels=levels, index=only(here, target.index))
        t0, q0, u0, h0 = needed(here, [only(here, x) for x in (t, q[:n], u, h)])
        flow = ChartFlow(system, a, u0, goal)
        still = ChartFlow(constant(system), a, constant(u0), goal)
        crossing = jnp.where(here, which, -1)
        # (A branch of its own, lest XLA masks the states again in every stage.)
        step = jax.lax.cond(
            here.any(),
            lambda: take_step(flow.method, flow.field, t0, q0, h0, unroll, still.field),
            lambda: Step(q0, q0, q0, q0),
        )
        q1, t1 = step.q, t0 + h0

        def land():
            zero = flow.locate(t1, q1, step.f1, crossing)
            return t1 + zero.past, zero.q

        if flow.rows:
            t1, q1 = jax.lax.cond((crossing >= 0).any(), land, lambda: (t1, q1))
        return jnp.where(here, t1, t_out), q_out.at[:n].set(jnp.where(here, q1, q_out[:n]))

    return for_each_chart(s, chart, moving, work, (t, q))
