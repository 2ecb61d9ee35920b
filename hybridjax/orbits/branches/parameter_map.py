"""The return map and its derivatives by the state and by one parameter, from one turn."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..._core.compile import quick_jit
from ...engine.lanes import Lanes
from ...engine.move import constant, record, retrace
from ...engine.settings import Settings
from ...systems.structure import Structure
from ...systems.system import HybridSystem
from ..return_map import ReturnMap, across, departure, held, turn


class Round(NamedTuple):
    """One round of the return map from a state q."""

    residual: Float[Array, " d"]
    """P(q) - q, and what keeps conserved quantities at their values."""
    by_state: Float[Array, "d d"]
    """Derivative of the residual by q."""
    by_parameter: Float[Array, " d"]
    """Derivative of the residual by the parameter."""
    monodromy: Float[Array, "d d"]
    """Derivative of P by q; for an autonomous system across the flow."""
    period: Float[Array, ""]
    start: Lanes
    legs: Lanes
    factors: Float[Array, "K d d"]
    codes: Int[Array, "K R"]
    result: Int[Array, ""]


@quick_jit
def go_round(
    system: HybridSystem,
    direction: HybridSystem,
    q: Float[Array, " d"],
    start: Lanes,
    kind: ReturnMap,
    expected: Float[Array, ""],
    settings: Settings,
) -> Round:
    """One round from q, with derivatives by q and along `direction` in the parameters.

    `direction` is a system like `system` whose numbers are the direction: so one program serves
    all parameters. `start` gives chart and phase; `expected` the period, as a rough value.
    """
    s = Structure(system)
    n = s.d
    clocked = kind.base is None
    rate = jnp.zeros(())
    if clocked:  # all times of a turn grow with the period of the clock
        period, by_parameter = _along(lambda system: system.period(), system, direction)
        start = eqx.tree_at(lambda x: x.t, start, start.t / expected * kind.turns * period)
        expected, rate = kind.turns * period, by_parameter / period

    def flow(s, lanes, target, settings, h, result):
        u = jnp.zeros((s.nu, 1))
        source, *go = constant((s.source, lanes, u, target))
        moved, tape = record(
            Structure(source), *go, settings, h, result, new_input=False, tangents=True
        )

        def end(q, step):
            grown = 1 + rate * step
            begin = eqx.tree_at(lambda x: (x.t, x.q), lanes, (lanes.t * grown, q))
            time = jnp.where(jnp.isfinite(target.time), target.time * grown, jnp.inf)
            to = dataclasses.replace(target, time=time)
            t, q = retrace(Structure(_moved(system, direction, step)), begin, u, to, tape)
            return t, q[:, 0]

        at = (lanes.q, jnp.zeros(()))
        push = lambda *tangent: jax.jvp(end, at, tangent)  # noqa: E731
        along = jnp.eye(n + 1)
        states = along[:, :n, None]
        (t, q), (_, columns) = jax.vmap(push, out_axes=((None, None), 0))(states, along[:, n])
        moved = eqx.tree_at(lambda x: (x.lanes.t, x.lanes.q), moved, (t, q[:, None]))
        return moved, (lanes, columns.T, tape.code)

    residual, end, result, (legs, columns, codes) = turn(
        q, system, start, kind, expected, settings, flow
    )
    valid = jnp.arange(n) < jnp.array(s.dims)[start.chart[0]]

    def chain(carry, F):
        P, p = carry
        return (F[:, :n] @ P, F[:, :n] @ p + F[:, n]), None

    (P, p), _ = jax.lax.scan(chain, (jnp.eye(n), jnp.zeros(n)), columns)
    legs = jax.tree_util.tree_map(lambda x: jnp.moveaxis(x[..., 0], 0, -1), legs)
    factors = columns[:, :, :n]
    monodromy = P
    if not clocked:
        factors = across(s, legs, factors)
        monodromy = jax.lax.scan(lambda P, F: (F @ P, None), jnp.eye(n), factors)[0]
    _, by_parameter = _along(lambda x: held(Structure(x), q, start, kind)[0], system, direction)
    _, hold = held(s, q, start, kind)
    return Round(
        residual,
        jnp.where(valid[:, None], P, 0.0) - jnp.eye(n) - hold,
        jnp.where(valid, p, 0.0) - by_parameter,
        jnp.where(valid[:, None] & valid, monodromy, 0.0),
        end.t[0] - start.t[0],
        departure(s, q, start, kind.base, expected),
        legs,
        factors,
        codes[..., 0],
        result,
    )


def _along(function, system, direction):
    """A function of the system, and its derivative along `direction`."""
    at = lambda step: jnp.asarray(function(_moved(system, direction, step)), float)  # noqa: E731
    return jax.jvp(at, (jnp.zeros(()),), (jnp.ones(()),))


def _moved(system, direction, step):
    """`system`, with its parameters moved by `step` along `direction`."""
    return jax.tree_util.tree_map(
        lambda x, v: x + step * v if eqx.is_inexact_array(x) else x, system, direction
    )
