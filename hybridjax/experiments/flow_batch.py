"""The response of a hybrid system around its limit cycle to inputs: many experiments, compiled."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._core.results import Result, update_result
from ..engine.lanes import Lanes
from ..engine.move import Options, move
from ..engine.settings import Settings
from ..errors import DefinitionError
from ..sections.families import BoundSections
from ..sections.placed import PlacedSections, observe, section_target
from ..systems.output import Output
from ..systems.structure import Structure
from ..systems.system import HybridSystem
from .plan import Plan


# Rounding error at a section, relative to the states' scales. Smaller: error estimates near 1e-13
# are exceeded. Larger: accuracies near 1e-13 are not reported.
_LEAST_ERROR = 1e-13


class Response(NamedTuple):
    """The response of S experiments of n samples."""

    y: Float[Array, "S n ny"]
    """Outputs at the sections, before the new input acts; NaN after a failure."""
    result: Int[Array, " S"]
    """Codes of `Result`."""
    failed_at: Int[Array, " S"]
    """The sample at which an experiment failed, or -1."""
    error: Float[Array, " S"]
    """Estimate of the largest error of (t, q) at any section, relative to the states' scales."""
    end: Float[Array, "S m"]
    """Times and states on section 0 after the last sample, the time counted within one period as
    that of the start is; NaN after a failure."""


class Course(eqx.Module):
    """The sections on a limit cycle, as experiments need them.

    **Fields:** `outputs`, what is recorded there; the others are those of `PlacedSections` and
    `LimitCycle`.
    """

    system: HybridSystem
    outputs: tuple[str | Output, ...]
    bound: BoundSections
    lanes: Lanes
    period: Float[Array, ""]
    event_sequence: tuple[int, ...] = eqx.field(static=True)


def course(placed: PlacedSections, outputs: Sequence[str | Output]) -> Course:
    """Return the course of experiments around a limit cycle."""
    cycle = placed.cycle
    return Course(
        cycle.system, tuple(outputs), placed.bound, placed.lanes, cycle.period, cycle.event_sequence
    )


def require_shape(shape: tuple[int, ...], n_sections: int, nu: int) -> None:
    """**Raises:** `DefinitionError` for inputs that are not (S, n, nu) with n a multiple of N."""
    if len(shape) != 3 or shape[2] != nu or shape[1] % n_sections or 0 in shape:
        raise DefinitionError(
            f"inputs must have the shape (experiments, samples, {nu}) with samples a multiple of "
            f"the {n_sections} sections; got {shape}."
        )


def flow_batch(
    course: Course,
    plan: Plan,
    start: Float[Array, "m S"],
    u: Float[Array, "S n nu"],
    settings: Settings,
) -> Response:
    """Flow S experiments from section 0 through n sections under inputs held between them, n a
    multiple of N.

    `start` holds times and (padded) states at section 0. Differentiable in both modes; reverse mode
    stores the states at the sections and recomputes the flow between them.
    """
    s, period, sequence = Structure(course.system), course.period, course.event_sequence
    z = s.resolve_outputs(course.outputs)
    N, (S, n, _) = len(course.bound.time), u.shape
    one_turn = len(sequence)
    first = jax.tree_util.tree_map(lambda x: x[..., :1], course.lanes)
    lanes = jax.tree_util.tree_map(lambda x: jnp.broadcast_to(x, (*x.shape[:-1], S)), first)
    lanes = eqx.tree_at(lambda x: (x.t, x.q), lanes, (start[0], start[1:]))

    @jax.checkpoint
    def section(carry, xs):
        lanes, result = carry
        k, u = xs
        i, j = k % N, (k + 1) % N
        y = jnp.where(result == Result.OK, observe(s, z, lanes, u), jnp.nan)
        turns = (j == 0).astype(jnp.int32)
        to = j[None], lanes.t, turns[None]
        target = section_target(course.bound, course.lanes, period, *to)
        target = dataclasses.replace(target, event_sequence=sequence)
        stride = plan.stride(i, S)
        moved = move(s, lanes, u, target, settings, stride, result, Options(glide=True)).moved
        # An event may change places with a section, but none may be left out or come in addition.
        due = course.lanes.events[j] + turns * one_turn
        wrong = jnp.abs(moved.lanes.events - due) > 1
        result = update_result(moved.result, wrong, Result.EVENT_ORDER)
        # Times and events are counted within one turn, so that every turn is computed alike.
        lanes = eqx.tree_at(
            lambda x: (x.t, x.events),
            moved.lanes,
            (moved.lanes.t - turns * period, moved.lanes.events - turns * one_turn),
        )
        ok = result == Result.OK
        share = jnp.where(ok & (moved.error > 0), moved.error * plan.weight[i], 0.0)
        return (lanes, result), (y, ok, jax.lax.stop_gradient(share))

    xs = (jnp.arange(n), jnp.transpose(u, (1, 2, 0)))
    begin = (lanes, jnp.zeros(S, jnp.int32))
    (lanes, result), (y, ok, shares) = jax.lax.scan(section, begin, xs)
    failed_at = jnp.where(ok.all(axis=0), -1, jnp.argmin(ok, axis=0))
    each_turn = jnp.sum(shares.reshape(n // N, N, S), axis=1)
    error = _LEAST_ERROR + jnp.max(each_turn, axis=0)
    end = jnp.where(result == Result.OK, jnp.concatenate([lanes.t[None], lanes.q]), jnp.nan)
    return Response(jnp.moveaxis(y, -1, 0), result, failed_at, error, end.T)
