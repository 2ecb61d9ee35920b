"""Experiments in single precision: the effect of rounding errors, measured on the cycle."""

import dataclasses
import functools

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


# Lanes that leave each section, and their distance from the cycle relative to the states' scales.
# Fewer lanes: the measured errors scatter more. Farther: the curvature of section maps counts as
# rounding. Nearer: the fit of section maps is dominated by rounding.
_LANES, _DISTANCE = 32, 1e-4
# Directions in which lanes differ by less than this part of the most are left out of the fit of
# section maps. Smaller: rounding is fitted. Larger: slow directions are left out.
_INDEPENDENT = 1e-6
# Rounding errors of a step's error estimate, in units of the last place of the state. Smaller:
# steps are shortened in vain. Larger: inaccurate steps are accepted.
_ROUNDINGS_PER_STEP = 8.0
# Errors accumulate over 2 to the power of this periods. Fewer: they are underestimated for
# multipliers near the unit circle. More: uncertain multipliers above 1 make them infinite.
_DOUBLINGS = 10
# The largest of the thousands of errors of an experiment in standard deviations, times a safety
# factor of 2. Smaller: experiments exceed their estimates. Larger: estimates are pessimistic.
_LARGEST = 8.0


_measured = Memory()


def plan_single(placed: PlacedSections, accuracy: float) -> Stepping:
    """Return the plan for single precision, with the errors that rounding adds.

    **Raises:** `DefinitionError` for an accuracy that single precision cannot give here; otherwise
    as `plan_flow`.
    """
    half = plan_flow(placed, accuracy / 2)
    # No step is made shorter because of what rounding leaves in its error estimate.
    noise = _ROUNDINGS_PER_STEP * float(jnp.finfo(jnp.float32).eps) / (accuracy / 2)
    slack = from_host(np.maximum(half.plan.slack, noise))
    rough = dataclasses.replace(half, plan=dataclasses.replace(half.plan, slack=slack))
    rounding = _measured.recall(placed, accuracy, lambda: rounding_error(placed, rough))
    if rounding > accuracy / 2:
        raise DefinitionError(
            f"single precision leaves errors of about {rounding:.1e} of the states' sizes in these "
            f"experiments, more than half the accuracy of {accuracy:.1e}: ask for less, e.g. "
            f"accuracy={3 * rounding:.1g}, or compute in double precision."
        )
    return dataclasses.replace(rough, accuracy=accuracy, rounding=rounding)


def rounding_error(placed: PlacedSections, stepping: Stepping) -> float:
    """Return an estimate of the largest error of (t, q) that rounding to 32 bits causes at any
    section, relative to the scales.

    Lanes near the cycle flow from every section to the next in both precisions. The differences
    are the errors that one section adds: a mean (of rounded parameters, for instance) and a
    scatter. Both accumulate under the section maps, which are fitted to the same lanes. Infinity if
    lanes do not arrive.
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
    return _accumulated(np.array(maps), added)


def _accumulated(maps: Float[np.ndarray, "N n n"], added: Float[np.ndarray, "L N n"]) -> float:
    """Return the largest error if section k adds a draw of `added` to the image of earlier errors
    under its map (rows of states times `maps[k]`)."""
    mean = added.mean(axis=0)
    scatter = [np.atleast_2d(np.cov(x.T)) for x in np.swapaxes(added, 0, 1)]

    def period(bias, cov):
        for J, m, c in zip(maps, mean, scatter, strict=True):
            bias, cov = bias @ J + m, J.T @ cov @ J + c
            yield bias, cov

    M = functools.reduce(np.matmul, maps)
    *_, (bias, cov) = period(np.zeros(len(M)), np.zeros(M.shape))
    for _ in range(_DOUBLINGS):
        bias, cov, M = bias + bias @ M, cov + M.T @ cov @ M, M @ M
    sizes = (2 * np.abs(b) + _LARGEST * np.sqrt(np.diag(c)) for b, c in period(bias, cov))
    return max(float(size.max()) for size in sizes)


@quick_jit
def _sections(
    placed: PlacedSections, plan: Plan, settings: Settings, start: Float[Array, "n L"]
) -> Float[Array, "n L"]:
    """Return the next section's (t, q) of lanes from sections 0, 1, ..., N-1, 0, ...; else NaN."""
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
