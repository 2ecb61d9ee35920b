"""What is compiled for a sweep: a turn of every system of a call, and what is said of it."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from ..._core.compilation.compile import quick_jit
from ..._core.results import Result
from ...engine.lanes import Lanes
from ...engine.move import move
from ...engine.settings import TRANSIENT, Settings
from ...engine.target import toward, until
from ...sections.crossing import AtEvent
from ...sections.section_list import ListLevels
from ...systems.system import HybridSystem
from ..return_map import ReturnMap, Turn


# Periods for which a system flows freely before Newton tries again. Doubled, slower transients die
# out, and each failure takes twice as long.
_SETTLE = 40


def _own(map: ReturnMap, system: HybridSystem, anchor: Lanes, expected) -> ReturnMap:
    """The return map of a system, begun at the same phase of its own clock."""
    own = map.at_phase_of(system)
    if map.base is not None:
        own = dataclasses.replace(own, expected=expected)
    anchor = eqx.tree_at(lambda x: x.t, anchor, own.anchor.t)
    return dataclasses.replace(own, anchor=anchor)


def _turn(systems, map: ReturnMap, anchor: Lanes, period, wanted):
    """One turn of every system from its anchor, with the Jacobian if it is `wanted`."""

    def one(system, anchor, expected):
        own = _own(map, system, anchor, expected)
        turn = own.turn_with_jacobian(own.anchor.q[:, 0], wanted)
        events = turn.codes.ravel(), turn.times.ravel()
        return own.anchor, own.expected, turn._replace(codes=None, times=None), *events

    return eqx.filter_vmap(one)(systems, anchor, period)


def _verdict(systems, map: ReturnMap, anchor: Lanes, period, turn: Turn):
    """The anchors ready to be left, periods, and result codes."""

    def one(system, anchor, expected, turn):
        own, q = _own(map, system, anchor, expected), anchor.q[:, 0]
        period = own.expected if own.base is None else turn.period
        return own.departure(q), period, own.judge(q, turn)

    return eqx.filter_vmap(one)(systems, anchor, period, turn)


def _settled(systems, map: ReturnMap, anchor: Lanes, period):
    """Where systems are after they have flowed freely for a while, at the guess's phase or
    section (NaN for those that do not get there), and their expected periods."""
    base = map.base
    patient = Settings(TRANSIENT, TRANSIENT, 512 * _SETTLE, map.settings.scale)

    def one(system, anchor, expected):
        own = _own(map, system, anchor, expected)
        s, anchor, expected = own.structure, own.anchor, own.expected
        u = jnp.zeros((s.nu, 1))
        moved = move(s, anchor, u, until(anchor.t + _SETTLE * expected), patient)
        if base is not None:
            at_event = isinstance(base, AtEvent)
            event = s.transition_index(base.name) if at_event else -1
            target = toward(jnp.full(1, jnp.inf), event, moved.lanes.t + 3 * expected)
            if not at_event:
                target = dataclasses.replace(target, levels=ListLevels((base,)))
            moved = move(s, moved.lanes, u, target, patient, moved.h, moved.result)
        q = jnp.where(moved.result == Result.OK, moved.lanes.q, jnp.nan)
        anchor = eqx.tree_at(lambda x: (x.chart, x.q), anchor, (moved.lanes.chart, q))
        return anchor, expected

    return eqx.filter_vmap(one)(systems, anchor, period)


class Programs(NamedTuple):
    """The functions above, compiled."""

    turn: Callable
    verdict: Callable
    settled: Callable


# For few systems, and for many.
QUICK, FULL = (
    Programs(*map(jit, (_turn, _verdict, _settled))) for jit in (quick_jit, eqx.filter_jit)
)
