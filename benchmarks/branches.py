"""Branches of limit cycles against single searches, scipy, and what is known of them.

    python benchmarks/branches.py [--only NAME ...] [--every 10]

Each branch of `branch_cases.py` is continued over a wide range of a parameter. About each tenth of
its points, but five at least, is compared: scipy's DOP853, with its own search for events, follows
the cycle for a period, which must close then and not sooner, and differences of it must have the
same multipliers. A search for a cycle of the same system from the model's own guess finds the same
cycle, or another one that closes; then a search from the branch's cycle must find the same. Ends,
marked points and closed forms must be those that are known. What is wrong is printed.
"""

import argparse
import sys
import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from branch_cases import CASES, Case
from scipy.integrate import DOP853
from scipy.optimize import brentq

import hybridjax as hj
from hybridjax.orbits.branches import Branch
from hybridjax.orbits.curve import far_from_events


# Errors of the period and of the way back to the start, relative to the ranges of the states, and
# of multipliers by differences, relative to the largest or to 1, from which on they are wrong.
WRONG, WRONG_MULTIPLIER = 1e-6, 1e-4
# Steps of differences, relative to the ranges of the states: the shorter ones only where the first
# shows other multipliers. Near a canard the errors of 1e-5 are a fifth of a multiplier (for Morris
# and Lecar's neuron at 216.895, Liouville's formula gives 0.5307344398, as the package does).
DIFFERENCES = (1e-5, 1e-6, 1e-7)
# Points at which guards are evaluated in each step, of which a period has so many at least.
SAMPLES, STEPS = 8, 60
# A guard has left zero if it is this far from it, relative to its largest value so far.
LEFT = 1e-9
# Comparisons of a branch at least.
LEAST = 5
# Cycles of a branch each way at most: beyond them it takes minutes.
MOST = 200


class Loop:
    """A system in scipy, with its own search for events."""

    def __init__(self, system: hj.HybridSystem):
        leaves, form = jax.tree_util.tree_flatten(system)
        self.arrays, rest = eqx.partition(leaves, eqx.is_array)
        self.names = list(system.charts())
        transitions = list(system.transitions())
        self.transitions = transitions
        u = jnp.zeros(len(system.inputs))

        def whole(arrays):
            return jax.tree_util.tree_unflatten(form, eqx.combine(arrays, rest))

        def field(name):
            def rates(arrays, t, q):
                return jnp.stack([*whole(arrays).charts()[name].field(t, q, u)])

            return jax.jit(rates)

        def guards(name):
            def levels(arrays, t, q):
                own = list(whole(arrays).transitions())
                levels = [
                    own[g].sign * own[g].guard(t, q, u) for g in self.guards[name]
                ]
                return jnp.stack([jnp.asarray(x, float) for x in levels])

            return jax.jit(jax.vmap(levels, (None, 0, 0)))

        def event(g):
            def after(arrays, t, q):
                own = list(whole(arrays).transitions())[g]
                enabled = True if own.enabled is None else own.enabled(t, q, u)
                return jnp.stack([*own.reset(t, q, u)]).astype(float), enabled

            return jax.jit(after)

        scheduled = [isinstance(x.guard, hj.systems.Scheduled) for x in transitions]
        numbers = range(len(transitions))
        of_chart = {
            name: [g for g in numbers if transitions[g].source == name]
            for name in self.names
        }
        self.guards = {
            name: [g for g in own if not scheduled[g]] for name, own in of_chart.items()
        }
        self.ticks = {
            name: [g for g in own if scheduled[g]] for name, own in of_chart.items()
        }
        self.field = {name: field(name) for name in self.names}
        self.levels = {name: guards(name) for name in self.names}
        self.event = [event(g) for g in numbers]

    def at(self, system: hj.HybridSystem) -> "Loop":
        """The same with other numbers."""
        leaves = jax.tree_util.tree_leaves(system)
        self.arrays = eqx.filter(leaves, eqx.is_array)
        self.transitions = list(system.transitions())
        return self

    def follow(
        self, name: str, t: float, q, end: float
    ) -> tuple[str, np.ndarray, list]:
        """Chart and state at a time, and the events until then."""
        events: list[tuple[float, str]] = []
        longest = (end - t) / STEPS
        while t < end and len(events) < 50:
            due, tick = self._next_tick(name, t)
            t, q, g = self._stay(name, t, q, min(due, end), longest)
            if g is None and due < end:
                g = tick
            if g is None:
                break
            after, _ = self.event[g](self.arrays, t, q)
            q = np.asarray(after)
            name = self.transitions[g].target
            events.append((t, self.transitions[g].name))
        return name, q, events

    def _next_tick(self, name: str, t: float) -> tuple[float, int | None]:
        times = []
        for g in self.ticks[name]:
            clock = self.transitions[g].guard
            period, offset = float(clock.period), float(clock.offset)
            k = np.floor((t - offset) / period + 1e-9) + 1
            times.append((offset + k * period, g))
        return min(times, default=(np.inf, None))

    def _stay(self, name: str, t: float, q, end: float, longest: float):
        """Time, state and transition (none at the end) of the next event."""
        arrays, own = self.arrays, self.guards[name]

        def rates(t, q):
            return np.asarray(self.field[name](arrays, t, q))

        solver = DOP853(rates, t, q, end, rtol=1e-11, atol=1e-13, max_step=longest)
        armed = np.zeros(len(own), bool)
        largest = np.zeros(len(own))
        while solver.status == "running":
            solver.step()
            if not own:
                continue
            path = solver.dense_output()
            times = np.linspace(solver.t_old, solver.t, SAMPLES + 1)
            levels = np.asarray(self.levels[name](arrays, times, path(times).T))
            for k in range(SAMPLES + 1):
                largest = np.maximum(largest, np.abs(levels[k]))
                crossed = armed & (levels[k] < 0)
                for i in np.flatnonzero(crossed):
                    hit = self._locate(name, i, path, times[k - 1], times[k])
                    state = path(hit)
                    _, enabled = self.event[own[i]](arrays, hit, state)
                    if enabled:
                        return hit, state, own[i]
                    armed[i] = False
                armed |= levels[k] > LEFT * largest
        return end, solver.y, None

    def _locate(self, name: str, i: int, path, low: float, high: float) -> float:
        def level(t):
            row = self.levels[name](self.arrays, np.array([t]), path(t)[None])
            return float(row[0, i])

        return brentq(level, low, high, xtol=1e-15 * max(1.0, abs(high)), rtol=1e-14)


def faults(loop: Loop, cycle: hj.orbits.LimitCycle, at_end: bool = False) -> list[str]:
    """What scipy says against a cycle. At the end of a branch, where events are about to be lost,
    it must close, and no more is compared."""
    loop.at(cycle.system)
    path, period = cycle.trajectory(), float(cycle.period)
    times = path.t[path.event >= 0]
    k = far_from_events(path.t, times, period) if len(times) else 0
    t = float(path.t[k])
    name = loop.names[int(path.chart[k])]
    n = len(cycle.system.charts()[name].states)
    q = path.after[k, :n]
    here = path.after[path.chart == path.chart[k], :n]
    sizes = np.maximum(np.ptp(here, axis=0), 1e-3 * np.abs(here).max(axis=0) + 1e-300)
    found = []
    back, end, events = loop.follow(name, t, q, t + period)
    if back != name:
        return [f"scipy ends in chart {back}, not {name}"]
    multipliers = np.asarray(cycle.multipliers)
    largest = max(1.0, np.abs(multipliers).max(initial=0.0))
    off = float(np.max(np.abs(end - q) / sizes))
    if not off < WRONG * largest:
        found.append(f"scipy does not close: {off:.2g}")
    if at_end:
        return found
    ours = sorted(event.name for event in cycle.trajectory().events)
    if ours != sorted(name for _, name in events):
        found.append(f"events {ours}, by scipy {[name for _, name in events]}")
    if soon := _closes_sooner(cycle):
        found.append(f"closes after {soon:.6g}, less than the period {period:.6g}")
    point = name, t, q, sizes
    for step in DIFFERENCES:
        by_scipy = multipliers_by_scipy(loop, cycle, point, step)
        if by_scipy is None:
            return [*found, "the order of events is not fixed beside the cycle"]
        if _apart(multipliers, by_scipy) <= WRONG_MULTIPLIER * largest:
            return found
    return [*found, f"multipliers {multipliers}, by scipy {by_scipy}"]


def multipliers_by_scipy(
    loop: Loop, cycle: hj.orbits.LimitCycle, point: tuple, step: float
) -> np.ndarray | None:
    """Multipliers by differences of the flow over a period from a chart, a time and a state with
    its sizes; none if neighbors end in another chart."""
    name, t, q, sizes = point
    n = len(q)
    end = t + float(cycle.period)
    columns = []
    for j in range(n):
        shift = step * sizes[j] * np.eye(n)[j]
        ends = [loop.follow(name, t, q + x, end) for x in (shift, -shift)]
        if {x[0] for x in ends} != {name}:
            return None
        columns.append((ends[0][1] - ends[1][1]) / (2 * step * sizes[j]))
    multipliers = np.linalg.eigvals(np.stack(columns, axis=1)).astype(complex)
    if cycle.clocked:
        return multipliers
    return np.delete(multipliers, np.argmin(np.abs(multipliers - 1)))


def _closes_sooner(cycle: hj.orbits.LimitCycle) -> float | None:
    """A time less than the period after which the path of the cycle is back at its start."""
    path, period = cycle.trajectory(2.0), float(cycle.period)
    times = path.t[0] + np.linspace(0.0, 0.99, 40) * period
    charts, states = path.at(times)
    ranges = np.ptp(states, axis=0) + 1e-300
    for parts in (2, 3, 4):
        if cycle.clocked and cycle.multiplicity % parts:
            continue
        later, after = path.at(times + period / parts)
        apart = np.max(np.abs(after - states) / ranges)
        if np.all(charts == later) and apart < 1e-3:
            return period / parts
    return None


def _apart(a, b) -> float:
    """The largest distance between multipliers, padded with zeros."""
    n = max(len(a), len(b))
    a, b = (np.pad(np.asarray(x, complex), (0, n - len(x))) for x in (a, b))
    left, far = list(b), 0.0
    for x in sorted(a, key=lambda x: -abs(x)):
        k = int(np.argmin(np.abs(np.array(left) - x)))
        far = max(far, abs(left.pop(k) - x))
    return far


def same(a: hj.orbits.LimitCycle, b: hj.orbits.LimitCycle) -> bool:
    off = abs(float(a.period) / float(b.period) - 1)
    size = max(1.0, np.abs(b.multipliers).max(initial=0.0))
    apart = _apart(a.multipliers, b.multipliers)
    return off < WRONG and apart < WRONG_MULTIPLIER * size


def single_search(case: Case, system: hj.HybridSystem) -> Any:
    """A cycle found from the model's own guess, or none."""
    try:
        cycle: Any = hj.find_limit_cycle(system, throw=False, **case.find)
    except hj.errors.ComputationError:
        return None
    return cycle if int(cycle.result) == hj.errors.Result.OK else None


def compare(
    case: Case, loop: Loop, cycle: hj.orbits.LimitCycle, at_end: bool
) -> tuple[str, list[str]]:
    """The result of a single search, and all faults."""
    found = faults(loop, cycle, at_end)
    at = f"{float(getattr(cycle.system, case.parameter)):.6g}: "
    if at_end:
        return "left out at an end", [at + x for x in found]
    single = single_search(case, cycle.system)
    if single is not None and same(single, cycle):
        return "same", [at + x for x in found]
    if single is not None:
        found += [f"single search: {x}" for x in faults(loop, single)]
    again = hj.find_limit_cycle(cycle.system, cycle, throw=False)
    if int(again.result) != hj.errors.Result.OK:
        message = hj.errors.Result(int(again.result)).message
        found.append(f"a search from the cycle of the branch fails: {message}")
    elif not same(again, cycle):
        found.append("a search from the cycle of the branch finds another")
    return "failed" if single is None else "another", [at + x for x in found]


def known(case: Case, branch: Branch) -> list[str]:
    """Faults of ends, marked points and closed forms."""
    found = []
    for end, part, border in zip(branch.ends, case.ends, case.border, strict=True):
        if part not in end.message:
            found.append(f"end at {end.value:.8g}: {end.message!r}, not {part!r}")
        if abs(end.value - border) > case.within * abs(border):
            found.append(f"end at {end.value:.8g}, not {border:.8g}")
    if case.marks is not None:
        kinds = [point.kind for point in branch.bifurcations]
        if kinds != [kind for kind, _ in case.marks]:
            found.append(f"marked points {kinds}, not {case.marks}")
        else:
            for point, (kind, value) in zip(
                branch.bifurcations, case.marks, strict=True
            ):
                if abs(point.value - value) > case.within * abs(value):
                    found.append(f"{kind} at {point.value:.10g}, not {value:.10g}")
    if case.exact is not None:
        for k in range(len(branch)):
            got, exact = case.exact(branch[k])
            if not abs(got - exact) <= case.within * max(abs(exact), 1e-3):
                value = branch.values[k]
                found.append(f"{value:.6g}: {got:.10g}, by a closed form {exact:.10g}")
    return found


def run(name: str, every: int) -> tuple[int, int]:
    """Numbers of comparisons (one for so many points, but `LEAST`) and of faults of a case."""
    case = CASES[name]()
    begin = time.process_time()
    first = hj.find_limit_cycle(case.system, **case.find)
    middle = time.process_time()
    branch = hj.continuation(first, case.parameter, case.values, max_points=MOST)
    seconds = time.process_time() - middle
    print(f"== {name}: {len(branch)} cycles, {seconds:.1f} s", end=" ")
    print(f"(the first {middle - begin:.1f} s)")
    print(" ", branch.summary(), flush=True)
    found = known(case, branch)
    count = max(LEAST, -(-len(branch) // every))
    rows = np.unique(np.linspace(0, len(branch) - 1, count).round().astype(int))
    loop = Loop(case.system)
    searches = []
    for k in rows:
        at_end = any(
            end.result != hj.errors.Result.OK and end.value == branch.values[k]
            for end in branch.ends
        )
        search, wrong = compare(case, loop, branch[int(k)], at_end)
        searches.append(search)
        found += wrong
    counts = ", ".join(f"{searches.count(x)} {x}" for x in sorted(set(searches)))
    seconds = time.process_time() - begin
    print(f"  {len(rows)} comparisons (single searches: {counts}), {seconds:.0f} s")
    for text in found:
        print("  WRONG", text)
    sys.stdout.flush()
    return len(rows), len(found)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--every", type=int, default=10)
    given = parser.parse_args()
    hj.enable_x64()
    totals = np.zeros(2, int)
    for name in given.only:
        try:
            totals += run(name, given.every)
        except hj.errors.HybridJaxError as error:
            print(f"== {name}\n  WRONG {type(error).__name__}: {error}", flush=True)
            totals += (0, 1)
    print(f"{totals[0]} comparisons, {totals[1]} wrong")
    return int(totals[1] > 0)


if __name__ == "__main__":
    sys.exit(main())
