"""The independent truth: an event loop over scipy's DOP853, in plain numpy.

scipy sees only sign changes between the ends of steps, so guards are sampled densely on each
step's dense output here, and every minimum between samples is looked at. A guard is armed once
it has left zero on the side from which it crosses.
"""

import dataclasses

import numpy as np
from scipy.integrate import DOP853
from scipy.optimize import brentq, minimize_scalar

from .structures import Plan, Sample


# Guards are sampled at this many points of each step.
SAMPLES = 64
# A guard has left zero if it is this far from it.
LEFT = 1e-11
# Events, or an event and what would have been one, closer than this are too close.
CLOSE = 1e-6
# A guard that crosses more slowly than this fraction of its largest rate is grazed.
SLOW = 1e-3


@dataclasses.dataclass
class Event:
    """An event: its time, its transition, the chart and the state after it."""

    t: float
    code: int
    chart: int
    after: np.ndarray


@dataclasses.dataclass
class Run:
    """A trajectory: its events, where it ended, and if it is one, why it is a border case."""

    events: list[Event]
    t: float
    chart: int
    q: np.ndarray
    excluded: str | None = None


def run(plan: Plan, sample: Sample, events: int, rtol: float, atol: float) -> Run:
    """Follow a system until it has had some number of events, or to its time limit."""
    t, q, u, limit = sample.start
    found = []
    chart = 0
    excluded = None
    while len(found) < events and t < limit:
        state = np.asarray(q, float)
        stay = _Stay(plan, sample, chart, t, state, u)
        t, q, code, reason = stay.follow(limit, rtol, atol)
        excluded = excluded or reason
        if code is None:
            break
        x = sample.arrows[code]
        kept = x["R"] @ q
        pushed = x["V"] @ u
        q = kept + x["r"] + pushed
        chart = plan.arrows[code].target
        if found and t - found[-1].t < CLOSE:
            excluded = excluded or "events too close"
        found.append(Event(t, code, chart, q))
    return Run(found, t, chart, q, excluded)


class _Stay:
    """A stay in one chart, from its entry to the next event."""

    def __init__(self, plan: Plan, sample: Sample, chart: int, t: float, q, u):
        self.t = t
        self.q = q
        self.u = u
        self.x = sample.charts[chart]
        self.arrows = sample.arrows
        self.plan = plan
        self.clocks = []
        self.guards = []
        for g, arrow in enumerate(plan.arrows):
            if arrow.source == chart:
                kind = self.clocks if arrow.kind == "scheduled" else self.guards
                kind.append(g)
        self.armed = {g: self.guard(g, t, q) > LEFT for g in self.guards}
        self.fastest = dict.fromkeys(self.guards, 0.0)
        self.excluded = None

    def field(self, t, q):
        x = self.x
        linear = x["A"] @ q + x["b"]
        cubic = x["cube"] * q**3
        smooth = linear + x["B"] @ self.u - cubic
        swing = x["S"] @ np.sin(q)
        bounded = swing + x["T"] @ np.tanh(q)
        phase = x["w"] * t + x["p"]
        wave = x["a"] * np.sin(phase)
        return smooth + bounded + wave

    def guard(self, g, t, q):
        """Guard g at one state, or at states (n, m), signed so that it falls at its event."""
        x = self.arrows[g]
        phase = x["w"] * t + x["p"]
        wave = x["a"] * np.sin(phase)
        along = x["n"] @ q + x["c"]
        flat = along + x["m"] @ self.u + wave
        bent = q * (x["Q"] @ q)
        curved = 0.5 * np.sum(bent, axis=0)
        value = flat + curved
        return value if self.plan.arrows[g].kind == "falling" else -value

    def rate(self, g, t, q):
        """Time derivative of `guard` at one state."""
        x = self.arrows[g]
        symmetric = x["Q"] + x["Q"].T
        slope = x["n"] + 0.5 * symmetric @ q
        phase = x["w"] * t + x["p"]
        slope_of_wave = x["a"] * x["w"]
        wave = slope_of_wave * np.cos(phase)
        rate = slope @ self.field(t, q) + wave
        return rate if self.plan.arrows[g].kind == "falling" else -rate

    def enabled(self, g, q):
        if not self.plan.arrows[g].gated:
            return True
        x = self.arrows[g]
        return x["k"] @ q + x["k0"] > 0

    def tick(self):
        """The next scheduled event: time, transition."""
        times = []
        for g in self.clocks:
            period = self.arrows[g]["period"]
            offset = self.arrows[g]["offset"]
            passed = (self.t - offset) / period
            k = np.floor(passed + 1e-9) + 1
            times.append((offset + k * period, g))
        return min(times, default=(np.inf, None))

    def follow(self, limit, rtol, atol):
        """Time, state, transition (None at the limit) and reason of exclusion at the next event."""
        due, clock = self.tick()
        end = min(limit, due)
        solver = DOP853(self.field, self.t, self.q, end, rtol=rtol, atol=atol)
        while solver.status == "running":
            message = solver.step()
            assert solver.status != "failed", message
            hit = self.first(solver.t_old, solver.t, solver.dense_output())
            if hit is not None:
                t, q, g = hit
                self.look(t, q, g, min(due, limit))
                return t, q, g, self.excluded
        self.look(end, solver.y, None, np.inf)
        event = clock if due < limit else None
        return end, solver.y, event, self.excluded

    def first(self, a, b, dense):
        """The first event in a step: time, state, transition."""
        t = np.linspace(a, b, SAMPLES + 1)
        q = dense(t)
        crossings = []
        for g in self.guards:
            crossings += self.crossings(g, t, q, dense)
        crossings.sort()
        for k, (time, g) in enumerate(crossings):
            state = dense(time)
            if self.enabled(g, state):
                for later, _ in crossings[k + 1 :]:
                    if later - time < CLOSE:
                        self.excluded = "events too close"
                return time, state, g
        return None

    def with_minima(self, value, t, v):
        """Samples, and the minima below zero between them."""
        inner = v[1:-1]
        below_last = inner <= v[:-2]
        below_next = inner <= v[2:]
        is_dip = (inner > 0) & below_last & below_next
        for k in np.flatnonzero(is_dip)[::-1] + 1:
            low = minimize_scalar(
                value,
                bounds=(t[k - 1], t[k + 1]),
                method="bounded",
                options={"xatol": 1e-12},
            )
            if low.fun < 0 and low.x != t[k]:
                place = k if low.x < t[k] else k + 1
                t = np.insert(t, place, low.x)
                v = np.insert(v, place, low.fun)
        return t, v

    def crossings(self, g, t, q, dense):
        """All falls of a guard through zero in a step."""

        def value(time):
            return self.guard(g, time, dense(time))

        values = self.guard(g, t, q)
        t, v = self.with_minima(value, t, values)
        steps = np.diff(v) / np.diff(t)
        rates = np.abs(steps)
        fastest = rates.max()
        self.fastest[g] = max(self.fastest[g], fastest)
        found = []
        for k in range(1, len(t)):
            self.armed[g] |= v[k - 1] > LEFT
            if self.armed[g] and v[k] <= 0:
                time = t[k - 1]
                if v[k - 1] > 0:
                    time = brentq(value, time, t[k], xtol=1e-15)
                found.append((time, g))
                self.armed[g] = False
        self.armed[g] |= v[-1] > LEFT
        return found

    def look(self, t, q, fired, known):
        """Whether an event is a border case."""
        for g in self.guards:
            value = self.guard(g, t, q)
            rate = self.rate(g, t, q)
            if g != fired and self.armed[g] and abs(value) < CLOSE * abs(rate):
                self.excluded = "events too close"
            if g == fired and -rate < SLOW * self.fastest[g]:
                self.excluded = "grazing"
        if known - t < CLOSE:
            self.excluded = "events too close"
