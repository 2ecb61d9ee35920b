"""Location of events: steps that land on the zero of a watched function."""

from typing import NamedTuple

from ..._core.executor import namespace
from ..._core.lanes import pick
from ..arrays import Mask, States, Times
from ..cubic import root_near_end
from ..events import INSTANT
from ..runge_kutta import Step
from ..watch import ChartFlow, Watch
from .state import Aim


# A lane lands if its crossing is nearer to the end of the step than this part of its length,
# measured from its expected time. Higher: a method of order 4 goes further, and more landings are
# rejected as too inaccurate. Lower: more steps until a lane lands.
_LANDING_REACH = 0.25
# A landing is accurate to this part of the step: its last correction is at most as large (or lasts
# no longer than an instant), and it lies no farther beyond the step in which the crossing was met.
# Corrections square their error. Higher: a crossing is off by more than a replay corrects to
# rounding. Lower: landings are repeated.
LANDING = 1e-6
# Attempts to land on a crossing before the step in which it was met is halved. Higher: they cost
# time where the cubic interpolant is no guide to the crossing. Lower: steps are halved too early.
LANDING_TRIES = 8


class Landing(NamedTuple):
    """Ends of steps, of lanes that land on the zero itself."""

    q: States
    f: States
    past: Times
    """Time from the end of the step to the zero, as far as is known."""
    lands: Mask
    error: Times
    """Error of the way from the step's end to the zero, relative to the tolerance."""


def land(
    flow: ChartFlow, before: Watch, step: Step, allowed: States, t: Times, aim: Aim, span: Times
) -> Landing:
    """The zero of the function aimed at, before or beyond the end of a step from t.

    `before` are the watched functions at its start, `allowed` the errors that it may have.
    """
    xp, tau, which = namespace(t), aim.step, aim.which
    after = flow.watch(t + tau, step.q, step.f1)
    v0, r0, v1, r1 = (pick(x, flow.rows, which) for x in (*before, *after))
    by_cubic = tau * (root_near_end(v0, v1, tau * r0, tau * r1) - 1)
    by_newton = -v1 / xp.where(r1 == 0, 1.0, r1)
    # (The cubic between the ends of a very short step is a worse guess than Newton's.)
    first = xp.where(tau > 1e-3 * aim.reach, by_cubic, by_newton)
    near = (which >= 0) & (xp.abs(first) <= aim.reach)
    first = xp.where(near, first, 0.0)
    end = flow.locate(t + tau, step.q, step.f1, which, first)
    share = xp.abs(first) / xp.where(aim.reach > 0, aim.reach, 1.0)
    error = xp.max(end.error / allowed * xp.where(share > 0, share, 0.0) ** 2, axis=0)
    fine = xp.abs(end.last) <= LANDING * xp.abs(tau + end.past) + INSTANT * span
    lands = near & fine & (share <= _LANDING_REACH) & (xp.abs(error) <= 1.0)
    return Landing(
        xp.where(lands, end.q, step.q),
        xp.where(lands, end.f, step.f1),
        xp.where(near, end.past, by_newton),
        lands,
        xp.where(lands, xp.abs(error), 0.0),
    )
