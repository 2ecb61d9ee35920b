"""Differentiable flow: the moves on a tape, repeated.

What a search decided (step sizes, the order of events) is fixed here; only smooth arithmetic is
left, so that this function has exact derivatives in forward and reverse mode. The times of
crossings follow from two Newton steps on the true guard, which is the saltation formula.
"""

import dataclasses
import functools as ft

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..systems.structure import Structure
from ..systems.transition import Scheduled
from .events import apply_resets, scheduled_time
from .lanes import Lanes, constant, for_each_chart, needed, only
from .solver import take_step
from .solver.step import Step
from .tape import ARRIVE_LEVEL, ARRIVE_TIME, IDLE
from .target import Target
from .watch import ChartFlow


# Rows of a tape that are skipped, or computed again by reverse mode, together. Twice as many: half
# the states that reverse mode keeps, and up to 15 empty rows that are looked at.
_BLOCK = 16


def replay(
    s: Structure,
    lanes: Lanes,
    u: Float[Array, "nu L"],
    target: Target,
    h: Float[Array, "R L"],
    code: Int[Array, "R L"],
    unroll: bool = False,
) -> tuple[Float[Array, " L"], Float[Array, "d L"]]:
    """Times and states at the end of the moves `h` with outcomes `code` (see `Tape`)."""
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
            t, q = _advance(s, t, q, chart, code != IDLE, u, target, h1, which, unroll)
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
    t: Float[Array, " L"],
    q: Float[Array, "d L"],
    chart: Int[Array, " L"],
    moves: Bool[Array, " L"],
    u: Float[Array, "nu L"],
    target: Target,
    h: Float[Array, " L"],
    which: Int[Array, " L"],
    unroll: bool,
) -> tuple[Float[Array, " L"], Float[Array, "d L"]]:
    """A step of every lane that moves, ended on the zero of its crossing function, if any."""

    def work(a, here, out):
        t_out, q_out = out
        n = s.dims[a]
        own, levels = needed(here, (s.source, target.levels))
        goal = dataclasses.replace(target, levels=levels, index=only(here, target.index))
        t0, q0, u0, h0 = needed(here, [only(here, x) for x in (t, q[:n], u, h)])
        flow = ChartFlow(Structure(own), a, u0, goal)
        still = ChartFlow(Structure(constant(own)), a, constant(u0), goal)
        crossing = jnp.where(here, which, -1)
        # (A branch of its own, lest XLA masks the states again in every stage.)
        step = jax.lax.cond(
            here.any(),
            lambda: take_step(flow.method, flow.field, t0, q0, h0, unroll, still.field),
            lambda: Step(q0, q0, q0, q0),
        )
        q1, t1 = step.q, t0 + h0

        def land():
            settled = flow.settle(t1, q1, step.f1, crossing)
            return t1 + settled.past, settled.q

        if flow.rows:
            t1, q1 = jax.lax.cond((crossing >= 0).any(), land, lambda: (t1, q1))
        return jnp.where(here, t1, t_out), q_out.at[:n].set(jnp.where(here, q1, q_out[:n]))

    return for_each_chart(s, chart, moves, work, (t, q))
