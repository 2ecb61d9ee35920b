"""Continuation of a limit cycle in a parameter, by pseudo-arclength.

`continuation` is the public function: it follows a branch of cycles in both directions
(`_Trace.run`), marks bifurcations between points (`_Trace.locate`), and returns a `Branch`. Points
themselves are computed in `curve.py`, and the reason for an end is found in `branch_ends.py`. A
further kind of bifurcation is added to `Kind`, to `Point.tests` and to `_Trace.locate`. Points must
stay in their order along the branch: `_branch` cuts it at the first cycle that is refused.

A branch that jumps to another one has its cause in the length of steps (`_Trace._next`); one that
ends too early, in `Curve._correct` or in the verdicts (`_branch`); a bifurcation that is missed, in
`_Trace.between`; one of the wrong kind, in `_Trace.locate`.

H. B. Keller, Numerical solution of bifurcation and nonlinear eigenvalue problems, 1977; Yu. A.
Kuznetsov, Elements of applied bifurcation theory, 3rd ed., Springer 2004, Ch. 10 (test functions).
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple, SupportsIndex, get_args

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Complex, Float

from .._core.boundary.checked import checked, checked_methods, taken_parameters
from .._core.boundary.kinds import Count, Share, Vector
from .._core.boundary.members import leading_on
from .._core.html import COLORS, Curve as Line, card, picture, table
from .._core.memo import remembered
from .._core.precision import require_x64
from .._core.progress import say, working
from .._core.results import Result
from .._core.showable import Showable
from .._core.text import number
from ..errors import DefinitionError
from ..systems.system import Guess, copies_of, name_of, parameters_of, require_positive
from .batches import front
from .branch_ends import explained
from .coincidence import SAME
from .crossing import AtEvent
from .curve import Curve, Point
from .cycle import LimitCycle
from .find import find_limit_cycle
from .guess import is_default
from .limit_cycles import LimitCycles, examined, keep_turns
from .newton import USUAL_STEPS
from .return_map import SINGULAR
from .rivals import coincident
from .verdict import verdict


# A step is halved if the cosine of the angle between successive tangents is below this. Nearer to
# 1: more points than a plot needs. Smaller: the branch jumps over sharp bends.
_STRAIGHT = 0.97
# At a crossing of two branches Newton's method fails. A test function is then evaluated at a point
# nearby, at these distances (as parts of the step).
_ASIDE = (0.0, 1e-6, -1e-6, 1e-4, -1e-4, 1e-2, -1e-2)
# The shortest step, relative to the longest. Longer: the branch ends far from a grazing. Shorter:
# its end takes more time.
_SHORTEST = 1e-5

Kind = Literal["fold", "branch point", "flip", "Neimark-Sacker"]
KINDS: tuple[str, ...] = get_args(Kind)


@leading_on
class Bifurcation(NamedTuple):
    """A bifurcation: a point of a branch with a multiplier on the unit circle."""

    kind: str
    """"fold" (a multiplier +1: the branch turns back), "branch point" (+1: another branch crosses),
    "flip" (-1: a cycle of twice the period begins) or "Neimark-Sacker" (a complex pair)."""
    index: int  # type: ignore[assignment]  # (not the method of tuples)
    """Its row in the branch."""
    value: float
    """The value of the parameter."""
    multipliers: Complex[np.ndarray, " r"]
    """All multipliers of the cycle. The critical ones lie on the unit circle up to rounding."""

    @property
    def critical(self) -> Complex[np.ndarray, " c"]:
        """The multipliers on the unit circle."""
        off_circle = np.abs(np.abs(self.multipliers) - 1)
        return self.multipliers[off_circle < SAME]


@leading_on
class BranchEnd(NamedTuple):
    """The end of a branch, and the reason."""

    value: float
    """The value of the parameter."""
    result: Result
    """`Result.OK` at the end of the values."""
    message: str


@checked_methods
class Branch(Showable, eqx.Module):
    """Limit cycles along one parameter, in their order on the branch.

    **Fields:**

    - `parameter`: its name. `values` (K,): its values.
    - `cycles`: the K cycles; `branch[k]` is one of them, with its system.
    - `bifurcations`: points at which multipliers cross the unit circle, each a `Bifurcation`; it is
      also one of the K cycles (its `index`).
    - `ends`: the two ends of the branch, with their reasons.
    """

    parameter: str = eqx.field(static=True)
    values: Float[np.ndarray, " K"]
    cycles: LimitCycles
    bifurcations: tuple[Bifurcation, ...]
    ends: tuple[BranchEnd, BranchEnd]

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, k: SupportsIndex) -> LimitCycle:
        return self._each[k]

    @remembered
    def _each(self) -> tuple[LimitCycle, ...]:
        """The cycles. Each call returns the same objects, which remember what was computed from
        them."""
        return tuple(self.cycles[k] for k in range(len(self)))

    @remembered
    def multipliers(self) -> Complex[np.ndarray, "K r"]:
        """Floquet multipliers of every cycle, by decreasing modulus, padded with zeros."""
        rows = [self[k].multipliers for k in range(len(self))]
        width = max(map(len, rows))
        padded = []
        for row in rows:
            missing = width - len(row)
            padded.append(np.pad(row.astype(complex), (0, missing)))
        return np.array(padded)

    @remembered
    def stable(self) -> Bool[np.ndarray, " K"]:
        """True for each stable cycle. At a bifurcation itself rounding decides."""
        if self.cycles.conserved:
            return np.array([cycle.is_stable for cycle in self._each])
        # (By the product of the factors: its rounding errors are small compared to 1.)
        within = np.abs(self.cycles.multipliers) < 1
        return np.array([each.all() for each in within])

    def largest(self, output: str) -> Float[np.ndarray, " K"]:
        """The largest value of a state or output on each cycle, as accurate as a plot needs.

        **Raises:** `DefinitionError` for a name that does not exist.
        """
        return np.array(
            [np.nanmax(self[k].trajectory()(output)[1]) for k in range(len(self))]
        )

    def summary(self) -> str:
        """One line for each bifurcation and each end."""
        begin, end = self.ends
        lines = [f"from {self.parameter} = {begin.value:.9g}: {begin.message}"]
        for p in self.bifurcations:
            at = ", ".join(map(number, p.critical))
            lines.append(
                f"{p.kind} at {self.parameter} = {p.value:.12g} (multipliers {at})"
            )
        lines.append(f"to {self.parameter} = {end.value:.9g}: {end.message}")
        return "\n  ".join(lines)

    def __repr__(self):
        name = name_of(self.cycles.systems)
        return f"Branch({name} along {self.parameter}: {len(self)} cycles)\n  {self.summary()}"

    def _repr_html_(self) -> str:
        largest = np.abs(self.multipliers).max(axis=1)
        marks = [p.index for p in self.bifurcations]
        begin, end = self.ends
        rows = [("from", begin.value, begin.message)]
        rows += [
            (p.kind, p.value, ", ".join(map(number, p.critical)))
            for p in self.bifurcations
        ]
        rows += [("to", end.value, end.message)]
        rows = [(name, f"{value:.9g}", text) for name, value, text in rows]
        curves = [
            Line(self.values[[0, -1]], np.ones(2), color=COLORS[-1]),
            Line(self.values, largest),
            Line(self.values[marks], largest[marks], color=COLORS[1], points=True),
        ]
        drawn = picture(curves, self.parameter, "largest modulus of multipliers")
        kind = name_of(self.cycles.systems)
        title = f"of {kind}: {len(self)} cycles"
        return card("Branch", title, table(("", self.parameter, ""), rows), drawn)


@checked
@working("continuation")
def continuation(
    cycle: LimitCycle,
    parameter: str | None = None,
    range: Vector | None = None,
    *,
    step: Share = 0.05,
    max_points: Count = 1000,
    **parameters: Vector,
) -> Branch:
    """Continue a limit cycle in a parameter, and mark changes of its stability.

    Pseudo-arclength continuation computes the branch in both directions from the cycle, to the ends
    of the range, around folds in between. Points at which a multiplier crosses the unit circle are
    accurate to rounding errors. The cycle may be unstable.

    **Arguments:**

    - `cycle`: the first cycle. The value of the parameter in its system lies between the first and
      the last number of `range`.
    - `parameter`: the name of a parameter of the system, or of a part of the system with dots, such
        as `"leg.k"`.
    - `range`: two or more numbers, ascending or descending. The branch ends at the first and the
        last. It contains a cycle at each of the numbers, and further cycles in between.
    - `parameters`: a keyword, `k=(8, 12)`, in place of the name and the range of a parameter
        without dots in its name.
    - `step`: the longest step, as a fraction of the range and of the magnitudes of the
        states. Default: 0.05.
    - `max_points`: largest number of cycles in each direction. Default: 1000.

    **Returns:** a `Branch`, with its cycles and `bifurcations`. If it ends earlier, no error is
    raised, and `ends` has the reason: an event that grazes, is lost or comes out of order, no
    convergence even in the shortest step, or an equilibrium in place of a cycle.

    **Raises:** `DefinitionError` for a parameter that does not exist, values without order, or a
    cycle that was not found or lies outside of the values.

    **Example:**

    ```python
    branch = hj.continuation(cycle, k=(10.0, 11.0), step=0.5)
    print(branch.values, branch.stable, branch.bifurcations)
    ```

    **Before:** `hj.find_limit_cycle`. **After:** `hj.plot.branch`, `branch.to_pandas()`.
    """
    parameter, range = _parameter_and_range(cycle, parameter, range, parameters)
    values = _check(cycle, range)
    cycle = _at_event(cycle)
    curve = Curve(cycle, parameter, float(np.ptp(values)))
    for value in values:
        require_positive(curve.system_at(value))
    if not values.min() <= curve.value <= values.max():
        raise DefinitionError(
            f"the cycle has {parameter} = {curve.value:.6g}, outside of the values "
            f"{values[0]:.6g} to {values[-1]:.6g}: begin within them."
        )
    first = curve.first()
    if isinstance(first, Result):
        raise DefinitionError(
            f"the cycle given is none of {name_of(cycle.system)} at {parameter} = "
            f"{curve.value:.6g}: {first.message}. Find it anew."
        )
    trace = _Trace(
        curve=curve,
        values=np.sort(values),
        step=step,
        max_points=max_points,
    )
    sense = np.sign(values[-1] - values[0])
    back, begin = trace.run(first.oriented(-sense))
    ahead, end = trace.run(first.oriented(sense))
    points = [*back[:0:-1], *ahead]
    return _branch(curve, points, len(back) - 1, (begin, end))


def _parameter_and_range(
    cycle: LimitCycle,
    parameter: str | None,
    range: Any,
    by_name: Mapping[str, Any],
) -> tuple[str, Any]:
    """Return the name of the parameter, and its range.

    **Raises:** `DefinitionError` where one of them is missing, or there are several.
    """
    given = list(taken_parameters(continuation, cycle, by_name).items())
    if parameter is not None and range is not None:
        given.append((parameter, range))
    elif given and (parameter is not None or range is not None):
        name, values = given[0]
        raise DefinitionError(
            f"continuation: `{name}={values}` stands for both `parameter` and `range`: leave these "
            "out."
        )
    if len(given) > 1:
        names = " and ".join(f"`{name}`" for name, _ in given)
        raise DefinitionError(
            f"a continuation has one parameter, not {names}: `hj.sweep` takes several."
        )
    if not given:
        names = parameters_of(cycle.system)
        name = parameter or next((x for x in names if "." not in x), "k")
        raise DefinitionError(
            "continuation needs a parameter and its `range`, with the value of the cycle's "
            f"system between them, as in `hj.continuation(cycle, '{name}', (0.1, 0.5))`."
        )
    return given[0]


def _at_event(cycle: LimitCycle) -> LimitCycle:
    """Let a cycle begin at an event, if its section is the default plane through a guess. (Other
    cycles of the branch may not cross this plane.) Cycles with another section are returned as they
    are."""
    if not is_default(cycle.base) or not cycle.event_sequence:
        return cycle
    events = cycle.trajectory().events
    names = [event.name for event in events]
    once = [event for event in events if names.count(event.name) == 1]
    if not once or cycle.multiplicity > 1:
        return cycle
    event = once[0]
    state = tuple(event.after.values())
    guess = Guess(event.target, state, time=event.time, after=event.name)
    moved = find_limit_cycle(
        cycle.system,
        guess,
        section=AtEvent(event.name),
        conserved=cycle.conserved or None,
        settings=cycle.settings,
        throw=False,
    )
    return moved if moved.result == Result.OK else cycle


def _branch(
    curve: Curve, points: list[Point], start: int, ends: tuple[BranchEnd, BranchEnd]
) -> Branch:
    """The branch through some points. The branch ends before the first point whose verdict has a
    fault.

    **Arguments:** `start`: the index of the first cycle.
    """
    cycles = _stack(curve, points)
    bad = np.flatnonzero(~cycles.ok)
    low = int(max(bad[bad < start], default=-1)) + 1
    high = int(min(bad[bad > start], default=len(points)))
    begin, end = ends
    if low > 0:
        refused = points[low - 1]
        begin = _refused(points[low].value, refused, cycles[low - 1])
    if high < len(points):
        end = _refused(points[high - 1].value, points[high], cycles[high])
    if (low, high) != (0, len(points)):
        points = points[low:high]
        cycles = _stack(curve, points)
    begin = _explained(cycles[0], begin)
    end = _explained(cycles[len(points) - 1], end)
    marked = tuple(
        Bifurcation(
            kind=point.kind,
            index=k,
            value=point.value,
            multipliers=cycles[k].multipliers,
        )
        for k, point in enumerate(points)
        if point.kind
    )
    values = np.array([point.value for point in points])
    return Branch(curve.parameter, values, cycles, marked, (begin, end))


def _refused(value: float, point: Point, cycle: LimitCycle) -> BranchEnd:
    """The end of a branch before a point whose cycle has failed its checks."""
    # (A cycle that failed its checks has no period of its own.)
    cycle = dataclasses.replace(cycle, period=point.turn.period)
    texts = [finding.text for finding in verdict(cycle).refused]
    result = Result(int(cycle.result))
    return BranchEnd(value, result, " ".join(texts[:1]) or result.message)


def _explained(cycle: LimitCycle, end: BranchEnd) -> BranchEnd:
    """The end of a branch after a cycle, with its cause."""
    # (These two results have a simple cause near the end of a branch: near a grazing linearizations
    # fail, and a cycle that has shrunk to a point closes after any time.)
    if end.result in (Result.NOT_VERIFIED, Result.EXTRA_TURNS):
        cause = explained(cycle, Result.NOT_CONVERGED)
        known = cause.message != Result.NOT_CONVERGED.message
        return BranchEnd(end.value, *cause) if known else end
    if end.result == Result.OK or end.message != end.result.message:
        return end
    return BranchEnd(end.value, *explained(cycle, end.result))


def _check(cycle, values) -> np.ndarray:
    """Return the range as an array.

    **Raises:** `DefinitionError` for a cycle that has changed or was not found, and for values
    without order.
    """
    require_x64(cycle)
    cycle.require_current()
    if int(cycle.result) != Result.OK:
        raise DefinitionError(
            f"`cycle` was not found ({Result(int(cycle.result)).message})."
        )
    steps = np.diff(np.asarray(values))
    if not len(steps) or abs(np.sign(steps).sum()) < len(steps):
        raise DefinitionError(
            "`range` must be (low, high), or more numbers, ascending or descending, not "
            f"{values.tolist()}."
        )
    return np.asarray(values)


class _Trace(NamedTuple):
    """The curve of cycles, followed step by step between the least and the largest of the given
    parameter values."""

    curve: Curve
    values: np.ndarray
    step: float
    max_points: int

    def run(self, start: Point) -> tuple[list[Point], BranchEnd]:
        """The points of the branch from `start` on, including those at changes of stability, and
        the end of the branch."""
        points = [start]
        length = self.step
        before: Point | None = None
        moved: Point | None = None
        rises = start.tangent[-1] > 0
        last_value = self.values[-1 if rises else 0]
        over = bool(start.value == last_value)
        while not over and len(points) < self.max_points:
            last = points[-1]
            say(f"{self.curve.parameter} = {last.value:.5g}, {len(points)} cycles")
            point, over = self._next(before, last, length)
            if isinstance(point, Point):
                points += self.between(last, point)
                before = last
                longer = 1.5 * length if point.steps <= USUAL_STEPS else length
                length = min(self.step, longer)
                continue
            # There is no point at this length: half of it is tried.
            length = length / 2
            if length >= _SHORTEST * self.step:
                continue
            # An event may have come to the phase of the clock at which the cycles begin: once, the
            # last cycle is anchored at another phase.
            at_other_phase = None
            if point in (Result.EVENT_ORDER, Result.GRAZING) and last is not moved:
                at_other_phase = self.curve.elsewhere(last)
            if at_other_phase is None:
                return points, BranchEnd(last.value, point, point.message)
            moved = at_other_phase
            points[-1] = moved
            length = self.step
        value = points[-1].value
        if over:
            return points, BranchEnd(value, Result.OK, "end of the parameter range")
        text = f"{self.max_points} cycles; `max_points` raises it"
        return points, BranchEnd(value, Result.STEP_LIMIT, text)

    def _next(
        self, before: Point | None, last: Point, length: float
    ) -> tuple[Point | Result, bool]:
        """The next point, or the `Result` code that says why there is none; and whether the range
        of values ends there."""
        low = self.values[0]
        high = self.values[-1]
        point = self.curve.step(before, last, length)
        if isinstance(point, Result):
            return point, False
        over = not low <= point.value <= high
        if over:
            point = self.curve.land(last, point, np.clip(point.value, low, high))
        if isinstance(point, Result):
            return point, False
        if point.cosine(last) < _STRAIGHT:
            return Result.NOT_CONVERGED, False
        return point, over

    def between(self, a: Point, b: Point) -> list[Point]:
        """The points at changes of stability and at wanted values between a and b; b comes last."""
        marked: dict[tuple[float, str], Point] = {}
        for kind, before in a.tests.items():
            after = b.tests[kind]
            if max(abs(before), abs(after)) < SINGULAR or before * after >= 0:
                continue
            if kind == "branch point" and a.tests["fold"] * b.tests["fold"] < 0:
                continue  # the parameter turns back
            located = self.locate(a, b, kind)
            if located is not None:
                where, point = located
                # (Two multipliers of a pair cross at the same place.)
                marked.setdefault((round(where, 9), point.kind), point)
        points = []
        last = a
        for point in [*(marked[key] for key in sorted(marked)), b]:
            points += self._at_values(last, point)
            points.append(point)
            last = point
        return points

    def _at_values(self, a: Point, b: Point) -> list[Point]:
        """The points at the values that are passed between two points."""
        passed = [v for v in self.values if (a.value - v) * (b.value - v) < 0]
        points = []
        for value in sorted(passed, key=lambda v: abs(v - a.value)):
            landed = self.curve.land(a, b, value)
            if isinstance(landed, Point):
                points.append(landed)
        return points

    def locate(self, a: Point, b: Point, kind: str | int) -> tuple[float, Point] | None:
        """The point between a and b at which a test function is zero, with its distance from a as a
        part of the distance from a to b.

        At a crossing of two branches no point can be computed; a point nearby is returned.
        """
        from scipy.optimize import brentq  # (a third of a second)

        points = {0.0: a, 1.0: b}
        beside: set[float] = set()  # (only a point nearby could be computed)

        def compute(where: float) -> None:
            for aside in _ASIDE:
                point = self.curve.between(a, b, where + aside)
                if isinstance(point, Point):
                    points[where] = point
                    if aside != 0:
                        beside.add(where)
                    return

        def test(where: float) -> float:
            if where not in points:
                compute(where)
            return points[where].tests[kind]

        accuracy: Any = dict(xtol=1e-13, rtol=np.float64(1e-14), maxiter=60)
        try:
            where: Any = brentq(test, 0.0, 1.0, **accuracy)
            test(where)
        except (KeyError, RuntimeError):
            return None
        point = points[where]
        if isinstance(kind, int):
            critical = point.multipliers[kind]
            if critical.imag == 0 and critical.real > 0:
                return None  # (a fold, or a branch point)
            kind = "Neimark-Sacker" if critical.imag else "flip"
        if beside:
            kind = "branch point"
        return where, dataclasses.replace(point, kind=kind)


def _stack(curve: Curve, points: list[Point]) -> LimitCycles:
    """The points as cycles."""
    cycle = curve.cycle

    def stack(*arrays) -> np.ndarray:
        return np.stack([np.asarray(x) for x in arrays])

    systems = [eqx.filter(curve.system_at(p.value), eqx.is_array) for p in points]
    systems = eqx.combine(jax.tree_util.tree_map(stack, *systems), cycle.system)
    pairs = [(point.departure, point.turn._replace(tapes=None)) for point in points]
    anchor, turn = jax.tree_util.tree_map(stack, *pairs)
    cycles = LimitCycles(
        systems,
        cycle.base,
        turn.period,
        anchor,
        turn.pieces,
        turn.factors,
        turn.distance,
        np.array([p.steps for p in points]),
        np.zeros(len(points), np.int32),
        front(turn.codes.reshape(len(points), -1)),
        dataclasses.replace(cycle.settings, max_steps=curve.map.settings.max_steps),
        cycle.conserved,
        cycle.multiplicity,
        copies_of(systems),
    )
    maps = [curve.map.at_phase_of(curve.system_at(p.value)) for p in points]
    together = [
        coincident(map, point.turn) is not None
        for map, point in zip(maps, points, strict=True)
    ]
    turns = [point.recorded for point in points]
    checked = examined(keep_turns(cycles, turns), np.array(together))
    return keep_turns(checked, turns)
