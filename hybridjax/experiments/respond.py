"""The response of a hybrid system around its limit cycle to inputs: many experiments, compiled."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._core.results import Result, update_result
from ..engine.move import move
from ..engine.settings import Settings
from ..maps.outputs import observe
from ..maps.placed import PlacedSections
from ..systems.output import Output
from ..systems.structure import Structure
from .plan import Plan


# Error that rounding alone may leave, relative to the states' scales.
ROUNDING = 1e-13


class Response(NamedTuple):
    """What becomes of S experiments of n samples."""

    y: Float[Array, "S n ny"]
    """Outputs at the sections, before the new input acts; NaN after a failure."""
    result: Int[Array, " S"]
    failed_at: Int[Array, " S"]
    """The sample at which an experiment failed, or -1."""
    error: Float[Array, " S"]
    """Estimate of the largest error of (t, q) at any section, relative to the states' scales."""


def respond(
    placed: PlacedSections,
    plan: Plan,
    start: Float[Array, "m S"],
    u: Float[Array, "S n nu"],
    outputs: Sequence[str | Output],
    settings: Settings,
) -> Response:
    """Flow S experiments from section 0 through n sections under inputs held between them, n a
    multiple of N.

    `start` holds times and (padded) states at section 0. Differentiable in both modes; reverse
    mode stores the states at the sections, and computes what lies between them again.
    """
    system, cycle = placed.cycle.system, placed.cycle
    s = Structure(system)
    z = s.resolve_outputs(outputs)
    N, (S, n, _) = placed.n_sections, u.shape
    one_turn = len(cycle.order)
    first = jax.tree_util.tree_map(lambda x: x[..., :1], placed.lanes)
    lanes = jax.tree_util.tree_map(lambda x: jnp.broadcast_to(x, (*x.shape[:-1], S)), first)
    lanes = eqx.tree_at(lambda x: (x.t, x.q), lanes, (start[0], start[1:]))

    @jax.checkpoint
    def section(carry, xs):
        lanes, result = carry
        k, u = xs
        i, j = k % N, (k + 1) % N
        y = jnp.where(result == Result.OK, observe(s, z, lanes, u), jnp.nan)
        turns = (j == 0).astype(jnp.int32)
        target = placed.target(j[None], lanes.t, turns[None])
        target = dataclasses.replace(target, order=cycle.order)
        moved = move(s, lanes, u, target, settings, plan.stride(i, S), result, glide=True)
        # An event may change places with a section, but none may be left out or come in addition.
        due = placed.lanes.events[j] + turns * one_turn
        wrong = jnp.abs(moved.lanes.events - due) > 1
        result = update_result(moved.result, wrong, Result.EVENT_ORDER)
        # Times and events are counted within one turn, so that every turn is computed alike.
        lanes = eqx.tree_at(
            lambda x: (x.t, x.events),
            moved.lanes,
            (moved.lanes.t - turns * cycle.period, moved.lanes.events - turns * one_turn),
        )
        ok = result == Result.OK
        share = jnp.where(ok & (moved.error > 0), moved.error * plan.weight[i], 0.0)
        return (lanes, result), (y, ok, jax.lax.stop_gradient(share))

    xs = (jnp.arange(n), jnp.transpose(u, (1, 2, 0)))
    begin = (lanes, jnp.zeros(S, jnp.int32))
    (_, result), (y, ok, shares) = jax.lax.scan(section, begin, xs)
    failed_at = jnp.where(ok.all(axis=0), -1, jnp.argmin(ok, axis=0))
    turns = jnp.sum(shares.reshape(n // N, N, S), axis=1)
    error = ROUNDING + jnp.max(turns, axis=0)
    return Response(jnp.transpose(y, (2, 0, 1)), result, failed_at, error)
