"""Flows by one compiled program: all flows of many lanes, and each flow that JAX traces.

`orbits/flow.py` writes what a user asked for as a `Request`. From it, `passage_of` computes the
ends, the events and samples of all lanes, without the trajectory that a single flow on the host
has. The program keeps a record of all moves (steps and jumps), from which derivatives come:

| lanes | rows of the record | parts |
|---|---|---|
| up to `_FEW`, or traced | `max_steps` | one for each `_PART_BYTES` of the record |
| more | `_FIRST_ROWS`, then 4 times as many until they suffice | the same |

Which lanes form a part is decided in `_parts`, steps and derivatives are those of
`engine/flow.py`, and the codes `SECTION_MISSED`, `SIMULTANEOUS` and `BAD_INPUT` come from
`_passage`. Numbers of rows and parts must have no effect on results.

If a flow is wrong in a program and right on the host, look at `_passage` first; if many flows need
too much memory, at `_parts` and `_bytes_of_record`; if they are slow, at `_with_enough_rows`.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from .._core.compilation import Program, quick_jit
from .._core.executor import Array, is_traced
from .._core.results import Result, update_result
from ..engine.flow import Events, Passage, pass_through
from ..engine.lanes import Lanes, blank_tape
from ..engine.settings import Settings
from ..engine.target import Target
from ..systems.structure import Structure
from ..systems.system import HybridSystem
from ..systems.transition import SAME_TIME
from . import rivals


# Most flows that are computed with all rows of the record at once, by a program that compiles
# sooner. More: they run four times as long. Fewer: some wait for the compiler in vain.
_FEW = 500
# Most flows of a part. More: their states leave the cache of the processor. Fewer: the calls of
# small functions of a program take longer than what these do.
_PART_LANES = 3000
# Bytes of the record of a part. More: gigabytes in reverse mode. Fewer: many flows are computed in
# more parts.
_PART_BYTES = 64e6
# Bytes of the record of all flows that reverse mode keeps. More: gigabytes. Fewer: parts are
# searched twice.
_KEPT_BYTES = 5e8
# Rows of the record with which many flows begin. More: flows of few steps fill rows in vain. Fewer:
# flows of many steps are computed twice, and another program is compiled.
_FIRST_ROWS = 128


class Request(eqx.Module):
    """What a user asked of a flow: L lanes where they begin, and where they end."""

    system: HybridSystem
    lanes: Lanes
    result: Int[Array, " L"]
    """Lanes whose code is not OK stay where they are."""
    u: Float[Array, "nu #L"]
    target: Target
    settings: Settings
    most_events: int = eqx.field(static=True)
    new_input: bool = eqx.field(static=True)
    many: bool = eqx.field(static=True)
    """Whether the result has an axis of lanes."""
    ends_in: int | None = eqx.field(static=True)
    """Chart at the end, if it is known."""

    def with_rows(self, rows: int) -> "Request":
        """The same request with a record of this many rows."""
        old = self.settings
        settings = Settings(old.rtol, old.atol, rows, old.scale)
        return dataclasses.replace(self, settings=settings)

    def of_lanes(self, lanes: Int[Array, " l"]) -> "Request":
        """The same request for some of the lanes. (Arrays of one entry are for all lanes.)"""

        def of(x):
            return x[..., lanes] if x.shape[-1] > 1 else x

        target, levels = self.target.split()
        own = self.lanes, self.result, self.u, target
        some, result, u, target = jax.tree_util.tree_map(of, own)
        target = target.with_levels(levels)
        return dataclasses.replace(self, lanes=some, result=result, u=u, target=target)


# Which program.


def passage_of(request: Request) -> Passage:
    """The passage of all lanes, by the program that suits their number."""
    if is_traced(request) or len(request.lanes.t) <= _FEW:
        return sampled_passage(request)
    return _with_enough_rows(request)


def _with_enough_rows(request: Request) -> Passage:
    """The passage of many lanes. The record has few rows as long as these suffice, because rows
    without moves take time, too."""
    most = request.settings.max_steps
    rows = min(_FIRST_ROWS, most)
    passage = _of_many(request.with_rows(rows))
    while rows < most and np.any(passage.moved.result == Result.STEP_LIMIT):
        rows = min(4 * rows, most)
        passage = _of_many(request.with_rows(rows))
    return passage


# The program.


def _passage(request: Request, times: Float[Array, " K"] | None = None) -> Passage:
    """The passage of all lanes, with samples at some times."""
    s = Structure(request.system)
    target = request.target
    lanes = request.lanes._replace(events=request.lanes.events * 0)
    times = jnp.zeros(0) if times is None else times
    early = jnp.isfinite(target.time) & (target.time < lanes.t)
    # (A time that is infinite or NaN is the limit, too.)
    bad = early | ~jnp.isfinite(target.limit)
    begin = update_result(request.result, bad, Result.BAD_INPUT)
    request = dataclasses.replace(request, lanes=lanes, result=begin)
    passage = _in_parts(request, times)
    moved, events, _ = passage
    late = is_late(target, lanes, moved.lanes)
    result = update_result(moved.result, late, Result.SECTION_MISSED)
    coincide = _coincide(s, lanes, target, events)
    result = update_result(result, coincide, Result.SIMULTANEOUS)
    return passage._replace(moved=moved._replace(result=result))


# For few lanes, or with samples: compiles sooner.
sampled_passage = quick_jit(_passage)
# For many lanes, whose program runs longer than it compiles.
_of_many = Program(_passage, loops=True)


def is_late(target: Target, begin: Lanes, end: Lanes) -> Bool[Array, " L"]:
    """Test whether lanes ended later than they may: the last step can go on beyond the limit."""
    return end.t > target.limit + SAME_TIME * (target.limit - begin.t)


def _coincide(
    s: Structure, lanes: Lanes, target: Target, events: Events
) -> Bool[Array, " L"]:
    """Test whether two events of a lane coincide, in programs, where their orders are not compared:
    an event at once follows the one before on all trajectories."""
    of_turn = rivals.Events(events.transition, events.t, events.at_once, events.rival)
    span = jax.lax.stop_gradient(target.limit - lanes.t)
    found = rivals.rivals_of(s, jax.lax.stop_gradient(of_turn), span) >= 0
    return (found & ~events.at_once).any(axis=0)


# Its parts.


def _in_parts(request: Request, times: Float[Array, " K"]) -> Passage:
    """The passage of all lanes, part by part if their record would be too large. Reverse mode keeps
    the record, or if that is too large, where each part starts: it searches and records it again.
    """
    parts = _parts(request)
    if len(parts) == 1:
        return _part(request, times)

    def part(lanes):
        return _part(request.of_lanes(lanes), times)

    L = len(request.lanes.t)
    if L * _bytes_of_record(request) > _KEPT_BYTES:
        part = jax.checkpoint(part)
    passages = jax.lax.map(part, jnp.asarray(parts))

    def joined(x):
        x = jnp.moveaxis(x, 0, -2)
        return x.reshape(*x.shape[:-2], parts.size)[..., :L]

    return jax.tree_util.tree_map(joined, passages)


def _part(request: Request, times: Float[Array, " K"]) -> Passage:
    """The passage of lanes whose record is small enough."""
    return pass_through(
        Structure(request.system),
        request.lanes,
        request.u,
        request.target,
        request.settings,
        request.most_events,
        request.new_input,
        jnp.broadcast_to(times[:, None], (len(times), len(request.lanes.t))),
        request.result,
    )


def _parts(request: Request) -> Int[np.ndarray, "parts l"]:
    """The lanes of each part, such that its record is not too large. The last part is filled up
    with the last lane, so that all parts are of one size."""
    L = len(request.lanes.t)
    by_record = int(np.ceil(L * _bytes_of_record(request) / _PART_BYTES))
    by_cache = int(np.ceil(L / _PART_LANES))
    count = max(1, min(L, max(by_record, by_cache)))
    size = -(-L // count)
    return np.minimum(np.arange(count * size), L - 1).reshape(count, size)


def _bytes_of_record(request: Request) -> float:
    """Bytes of the record of one lane."""
    lanes = request.lanes
    record = jax.eval_shape(lambda: blank_tape(request.settings.max_steps, lanes))
    return sum(x.size * x.dtype.itemsize for x in record) / len(lanes.t)
