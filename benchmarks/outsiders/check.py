"""Truth from scipy: simulation with events of its own, and the examination of a cycle.

Nothing here uses hybridjax. A guard fires when it passes zero in its direction while the motion is
in the source chart. A guard that a reset puts at zero or beyond fires at once by the rule of
docs/mathematics.md ("Events at once"). Another one that is beyond zero when a chart is entered does
not fire until it has come back; this is reported. A guard that is zero at the start is armed by
what follows.
"""

import dataclasses
import math
import time
import types
import warnings

import numpy as np
import scipy.integrate
import scipy.optimize
from form import Event, Model


SAMPLES = 16  # of a guard in one step; fewer miss pairs of crossings
NEUTRAL = 1e-11  # share of the guard's size; below it a guard counts as zero at entry
TOGETHER = 1e-9  # share of a period; closer events coincide


@dataclasses.dataclass
class Piece:
    """A stretch of the motion in one chart, as dense outputs of the steps."""

    chart: str
    steps: list

    def at(self, t: np.ndarray) -> np.ndarray:
        ends = np.array([step.t_max for step in self.steps])
        index = np.minimum(np.searchsorted(ends, t), len(ends) - 1)
        return np.stack(
            [self.steps[k](x) for k, x in zip(index, t, strict=True)], axis=1
        )

    @property
    def begin(self) -> float:
        return self.steps[0].t_min

    @property
    def end(self) -> float:
        return self.steps[-1].t_max


@dataclasses.dataclass
class Occurrence:
    time: float
    name: str


@dataclasses.dataclass
class Motion:
    """A simulated motion: pieces, events, remarks, the end, and why it ended."""

    pieces: list
    events: list
    remarks: list
    chart: str
    state: np.ndarray
    time: float
    ending: str = "ok"
    together: list = dataclasses.field(default_factory=list)
    armed: dict = dataclasses.field(
        default_factory=dict
    )  # of the last chart, at its end


@dataclasses.dataclass
class Left:
    """A chart that an event has ended: its state there, and which of its guards were armed."""

    chart: str
    state: np.ndarray
    armed: dict


def parameters(model: Model) -> types.SimpleNamespace:
    return types.SimpleNamespace(**model.parameters)


def clock_of(model: Model) -> float | None:
    return None if model.clock is None else float(model.clock(parameters(model)))


class Simulator:
    def __init__(
        self, model: Model, rtol: float = 1e-11, scale=None, per_period: int = 16
    ):
        self.model = model
        self.p = parameters(model)
        self.rtol = rtol
        self.scale = scale
        self.clock = clock_of(model)
        self.per_period = per_period  # least steps in a period of a clock
        self.exits = {
            name: [event for event in model.events if event.source == name]
            for name in model.charts
        }

    def field(self, chart: str):
        rule = self.model.charts[chart][1]

        def rates(t, q):
            return np.array(rule(np, t, q, self.p), dtype=float)

        return rates

    def guard(self, event: Event, t, q):
        """Positive before the event, negative beyond it; also for arrays of times."""
        sign = 1.0 if event.direction == "falling" else -1.0
        value = sign * np.asarray(event.guard(np, t, q, self.p), dtype=float)
        return np.broadcast_to(value, np.shape(t))

    def enabled(self, event: Event, t: float, q: np.ndarray) -> bool:
        if event.enabled is None:
            return True
        return bool(event.enabled(np, t, q, self.p))

    def reset(self, event: Event, t: float, q: np.ndarray) -> np.ndarray:
        if event.reset is None:
            return np.array(q, dtype=float)
        return np.array(event.reset(np, t, q, self.p), dtype=float)

    def next_tick(self, event: Event, t: float) -> float:
        period, offset = event.schedule(self.p)
        count = math.floor((t - offset) / period + TOGETHER) + 1
        return offset + count * period

    def at_tick(self, event: Event, t: float) -> bool:
        period, offset = event.schedule(self.p)
        turns = (t - offset) / period
        return abs(turns - round(turns)) < TOGETHER

    def _same(self, event: Event, fired: Event) -> bool:
        """One tick of a clock, written as two transitions, is not two events."""
        if fired.schedule is None:
            return False
        return event.schedule(self.p) == fired.schedule(self.p)

    def run(
        self,
        chart: str,
        state,
        start: float,
        duration: float,
        wall: float = 60.0,
        record: bool = True,
        max_events: int = 20_000,
    ) -> Motion:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            return self._run(chart, state, start, duration, wall, record, max_events)

    def _run(self, chart, state, start, duration, wall, record, max_events):
        motion = Motion([], [], [], chart, np.array(state, dtype=float), float(start))
        end = start + duration
        deadline = time.monotonic() + wall
        fired = None
        while motion.time < end:
            event = self._stay(motion, end, deadline, fired, record)
            if event is None:
                return motion
            while event is not None:
                before = motion.state
                left = Left(motion.chart, before, motion.armed | {event.name: False})
                motion.events.append(Occurrence(motion.time, event.name))
                motion.state = self.reset(event, motion.time, before)
                motion.chart = event.target
                fired = event
                for other in motion.together:
                    fired = self._join(motion, event, other, before) or fired
                motion.together = []
                if not np.all(np.isfinite(motion.state)):
                    motion.ending = "reset is not finite"
                    return motion
                recent = motion.events[-100:]
                crowded = (
                    len(recent) == 100
                    and recent[-1].time - recent[0].time < 1e-7 * duration
                )
                if crowded or len(motion.events) > max_events:
                    motion.ending = "Zeno"
                    return motion
                event = self._at_once(motion, left, fired, self.clock or duration)
                event = event or self._tick_too(motion)
        return motion

    def _at_once(self, motion, left, fired, span) -> Event | None:
        """The first event whose guard the reset of `fired` has put at zero or beyond."""
        chart, state, t = motion.chart, motion.state, motion.time
        motion.armed, due = {}, None
        for event in self.exits[chart]:
            if event.guard is None:
                continue
            value, rate, noise = self._level(event, chart, t, state, span)
            motion.armed[event.name] = value > noise
            known, armed = self._before(event, chart, left, t, noise)
            falls = rate < 0
            at_zero = abs(value) <= noise and event is not fired and falls
            put = at_zero and (armed or not known)
            late = value < -noise and (armed or (falls and not known))
            if due is None and (put or late) and self.enabled(event, t, state):
                due = event
        return due

    def _tick_too(self, motion) -> Event | None:
        """An event of another clock that ticks at the same time (docs/mathematics.md, "Clocks")."""
        now = [e.name for e in motion.events[-5:] if e.time == motion.time]
        ticked = [
            event.schedule(self.p)
            for event in self.model.events
            if event.schedule is not None and event.name in now
        ]
        if not ticked:
            return None
        for event in self.exits[motion.chart]:
            if event.schedule is None or not self.at_tick(event, motion.time):
                continue
            period, offset = event.schedule(self.p)
            turn = round((motion.time - offset) / period)
            over = [
                (period, offset) == clock
                or (
                    period == clock[0]
                    and turn < round((motion.time - clock[1]) / period)
                )
                for clock in ticked
            ]
            if not any(over) and self.enabled(event, motion.time, motion.state):
                return event
        return None

    def _before(self, event, chart, left, t, noise) -> tuple[bool, bool]:
        """Whether the chart that was left has this guard, too, and whether it was armed there."""
        if chart == left.chart:
            return True, bool(left.armed.get(event.name))
        names = len(self.model.charts[chart][0]), len(self.model.charts[left.chart][0])
        if names[0] != names[1]:
            return False, False
        value = float(self.guard(event, t, left.state))
        alike = [
            other
            for other in self.exits[left.chart]
            if other.guard is not None
            and abs(float(self.guard(other, t, left.state)) - value) <= noise
        ]
        return bool(alike), any(left.armed.get(other.name) for other in alike)

    def _level(self, event, chart, t, state, span) -> tuple[float, float, float]:
        """A guard, its rate along the flow, and values of it that are only rounding."""
        value = float(self.guard(event, t, state))
        field = self.field(chart)(t, state)
        largest = np.max(np.abs(state)) / max(np.max(np.abs(field)), 1e-300)
        step = 1e-7 * (min(span, largest) if largest > 0 else span)
        later = float(self.guard(event, t + step, state + step * field))
        rate = (later - value) / step
        noise = 1e-11 * span * abs(rate)
        for k, x in enumerate(state):
            moved = np.array(state)
            moved[k] += 1e-6 * (abs(x) or 1.0)
            slope = (float(self.guard(event, t, moved)) - value) / (moved[k] - x)
            noise += 1e-13 * abs(slope * x)
        return value, rate, noise

    def _join(self, motion, event, other, before) -> Event | None:
        """Fires an event that coincides with `event`, and says whether the order matters."""
        if other.source != motion.chart or other.guard is None:
            motion.remarks.append(
                f"'{event.name}' ends the chart of '{other.name}': order matters"
            )
            return None
        motion.events.append(Occurrence(motion.time, other.name))
        motion.state = self.reset(other, motion.time, motion.state)
        motion.chart = other.target
        swapped = self.reset(event, motion.time, self.reset(other, motion.time, before))
        size = np.max(np.abs(before)) + 1e-300
        same = np.shape(swapped) == np.shape(motion.state)
        if not same or np.max(np.abs(swapped - motion.state)) > 1e-7 * size:
            motion.remarks.append(f"'{event.name}' and '{other.name}': order matters")
        return other

    def _stay(self, motion, end, deadline, fired, record) -> Event | None:
        """Integrates in one chart until an event, which it returns, or an end."""
        chart, entry = motion.chart, motion.time
        guards = [event for event in self.exits[chart] if event.guard is not None]
        ticks = [event for event in self.exits[chart] if event.schedule is not None]
        bound, tick = end, None
        for event in ticks:
            recent = [x.name for x in motion.events[-5:] if x.time == entry]
            if (
                fired is not None
                and self.at_tick(event, entry)
                and not self._same(event, fired)
                and event.name not in recent
            ):
                motion.remarks.append(f"'{event.name}' coincides with '{fired.name}'")
            when = self.next_tick(event, entry)
            if (
                tick is not None
                and abs(when - bound) < TOGETHER * event.schedule(self.p)[0]
            ):
                motion.remarks.append(f"'{event.name}' coincides with '{tick.name}'")
            if when < bound or (when == bound and tick is None):
                bound, tick = when, event
        first = {
            event.name: float(self.guard(event, entry, motion.state))
            for event in guards
        }
        armed = motion.armed = dict.fromkeys(first)
        solver = self._solver(chart, entry, motion.state, bound, end - entry)
        if solver is None:
            motion.ending = "the field is not finite"
            return None
        steps = []
        if record:
            motion.pieces.append(Piece(chart, steps))
        while True:
            if time.monotonic() > deadline:
                motion.ending = "wall time"
                return None
            if solver.status == "running":
                solver.step()
            if solver.status == "failed" or not np.all(np.isfinite(solver.y)):
                motion.ending = "blow-up"
                return None
            if np.max(np.abs(solver.y)) > 1e30:
                motion.ending = "blow-up"
                return None
            dense = solver.dense_output()
            if record:
                steps.append(dense)
            times = np.linspace(solver.t_old, solver.t, SAMPLES + 1)
            states = dense(times)
            hits = []
            for event in guards:
                values = self.guard(event, times, states)
                if armed[event.name] is None:
                    armed[event.name] = self._armed_at_entry(
                        motion, event, first[event.name], values, fired
                    )
                hit, armed[event.name] = self._crossing(
                    event, times, values, dense, armed[event.name]
                )
                if hit is not None:
                    hits.append((hit, event))
            if hits:
                hits.sort(key=lambda hit: hit[0])
                when, event = hits[0]
                span = self.clock or max(when - entry, 1e-300)
                others = [
                    other for other in hits[1:] if other[0] - when < TOGETHER * span
                ]
                if tick is not None and bound - when < TOGETHER * span:
                    others.append((bound, tick))
                for other in others:
                    motion.remarks.append(
                        f"'{event.name}' coincides with '{other[1].name}'"
                    )
                motion.together = [other[1] for other in others]
                if record:
                    steps[-1] = Cut(dense, solver.t_old, when)
                motion.time, motion.state = float(when), dense(when)
                return event
            if solver.status == "finished":
                motion.time, motion.state = bound, solver.y
                if tick is None:
                    return None
                if bound >= end and bound != end:
                    return None
                if self.enabled(tick, bound, solver.y):
                    return tick
                return self._stay(motion, end, deadline, None, record)

    def _armed_at_entry(self, motion, event, value, values, fired) -> bool:
        size = np.max(np.abs(values))
        if abs(value) > NEUTRAL * size:
            if value < 0:
                motion.remarks.append(f"enters '{event.source}' beyond '{event.name}'")
            return value > 0
        own = fired is not None and fired.name == event.name
        if values[1] < 0 and not own and fired is not None:
            motion.remarks.append(
                f"enters '{event.source}' on '{event.name}' and passes it"
            )
        return False

    def _crossing(self, event, times, values, dense, armed):
        """The first enabled crossing in a step, and whether the guard is armed at its end."""
        for k in range(1, len(times)):
            if armed and values[k] < 0:
                when = self._root(event, times[k - 1], times[k], dense)
                if self.enabled(event, when, dense(when)):
                    return when, False
                armed = False
            elif values[k] > 0:
                low = self._dip(event, times, values, k, dense) if armed else None
                if low is not None:
                    when = self._root(event, times[k - 1], low, dense)
                    if self.enabled(event, when, dense(when)):
                        return when, False
                armed = True
        return None, armed

    def _dip(self, event, times, values, k, dense):
        """A time at which the guard is negative although the samples beside it are positive."""
        if k + 1 >= len(times):
            return None
        before, here, after = values[k - 1], values[k], values[k + 1]
        if not (here <= before and here <= after and here > 0):
            return None
        curvature = before - 2 * here + after
        if (
            curvature <= 0
            or here - (after - before) ** 2 / (8 * curvature) > 0.5 * here
        ):
            return None
        found = scipy.optimize.minimize_scalar(
            lambda x: float(self.guard(event, x, dense(x))),
            bounds=(times[k - 1], times[k + 1]),
            method="bounded",
            options={"xatol": 1e-12 * (times[k + 1] - times[k - 1])},
        )
        return found.x if found.fun < 0 and found.x > times[k - 1] else None

    def _root(self, event, left, right, dense) -> float:
        def level(x):
            return float(self.guard(event, x, dense(x)))

        if level(left) <= 0:
            return left
        return scipy.optimize.brentq(level, left, right, xtol=1e-300, rtol=1e-15)

    def _solver(self, chart, t, q, bound, rest):
        size = np.max(np.abs(q)) if self.scale is None else None
        scale = (
            np.full(len(q), max(size, 1e-9))
            if self.scale is None
            else self.scale[chart]
        )
        rates = self.field(chart)
        if not np.all(np.isfinite(rates(t, q))):
            return None
        longest = rest / 20 if self.clock is None else self.clock / self.per_period
        method = scipy.integrate.Radau if self.model.stiff else scipy.integrate.DOP853
        try:
            return method(
                rates,
                t,
                q,
                bound,
                rtol=self.rtol,
                atol=self.rtol * 0.1 * scale,
                max_step=max(longest, 1e-300),
            )
        except ValueError:
            return None


@dataclasses.dataclass
class Cut:
    """A dense output that ends at an event."""

    dense: object
    t_min: float
    t_max: float

    def __call__(self, t):
        return self.dense(t)


@dataclasses.dataclass
class Orbit:
    """A cycle as plain numbers: rows of time, chart, state and event, as a caller made them.

    `events` are the occurrences of one period, `autonomous` is false if a clock drives the model.
    """

    period: float
    time: np.ndarray
    chart: list
    state: list
    is_event: np.ndarray
    events: list
    multipliers: np.ndarray
    multiplicity: int


@dataclasses.dataclass
class Report:
    complaints: list
    remarks: list
    multipliers: np.ndarray | None = None
    ranges: dict | None = None
    samples: dict | None = None


def ranges_of(model: Model, orbit: Orbit) -> tuple[dict, dict]:
    """For each chart: half of the range of each state (by name, over all charts), and its size."""
    low, high = {}, {}
    for chart, state in zip(orbit.chart, orbit.state, strict=True):
        for name, value in zip(model.charts[chart][0], state, strict=True):
            low[name] = min(low.get(name, np.inf), value)
            high[name] = max(high.get(name, -np.inf), value)
    spread, size = {}, {}
    for chart, (names, _) in model.charts.items():
        spread[chart] = np.array([high.get(n, 0.0) - low.get(n, 0.0) for n in names])
        size[chart] = np.array(
            [max(abs(high.get(n, 0.0)), abs(low.get(n, 0.0))) for n in names]
        )
    return spread, size


def usual_sizes(model: Model) -> dict:
    """Sizes of states in the first guess: a state that is only rounding is zero beside them."""
    first = model.guesses[0]
    names = model.charts[first.chart][0]
    known = dict(zip(names, map(abs, first.state), strict=True))
    return {
        chart: np.array([known.get(name, 0.0) for name in states])
        for chart, (states, _) in model.charts.items()
    }


def nodes_of(orbit: Orbit, most: int = 12) -> list[int]:
    """Rows away from events, from which pieces of the orbit are simulated."""
    plain = np.flatnonzero(~orbit.is_event)
    plain = plain[orbit.time[plain] < orbit.time[0] + orbit.period * (1 - 1e-9)]
    marks = orbit.time[orbit.is_event]
    if len(marks):
        ring = np.concatenate([marks - orbit.period, marks, marks + orbit.period])
        gap = np.array([np.min(np.abs(ring - orbit.time[k])) for k in plain])
        far = plain[gap > 1e-6 * orbit.period]
        if len(far):
            plain = far
    if len(plain) == 0:
        return []
    wanted = np.linspace(orbit.time[0], orbit.time[0] + orbit.period, most + 1)[:-1]
    chosen = {int(plain[np.argmin(np.abs(orbit.time[plain] - t))]) for t in wanted}
    return sorted(chosen)


def verify(orbit: Orbit, model: Model, multipliers: bool = True) -> Report:
    """Complaints about a cycle; none if it is a true one."""
    report = Report([], [])
    clock = clock_of(model)
    spread, size = ranges_of(model, orbit)
    usual = usual_sizes(model)
    scale = {
        c: np.maximum(np.maximum(spread[c], 1e-6 * size[c]), 1e-7 * usual[c] + 1e-300)
        for c in spread
    }
    report.ranges = scale
    motions = [spread[c] / np.maximum(size[c], 1e-300) for c in set(orbit.chart)]
    if not orbit.events and max(float(np.max(m)) for m in motions) < 1e-9:
        report.complaints.append("an equilibrium")
    if (
        clock is not None
        and abs(orbit.period / (orbit.multiplicity * clock) - 1) > 1e-9
    ):
        report.complaints.append(
            f"the period {orbit.period} is not that of the clock {clock}"
        )
    nodes = nodes_of(orbit)
    if not nodes:
        report.complaints.append("no row of the trajectory is away from events")
        return report
    simulator = Simulator(model, scale=scale)
    pieces, found, legs = [], [], []
    for k, row in enumerate(nodes):
        last = k == len(nodes) - 1
        after = nodes[0] if last else nodes[k + 1]
        span = orbit.time[after] - orbit.time[row] + (orbit.period if last else 0.0)
        legs.append((row, after, span))
        motion = simulator.run(
            orbit.chart[row], orbit.state[row], orbit.time[row], span
        )
        pieces += motion.pieces
        found += motion.events
        report.remarks += [r for r in motion.remarks if r not in report.remarks]
        if motion.ending != "ok":
            report.complaints.append(
                f"simulation from t = {orbit.time[row]}: {motion.ending}"
            )
            return report
        if motion.chart != orbit.chart[after]:
            report.complaints.append(
                f"from t = {orbit.time[row]:.9g} in '{orbit.chart[row]}' the motion comes to "
                f"'{motion.chart}', not to '{orbit.chart[after]}'"
            )
            return report
        error = np.max(np.abs(motion.state - orbit.state[after]) / scale[motion.chart])
        if error > 1e-6:
            report.complaints.append(
                f"from t = {orbit.time[row]:.9g} the motion misses the next point by {error:.1e}"
            )
    report.complaints += [r for r in report.remarks if "order matters" in r]
    report.complaints += compare_events(orbit, found)
    report.complaints += early_return(orbit, pieces, scale, nodes[0], clock)
    report.complaints += ghosts(simulator, pieces, found)
    together = any("coincides" in r for r in report.remarks)
    if multipliers and not report.complaints and not together:
        mine = monodromy(simulator, orbit, legs, scale, clock is None, report)
        if mine is not None:
            report.multipliers = mine
            report.complaints += compare_multipliers(mine, orbit.multipliers)
    return report


def compare_events(orbit: Orbit, found: list) -> list:
    ours = sorted(found, key=lambda e: e.time % orbit.period)
    names = sorted(e.name for e in found)
    theirs = sorted(e.name for e in orbit.events)
    if names != theirs:
        return [f"events of the cycle {theirs}, of the simulation {names}"]
    for name in set(names):
        a = np.sort([e.time % orbit.period for e in ours if e.name == name])
        b = np.sort([e.time % orbit.period for e in orbit.events if e.name == name])
        # Both lists are cyclic: an event close to the begin may appear at the end.
        shifts = [np.roll(b, k) for k in range(-1, 2)]
        distance = [
            np.abs((a - s + orbit.period / 2) % orbit.period - orbit.period / 2)
            for s in shifts
        ]
        worst = min(float(np.max(d)) for d in distance)
        if worst > 1e-6 * orbit.period:
            return [f"'{name}' is off by {worst / orbit.period:.1e} periods"]
    return []


def early_return(orbit, pieces, scale, row, clock) -> list:
    """Does the orbit close before its period?"""
    chart, state, begin = orbit.chart[row], orbit.state[row], orbit.time[row]
    if clock is not None:
        found = []
        for m in range(1, orbit.multiplicity):
            if orbit.multiplicity % m:
                continue
            for piece in pieces:
                t = begin + m * clock
                if piece.chart == chart and piece.begin <= t <= piece.end:
                    gap = np.max(
                        np.abs(piece.at(np.array([t]))[:, 0] - state) / scale[chart]
                    )
                    if gap < 1e-5:
                        found.append(
                            f"closes after {m} of {orbit.multiplicity} periods"
                        )
        return found
    best = []
    for piece in pieces:
        if piece.chart != chart:
            continue
        for step in piece.steps:
            t = np.linspace(step.t_min, step.t_max, 9)
            gap = np.max(
                np.abs(step(t) - state[:, None]) / scale[chart][:, None], axis=0
            )
            k = int(np.argmin(gap))
            if gap[k] > 0.05:
                continue
            left, right = t[max(k - 1, 0)], t[min(k + 1, 8)]

            def away(x, step=step):
                return float(np.max(np.abs(step(x) - state) / scale[chart]))

            low = scipy.optimize.minimize_scalar(
                away,
                bounds=(left, right),
                method="bounded",
                options={"xatol": 1e-13 * orbit.period},
            )
            lag = (low.x - begin) / orbit.period
            if low.fun < 1e-5 and 0.01 < lag % 1.0 < 0.99:
                best.append(lag)
    if best:
        return [f"closes after {min(best):.6g} of its period"]
    return []


def ghosts(simulator, pieces, found) -> list:
    """Guards that the orbit is beyond all along."""
    complaints = []
    happened = {event.name for event in found}
    for chart in {piece.chart for piece in pieces}:
        for event in simulator.exits[chart]:
            if event.guard is None or event.name in happened or not event.domain:
                continue
            beyond, usable = True, event.enabled is None
            for piece in pieces:
                if piece.chart != chart:
                    continue
                t = np.linspace(piece.begin, piece.end, 200)
                states = piece.at(t)
                value = simulator.guard(event, t, states)
                beyond = beyond and bool(np.all(value <= 1e-12 * np.max(np.abs(value))))
                if not usable:
                    usable = any(
                        simulator.enabled(event, x, states[:, k])
                        for k, x in enumerate(t)
                    )
            if beyond and usable:
                complaints.append(
                    f"ghost: in '{chart}' always beyond the guard of '{event.name}'"
                )
    return complaints


def monodromy(simulator, orbit, legs, scale, autonomous, report):
    """Multipliers of one period by central differences over the legs, or None."""
    product = None
    for row, after, span in legs:
        source, target = orbit.chart[row], orbit.chart[after]
        matrix = None
        for step in (1e-5, 1e-6, 1e-7):
            matrix = difference(
                simulator, orbit, row, target, span, step * scale[source]
            )
            if matrix is not None:
                break
        if matrix is None:
            report.remarks.append("no finite differences: events change order nearby")
            return None
        scaled = matrix * scale[source][None, :] / scale[target][:, None]
        product = scaled if product is None else scaled @ product
    values = np.linalg.eigvals(product)
    if autonomous and len(values):
        k = int(np.argmin(np.abs(values - 1)))
        if abs(values[k] - 1) > 1e-3:
            report.remarks.append(f"no multiplier near 1: {values}")
        values = np.delete(values, k)
    return values[np.argsort(-np.abs(values))]


def difference(simulator, orbit, row, target, span, steps):
    state, chart, begin = orbit.state[row], orbit.chart[row], orbit.time[row]
    columns, names = [], None
    for k, step in enumerate(steps):
        ends = []
        for sign in (1.0, -1.0):
            moved = np.array(state)
            moved[k] += sign * step
            motion = simulator.run(chart, moved, begin, span, record=False)
            order = [event.name for event in motion.events]
            names = order if names is None else names
            if motion.ending != "ok" or motion.chart != target or order != names:
                return None
            ends.append(motion.state)
        columns.append((ends[0] - ends[1]) / (2 * step))
    return np.stack(columns, axis=1)


def compare_multipliers(mine: np.ndarray, theirs: np.ndarray) -> list:
    largest = max([1.0, *np.abs(mine)])
    floor = 1e-5 * largest
    left = list(mine)
    for value in theirs:
        if not left:
            if abs(value) > 2 * floor:
                return [f"multipliers {theirs}, by differences {mine}"]
            continue
        k = int(np.argmin([abs(x - value) for x in left]))
        if abs(left[k] - value) > 1e-3 * abs(value) + floor:
            return [f"multipliers {theirs}, by differences {mine}"]
        left.pop(k)
    if any(abs(x) > 2 * floor for x in left):
        return [f"multipliers {theirs}, by differences {mine}"]
    return []


@dataclasses.dataclass
class Settled:
    """Where a long simulation from a guess ends."""

    what: str
    period: float = 0.0
    turns: int = 0
    remarks: tuple = ()


def settle(model: Model, chart: str, state, start: float, wall: float = 6.0) -> Settled:
    """A long simulation from a guess: 'cycle', 'equilibrium', 'unsettled', 'beyond a guard' for a
    cycle that is outside of the model, or an ending."""
    clock = clock_of(model)
    simulator = Simulator(model, rtol=1e-9, per_period=8)
    deadline = time.monotonic() + wall
    state = np.array(state, dtype=float)
    duration = (
        20 * clock if clock else first_time(model, simulator, chart, state, start)
    )
    remarks: list = []
    now = start
    while time.monotonic() < deadline:
        motion = simulator.run(
            chart, state, now, duration, wall=max(0.1, deadline - time.monotonic())
        )
        remarks += [r for r in motion.remarks if r not in remarks]
        if motion.ending == "wall time":
            break
        if motion.ending != "ok":
            return Settled(motion.ending, remarks=tuple(remarks))
        found = clock_return(motion, clock) if clock else own_return(motion)
        if found is not None:
            turn = tail_of(motion, motion.time - found.period)
            if found.what == "cycle" and ghosts(simulator, turn.pieces, turn.events):
                found = dataclasses.replace(found, what="beyond a guard")
            return dataclasses.replace(found, remarks=tuple(remarks))
        chart, state, now = motion.chart, motion.state, motion.time
        if clock is None:
            duration *= 1.6
    return Settled("unsettled", remarks=tuple(remarks))


def first_time(model, simulator, chart, state, start) -> float:
    """A time scale of the motion, from the field and from the first events."""
    rates = simulator.field(chart)(start, state)
    ratio = np.abs(state) / np.maximum(np.abs(rates), 1e-300)
    finite = ratio[(ratio > 0) & (ratio < 1e6)]
    scale = float(np.median(finite)) if len(finite) else 1.0
    return 20 * min(max(scale, 1e-6), 100.0)


def sizes(motion: Motion) -> dict:
    low, high = {}, {}
    for piece in motion.pieces:
        if not piece.steps:
            continue
        ends = np.stack([step(step.t_max) for step in piece.steps], axis=1)
        low[piece.chart] = np.minimum(low.get(piece.chart, np.inf), ends.min(axis=1))
        high[piece.chart] = np.maximum(high.get(piece.chart, -np.inf), ends.max(axis=1))
    return {
        chart: (high[chart] - low[chart], np.maximum(abs(high[chart]), abs(low[chart])))
        for chart in low
    }


def state_at(motion: Motion, t: float):
    for piece in reversed(motion.pieces):
        if piece.steps and piece.begin <= t <= piece.end:
            return piece.chart, piece.at(np.array([t]))[:, 0]
    return None, None


def tail_of(motion: Motion, begin: float) -> Motion:
    """The steps and events of a motion after a time."""
    pieces = []
    for piece in motion.pieces:
        steps = [step for step in piece.steps if step.t_max > begin]
        if steps:
            pieces.append(Piece(piece.chart, steps))
    events = [event for event in motion.events if event.time > begin]
    return Motion(pieces, events, [], motion.chart, motion.state, motion.time)


def clock_return(motion: Motion, clock: float) -> Settled | None:
    size = sizes(motion)
    last = sizes(tail_of(motion, motion.time - 2 * clock))
    now = motion.time - 0.137 * clock  # not at an event of the clock
    chart, state = state_at(motion, now)
    if chart is None:
        return None
    for turns in range(1, 7):
        old_chart, old = state_at(motion, now - turns * clock)
        if old_chart != chart:
            continue
        bound = 1e-6 * np.maximum(
            last.get(chart, size[chart])[0], 1e-6 * size[chart][1]
        )
        if np.all(np.abs(old - state) <= bound + 1e-300):
            still = not motion.events and np.all(
                last[chart][0] <= 1e-7 * last[chart][1] + 1e-12
            )
            return Settled("equilibrium" if still else "cycle", turns * clock, turns)
    return None


def own_return(motion: Motion) -> Settled | None:
    """A return of an autonomous motion to its last state, twice in a row."""
    pieces = [p for p in motion.pieces if p.steps]
    half = motion.time - 0.5 * (motion.time - pieces[0].begin)
    tail = tail_of(motion, half)
    last = sizes(tail)
    recent = tail.events
    spread, largest = last[motion.chart]
    if not recent and np.all(spread <= 1e-6 * np.maximum(largest, 1e-6)):
        return Settled("equilibrium")
    chart, state = motion.chart, motion.state
    unit = np.maximum(spread, 1e-6 * largest + 1e-300)
    lags, left = [], False
    for piece in reversed(pieces):
        if piece.chart != chart:
            left = True
            continue
        for step in reversed(piece.steps):
            t = np.linspace(step.t_min, step.t_max, 9)
            gap = np.max(np.abs(step(t) - state[:, None]) / unit[:, None], axis=0)
            left = left or gap[0] > 0.2
            k = int(np.argmin(gap))
            if not left or gap[k] > 0.2:
                continue

            def away(x, step=step):
                return float(np.max(np.abs(step(x) - state) / unit))

            low = scipy.optimize.minimize_scalar(
                away,
                bounds=(t[max(k - 1, 0)], t[min(k + 1, 8)]),
                method="bounded",
                options={"xatol": 1e-12 * (motion.time - pieces[0].begin)},
            )
            if low.fun < 1e-5:
                lags.append(motion.time - low.x)
                left = False
                if len(lags) == 2:
                    if abs(lags[1] / lags[0] - 2) < 1e-4:
                        return Settled("cycle", lags[0], 1)
                    return None
    return None
