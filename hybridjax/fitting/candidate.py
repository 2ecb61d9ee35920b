"""The limit cycle of a candidate system, with derivatives of first order only."""

import dataclasses

import jax.numpy as jnp

from .._core.results import Result
from ..orbits.cycle import LimitCycle
from ..orbits.return_map import ReturnMap, _flow, _root, departure, turn
from ..systems.structure import Structure
from ..systems.system import HybridSystem


def candidate_cycle(system: HybridSystem, guess: LimitCycle) -> LimitCycle:
    expected = (
        guess.period
        if system.period() is None
        else guess.turns * jnp.asarray(system.period(), float)
    )
    kind = ReturnMap(guess.base, guess.conserved, guess.turns)
    q, seen, steps = _root(system, guess.start, kind, expected, guess.settings, False, 32)
    period = expected
    if guess.base is not None:
        _, end, _, _ = turn(q, system, guess.start, kind, expected, guess.settings, _flow)
        period = end.t[0] - guess.start.t[0]
    good = seen.distance <= 1e-8 * (1 + jnp.max(jnp.abs(q)))
    code = jnp.where(seen.result == Result.OK, Result.NOT_CONVERGED, seen.result)
    code = jnp.where(good, Result.OK, code)
    start = departure(Structure(system), q, guess.start, guess.base, expected)
    hidden = jnp.full_like(guess.factors, jnp.nan)
    return dataclasses.replace(
        guess,
        system=system,
        period=period,
        start=start,
        factors=hidden,
        residual=seen.distance,
        iterations=steps,
        result=code,
    )
