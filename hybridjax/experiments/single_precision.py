"""Experiments in single precision: how far rounding errors carry them, measured on the cycle."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core.compilation import quick_jit
from .._core.executor import from_host
from .._core.memo import Memory
from .._core.precision import single, single_precision
from .._core.results import Result
from ..engine.move import move
from ..engine.search.state import Stride
from ..engine.settings import Settings
from ..errors import DefinitionError
from ..sections.placed import PlacedSections
from .plan import Plan, Stepping, plan_flow


# Lanes that leave each section. Twice as many measure for twice as long, and scatter less by a
# factor of 1.4.
_LANES = 32
# Their distance from the cycle, relative to the states' scales. Twice as much shows more of the
# curvature of section maps, which counts as if it were a rounding error.
_DISTANCE = 1e-4
# Directions in which lanes differ by less than this part of the most are left out of the fit of
# section maps. Twice as much leaves out directions that are known twice as well.
_INDEPENDENT = 1e-6
# Rounding errors of a step's error estimate, in units of the last place of the state. Twice as many
# let estimates be twice as large before a step is made shorter.
_ROUNDINGS_PER_STEP = 8.0
# Periods over which errors are followed at most, until one adds less than this share. Twice the
# share stops earlier, by as much too small an estimate.
_PERIODS, _GROWTH = 1024, 1e-3
# The largest of the thousands of errors of an experiment, in standard deviations; and a factor of
# reserve. Twice either doubles what single precision is said to cost.
_LARGEST, _CAUTION = 4.0, 2.0


_known = Memory()


def plan_single(placed: PlacedSections, accuracy: float) -> Stepping:
    """The plan for experiments in single precision, with what rounding adds to their errors.

    **Raises:** `DefinitionError` for an accuracy that single precision cannot give here; otherwise
    as `plan_flow`.
    """
    half = plan_flow(placed, accuracy / 2)
    # No step is made shorter because of what rounding leaves in its error estimate.
    noise = _ROUNDINGS_PER_STEP * float(jnp.finfo(jnp.float32).eps) / half.settings.rtol
    slack = from_host(np.maximum(half.plan.slack, noise))
    rough = dataclasses.replace(half, plan=dataclasses.replace(half.plan, slack=slack))
    rounding = _known.recall(placed, accuracy, lambda: rounding_error(placed, rough))
    if rounding > accuracy / 2:
        raise DefinitionError(
            f"single precision leaves errors of about {rounding:.1e} of the states' sizes in these "
            f"experiments, more than half the accuracy of {accuracy:.1e}: ask for less, e.g. "
            f"accuracy={3 * rounding:.1g}, or compute in double precision."
        )
    return dataclasses.replace(rough, accuracy=accuracy, rounding=rounding)


def rounding_error(placed: PlacedSections, stepping: Stepping) -> float:
    """An estimate of the largest error of (t, q) at any section that 32 bits leave, relative to
    the scales.

    Lanes near the cycle flow from every section to the next in both precisions. What differs is
    what one section adds: a mean (parameters are rounded, for instance) and a scatter. Both are
    followed through the section maps, which are fitted to the same lanes, until as much is
    forgotten as is added. Infinity if lanes do not arrive.
    """
    scale = stepping.scales
    N, n = scale.shape
    s, clocked = placed.structure(), placed.cycle.clocked
    moves = np.arange(n - 1) < np.array(s.dims)[np.asarray(placed.lanes.chart)][:, None]
    moves = np.concatenate([np.asarray(placed.time_is_state)[:, None], moves], axis=1)
    cycle = np.concatenate([placed.lanes.t[None], placed.lanes.q]).T
    aside = _DISTANCE * np.random.default_rng(0).standard_normal((_LANES, N, n))
    # Where time is no state, it is that of the section, as it is in each precision.
    start = np.where(moves, np.float32(cycle + scale * aside), cycle)
    arguments = placed, stepping.plan, stepping.settings, from_host(start.reshape(-1, n).T)
    exact = np.asarray(_sections(*arguments))
    with single_precision():
        rounded = np.asarray(_sections(*single(arguments)), float)
    ends, added = (
        x.T.reshape(_LANES, N, n) / np.roll(scale, -1, axis=0) for x in (exact, rounded - exact)
    )
    if not np.isfinite(added).all():
        return np.inf
    if not clocked:
        added[..., 0] = 0.0
    x, z = (start - start.mean(axis=0)) / scale, ends - ends.mean(axis=0)
    maps = [np.linalg.pinv(x[:, k], rcond=_INDEPENDENT) @ z[:, k] for k in range(N)]
    return _followed(np.array(maps), added)


def _followed(maps: Float[np.ndarray, "N n n"], added: Float[np.ndarray, "L N n"]) -> float:
    """The largest error where section k adds a draw of `added` to what its map (rows of states
    times `maps[k]`) makes of the errors so far."""
    mean = added.mean(axis=0)
    scatter = np.array([np.atleast_2d(np.cov(x.T)) for x in np.swapaxes(added, 0, 1)])
    bias, cov, largest = np.zeros(mean.shape[1]), np.zeros(scatter.shape[1:]), 0.0
    for _ in range(_PERIODS):
        before = largest
        for J, m, c in zip(maps, mean, scatter, strict=True):
            bias, cov = bias @ J + m, J.T @ cov @ J + c
            size = np.abs(bias) + _LARGEST * np.sqrt(np.diag(cov))
            largest = max(largest, float(size.max()))
        if largest - before <= _GROWTH * largest:
            break
    return _CAUTION * largest


@quick_jit
def _sections(
    placed: PlacedSections, plan: Plan, settings: Settings, start: Float[Array, "n L"]
) -> Float[Array, "n L"]:
    """Where lanes arrive that start by turns from section 0, 1, ... N-1; NaN if they do not."""
    N, L = placed.n_sections, start.shape[1]
    k = jnp.arange(L) % N
    i = (k + 1) % N
    turns = (i == 0).astype(jnp.int32)
    lanes = jax.tree_util.tree_map(lambda x: x[..., k], placed.lanes)
    lanes = eqx.tree_at(lambda x: (x.t, x.q), lanes, (start[0], start[1:]))
    target = placed.target(i, lanes.t, turns)
    stride = Stride(plan.h[k], plan.lead[k], plan.slack[k])
    s = placed.structure()
    moved = move(s, lanes, jnp.zeros((s.nu, L)), target, settings, stride)
    t = moved.lanes.t - turns * placed.cycle.period
    ends = jnp.concatenate([t[None], moved.lanes.q])
    return jnp.where(moved.result == Result.OK, ends, jnp.nan)
