"""One step of every lane, before it is accepted: where it leads, and how far it can be trusted."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._core.precision import at_precision
from ..systems.structure import Structure
from .aim import Aim
from .events import width
from .hermite import NEAR, control_points, root_near_end
from .lanes import Lanes, for_each_chart, only
from .settings import Settings
from .solver.step import Step, rk_step
from .target import Target
from .watch import Watch, chart_field, nothing, pick, settle, take, values, watched, write


# A crossing slower than this fraction of the function's rate elsewhere in the step is a grazing.
SLOW = 1e-5
# A step is too long for a watched function if halfway its cubic interpolant misses it by more than
# this fraction of its size.
_BEND = 2e-3
# A lane lands if its crossing is nearer to the end of the step than this fraction of its length,
_SHORT = 0.25
# and if the last correction is at most this fraction of the way from the step's start.
_FINE = 1e-6
# or at most this fraction of the time allowed, in double and in single precision.
_HERE = 1e-14, 5e-6
# The error of a derivative is seen by a step that starts aside, by this part of the state's size in
# a direction that no system is made for.
_ASIDE = 1e-4


class Attempt(NamedTuple):
    """A step of every lane."""

    q: Float[Array, "d L"]
    """The state at its end: on the zero that the lane aims at, if it lands."""
    seen: Watch
    """The watched functions there."""
    error: Float[Array, " L"]
    """Estimate of the step's error, relative to the tolerance."""
    past: Float[Array, " L"]
    """Time from the end of the step aimed for to the zero, as far as is known."""
    lands: Bool[Array, " L"]
    slow: Bool[Array, " L"]
    """The zero that the lane lands on is not crossed in falling, or at a vanishing speed."""
    bent: Bool[Array, " L"]
    """A watched function is not resolved by its cubic interpolant over the step.

    Step control looks at the states only; where those are simple, a guard may still turn many
    times within a step."""
    calm: Bool[Array, " L"]
    """No watched function comes near to a zero, save the one that the lane lands on."""


class _Home(NamedTuple):
    q: Array
    f: Array
    past: Array
    lands: Array
    rough: Array


def attempt(
    s: Structure,
    lanes: Lanes,
    seen: Watch,
    ready: Bool[Array, "W L"],
    mask: Bool[Array, " L"],
    aim: Aim,
    u: Float[Array, "nu L"],
    target: Target,
    settings: Settings,
    span: Float[Array, " L"],
    unroll: bool,
    in_step: bool,
    tangents: Bool[Array, ""] | bool,
) -> Attempt:
    """Let the lanes of `mask` step, and land those that come close to the zero they aim at.

    With `in_step`, all lanes are thought to go equally far from the same time, to no zero; then
    what depends on time only is computed once. With `tangents`, errors are also those of a
    derivative: where the state rests, it has none of its own.
    """
    L = lanes.t.shape[0]
    zero, no, yes = jnp.zeros(L), jnp.zeros(L, bool), jnp.ones(L, bool)
    empty = Attempt(lanes.q, nothing(s, L), zero, zero, no, no, no, yes)

    def work(a, here, out):
        n = s.dims[a]
        t, q, uu = only(here, lanes.t), only(here, lanes.q[:n]), only(here, u)
        tau = jnp.where(here, aim.step, 0.0)
        if in_step:
            t, tau = t[:1], aim.step[jnp.argmax(here)][None]
        some = here.any()
        step = jax.lax.cond(
            some,
            lambda: rk_step(chart_field(s, a, uu), t, q, tau, unroll),
            lambda: Step(q, q, q, q),
        )
        tolerance = settings.tolerance(a, q, step.q)
        error = jnp.max(jnp.abs(step.error) / tolerance, axis=0, initial=0.0)
        if tangents is not False:
            aside = _ASIDE * jnp.cos(1.0 + jnp.arange(n))[:, None] * tolerance / settings.rtol
            field = chart_field(s, a, uu)
            near = jax.lax.cond(
                some & tangents,
                lambda: rk_step(field, t, q + aside, tau, unroll).error,
                lambda: step.error,
            )
            change = jnp.max(jnp.abs(near - step.error) / tolerance, axis=0, initial=0.0) / _ASIDE
            error = jnp.maximum(error, jnp.where(jnp.isfinite(change), change, 0.0))
        finite = jnp.isfinite(step.q).all(axis=0) & ~jnp.isnan(error)
        error = jnp.where(finite, error, jnp.inf)
        if not watched(s, a, target):
            end = jnp.where(here, step.q, out.q[:n])
            return out._replace(q=out.q.at[:n].set(end), error=jnp.where(here, error, out.error))

        rows = watched(s, a, target)
        before = take(seen, rows)
        index, which = only(here, target.index), jnp.where(here, aim.which, -1)
        go = t, uu, index, tau, aim.reach, span
        home = _Home(step.q, step.f1, zero, no, zero)
        moved = tau
        if not in_step:
            home = jax.lax.cond(
                (which >= 0).any(),
                lambda: _go_home(s, a, target, rows, before, which, step, tolerance, *go),
                lambda: home,
            )
            moved = tau + jnp.where(home.lands, home.past, 0.0)
        value, rate = jax.lax.cond(
            some,
            lambda: values(s, a, target, t + moved, home.q, uu, index, home.f),
            lambda: before,
        )
        ends = before[0], value, moved * before[1], moved * rate

        middle = 0.5 * (q + home.q) + 0.125 * moved * (step.f0 - home.f)
        true, _ = values(s, a, target, t + 0.5 * moved, middle, uu, index, home.f)
        cubic = 0.5 * (ends[0] + ends[1]) + 0.125 * (ends[2] - ends[3])
        size = jnp.abs(ends[0]) + jnp.abs(ends[1]) + jnp.abs(true)
        rounding = width(t, span, jnp.maximum(jnp.abs(before[1]), jnp.abs(rate)))
        bent = (jnp.abs(true - cubic) > _BEND * size + rounding).any(axis=0)

        points = control_points(*ends)
        low = jnp.minimum(jnp.minimum(points[0], points[1]), jnp.minimum(points[2], points[3]))
        high = jnp.maximum(jnp.maximum(points[0], points[1]), jnp.maximum(points[2], points[3]))
        scale = jnp.maximum(jnp.abs(ends[0]), jnp.abs(ends[1]))
        own = (jnp.array(rows)[:, None] == which) & home.lands
        armed = jnp.stack([ready[row] for row in rows])
        far = jnp.where(armed, low > NEAR * scale, high <= 0)
        fastest = jnp.maximum(jnp.abs(ends[2]), jnp.abs(ends[0]))
        # (By rounding, the zero may lie a little before the start.)
        slow = (own & (jnp.abs(moved) * rate > -SLOW * fastest)).any(axis=0)
        return Attempt(
            out.q.at[:n].set(jnp.where(here, home.q, out.q[:n])),
            write(out.seen, rows, here, Watch(value, rate)),
            jnp.where(here, error + home.rough, out.error),
            jnp.where(here, home.past, out.past),
            jnp.where(here, home.lands, out.lands),
            jnp.where(here, slow, out.slow),
            jnp.where(here, bent, out.bent),
            jnp.where(here, (far | own).all(axis=0) & ~bent & ~slow, out.calm),
        )

    return for_each_chart(s, lanes.chart, mask, work, empty)


def _go_home(
    s, a, target, rows, before, which, step: Step, tolerance, t, u, index, tau, reach, span
) -> _Home:
    """From the end of a step onto the zero of `which`, on either side of it."""
    value, rate = values(s, a, target, t + tau, step.q, u, index, step.f1)
    v0, r0, v1, r1 = (pick(x, rows, which) for x in (*before, value, rate))
    by_cubic = tau * (root_near_end(v0, v1, tau * r0, tau * r1) - 1)
    by_newton = -v1 / jnp.where(r1 == 0, 1.0, r1)
    first = jnp.where(tau > 1e-3 * reach, by_cubic, by_newton)
    near = (which >= 0) & (jnp.abs(first) <= reach)
    first = jnp.where(near, first, 0.0)
    end = settle(s, a, target, t + tau, step.q, step.f1, u, index, which, first)
    share = jnp.abs(first) / jnp.where(reach > 0, reach, 1.0)
    rough = jnp.max(end.error / tolerance * jnp.where(share > 0, share, 0.0) ** 2, axis=0)
    rounding = at_precision(*_HERE) * span
    fine = jnp.abs(end.last) <= _FINE * jnp.abs(tau + end.past) + rounding
    lands = near & fine & (share <= _SHORT) & (jnp.abs(rough) <= 1.0)
    return _Home(
        jnp.where(lands, end.q, step.q),
        jnp.where(lands, end.f, step.f1),
        jnp.where(near, end.past, by_newton),
        lands,
        jnp.where(lands, jnp.abs(rough), 0.0),
    )
