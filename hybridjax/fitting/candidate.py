"""The limit cycle of a candidate system, under a JAX transformation."""

import dataclasses

import jax.numpy as jnp

from .._core.results import Result
from ..orbits.cycle import LimitCycle
from ..orbits.find import find_limit_cycle
from ..orbits.newton import MAX_STEPS, root
from ..systems.system import HybridSystem


def candidate_cycle(
    system: HybridSystem, guess: LimitCycle, with_factors: bool = True
) -> LimitCycle:
    """The cycle of a system near the `guess`, as `find_limit_cycle` gives it.

    Derivatives of a cycle's factors are second derivatives of the flow. Without them it is traced
    and compiled in a third of the time: `factors` and `legs` are NaN then.
    """
    if with_factors:
        return find_limit_cycle(system, guess)
    map = guess.return_map.at_phase_of(system)
    q, turn, steps = root(map, False, MAX_STEPS)
    period = map.expected if map.base is None else map.turn(q).period
    code = jnp.where(turn.closed, Result.OK, Result.NOT_CONVERGED)
    return dataclasses.replace(
        guess,
        system=system,
        period=period,
        anchor=map.departure(q),
        legs=guess.legs._replace(q=jnp.full_like(guess.legs.q, jnp.nan)),
        factors=jnp.full_like(guess.factors, jnp.nan),
        residual=turn.distance,
        iterations=steps,
        result=jnp.where(turn.result == Result.OK, code, turn.result),
    )
