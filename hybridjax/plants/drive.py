"""A plant driven from section to section. Workers import this file, so it needs only Python."""

import dataclasses
import math
import os
import pickle
import sys
from collections.abc import Sequence
from typing import Any, NamedTuple


class Stopped(Exception):
    """The end of an experiment, with its cause."""


@dataclasses.dataclass
class PhaseWatch:
    """Sections at equal phases of a period (`columns` None), or of the angle of two signals.

    **Fields:** `first`: time or angle of section 0. `scale`, `center`: of the two signals. `sense`:
    +1 if the angle grows, otherwise -1.
    """

    n: int
    period: float
    first: float = 0.0
    columns: tuple[int, int] | None = None
    center: Sequence[float] = (0.0, 0.0)
    scale: Sequence[float] = (1.0, 1.0)
    sense: float = 1.0
    phase: float = 0.0
    start: float = 0.0

    def turns(self, t: float, z: Sequence[float]) -> float:
        """Return the phase from section 0 in turns, for angles up to whole turns."""
        if self.columns is None:
            return (t - self.first) / self.period
        (i, j), (a, b), (p, q) = self.columns, self.center, self.scale
        angle = math.atan2((z[j] - b) / q, (z[i] - a) / p)
        return self.sense * (angle - self.first) / (2 * math.pi)

    def begin(self, t: float, z: Sequence[float], on_section: bool = False) -> None:
        """Count sections from the next section 0 on, or from the one on which the plant is."""
        self.phase = self.turns(t, z)
        self.start = round(self.phase) if on_section else math.ceil(self.phase)

    def level(self, k: int, t: float, z: Sequence[float]) -> float:
        """Return a number that falls through zero at section k, counted from `begin` on: the time
        until then, or an angle in turns, which is unwrapped."""
        turns = self.turns(t, z)
        if self.columns is not None:
            turns += round(self.phase - turns)
        self.phase = turns
        return (self.start + k / self.n - turns) * self.period


@dataclasses.dataclass
class ListWatch:
    """Sections one by one: for each its column, +1 if it is falling and -1 if rising, and the
    value."""

    items: tuple[tuple[int, float, float], ...]

    def begin(self, t: float, z: Sequence[float], on_section: bool = False) -> None:
        """Nothing is counted: each section is crossed in its turn."""

    def level(self, k: int, t: float, z: Sequence[float]) -> float:
        """Return a number that falls through zero at section k."""
        column, sign, value = self.items[k % len(self.items)]
        return sign * (z[column] - value)


class At(NamedTuple):
    """A point of a course: time and signals, at sections interpolated between two steps; the time
    by which the plant is beyond it; and the state of a plant that can be set."""

    t: float
    z: Sequence[float]
    late: float = 0.0
    state: Any = None


class Drive:
    """A plant, its time since `reset`, and its signals.

    **Arguments:** `names`: the signals in order; empty: those of the first observation. `longest`:
    time that one section may take.
    """

    def __init__(self, plant: Any, names: tuple[str, ...] = (), longest: float = math.inf):
        self.plant, self.names, self.longest = plant, names, longest
        self.dt, self.fixed = float(plant.dt), bool(getattr(plant, "fixed_step", False))
        self.sets = hasattr(plant, "get_state") and hasattr(plant, "set_state")
        self.zero = [0.0] * len(plant.inputs)
        self.t = 0.0
        self.z: Sequence[float] = ()
        self.last: At | None = None
        self.watch: Any = None

    def reset(self, seed: int) -> None:
        """Begin at time 0. **Raises:** `Stopped`, like all methods, if the plant fails."""
        self._observe("reset", 0.0, seed)
        self.last = None

    def restore(self, start: At) -> None:
        """Continue from a state that was kept."""
        self.plant.set_state(start.state)
        self.t, self.z, self.last = start.t, start.z, None

    def here(self) -> At:
        """Return the present time, signals and state."""
        return At(self.t, self.z, 0.0, self.plant.get_state() if self.sets else None)

    def step(self, u: Sequence[float], h: float) -> None:
        """Hold the input for some time."""
        self._observe("step", self.t + h, u, h)

    def _observe(self, method: str, t: float, *arguments: Any) -> None:
        try:
            observation = getattr(self.plant, method)(*arguments)
        except Exception as error:
            text = f"`{method}` raised {type(error).__name__}: {error}"
            raise Stopped(f"{text} (t = {self.t:.6g})") from error
        names = tuple(observation)
        if self.names and names != self.names:
            raise Stopped(f"signals changed from {self.names} to {names} (t = {t:.6g})")
        self.t, self.z, self.names = t, tuple(observation.values()), names
        for name, x in zip(names, self.z, strict=True):
            if not x - x == 0:
                raise Stopped(f"{name} became {x} (t = {t:.6g})")

    def run(self, duration: float) -> None:
        """Let the plant run without input."""
        for _ in range(round(duration / self.dt)):
            self.step(self.zero, self.dt)

    def advance(self, u: Sequence[float], k: int, pause: float = 0.0) -> At:
        """Hold the input until section k. Steps end on it if its time is known, or if the state can
        be set; steps of fixed length end after it.

        **Arguments:** `pause`: time in which a section is not crossed again (bounces, noise).
        """
        watch, began = self.watch, self.t
        ordered = isinstance(watch, PhaseWatch)  # (sections cannot be crossed in another order)
        x, last, armed = watch.level(k, self.t, self.z), self.last, ordered
        if ordered and watch.columns is None and not self.fixed:
            while x > 1e-9 * self.dt:
                self.step(u, min(x, self.dt))
                x = watch.level(k, self.t, self.z)
            return At(self.t, self.z, max(0.0, -x))
        if x <= 0 and armed and last is not None:  # two sections in one step
            before = watch.level(k, last.t, last.z)
            x = watch.level(k, self.t, self.z)
            if before > 0:
                return self._between(last, before, x)
        while self.t - began <= self.longest:
            lands = self.sets and not self.fixed and armed and x > 0
            last = self.here() if lands else At(self.t, self.z)
            self.step(u, self.dt)
            self.last = last
            y = watch.level(k, self.t, self.z)
            if armed and y <= 0 and self.t - began > pause:
                return self._land(u, k, last, x, y) if lands else self._between(last, x, y)
            armed, x = ordered or y > 0, y
        text = f"a section was not reached within {self.longest:.4g}"
        raise Stopped(f"{text} (t = {self.t:.6g})")

    def _between(self, last: At, x: float, y: float) -> At:
        """Return the section between an earlier point and the present one."""
        share = x / (x - y) if x > y else 1.0
        at = last.t + share * (self.t - last.t)
        values = tuple(a + share * (b - a) for a, b in zip(last.z, self.z, strict=True))
        return At(at, values, self.t - at)

    def _land(self, u: Sequence[float], k: int, before: At, x: float, y: float) -> At:
        """Repeat a step that went beyond a section, so that it ends there (Illinois method)."""
        low, high, side = 0.0, self.t - before.t, 0.0
        for _ in range(40):
            h = low + (high - low) * x / (x - y)
            self.restore(before)
            self.step(u, h)
            level = self.watch.level(k, self.t, self.z)
            late = -level * (high - low) / (x - y)
            if abs(late) <= 1e-9 * self.dt or high - low <= 1e-9 * self.dt:
                break
            if level > 0:
                low, x, y, side = h, level, y / 2 if side > 0 else y, 1.0
            else:
                high, y, x, side = h, level, x / 2 if side < 0 else x, -1.0
        return At(self.t, self.z, late)


class Trial(NamedTuple):
    """One experiment: signals (n, ny) at the sections, lateness (n,), and the cause of its end, ""
    if it ran to its end."""

    y: list[list[float]]
    late: list[float]
    cause: str = ""


@dataclasses.dataclass(frozen=True)
class Experiment:
    """How all experiments of a campaign are run.

    **Fields:** `columns`: of the outputs. `start`: on section 0, with `names`, `watch`. `warmup`:
    time for which a plant whose state cannot be set runs after `reset` instead. `longest`, `pause`:
    as in `Drive`.
    """

    plant: Any
    watch: Any
    names: tuple[str, ...]
    columns: tuple[int, ...]
    start: At
    warmup: float
    longest: float
    pause: float

    def run(self, seed: int, u: Sequence[Sequence[float]], repeats: bool = False) -> Trial:
        """Run one experiment with inputs u (n, nu), each held until the next section.

        **Arguments:** `repeats`: whether the plant is known to repeat itself after `reset`.
        """
        drive = Drive(self.plant, self.names, self.longest)
        y: list[list[float]] = []
        late: list[float] = []
        try:
            if not repeats:
                self._require_repeatable(drive, seed)
            at = self._begin(drive, seed)
            for k, held in enumerate(u, 1):
                y.append([float(at.z[c]) for c in self.columns])
                late.append(at.late)
                if k < len(u):
                    at = drive.advance(held, k, self.pause)
        except Exception as error:
            text = f"{type(error).__name__}: {error} (t = {drive.t:.6g})"
            return Trial(y, late, str(error) if isinstance(error, Stopped) else text)
        return Trial(y, late)

    def _require_repeatable(self, drive: Drive, seed: int) -> None:
        """Compare the first steps after two equal resets."""
        courses: list[list[Sequence[float]]] = [[], []]
        for course in courses:
            drive.reset(seed)
            for _ in range(16):
                course.append(drive.z)
                drive.step(drive.zero, drive.dt)
        if courses[0] != courses[1]:
            raise Stopped("the plant is not deterministic after `reset(seed)`")

    def _begin(self, drive: Drive, seed: int) -> At:
        """Bring a plant to section 0."""
        drive.reset(seed)
        drive.watch = dataclasses.replace(self.watch)
        if drive.sets:
            drive.restore(self.start)
            drive.watch.begin(drive.t, drive.z, on_section=True)
            return At(drive.t, drive.z)
        drive.run(self.warmup)
        drive.watch.begin(drive.t, drive.z)
        return drive.advance(drive.zero, 0)


def serve() -> None:
    """Run experiments in a worker: standard input holds pickles that only the parent writes (the
    packed `Experiment`, then the seed and inputs of each), standard output the answers."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a plant prints goes to standard error
    problem, packed = "", pickle.load(sys.stdin.buffer)
    try:
        experiment = pickle.loads(packed)
    except Exception as error:
        problem = f"{type(error).__name__}: {error}"
    while True:
        try:
            item = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        pickle.dump(problem or tuple(experiment.run(*item)), answers)
        answers.flush()
