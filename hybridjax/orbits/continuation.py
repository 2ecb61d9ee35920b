"""Continuation: a limit cycle followed along a parameter, by pseudo-arclength.

H. B. Keller, Numerical solution of bifurcation and nonlinear eigenvalue problems, 1977; Yu. A.
Kuznetsov, Elements of applied bifurcation theory, 3rd ed., Springer 2004, Ch. 10 (test functions).
"""

from typing import Annotated, NamedTuple

import equinox as eqx
import jax
import numpy as np
from scipy.optimize import brentq

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, Numbers, Share
from .._core.boundary.values import Reals
from .._core.executor import is_traced
from .._core.precision import require_x64
from .._core.progress import say, working
from .._core.results import Result
from ..errors import DefinitionError
from .batches import front
from .branch import KINDS, Branch, BranchEnd, BranchPoint
from .coincidence import coincident
from .curve import Curve, Failure, Point
from .cycle import LimitCycle
from .limit_cycles import LimitCycles, without_coincidences


# A step is halved if the tangent turns by more than the angle of this cosine. (Twice the angle:
# about half as many points.)
_STRAIGHT = 0.97
# The next step is longer if Newton needs at most this many. Doubled, it almost always is.
_QUICK = 3
# Where to look for a point instead, as parts of a step: beside a crossing of two branches.
_ASIDE = (0.0, 1e-6, -1e-6, 1e-4, -1e-4, 1e-2, -1e-2)
# Test functions below this are rounding errors. Doubled, points twice as close to a degenerate one
# are not marked.
_ROUNDING = 1e-7
# The first step, relative to the longest. Doubled, a branch is sometimes lost in its first step.
_FIRST = 0.2
# The shortest step, relative to the longest. Doubled, branches end twice as far from a grazing.
_SHORTEST = 1e-5


@checked
@working("continuation")
def continuation(
    cycle: LimitCycle,
    parameter: str,
    values: Annotated[Numbers, Reals("n")],
    *,
    step: Share = 0.05,
    max_points: Count = 1000,
) -> Branch:
    """Follow a limit cycle along a parameter, and mark where its stability changes.

    The branch is traced from the cycle both ways, until the first and the last of the values, by
    pseudo-arclength: it may turn back in between. Points at which a multiplier crosses the unit
    circle are located to rounding errors. Stable or not makes no difference.

    ```python
    branch = hj.continuation(hj.find_limit_cycle(buck), "Vin", (20.0, 26.0))
    hj.plot.branch(branch, output="v")
    ```

    **Arguments:**

    - `cycle`: where to begin. Its own value of the parameter lies within the values.
    - `parameter`: the name of a parameter of the system; a part of a part has a path with dots,
        such as `"leg.k"`.
    - `values`: two or more numbers, ascending or descending, from where to where. The branch has
        a cycle at each of them, as often as it passes it, and others in between.
    - `step`: the longest step, as a part of the range of values and of the size of the states.
    - `max_points`: give up after so many cycles each way.

    **Returns:** a `Branch`. Nothing is raised where it ends before the values do: `ends` says why
    (an event that grazes, is lost or comes out of order; no convergence even in the shortest step;
    rest in place of a cycle).

    **Raises:** `DefinitionError` for a parameter that does not exist, values without order, or a
    cycle that was not found or lies outside of them.
    """
    values = _check(cycle, values)
    curve = Curve(cycle, parameter, float(np.ptp(values)))
    own = curve.value_of(cycle.system)
    low, high = values.min(), values.max()
    if not low <= own <= high:
        raise DefinitionError(
            f"the cycle has {parameter} = {own:.6g}, outside of the values {values[0]:.6g} to "
            f"{values[-1]:.6g}: begin within them."
        )
    first = curve.first(own)
    if isinstance(first, Failure):
        raise DefinitionError(
            f"the cycle given is none of {type(cycle.system).__name__} at {parameter} = {own:.6g}: "
            f"{first.result.message}. Find it anew."
        )
    sense = np.sign(values[-1] - values[0])
    ways = []
    for sign in (-sense, sense):
        trace = _Trace(curve, np.sort(values), step, max_points)
        ways.append(trace.run(first.oriented(sign)))
    (back, marks_back, begin), (ahead, marks, end) = ways
    points = [*back[:0:-1], *ahead]
    shift = len(back) - 1
    marks = [(shift - k, kind) for k, kind in reversed(marks_back)] + [
        (shift + k, kind) for k, kind in marks
    ]
    cycles = _stack(curve, points)
    marked = tuple(
        BranchPoint(kind, k, points[k].value, cycles[k].multipliers) for k, kind in marks
    )
    return Branch(parameter, np.array([p.value for p in points]), cycles, marked, (begin, end))


def _check(cycle, values) -> np.ndarray:
    if is_traced(cycle):
        raise DefinitionError(
            "a branch is followed where values are known: call `continuation` outside of "
            "JAX transformations, and differentiate `find_limit_cycle` at its points."
        )
    require_x64(cycle)
    if int(cycle.result) != Result.OK:
        raise DefinitionError(
            f"the cycle to follow was not found: {Result(int(cycle.result)).message}."
        )
    steps = np.diff(np.asarray(values))
    if not len(steps) or abs(np.sign(steps).sum()) < len(steps):
        raise DefinitionError(
            f"the values must be two or more numbers, ascending or descending; got {values}."
        )
    return np.asarray(values)


class _Event(NamedTuple):
    """Something on a segment of the curve: `where` of its length."""

    where: float
    kind: str
    point: Point


class _Trace:
    """One way along the curve."""

    def __init__(self, curve: Curve, values: np.ndarray, step: float, max_points: int):
        self.curve, self.values = curve, values
        self.step, self.max_points = step, max_points

    def run(self, start: Point) -> tuple[list[Point], list[tuple[int, str]], BranchEnd]:
        """The points, the marks (row, kind) among them, and why they end."""
        points, marks, length, moved = [start], [], _FIRST * self.step, None
        low, high = self.values[0], self.values[-1]
        if (start.value >= high and start.tangent[-1] > 0) or (
            start.value <= low and start.tangent[-1] < 0
        ):
            return points, marks, BranchEnd(start.value, Result.OK, "the values end")
        while len(points) < self.max_points:
            here = points[-1]
            say(f"{self.curve.parameter} = {here.value:.5g}, {len(points)} cycles")
            there = self.curve.step(here, length)
            over = not isinstance(there, Failure) and not low <= there.value <= high
            if over:
                there = self.curve.land(here, there, np.clip(there.value, low, high))
            if not isinstance(there, Failure) and there.cosine(here) < _STRAIGHT:
                there = Failure(Result.NOT_CONVERGED)
            if isinstance(there, Failure):
                length /= 2
                if length >= _SHORTEST * self.step:
                    continue
                if there.result in (Result.EVENT_ORDER, Result.GRAZING) and here is not moved:
                    moved = self.curve.elsewhere(here)
                    if moved is not None:
                        points[-1], length = moved, _FIRST * self.step
                        continue
                return points, marks, BranchEnd(here.value, there.result, there.result.message)
            for event in self.events(here, there):
                if event.kind:
                    marks.append((len(points), event.kind))
                points.append(event.point)
            points.append(there)
            if over:
                return points, marks, BranchEnd(there.value, Result.OK, "the values end")
            length = min(self.step, length * (1.5 if there.steps <= _QUICK else 1.0))
        end = BranchEnd(
            points[-1].value, Result.STEP_LIMIT, f"{self.max_points} cycles; `max_points` raises it"
        )
        return points, marks, end

    def events(self, here: Point, there: Point) -> list[_Event]:
        """Marked points and values between two neighbors, in order."""
        found = []
        for kind in KINDS:
            before, after = here.tests[kind], there.tests[kind]
            if max(abs(before), abs(after)) < _ROUNDING:
                continue
            if before * after >= 0 or (kind == "branch point" and here.folds_before(there)):
                continue
            event = self.locate(here, there, kind)
            if event is not None:
                found.append(event)
        found.sort(key=lambda event: event.where)
        events, before = [], here
        for event in [*found, _Event(1.0, "", there)]:
            events += self.landings(before, event.point) + [event]
            before = event.point
        return events[:-1]

    def landings(self, a: Point, b: Point) -> list[_Event]:
        """Points at the values that the parameter passes between two neighbors."""
        passed = [v for v in self.values if (a.value - v) * (b.value - v) < 0]
        passed.sort(key=lambda v: abs(v - a.value))
        points = [self.curve.land(a, b, v) for v in passed]
        return [_Event(0.0, "", p) for p in points if not isinstance(p, Failure)]

    def locate(self, here: Point, there: Point, kind: str) -> _Event | None:
        """The zero of a test function between two points.

        Where two branches cross no point can be found on the crossing itself, but beside it.
        """
        seen, crossing = {0.0: here, 1.0: there}, False

        def test(where):
            nonlocal crossing
            if where not in seen:
                for aside in _ASIDE:
                    seen[where] = self.curve.between(here, there, where + aside)
                    if not isinstance(seen[where], Failure):
                        break
                else:
                    raise ArithmeticError
                crossing |= aside != 0
            return seen[where].tests[kind]

        try:
            where = brentq(test, 0.0, 1.0, xtol=1e-13, rtol=1e-14, maxiter=60)
            test(where)
        except (ArithmeticError, RuntimeError):
            return None
        point = seen[where]
        if kind == "Neimark-Sacker" and not point.has_pair_on_circle():
            return None  # two real multipliers with the product 1
        return _Event(where, "branch point" if crossing else kind, point)


def _stack(curve: Curve, points: list[Point]) -> LimitCycles:
    """The points as cycles."""
    cycle, stack = curve.cycle, lambda *x: np.stack([np.asarray(y) for y in x])
    systems = [eqx.filter(curve.system_at(p.value), eqx.is_array) for p in points]
    systems = eqx.combine(jax.tree_util.tree_map(stack, *systems), cycle.system)
    anchor, turn = jax.tree_util.tree_map(stack, *((p.departure, p.turn) for p in points))
    cycles = LimitCycles(
        systems, cycle.base, turn.period, anchor, turn.legs, turn.factors, turn.distance,
        np.array([p.steps for p in points]), np.zeros(len(points), np.int32),
        front(turn.codes.reshape(len(points), -1)), cycle.settings, cycle.conserved,
        cycle.multiplicity,
    )  # fmt: skip
    together = [coincident(cycle.return_map, p.turn) is not None for p in points]
    return without_coincidences(cycles, np.array(together))
