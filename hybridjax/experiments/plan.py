"""Step schedules from section to section, computed in advance on the limit cycle.

`run.py` calls `plan_flow(placed, accuracy)` once for all experiments, and gets a `Stepping`: the
tolerances and a `Plan`. The plan has, for each section, the length of the first step and how large
error estimates of steps may be. It also converts error estimates of steps to errors of the outputs
(`weight`). `make_plan` tries several *candidates* for each section (numbers of equal steps, or
tolerances), on the cycle and near it, and takes the cheapest ones that keep the accuracy.

A plan does not decide on events: experiments that leave the cycle are integrated as accurately,
perhaps in more steps. Estimates of steps are relative to the tolerance, and errors to the states'
scales: `response.py` and `passage.py` rely on both, and this must stay so.

If `ExperimentData.error` is wrong, look at `_impact` and `_accumulated`; if experiments take too
many steps, at `_cheapest` (which candidate) and at `slack` in `make_plan` (how large estimates may
be); if no candidate arrives, at `_try_ways`.
"""

import contextlib
import dataclasses
from typing import Annotated, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from .._core.boundary.values import Number
from .._core.compilation import at_ease, host_first
from .._core.executor import (
    Array,
    from_host,
    is_inside_program,
    is_traced,
    namespace,
    to_host,
)
from .._core.memo import Memory
from .._core.results import Result
from ..engine.lanes import IDLE
from ..engine.move import Options, move, tape_jacobian
from ..engine.search.state import Stride
from ..engine.settings import Settings
from ..engine.watch import watch
from ..errors import ComputationError
from ..orbits.return_map import PATIENCE
from ..orbits.scale import has_implicit
from ..sections.placed import PlacedSections


# Candidates for each section, the cheapest first: these numbers of equal steps; then steps whose
# error estimate is at most these parts of the tolerance. Fewer: more steps than needed. More: plans
# take longer to make.
_EQUAL_STEPS = (1, 2, 3, 4, 6, 8)
_TOLERANCES = (1.0, 1e-2, 1e-4)
# In charts with implicit methods, inputs excite modes that die out within a step. Steps are
# therefore also tried at deviations of these two sizes, relative to the states' scales. A larger
# first number: steps are shorter than experiments need. Smaller: experiments far from the cycle
# take more steps. At the second one, errors on the cycle hide such a mode; with a larger distance
# between the two, sizes in between are not tried.
_KICKS = (1e-3, 1e-6)
# Tolerance of the reference solution, and least error at a section, relative to the states' scales.
# Larger: small errors are estimated wrongly. Smaller: rounding errors exceed estimates.
ROUNDING = 1e-13
# Equal steps suffice for experiments whose way to a section takes up to this many times as long as
# on the cycle. Smaller: more experiments need one step more. Larger: steps are longer than planned.
_ROOM = 1.25
# Steps of experiments may have up to this many times the error estimate of the step on the cycle,
# if the accuracy allows it. Smaller: experiments far from the cycle take more steps. Larger: their
# errors grow.
_MOST_SLACK = 10.0
# Periods over which errors are propagated; a geometric series stands for all later ones. Fewer:
# errors are underestimated for multipliers near the unit circle. More: plans take longer to make.
_PERIODS = 8
# Safety factor of error estimates. Smaller: experiments far from the cycle exceed their estimates.
# Larger: `ExperimentData.error` is pessimistic.
_CAUTION = 3.0
# Errors of different sections partly cancel. Estimates assume that this makes the sum smaller by at
# most this factor. Larger: estimates are too small if errors cancel on the cycle only. Smaller:
# estimates are pessimistic.
_MOST_CANCELLATION = 30.0
# Least error estimate of a step, relative to the tolerance. Smaller: weights of steps without error
# overflow. Larger: the errors of accurate steps are overestimated.
_LEAST_SHARE = 1e-6
# Newton's guess of the time to the next section is used if it is wrong by less than this factor.
# Larger: bad guesses set the length of the last step. Smaller: good guesses are not used.
_WORST_GUESS = 3.0

Accuracy = Annotated[
    float, Number("a number from 1e-13 to 0.01", low=ROUNDING, high=1e-2)
]
"""Accuracies that may be asked for, relative to the states' scales. Below the least, rounding
errors are larger. Above the largest, errors on the cycle differ from those of experiments near
it."""


class Plan(eqx.Module):
    """Step schedule from section k to the next, for k = 0..N-1.

    **Fields:**

    - `h`: first step. `lead`: time to section k + 1 as a multiple of Newton's guess at section k.
    - `slack`: a step's error estimate may be this many times the tolerance.
    - `weight`: true error per embedded error estimate (relative to the tolerance), measured on the
      cycle and relative to the states' scales: it is the largest error that the step causes at any
      later section, if each period makes the same error.
    - `least`: least error estimate, for experiments in charts with implicit methods whose steps
      seem to have no error.
    """

    h: Float[Array, " N"]
    lead: Float[Array, " N"]
    slack: Float[Array, " N"]
    weight: Float[Array, " N"]
    least: Float[Array, ""]

    def stride(self, k: int | Int[Array, ""], lanes: int) -> Stride:
        """Return the first step and its limits at section k, for a number of experiments
        (lanes)."""

        def fill(x):
            return jnp.full(lanes, x[k])

        return Stride(fill(self.h), fill(self.lead), fill(self.slack))


def make_plan(
    placed: PlacedSections,
    settings: Settings,
    accuracy: float,
    scale: Float[np.ndarray, "N n"],
) -> Plan:
    """Return the cheapest schedule that keeps the accuracy.

    **Arguments:** `accuracy`: largest error of (t, q) at every later section, relative to `scale`.

    **Raises:** `ComputationError` if no candidate reaches the next section.
    """
    placed = to_host(placed)
    *_, target = placed.onwards()
    assert placed.tape is not None
    # Jacobians of the flow from section to section, by which errors are propagated.
    with at_ease():
        J, _ = tape_jacobian(placed.structure(), placed.lanes, target, placed.tape)
    by_input = J[:, :, scale.shape[1] :]
    J = J[:, :, : scale.shape[1]]
    J[~placed.time_is_state, :, 0] = 0.0
    # Errors (K, M, N, n) of all candidates; the reference is the last of the ways.
    ways = to_host(_try_ways(placed, settings, _kicks(placed, by_input, scale)))
    reference = ways.ends[:, -1:]
    error = np.moveaxis(ways.ends[:, :-1] - reference, 0, -1)
    if not placed.cycle.clocked:
        error[..., 0] = 0.0

    # The candidate for each section.
    impacts = _impacts(ways, J, error, scale)
    largest = impacts.max(axis=1)
    _require_ways(largest)
    best, total = _cheapest(largest, accuracy)
    section = np.arange(placed.n_sections)
    # Errors of small deviations may be hidden by the errors on the cycle itself: `least` is a lower
    # bound of estimates, from both.
    least = np.zeros(())
    if ways.estimate.shape[1] > 1:
        after = np.roll(section, -1)
        off = ways.ends[1:, -1, 0] - placed.lanes.q[:, after]
        own = off / scale[after, 1:].T
        least = largest[best, section].sum() + np.abs(own).max()

    # The cycle itself comes first, and then the larger deviations.
    large = slice(1 + placed.structure().nu)
    impact = impacts[best, large, section].T
    estimate = np.maximum(ways.estimate, _LEAST_SHARE)[best, large, section].T
    # Errors of different sections partly cancel, in experiments almost as on the cycle.
    accumulated = _accumulated(J, error[best, 0, section], scale)
    together = _CAUTION * accumulated / impact[0].sum()
    weight = (impact / estimate).max(axis=0)
    weight = weight * np.maximum(together, 1 / _MOST_CANCELLATION)

    # Experiments may use a section's full share of the accuracy, even if the cycle itself has a
    # smaller error there.
    share = np.minimum(accuracy * estimate[0] / impact[0], 1.0)
    share = share / len(section)
    spare = np.clip(accuracy / total, _LEAST_SHARE, _MOST_SLACK)
    of_equal_steps = np.maximum(spare * estimate[0], share)
    slack = ways.slack[best]
    slack = np.where(np.isinf(slack), of_equal_steps, slack)
    return from_host(Plan(ways.first[best, section], ways.lead, slack, weight, least))


def _impacts(ways: "_Ways", J, error, scale) -> Float[np.ndarray, "K M N"]:
    """Return the largest later errors that each candidate causes from each start. The error is
    infinite if the candidate does not reach the next section, and 0 if even the reference does
    not."""
    impact = np.maximum(_impact(J, error, scale), np.finfo(float).eps)
    impact = np.where(np.isnan(impact), np.inf, impact)
    reference = ways.ends[0, -1]
    deviates = np.arange(len(reference))[:, None] > 0
    has_no_reference = np.isnan(reference) & deviates
    return np.where(has_no_reference, 0.0, impact)


def _require_ways(impact: Float[np.ndarray, "K N"]) -> None:
    """**Raises:** `ComputationError` if no candidate reaches the next section."""
    lost = ~np.isfinite(impact).any(axis=0)
    if lost.any():
        raise ComputationError(
            f"too many steps from section {int(np.argmax(lost))} to the next: place more sections, "
            "or find the cycle with `settings=Settings(max_steps=...)`."
        )


def _cheapest(
    impact: Float[np.ndarray, "K N"], accuracy: float
) -> tuple[Int[np.ndarray, " N"], float]:
    """Return a candidate for each section, and the sum of their later errors. They are the cheapest
    ones whose sum keeps the accuracy."""
    N = impact.shape[1]
    section = np.arange(N)
    most_accurate = np.argmin(impact, axis=0)
    for share in accuracy * 0.5 ** np.arange(0, 4 + N.bit_length()):
        enough = impact <= share
        first = np.argmax(enough, axis=0)
        best = np.where(enough.any(axis=0), first, most_accurate)
        total = impact[best, section].sum()
        if total <= accuracy:
            break
    return best, total


class _Ways(NamedTuple):
    """Candidates from every section to the next, on the cycle and for M - 1 deviations."""

    ends: Float[Array, "n B M N"]
    """(t, q) after each of K candidates and the reference; NaN for those that do not arrive."""
    estimate: Float[Array, "K M N"]
    """Error estimates of the candidates, relative to the tolerance."""
    first: Float[Array, "K N"]
    """First steps of the candidates."""
    slack: Float[Array, " K"]
    """As in `Plan`; infinite for candidates of equal steps."""
    lead: Float[Array, " N"]
    """As in `Plan`."""


def _kicks(placed: PlacedSections, by_input, scale) -> Float[np.ndarray, "M nu"]:
    """Return inputs that cause deviations. The first is zero; with implicit methods, each input
    follows at each of the sizes `_KICKS`."""
    s = placed.structure()
    nu = by_input.shape[2]
    if not has_implicit(s):
        return np.zeros((1, nu))
    time = 0 if placed.cycle.clocked else 1
    after = np.roll(scale, -1, axis=0)[:, :, None]
    relative = np.abs(by_input / after)[:, time:]
    largest = relative.max(axis=(0, 1))
    unit = np.divide(1.0, largest, where=largest > 0, out=np.zeros(nu))
    none = np.zeros((1, nu))
    kicks = [size * np.diag(unit) for size in _KICKS]
    return np.concatenate([none, *kicks])


@host_first
def _try_ways(
    placed: PlacedSections, settings: Settings, kicks: Float[Array, "M nu"]
) -> _Ways:
    """Run all candidates and the reference from every section to the next, on the cycle and under
    the inputs `kicks`, in one call: a lane for each."""
    s = placed.structure()
    xp = namespace(placed.lanes.t)
    N = placed.n_sections
    M = len(kicks)
    implicit = has_implicit(s)
    equal = () if implicit else _EQUAL_STEPS
    K = len(equal) + len(_TOLERANCES)
    most = _EQUAL_STEPS[-1]
    patience = max(settings.max_steps, PATIENCE)
    following, _, target = placed.onwards()
    lead = _lead(placed, target)
    by_level = xp.isinf(placed.bound.time[following])
    by_level = by_level & (placed.bound.event[following] < 0)
    longest = placed.duration * xp.where(by_level, _ROOM, 1 + 1e-9)

    # A lane for every section in each of K candidates and the reference.
    W = K + 1
    divide = np.array([*equal, *(most for _ in _TOLERANCES), 2])
    slack = np.array([*(np.inf for _ in equal), *_TOLERANCES, 1.0])
    by_estimate = np.isfinite(slack) & (np.arange(W) < K)
    rtol = xp.where(by_estimate, settings.rtol, ROUNDING)

    def all_ways(tree):
        return jax.tree_util.tree_map(lambda x: xp.tile(x, W * M), tree)

    def each(x):
        return xp.repeat(xp.asarray(x), M * N)

    lanes = all_ways(placed.lanes)
    per_lane = ("time", "index", "event", "limit")
    ends_of_lanes = {name: all_ways(getattr(target, name)) for name in per_lane}
    target = dataclasses.replace(target, **ends_of_lanes)
    start = Stride(all_ways(longest) / each(divide), all_ways(lead), each(slack))
    accuracy = each(rtol), each(settings.atol * rtol / settings.rtol)
    tolerance = Settings(1.0, 1.0, patience, settings.scale)
    tolerance = eqx.tree_at(lambda x: (x.rtol, x.atol), tolerance, accuracy)
    u = xp.tile(xp.repeat(kicks.T, N, axis=1), W)
    moved, tape = move(
        s, lanes, u, target, tolerance, start, options=Options(tape=implicit)
    )
    ends = xp.concatenate([moved.lanes.t[None], moved.lanes.q])
    arrives = moved.result == Result.OK
    ends = xp.where(arrives, ends, xp.nan)
    ends = ends.reshape(1 + s.d, W, M, N)
    tolerances = rtol[:K, None, None] / settings.rtol
    estimate = moved.error.reshape(W, M, N)[:K] * tolerances
    first = longest / divide[:K, None]
    if tape is not None:  # the first step that is accepted, or all the way
        accepted = xp.argmax(tape.code != IDLE, axis=0)[None]
        taken = xp.take_along_axis(tape.h, accepted, axis=0)
        shortest = taken.reshape(W, M, N)[:K].min(axis=1)
        first = xp.where(shortest < 0.9 * first, shortest, longest)
    return _Ways(
        ends=ends,
        estimate=estimate,
        first=first,
        slack=xp.asarray(slack[:K]),
        lead=lead,
    )


def _lead(placed: PlacedSections, target):
    """Return the time to the next level as a multiple of Newton's guess; 1 if the guess is bad."""
    s = placed.structure()
    lanes = placed.lanes
    N = placed.n_sections
    xp = namespace(lanes.t)
    watched = watch(
        s, lanes.t, lanes.chart, lanes.q, xp.zeros((s.nu, N)), target, xp.ones(N, bool)
    )
    value = watched.value[-1]
    rate = watched.rate[-1]
    falls = (value > 0) & (rate < 0)
    inverse_guess = xp.where(falls, -rate / xp.where(falls, value, 1.0), 0.0)
    lead = placed.duration * inverse_guess
    return xp.where((lead > 1 / _WORST_GUESS) & (lead < _WORST_GUESS), lead, 1.0)


def _impact(J, error, scale) -> Float[np.ndarray, "*K N"]:
    """Return the largest errors at later sections, relative to the scales, that errors (*K, N, n)
    of the intervals after the N sections cause."""
    N = len(scale)
    after = np.roll(scale, -1, axis=0)
    # (All errors of a section side by side: one product of matrices for each.)
    x = (error / after).reshape(-1, *scale.shape)
    x = x.transpose(1, 2, 0)
    J = J * scale[:, None] / after[:, :, None]
    section = np.arange(N)
    worst = np.zeros((_PERIODS, N, x.shape[2]))
    for m in range(_PERIODS * N):
        period = worst[m // N]
        largest = np.abs(x).max(axis=1)
        np.maximum(period, largest, out=period)
        x = J[(section + 1 + m) % N] @ x
    # Later periods continue the last two as a geometric series.
    *_, before, last = worst
    divisor = np.where(before > 0, before, 1.0)
    ratio = np.clip(last / divisor, 0.0, 0.999)
    later = last * ratio / (1 - ratio)
    total = worst.sum(axis=0) + later
    return total.T.reshape(error.shape[:-1])


def _accumulated(J, error, scale) -> float:
    """Return the largest error, relative to the scales, if all sections add `error` (N, n)."""
    N = len(scale)
    total = np.zeros(scale.shape[1])
    largest = 0.0
    for m in range(_PERIODS * N):
        total = J[m % N] @ total + error[m % N]
        relative = np.abs(total) / scale[(m + 1) % N]
        largest = max(largest, np.max(relative))
    return largest


class Stepping(eqx.Module):
    """Tolerances and step schedule from section to section.

    **Fields:**

    - `plan`: the schedule. `settings`: tolerances.
    - `scales`: of time (the period) and of states (`LimitCycle.scale`) at each section.
    - `accuracy`: bound on the error of (t, q) at every section, relative to the scales.
    """

    plan: Plan
    settings: Settings
    scales: Float[np.ndarray, "N n"]
    accuracy: float = eqx.field(static=True)


_made = Memory()


def plan_flow(placed: PlacedSections, accuracy: float) -> Stepping:
    """Return the plan for placed sections, made once for each accuracy."""

    def make() -> Stepping:
        cycle = placed.cycle
        patience = max(PATIENCE, cycle.settings.max_steps)
        settings = Settings(accuracy, accuracy, patience, cycle.settings.scale)
        time = np.full((placed.n_sections, 1), float(cycle.period))
        sizes = np.asarray(cycle.settings.scale)[np.asarray(placed.lanes.chart)]
        scales = np.concatenate([time, sizes], axis=1)
        plan = make_plan(placed, settings, accuracy, scales)
        return Stepping(
            plan=plan,
            settings=settings,
            scales=scales,
            accuracy=accuracy,
        )

    # A plan is no part of the program that JAX traces.
    inside = is_inside_program() and not is_traced(placed)
    with jax.ensure_compile_time_eval() if inside else contextlib.nullcontext():
        return _made.recall(placed, accuracy, make)
