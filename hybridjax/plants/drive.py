"""A plant driven from section to section. Workers import this file, so it needs only Python."""

import dataclasses
import math
import operator
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple


class Stopped(Exception):
    """The end of an experiment: its cause, and whether a section was missed."""

    def __init__(self, cause: str, missed: bool = False):
        super().__init__(cause)
        self.missed = missed


@dataclasses.dataclass
class ClockWatch:
    """Sections at equal times in a period. `first`: a time of section 0."""

    timed: ClassVar[bool] = True  # (the time until a section)
    ordered: ClassVar[bool] = True  # (sections cannot be crossed in another order)
    n: int
    period: float
    first: float
    start: float = 0.0

    def begin(self, t: float, z: Sequence[float], on_section: bool = False) -> None:
        """Count sections from the next section 0 on, or from the one on which the plant is."""
        turns = (t - self.first) / self.period
        self.start = self.first + self.period * (round(turns) if on_section else math.ceil(turns))

    def level(self, k: int, t: float, z: Sequence[float]) -> float:
        """Return a number that falls through zero at section k, counted from `begin` on."""
        return self.start + k / self.n * self.period - t


@dataclasses.dataclass
class AngleWatch:
    """Sections at equal angles of two signals: columns, center, scale, angle of section 0, and the
    sense of rotation."""

    timed: ClassVar[bool] = False
    ordered: ClassVar[bool] = True
    n: int
    columns: tuple[int, int]
    center: Sequence[float]
    scale: Sequence[float]
    first: float
    sense: float
    phase: float = 0.0

    def angle(self, z: Sequence[float]) -> float:
        """Return the angle in radians."""
        (i, j), (a, b), (p, q) = self.columns, self.center, self.scale
        return math.atan2((z[j] - b) / q, (z[i] - a) / p)

    def begin(self, t: float, z: Sequence[float], on_section: bool = False) -> None:
        """Count sections as `ClockWatch.begin` does."""
        turns = self.sense * (self.angle(z) - self.first) / (2 * math.pi)
        self.phase = turns - (round(turns) if on_section else math.ceil(turns))

    def level(self, k: int, t: float, z: Sequence[float]) -> float:
        """Return a number that falls through zero at section k. The angle is unwrapped."""
        turns = self.sense * (self.angle(z) - self.first) / (2 * math.pi) - self.phase
        self.phase += turns - round(turns)
        return k / self.n - self.phase


@dataclasses.dataclass
class ListWatch:
    """Sections one by one: for each its column, +1 if it is falling and -1 if rising, and the
    value."""

    timed: ClassVar[bool] = False
    ordered: ClassVar[bool] = False
    items: tuple[tuple[int, float, float], ...]

    @property
    def n(self) -> int:
        return len(self.items)

    def begin(self, t: float, z: Sequence[float], on_section: bool = False) -> None:
        """Nothing is counted: each section is crossed in its turn."""

    def level(self, k: int, t: float, z: Sequence[float]) -> float:
        """Return a number that falls through zero at section k."""
        column, sign, value = self.items[k % len(self.items)]
        return sign * (z[column] - value)


class Crossed(NamedTuple):
    """A section: the time at which it was crossed, the signals there, interpolated between two
    steps, and the time by which the plant is beyond it."""

    t: float
    z: Sequence[float]
    late: float


class Start(NamedTuple):
    """A start on section 0: time, signals, and the state of a plant that can be set."""

    t: float
    z: tuple[float, ...]
    state: Any


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
        self.z: tuple[float, ...] = ()
        self.recent: list[tuple[float, tuple[float, ...]]] = []
        self.watch: Any = None

    def reset(self, seed: int) -> None:
        """Begin at time 0. **Raises:** `Stopped`, like all methods, if the plant fails."""
        try:
            observation = self.plant.reset(seed)
        except Exception as error:
            raise Stopped(f"`reset` raised {type(error).__name__}: {error}") from error
        self._observe(observation, 0.0)
        self.recent = []

    def restore(self, start: Start) -> None:
        """Continue from a state that was kept."""
        self.plant.set_state(start.state)
        self.t, self.z, self.recent = start.t, start.z, []

    def here(self) -> Start:
        """Return the present time, signals and state."""
        return Start(self.t, self.z, self.plant.get_state() if self.sets else None)

    def step(self, u: Sequence[float], h: float) -> None:
        """Hold the input for some time."""
        last = self.t, self.z
        try:
            observation = self.plant.step(u, h)
        except Exception as error:
            text = f"{type(error).__name__}: {error}"
            raise Stopped(f"`step` raised {text} (t = {self.t:.6g})") from error
        self._observe(observation, self.t + h)
        self.recent = [*self.recent[-1:], last]

    def _observe(self, observation: Any, t: float) -> None:
        names = tuple(observation)
        if names != self.names:
            if self.names:
                raise Stopped(f"signals changed from {self.names} to {names} (t = {t:.6g})")
            self.names = names
        self.t, self.z = t, tuple(observation.values())
        total = sum(self.z)
        if not total - total == 0:
            k = [not x - x == 0 for x in self.z].index(True)
            raise Stopped(f"{names[k]} became {self.z[k]} (t = {t:.6g})")

    def run(self, duration: float) -> None:
        """Let the plant run without input."""
        for _ in range(round(duration / self.dt)):
            self.step(self.zero, self.dt)

    def advance(self, u: Sequence[float], k: int, pause: float = 0.0) -> Crossed:
        """Hold the input until section k. Steps end on the section, unless the plant's steps are
        fixed.

        **Arguments:** `pause`: time in which a section is not crossed again (bounces, noise).
        """
        watch, began, near = self.watch, self.t, 1e-9 * self.dt
        level, timed, ordered = watch.level, watch.timed, watch.ordered
        points: list[tuple[float, float]] = []
        if not timed:
            points = [(t, level(k, t, z)) for t, z in self.recent]
        x = level(k, self.t, self.z)
        if x <= 0 and ordered and self.recent:  # two sections in one step
            last = level(k, *self.recent[-1])
            level(k, self.t, self.z)
            if last > 0:
                return self._between(*self.recent[-1], last, x)
        armed, lands = ordered, self.sets and not self.fixed and not timed
        while True:
            wait = x if timed else self.dt
            if not timed and x > 0 and not self.fixed:
                points = [*points[-2:], (self.t, x)]
                wait = _wait(points)
            if armed and 0 < x and wait <= near:
                return Crossed(self.t, self.z, -wait)
            wait = wait if armed and x > 0 and not self.fixed else self.dt
            t, z = self.t, self.z
            closing = lands and wait <= self.dt
            before = self.here() if closing else None
            self.step(u, min(wait, self.dt))
            y = level(k, self.t, self.z)
            if armed and y <= 0 and self.t - began > pause:
                if before is not None:
                    self._land(u, k, before, x, y)
                    y = level(k, self.t, self.z)
                if y <= 0:
                    return self._between(t, z, x, y)
            armed = ordered or y > 0
            x = y
            if self.t - began > self.longest:
                text = f"section {k % watch.n} was not reached within {self.longest:.4g}"
                raise Stopped(f"{text} (t = {self.t:.6g})", missed=True)

    def _between(self, t: float, z: Sequence[float], x: float, y: float) -> Crossed:
        """Return the section between an earlier point and the present one."""
        share = x / (x - y) if x > y else 1.0
        at = t + share * (self.t - t)
        values = tuple(a + share * (b - a) for a, b in zip(z, self.z, strict=True))
        return Crossed(at, values, self.t - at)

    def _land(self, u: Sequence[float], k: int, before: Start, x: float, y: float) -> None:
        """Repeat a step that went beyond a section, so that it ends there (Illinois method)."""
        low, high, side = 0.0, self.t - before.t, 0
        recent = self.recent[:-1]
        for _ in range(40):
            beyond = (self.t - before.t - low) * -y / (x - y) if y <= 0 else 0.0
            if y <= 0 and beyond <= 1e-9 * self.dt:
                return
            h = low + (high - low) * x / (x - y)
            self.plant.set_state(before.state)
            self.t, self.z, self.recent = before.t, before.z, recent
            self.step(u, h)
            level = self.watch.level(k, self.t, self.z)
            if level > 0:
                low, x, y = h, level, y / 2 if side > 0 else y
                side = 1
                if (high - low) <= 1e-9 * self.dt:
                    return
            else:
                high, y, x = h, level, x / 2 if side < 0 else x
                side = -1


def _wait(points: Sequence[tuple[float, float]]) -> float:
    """Return the time until the level is zero, by inverse interpolation through the last two or
    three points (infinite if unknown)."""
    if len(points) < 2 or points[-2][1] <= points[-1][1]:
        return math.inf
    (t1, x1), (t2, x2) = points[-2:]
    secant = x2 * (t2 - t1) / (x1 - x2)
    if len(points) == 2 or points[-3][1] <= x1:
        return secant
    t0, x0 = points[-3]
    first = (x1 * (t0 - t2) - x0 * (t1 - t2)) / (x1 - x0)
    third = (x2 * first - x0 * secant) / (x2 - x0)
    return third if secant / 2 < third < 2 * secant else secant


class Trial(NamedTuple):
    """One experiment: signals (n, ny) at the sections, lateness (n,), number of samples that it
    holds, cause of its end ("" if it ran to its end), and whether it missed a section."""

    y: list[list[float]]
    late: list[float]
    cause: str = ""
    missed: bool = False


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
    start: Start
    warmup: float
    longest: float
    pause: float

    def run(self, seed: int, u: Sequence[Sequence[float]]) -> Trial:
        """Run one experiment with inputs u (n, nu), each held until the next section."""
        drive = Drive(self.plant, self.names, self.longest)
        y: list[list[float]] = []
        late: list[float] = []
        take = operator.itemgetter(*self.columns)
        single = len(self.columns) == 1
        try:
            self._require_repeatable(drive, seed)
            at = self.begin(drive)
            for k, held in enumerate(u, 1):
                values = take(at.z)
                y.append([values] if single else list(values))
                late.append(at.late)
                if k < len(u):
                    at = drive.advance(held, k, self.pause)
        except Stopped as stop:
            return Trial(y, late, str(stop), stop.missed)
        except Exception as error:
            return Trial(y, late, f"{type(error).__name__}: {error} (t = {drive.t:.6g})")
        return Trial(y, late)

    def begin(self, drive: Drive) -> Crossed:
        """Bring a plant to section 0, right after its `reset`."""
        drive.watch = dataclasses.replace(self.watch)
        if drive.sets:
            drive.restore(self.start)
            drive.watch.begin(drive.t, drive.z, on_section=True)
            return Crossed(drive.t, drive.z, 0.0)
        drive.run(self.warmup)
        drive.watch.begin(drive.t, drive.z)
        return drive.advance(drive.zero, 0)

    def _require_repeatable(self, drive: Drive, seed: int) -> None:
        """Compare the first steps after two equal resets; the plant is then reset once more."""
        courses = []
        for _ in range(2):
            drive.reset(seed)
            courses.append([drive.z])
            for _ in range(16):
                drive.step(drive.zero, drive.dt)
                courses[-1].append(drive.z)
        if courses[0] != courses[1]:
            raise Stopped("the plant is not deterministic after `reset(seed)`")
        drive.reset(seed)
