"""The return map of a cycle and Newton's method on it.

One turn is cut into pieces, whose Jacobians are found together with the pieces: their product is
the Jacobian of the return map, and they themselves are the factors of the monodromy.
"""

import dataclasses
import functools as ft

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int

from .._core.compile import quick_jit
from .._core.results import Result
from ..engine.events import arm, start_lanes
from ..engine.jacobian import flow_jacobian
from ..engine.lanes import Lanes
from ..engine.move import move
from ..engine.target import Target, toward, until
from ..engine.watch import slopes, watch
from ..sections.families import AtEvent, Crossing, ListLevels
from ..systems.structure import Structure


# Pieces into which one turn is cut: their Jacobians are the factors of the monodromy.
LEGS = 16
# An autonomous system flows freely up to this fraction of its last turn, then to the section.
_FREE = 0.75
# J - I counts as singular if its smallest singular value is below this.
_SINGULAR = 1e-7
# Newton's method ends with a step below this, absolute and relative to the state.
_ATOL, _RTOL = 1e-12, 1e-11
# Along a direction in which J - I is singular, neither Newton nor a derivative moves.
_SOLVER = lx.SVD(rcond=_SINGULAR)


class ReturnMap(eqx.Module):
    """Which states a cycle comes back to.

    **Fields:**

    - `base`: the section of an autonomous system; `None` for a clocked one, whose section is the
        phase of the clock at the start.
    - `conserved`: values of conserved quantities, by the name of the output; they choose one
        cycle of a family.
    - `turns`: periods of the clock, or meetings with the section, in one round.
    """

    base: Crossing | AtEvent | None
    conserved: dict[str, Float[Array, ""]]
    turns: int = eqx.field(static=True)


class Turn(eqx.Module):
    """What Newton sees on one turn."""

    legs: Lanes
    factors: Float[Array, "K d d"]
    codes: Int[Array, "K R"]
    period: Float[Array, ""]
    distance: Float[Array, ""]
    result: Int[Array, ""]
    meetings: Int[Array, ""]


@quick_jit
def solve(
    system,
    start: Lanes,
    kind: ReturnMap,
    expected,
    settings,
    damped: bool,
    follow: bool,
    max_steps: int = 32,
):
    """Newton on the return map, and what it saw in its last turn.

    **Arguments:** `damped` takes the smaller steps of Levenberg and Marquardt; `follow` goes round
    once more on the cycle found, so that what is seen has the derivatives of the cycle.
    """
    q, seen, steps = _root(system, start, kind, expected, settings, damped, max_steps)
    if follow:
        _, seen, _ = turn_with_jacobian(q, system, start, kind, expected, settings)
    lanes, period, factors, code = judge(q, seen, system, start, kind, expected, settings)
    return lanes, period, factors, seen, steps, code


def newton_step(
    q: Float[np.ndarray, "S d"],
    residual: Float[np.ndarray, "S d"],
    jacobian: Float[np.ndarray, "S d d"],
) -> tuple[Float[np.ndarray, "S d"], Float[np.ndarray, " S"]]:
    """Where Newton's steps from S states lead to, and the largest part of each relative to the
    tolerance of `solve`; NaN where the turn failed. On the host."""
    step = np.full(q.shape, np.nan)
    good = np.isfinite(residual).all(axis=1) & np.isfinite(jacobian).all(axis=(1, 2))
    inverse = np.linalg.pinv(jacobian[good], rcond=_SINGULAR)
    step[good] = -(inverse @ residual[good, :, None])[..., 0]
    return q + step, np.max(np.abs(step) / (_ATOL + _RTOL * np.abs(q)), axis=1)


def closes(q, seen: Turn):
    """Whether a turn from q came back to it. (Of NumPy's arrays as of JAX's.)"""
    return seen.distance <= 1e-8 * (1 + abs(q).max(axis=-1))


def judge(q, seen: Turn, system, start: Lanes, kind: ReturnMap, expected, settings):
    """The lane at q, the period, the factors of the monodromy, and whether q lies on a cycle."""
    s = Structure(system)
    n = s.d
    lanes = departure(s, q, start, kind.base, expected)
    valid = jnp.arange(n) < jnp.array(s.dims)[start.chart[0]]
    period = expected if kind.base is None else seen.period
    factors = seen.factors
    if kind.base is not None:
        factors = across(s, seen.legs, factors)
    monodromy = jax.lax.scan(lambda P, F: (F @ P, None), jnp.eye(n), factors)[0]
    _, hold = held(s, q, start, kind)
    singular = jnp.linalg.svd(monodromy - jnp.diag(valid * 1.0) - hold, compute_uv=False)
    smallest = jnp.min(jnp.where(jnp.arange(n) < valid.sum(), singular, jnp.inf))
    good = closes(q, seen)
    code = jnp.where(seen.result == Result.OK, Result.NOT_CONVERGED, seen.result)
    code = jnp.where(good, jnp.where(smallest < _SINGULAR, Result.SINGULAR, Result.OK), code)
    if kind.base is not None:
        same = seen.legs.chart == start.chart
        apart = jnp.where(same, jnp.max(jnp.abs(seen.legs.q - q[:, None]), axis=0), jnp.inf)
        still = jnp.max(apart) <= 1e3 * jnp.maximum(settings.atol, seen.distance)
        code = jnp.where(good & (seen.meetings > kind.turns), Result.EXTRA_TURNS, code)
        code = jnp.where(good & still, Result.EQUILIBRIUM, code)
    return lanes, period, factors, code.astype(jnp.int32)


@eqx.filter_custom_jvp
def _root(system, start, kind, expected, settings, damped, max_steps):
    """The state that the return map leaves where it is, what was seen there, and steps taken."""
    if damped:
        solver = optx.LevenbergMarquardt(rtol=_RTOL, atol=_ATOL)
    else:
        solver = optx.Newton(rtol=_RTOL, atol=_ATOL, linear_solver=_SOLVER)
    solution = optx.root_find(
        lambda q, args: _residual(q, *args, settings),
        solver,
        start.q[:, 0],
        (system, start, kind, expected),
        has_aux=True,
        max_steps=max_steps,
        throw=False,
    )
    return solution.value, solution.aux, solution.stats["num_steps"]


@_root.def_jvp
def _root_jvp(primals, tangents):
    """Implicit: 0 = P(q, p) - q moves q by -(J - I)^-1 dP/dp. (optimistix's own derivative raises
    where it is taken twice, since JAX cannot vectorize the derivative of `flow_jacobian`.)"""
    *parameters, settings, _, _ = primals
    q, seen, steps = _root(*primals)

    def residual(system, start, kind, expected):
        return turn(q, system, start, kind, expected, settings, _flow)[0]

    _, by_parameters = eqx.filter_jvp(residual, tuple(parameters), tuple(tangents[:4]))
    jacobian = lx.MatrixLinearOperator(turn_with_jacobian(q, *parameters, settings)[2])
    t_q = -lx.linear_solve(jacobian, by_parameters, _SOLVER, throw=False).value
    nothing = jax.tree_util.tree_map(lambda _: None, (seen, steps))
    return (q, seen, steps), (t_q, *nothing)


def _residual(q, system, start, base, expected, settings):
    """P(q) - q, whose derivative by q is the Jacobian of the turn's legs, and the `Turn`.

    The Jacobian comes with the value, so that the turn need not be traced again for it.
    """
    fixed = jax.lax.stop_gradient(q)
    residual, seen, jacobian = turn_with_jacobian(fixed, system, start, base, expected, settings)
    return residual + jacobian @ (q - fixed), seen


def turn_with_jacobian(q, system, start, kind, expected, settings, wanted=True):
    """P(q) - q, what was seen on the way, and the Jacobian (nonsense where it is not `wanted`)."""
    flow = ft.partial(_flow_with_jacobian, wanted=wanted)
    residual, end, result, (legs, jacobians, codes) = turn(
        q, system, start, kind, expected, settings, flow
    )
    n = q.shape[0]
    factors = jacobians[:, 0, 1 : n + 1]
    valid = jnp.arange(n) < jnp.array(Structure(system).dims)[start.chart[0]]
    monodromy = jax.lax.scan(lambda P, F: (F @ P, None), jnp.eye(n), factors)[0]
    jacobian = jnp.where(valid[:, None], monodromy, 0.0) - jnp.eye(n)
    off, hold = held(Structure(system), q, start, kind)
    jacobian = jacobian - hold
    legs = jax.tree_util.tree_map(lambda x: jnp.moveaxis(x[..., 0], 0, -1), legs)
    distance = jnp.max(jnp.abs(residual)) + jnp.max(jnp.abs(off))
    period, codes = end.t[0] - start.t[0], codes[..., 0]
    meetings = _meetings(Structure(system), kind, legs, codes)
    seen = Turn(legs, factors, codes, period, distance, result, meetings)
    return residual, seen, jacobian


def _meetings(s: Structure, kind: ReturnMap, legs: Lanes, codes) -> Int[Array, ""]:
    """How often a round met the section that it ended on, as far as its legs show it."""
    if kind.base is None:
        return jnp.asarray(kind.turns, jnp.int32)
    if isinstance(kind.base, AtEvent):
        own = codes == s.transition_index(kind.base.name)
        return jnp.sum(own, dtype=jnp.int32)
    K = legs.t.shape[0]
    target = dataclasses.replace(until(legs.t), levels=ListLevels((kind.base,)))
    u, everywhere = jnp.zeros((s.nu, K)), jnp.ones(K, bool)
    level = watch(s, legs.t, legs.chart, legs.q, u, target, everywhere).value[-1]
    falls = (level[1:-1] > 0) & (level[2:] <= 0) & (legs.events[1:-1] == legs.events[2:])
    return 1 + jnp.sum(falls, dtype=jnp.int32)


def _flow(s, lanes, target, settings, h, result):
    u = jnp.zeros((s.nu, 1))
    return move(s, lanes, u, target, settings, h, result, new_input=False), None


def _flow_with_jacobian(s, lanes, target, settings, h, result, wanted):
    jacobian, moved, tape = flow_jacobian(
        s, lanes, target, settings, h, result, of_states=True, new_input=False, wanted=wanted
    )
    return moved, (lanes, jacobian, tape.code)


def turn(q, system, start: Lanes, kind: ReturnMap, expected, settings, flow):
    """One round from state q on the section, leg by leg, each done by `flow`.

    **Returns:** P(q) - q, less what keeps conserved quantities at their values; the lane at the
    end, its result, and what `flow` returned besides.
    """
    s = Structure(system)
    lanes = departure(s, q, start, kind.base, expected)
    targets = _leg_targets(s, start.t[0], kind, expected)
    each, common = eqx.partition(targets, _per_lane(targets))

    def leg(carry, target):
        lanes, h, result = carry
        target = jax.tree_util.tree_map(lambda x: x[None], target)
        moved, extra = flow(s, lanes, eqx.combine(target, common), settings, h, result)
        return (moved.lanes, moved.h, moved.result), extra

    begin = (lanes, (0.5 * expected / LEGS)[None], jnp.zeros(1, jnp.int32))
    (end, _, result), extra = jax.lax.scan(leg, begin, each)
    valid = jnp.arange(s.d) < jnp.array(s.dims)[start.chart[0]]
    same = (result[0] == Result.OK) & (end.chart[0] == start.chart[0])
    residual = jnp.where(valid, end.q[:, 0], 0.0) - q - held(s, q, start, kind)[0]
    residual = jnp.where(same, residual, jnp.nan)
    return residual, end, result[0], extra


def departure(s: Structure, q, start: Lanes, base, expected) -> Lanes:
    """The lane at the beginning of a turn: right after an event, that event is not due again."""
    lanes = start_lanes(s, start.t, start.chart, q[:, None])
    u, everywhere = jnp.zeros((s.nu, 1)), jnp.ones(1, bool)
    seen = watch(s, lanes.t, lanes.chart, lanes.q, u, until(lanes.t), everywhere)
    lanes = arm(s, lanes, seen, expected[None])
    if isinstance(base, AtEvent):
        own = jnp.arange(len(s.transitions))[:, None] == s.transition_index(base.name)
        lanes = eqx.tree_at(lambda x: x.armed, lanes, lanes.armed & ~own)
    return lanes


def held(s: Structure, q, start: Lanes, kind: ReturnMap):
    """The step of the state that takes conserved quantities away from their values, as far as
    they are away, and its derivative (with the direction of the step held fixed).

    Along P(q) - q nothing that is conserved changes, so that P(q) - q and this step can add up to
    zero only where both are zero; and J - I is regular once the derivative is taken from it.
    """
    if not kind.conserved:
        return jnp.zeros_like(q), jnp.zeros((s.d, s.d))
    outputs = s.resolve_outputs(tuple(kind.conserved))
    t, u = start.t[0], jnp.zeros(s.nu)
    branches = [lambda q, a=a: outputs(a, t, q[: s.dims[a]], u) for a in range(len(s.charts))]

    def excess(q):
        values = jnp.stack(list(kind.conserved.values()))
        return jax.lax.switch(start.chart[0], branches, q) - values

    gradient = jax.jacfwd(excess)(q)
    back = jax.lax.stop_gradient(jnp.linalg.pinv(gradient))
    return back @ excess(q), back @ gradient


def across(s: Structure, legs: Lanes, factors):
    """The factors on the states modulo the direction of the flow.

    Along the flow of an autonomous system nothing contracts. Taken out of every factor, that
    direction cannot drown a strong contraction across it.
    """
    f = slopes(s, legs.t, legs.chart, legs.q, jnp.zeros((s.nu, legs.t.shape[0]))).T
    f = f / jnp.linalg.norm(f, axis=1, keepdims=True)
    project = jnp.eye(s.d) - f[:, :, None] * f[:, None, :]
    return jnp.roll(project, -1, axis=0) @ factors @ project


def _per_lane(targets):
    """Mark the leaves of a `Target` that have one entry per lane."""
    marks = jax.tree_util.tree_map(lambda _: False, targets)
    fields = lambda x: (x.time, x.index, x.event, x.limit)  # noqa: E731
    return eqx.tree_at(fields, marks, (True,) * 4)


def _leg_targets(s: Structure, t0, kind: ReturnMap, expected) -> Target:
    """Targets of the pieces of one round: K - 1 times, then the section the round began on."""
    base, k = kind.base, jnp.arange(1, LEGS + 1)
    if base is None:
        return toward(t0 + expected * k / LEGS, -1, t0 + 2 * expected)
    free = 1 - (1 - _FREE) / kind.turns
    time = jnp.where(k < LEGS, t0 + free * expected * k / (LEGS - 1), jnp.inf)
    target = toward(time, -1, t0 + 3 * expected)
    last = k == LEGS
    if isinstance(base, AtEvent):
        event = jnp.where(last, s.transition_index(base.name), -1).astype(jnp.int32)
        return dataclasses.replace(target, event=event)
    index = jnp.where(last, 0, -1).astype(jnp.int32)
    return dataclasses.replace(target, index=index, levels=ListLevels((base,)))
