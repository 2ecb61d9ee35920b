"""What the limit cycle teaches about the way from each section to the next.

A plan serves prediction, step lengths and error estimates, not control flow: lanes that go another
way than the cycle are integrated just as well, only perhaps in more steps.
"""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._core.compile import quick_jit
from .._core.memo import Memory
from .._core.results import Result
from ..engine.move import move
from ..engine.settings import Settings
from ..engine.stride import Stride
from ..engine.watch import watch
from ..errors import DefinitionError
from ..maps.place import PATIENCE
from ..maps.placed import PlacedSections
from ..systems.structure import Structure


# Ways to go that are tried for each section, the cheapest first: by so many equal steps, or by
# steps whose error estimate is at most this part of the tolerance.
_PIECES = (1, 2, 3, 4, 6, 8)
_PARTS = (1.0, 1e-2, 1e-4)
# The reference, and the differences that give the sensitivities.
_TIGHT, _NUDGE = 1e-13, 1e-6
# Room for the way to a level, which takes longer in some lanes than on the cycle.
_ROOM = 1.25
# A step may have this many times its error estimate on the cycle, where the accuracy allows it.
_SLACK = 10.0
# Turns over which errors are followed; the rest is a geometric series.
_TURNS = 8
# Estimates are this many times the error that accumulates on the cycle, and credit is given for
# cancellation up to a factor.
_CAUTION, _CANCEL = 3.0, 30.0
# Errors per section that are taken for granted, relative to the states' scales.
_ROUNDING = 1e-15


class Plan(eqx.Module):
    """How to go from section k to the next, for k = 0..N-1.

    **Fields:**

    - `h`: first step; `lead`, `slack`: see `flow.stride.Stride`.
    - `weight`: true error per embedded error estimate (relative to the tolerance), measured on the
        cycle and relative to the states' scales: the largest that it ever leads to at a later
        section, summed over all turns as if each made the same error.
    """

    h: Float[Array, " N"]
    lead: Float[Array, " N"]
    slack: Float[Array, " N"]
    weight: Float[Array, " N"]

    def stride(self, k, lanes: int) -> Stride:
        """How `lanes` lanes set out from section k."""
        fill = lambda x: jnp.full(lanes, x[k])  # noqa: E731
        return Stride(fill(self.h), fill(self.lead), fill(self.slack))


def make_plan(
    placed: PlacedSections, settings: Settings, accuracy: float, scale: Float[np.ndarray, "N n"]
) -> Plan:
    """Find the cheapest way between sections that keeps the accuracy asked for.

    **Arguments:** `accuracy` of (t, q) at every later section, relative to `scale`.
    """
    N = placed.n_sections
    ways = jax.device_get(_try_ways(placed, settings, jnp.asarray(scale)))
    K = len(ways.estimate)
    exact = ways.ends[:, K]
    J = np.transpose((ways.ends[:, K + 1 :] - exact[:, None]) / _NUDGE, (2, 0, 1))
    J = J / scale[:, None, :]
    J[~np.asarray(placed.time_is_state), :, 0] = 0.0
    error = np.transpose(ways.ends[:, :K] - exact[:, None], (1, 2, 0))
    if not placed.cycle.clocked:
        error[..., 0] = 0.0
    impact = np.maximum(_impact(J, error, scale), _ROUNDING)
    impact = np.where(np.isnan(impact), np.inf, impact)
    estimate = np.maximum(ways.estimate, 1e-6)

    # The largest share of the accuracy for each section that keeps their sum.
    section = np.arange(N)
    for share in accuracy * 0.5 ** np.arange(0, 4 + N.bit_length()):
        best = _cheapest(impact, share)
        total = impact[best, section].sum()
        if total <= accuracy:
            break
    spare = np.clip(accuracy / total, 1e-6, _SLACK)
    impact, estimate = impact[best, section], estimate[best, section]
    # Errors of different sections cancel in part, in experiments almost as they do on the cycle.
    together = _CAUTION * _accumulated(J, error[best, section], scale) / impact.sum()
    weight = impact / estimate * np.maximum(together, 1 / _CANCEL)
    # Lanes that are not on the cycle may use a section's share of the accuracy in any case.
    share = np.minimum(accuracy * estimate / impact, 1.0) / N
    slack = np.where(best < len(_PIECES), np.maximum(spare * estimate, share), ways.slack[best])
    return Plan(*map(jnp.asarray, (ways.first[best, section], ways.lead, slack, weight)))


class _Ways(NamedTuple):
    """What was tried from every section to the next."""

    ends: Float[Array, "n B N"]
    """(t, q) after each of K ways to go, after the reference, and after it from starts that are
    nudged in each coordinate; NaN for those that do not arrive."""
    estimate: Float[Array, "K N"]
    """Error estimates of the ways to go, relative to the tolerance."""
    first: Float[Array, "K N"]
    """Their first steps."""
    slack: Float[Array, " K"]
    lead: Float[Array, " N"]


@quick_jit
def _try_ways(placed: PlacedSections, settings: Settings, scale: Float[Array, "N n"]) -> _Ways:
    N, n = scale.shape
    K = len(_PIECES) + len(_PARTS)
    patience = max(settings.max_steps, PATIENCE)
    following, _, target = placed.onwards()
    lead = _lead(placed, target)
    by_level = jnp.isinf(placed.bound.time[following]) & (placed.bound.event[following] < 0)
    longest = placed.duration * jnp.where(by_level, _ROOM, 1 + 1e-9)

    # Blocks of N lanes: K candidates, the reference, and one for each coordinate of (t, q).
    nudge = _NUDGE * scale.T[None] * np.eye(n)[:, :, None]
    nudge = jnp.concatenate([np.zeros((K + 1, n, N)), nudge])
    divide = np.array([*_PIECES, *[_PIECES[-1]] * len(_PARTS), *[2] * (1 + n)])
    slack = np.array([*[np.inf] * len(_PIECES), *_PARTS, *[1.0] * (1 + n)])
    by_estimate = np.isfinite(slack) & (np.arange(len(slack)) < K)
    rtol = jnp.where(by_estimate, settings.rtol, _TIGHT)
    s = Structure(placed.cycle.system)
    u = jnp.zeros((s.nu, N))

    def block(xs):
        nudge, divide, slack, rtol = xs
        moved_to = placed.lanes.t + nudge[0], placed.lanes.q + nudge[1:]
        lanes = eqx.tree_at(lambda x: (x.t, x.q), placed.lanes, moved_to)
        start = Stride(longest / divide, lead, jnp.full(N, slack))
        tolerance = Settings(rtol, settings.atol * rtol / settings.rtol, patience)
        moved = move(s, lanes, u, target, tolerance, start)
        ends = jnp.concatenate([moved.lanes.t[None], moved.lanes.q])
        return jnp.where(moved.result == Result.OK, ends, jnp.nan), moved.error

    ends, error = jax.lax.map(block, (nudge, jnp.asarray(divide), jnp.asarray(slack), rtol))
    estimate = error[:K] * (rtol[:K, None] / settings.rtol)
    first = longest / divide[:K, None]
    return _Ways(jnp.moveaxis(ends, 0, 1), estimate, first, jnp.asarray(slack[:K]), lead)


def _cheapest(impact: Float[np.ndarray, "K N"], share: float) -> Int[np.ndarray, " N"]:
    """The first candidate of each section whose impact is at most `share`, or the best one."""
    enough = impact <= share
    return np.where(enough.any(axis=0), np.argmax(enough, axis=0), np.argmin(impact, axis=0))


def _lead(placed: PlacedSections, target):
    """Time to the next level as a multiple of Newton's guess; 1 where that makes no sense."""
    s, lanes = Structure(placed.cycle.system), placed.lanes
    N = placed.n_sections
    everywhere = jnp.ones(N, bool)
    seen = watch(s, lanes.t, lanes.chart, lanes.q, jnp.zeros((s.nu, N)), target, everywhere)
    value, rate = seen.value[-1], seen.rate[-1]
    falls = (value > 0) & (rate < 0)
    lead = placed.duration * jnp.where(falls, -rate / jnp.where(falls, value, 1.0), 0.0)
    return jnp.where((lead > 0.3) & (lead < 3.0), lead, 1.0)


def _impact(J, error, scale) -> Float[np.ndarray, "K N"]:
    """Where errors made on the way from section k (K, N, n) lead to, relative to the scales."""
    N = len(scale)
    section, worst = np.arange(N), np.zeros((_TURNS, *error.shape[:2]))
    for m in range(_TURNS * N):
        at = (section + 1 + m) % N
        now = worst[m // N]
        np.maximum(now, np.max(np.abs(error) / scale[at], axis=-1), out=now)
        error = np.einsum("kij,ckj->cki", J[at], error)
    last, before = worst[-1], worst[-2]
    ratio = np.clip(last / np.where(before > 0, before, 1.0), 0.0, 0.999)
    return worst.sum(axis=0) + last * ratio / (1 - ratio)


def _accumulated(J, error, scale) -> float:
    """The largest error, relative to the scales, when every section makes its `error` (N, n)."""
    N = len(scale)
    total, largest = np.zeros(scale.shape[1]), 0.0
    for m in range(_TURNS * N):
        total = J[m % N] @ total + error[m % N]
        largest = max(largest, np.max(np.abs(total) / scale[(m + 1) % N]))
    return largest


def section_scales(placed: PlacedSections, scale: Mapping[str, float] | None) -> np.ndarray:
    """Scales (N, 1 + d) of time and states at the sections: the largest size on the cycle."""
    s = Structure(placed.cycle.system)
    chart, q = np.asarray(placed.lanes.chart), np.abs(np.asarray(placed.lanes.q))
    given = dict(scale or {})
    out = np.ones((placed.n_sections, 1 + s.d))
    out[:, 0] = given.pop("t", float(placed.cycle.period))
    for name in s.state_names():
        places = [(a, c.states.index(name)) for a, c in enumerate(s.charts) if name in c.states]
        size = max((q[k, chart == a].max(initial=0.0) for a, k in places), default=0.0)
        size = given.pop(name, size if size > 0 else 1.0)
        for a, k in places:
            out[chart == a, 1 + k] = size
    if given or not np.all(out > 0) or not np.all(np.isfinite(out)):
        raise DefinitionError(
            "`scale` gives positive sizes of states, by name, and of time, as t; states are "
            f"{', '.join(s.state_names())}. Got {scale}."
        )
    return out


class Planned(NamedTuple):
    """A plan, and what it was made from."""

    plan: Plan
    settings: Settings
    scales: Float[np.ndarray, "N n"]


_made = Memory()


def check_accuracy(accuracy: float) -> None:
    """**Raises:** `DefinitionError` for an accuracy that no plan has."""
    if not 1e-13 <= accuracy <= 1e-2:
        raise DefinitionError(f"accuracy lies between 1e-13 and 1e-2, not at {accuracy}.")


def plan_flow(
    placed: PlacedSections, accuracy: float, scale: Mapping[str, float] | None = None
) -> Planned:
    """The plan for placed sections; made once for each accuracy and scale.

    **Raises:** `DefinitionError` for an accuracy out of range, or scales of unknown states.
    """
    check_accuracy(accuracy)

    def make() -> Planned:
        scales = section_scales(placed, scale)
        settings = Settings(rtol=accuracy, atol=accuracy * scales[:, 1:].min(), max_steps=PATIENCE)
        plan = make_plan(placed, settings, accuracy, scales)
        return Planned(plan, settings, scales)

    return _made.recall(placed, (float(accuracy), tuple(sorted((scale or {}).items()))), make)
