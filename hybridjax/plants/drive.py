"""A plant driven from section to section, in worker processes that may fail, hang or end without
harm to the others.

`cycle.py` makes a `Drive`, which joins a `Plant` (`reset`, `step`) with a `PlantPhase` (which
section comes when), and calls `advance` for single sections, or `resume` and `run_all` for many
experiments in processes. Each returns points (`At`) or a `Trial`. A section at a wrong time comes
from `PlantPhase.level`, a wrong signal on it from `_landed` or `_interpolated`, a wrong start of an
experiment from `Drive.begin`, and a worker that does not answer from `serve` or `run_all`.

Two things must stay: `PlantPhase.level` falls through zero at a section, and `serve` and `run_all`
exchange the same messages in the same order. Workers import this file, so that it needs only
Python. They are not those of `multiprocessing`, which would run the main script again, and cannot
be ended one by one.
"""

import contextlib
import dataclasses
import json
import math
import os
import pickle
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, Protocol, runtime_checkable

from ..errors import ComputationError, DefinitionError


@runtime_checkable
class Plant(Protocol):
    """A simulator that can be reset and stepped. It does not need JAX.

    **Fields:**

    - `inputs`: names of the inputs, or units by name.
    - `dt`: the longest time step. Sections are detected after each step.

    **Methods:**

    - `reset(seed)` begins at time 0 and returns an observation: the signals by name, always the
      same names in the same order. The seed determines everything that is random.
    - `step(u, duration)` holds the inputs `u` for a time and returns the observation at its end.

    A step raises any exception to end an experiment, for example where a walker falls.

    **Optional:**

    - `get_state()` and `set_state(x)`: the state, from which the plant continues exactly. For
      `perturbed_returns` it is an array of numbers, which can be changed by small amounts.
    - `states`: names of these numbers. `time` is the time of the clock.
    - `period`: period of the clock, on which the plant depends.
    - `fixed_step`: True if a step always lasts `dt`. Otherwise steps end on clock sections, and on
      others if the state can be set.
    - `units`: units of signals by name.

    An example of a plant is that of `hj.plants.find_cycle`.

    **Before:** a simulator. **After:** `hj.plants.find_cycle`.
    """

    inputs: Sequence[str] | Mapping[str, str]
    dt: float

    def reset(self, seed: int) -> Mapping[str, float]: ...

    def step(self, u: Sequence[float], duration: float) -> Mapping[str, float]: ...


@dataclasses.dataclass
class PlantPhase:
    """The rule by which a section is recognized: at equal phases of a period, at equal angles of
    two signals, or where signals cross levels.

    **Fields:** `first`: time or angle of section 0. `axes`: column, center and scale of the two
    signals of the angle. `sense`: -1 if the angle decreases. `start`: the angle, in revolutions,
    from which on sections are counted. `crossings`: for each section the column of its signal, the
    sign (1 if the signal falls) and the level.
    """

    n: int
    period: float = 1.0
    first: float = 0.0
    axes: Sequence[tuple[int, float, float]] = ()
    sense: float = 1.0
    turns: float = 0.0
    start: float = 0.0
    crossings: Sequence[tuple[int, float, float]] = ()

    def begin(self, t: float, z: Sequence[float], on_section: bool = False) -> None:
        """Count sections from the next section 0 on, or from the one on which the plant is."""
        self.turns = 0.0
        self.level(0, t, z)
        self.start = round(self.turns) if on_section else math.ceil(self.turns)

    def level(self, k: int, t: float, z: Sequence[float]) -> float:
        """Return a number that falls through zero at section k, counted from `begin` on. It is the
        time until the section, the angle until the section (unwrapped, in revolutions), or the
        signal minus its level."""
        if self.crossings:
            c, sign, value = self.crossings[k % self.n]
            return sign * (z[c] - value)
        if self.axes:
            x, y = ((z[column] - center) / scale for column, center, scale in self.axes)
            since = math.atan2(y, x) - self.first
            angle = self.sense * since / (2 * math.pi)
            self.turns = angle + round(self.turns - angle)
        else:
            self.turns = (t - self.first) / self.period
        return (self.start + k / self.n - self.turns) * self.period


class At(NamedTuple):
    """A point on the way of a plant: time and signals (on a section they may be interpolated
    between two steps); the time by which the plant has gone beyond the point; and the state, if it
    can be set."""

    t: float
    z: Sequence[float]
    late: float = 0.0
    state: Any = None


Trial = tuple[list[list[float]], str]
"""One experiment: outputs at the sections, with the lateness as a last column (n, ny + 1); and the
reason why it ended early, "" if it did not."""


class Drive:
    """A plant, and how it is taken from section to section.

    **Fields:**

    - `names`: names of the signals in order. If empty, the names of the first observation are
      taken. `columns`: columns of the outputs.
    - `phase`: the rule of the sections. `longest`: longest time from one section to the next.
      Default: a million steps.
    - `start`: point on section 0 at which experiments start. `warmup`: for a plant whose state
      cannot be set, the time for which it runs after `reset` instead.
    - `t`, `z`: present time since `reset`, and signals. `last`: the point before, if known.
    """

    def __init__(self, plant: Any):
        self.plant = plant
        self.dt = float(plant.dt)
        self.fixed = bool(getattr(plant, "fixed_step", False))
        self.sets = hasattr(plant, "get_state") and hasattr(plant, "set_state")
        self.zero = [0.0] * len(plant.inputs)
        self.t = 0.0
        self.warmup = 0.0
        self.longest = 1e6 * self.dt
        self.names = tuple[str, ...]()
        self.columns = tuple[int, ...]()
        self.z = tuple[float, ...]()
        self.phase = PlantPhase(1)
        self.start = At(0.0, ())
        self.last = At(0.0, ())

    def _take(self, observation: Any, t: float) -> None:
        """Keep the signals that the plant returned for time t.

        **Raises:** `ComputationError` for other names than before, and for NaN or infinity.
        """
        names = tuple(observation)
        self.t = t
        if self.names and names != self.names:
            raise ComputationError(f"signals changed from {self.names} to {names}")
        self.z = tuple(observation.values())
        self.names = names
        for name, x in zip(names, self.z, strict=True):
            if not x - x == 0:
                raise ComputationError(f"{name} became {x}")

    def reset(self, seed: int) -> None:
        """Begin at time 0.

        **Raises:** `ComputationError`, like all methods, for NaN and signals with other names.
        """
        self._take(self.plant.reset(seed), 0.0)
        self.last = At(0.0, ())

    def step(self, u: Sequence[float], h: float) -> None:
        """Hold the input for some time."""
        self._take(self.plant.step(u, h), self.t + h)

    def here(self) -> At:
        """Return the present time, signals and state."""
        return At(
            t=self.t,
            z=self.z,
            late=0.0,
            state=self.plant.get_state() if self.sets else None,
        )

    def restore(self, start: At) -> None:
        """Continue from a state that was kept."""
        self.plant.set_state(start.state)
        self.t = start.t
        self.z = tuple(start.z)
        self.last = At(0.0, ())

    def pass_time(self, duration: float) -> None:
        """Let the plant run without input."""
        for _ in range(round(duration / self.dt)):
            self.step(self.zero, self.dt)

    def advance(self, u: Sequence[float], k: int, points: list[At] | None = None) -> At:
        """Hold the input until section k, and append the point before each step to `points`.

        The last step ends on the section if the time of the section is known or if the state can be
        set. Otherwise it ends after the section. A crossing counts only if a step has ended before
        it, so that no crossing is counted twice.
        """
        phase = self.phase
        began = self.t
        armed = not phase.crossings
        by_clock = armed and not phase.axes
        stops = by_clock and not self.fixed
        lands = self.sets and not self.fixed and not by_clock
        reached = 1e-9 * self.dt if by_clock else 0.0  # (rounding is no step)
        # (A step may cross two sections.)
        last = self.last if self.last.z else At(self.t, self.z)
        before = phase.level(k, last.t, last.z)
        level = phase.level(k, self.t, self.z)
        while level > reached or not armed:
            if self.t - began > self.longest:
                raise ComputationError(
                    f"a section was not reached within {self.longest:.4g}"
                )
            last = self._point(points, lands)
            before = level
            self.step(u, min(level, self.dt) if stops else self.dt)
            level = phase.level(k, self.t, self.z)
            armed = armed or level > 0
        if lands and level < 0 < before:
            return self._landed(u, k, last)
        self.last = last
        return self._interpolated(last, before, level)

    def _point(self, points: list[At] | None, with_state: bool) -> At:
        """Return the present point, with its state if `with_state`. It is also appended to
        `points`, unless these are None."""
        if points is None and not with_state:
            return At(self.t, self.z)
        point = self.here()
        if points is not None:
            points.append(point)
        return point

    def _landed(self, u: Sequence[float], k: int, last: At) -> At:
        """Repeat the step after `last` with the length at which it ends on section k."""
        from scipy import optimize

        def level(h: float) -> float:
            self.restore(last)
            if h > 0:
                self.step(u, h)
            return self.phase.level(k, self.t, self.z)

        longest = self.t - last.t
        h: Any = optimize.brentq(level, 0.0, longest, xtol=1e-11 * self.dt)
        level(h)
        return At(self.t, self.z)

    def _interpolated(self, last: At, before: float, level: float) -> At:
        """Return the point at which the line between the last two points meets the section.
        `before`, `level`: levels at these two points."""
        share = before / (before - level) if before > level else 1.0
        at = last.t + share * (self.t - last.t)
        ends = zip(last.z, self.z, strict=True)
        values = tuple(begin + share * (end - begin) for begin, end in ends)
        return At(at, values, self.t - at)

    def run(self, seed: int, u: Sequence[Sequence[float]]) -> Trial:
        """Run one experiment with inputs u (n, nu), each held until the next section."""
        rows = list[At]()
        ended = ""
        try:
            if self.first_signals(seed) != self.first_signals(seed):
                raise ComputationError(
                    "the plant is not deterministic after `reset(seed)`"
                )
            rows.append(self.begin(seed))
            for k, held in enumerate(u[:-1], 1):
                rows.append(self.advance(held, k))
        except Exception as error:
            ended = f"{error} (t = {self.t:.6g})"
            if not isinstance(error, ComputationError):
                ended = f"the plant raised {type(error).__name__}: {ended}"
        values = []
        for x in rows:
            outputs = [float(x.z[c]) for c in self.columns]
            values.append([*outputs, x.late])
        return values, ended

    def first_signals(self, seed: int) -> Sequence[float]:
        """Return the signals after the first steps."""
        self.reset(seed)
        self.pass_time(16 * self.dt)
        return self.z

    def begin(self, seed: int) -> At:
        """Bring a plant to section 0."""
        self.reset(seed)
        if self.sets:
            self.restore(self.start)
        else:
            self.pass_time(self.warmup)
        self.phase.begin(self.t, self.z, on_section=self.sets)
        return self.start if self.sets else self.advance(self.zero, 0)


def serve() -> None:
    """Run experiments in a worker process. The parent writes pickles to its standard input (the
    packed `Drive`, then seed and inputs of each experiment) and reads results from its standard
    output."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a plant prints goes to standard error
    try:
        drive = pickle.loads(pickle.load(sys.stdin.buffer))
    except Exception as error:
        pickle.dump(f"{type(error).__name__}: {error}", answers)
        return answers.close()
    with contextlib.suppress(EOFError):
        while True:
            pickle.dump(drive.run(*pickle.load(sys.stdin.buffer)), answers)
            answers.flush()


def run_all(
    drive: Drive,
    items: Iterable[Any],
    processes: int,
    limit: float,
) -> Iterator[Trial]:
    """Run experiments (seed, inputs) in processes with a limit of time, and yield them in order.
    Processes that ended are replaced.
    """
    packed = _pack(drive)
    local = threading.local()
    begun = list[Any]()

    def run(item: tuple[int, Any]) -> Trial:
        local.worker = getattr(local, "worker", None) or _start(packed, begun)
        worker = local.worker
        timer = threading.Timer(limit, local.worker.kill)
        timer.start()
        try:
            pickle.dump(item, worker.stdin)
            worker.stdin.flush()
            answer = pickle.load(worker.stdout)
        except (EOFError, pickle.UnpicklingError, OSError):
            local.worker = None
            code = worker.wait()
            cause = (
                f"the process ended with code {code} (its error is on standard error)"
            )
            if not timer.is_alive():
                cause = f"no answer within the limit of {limit:g} s"
            return [], cause
        finally:
            timer.cancel()
        if isinstance(answer, str):
            raise DefinitionError(
                f"another process cannot make the plant ({answer}): define it in a module that can "
                "be imported, or use `processes=0`."
            )
        return answer

    with ThreadPoolExecutor(processes) as pool:
        try:
            yield from pool.map(run, items)
        finally:
            for worker in begun:
                worker.kill()
                worker.communicate()


def resume(
    file: Any,
    about: str,
    count: int,
    run: Callable[[list[int]], Any],
) -> list[Trial]:
    """Run the experiments that are not yet in a file of SQLite (None: memory), and store each one
    when it ends.

    **Raises:** `DefinitionError` for a file of another kind, or in a folder that is not there.
    """
    table = "create table if not exists trials (about, s, trial, unique (about, s))"
    rows = "select s, trial from trials where about = ?"
    try:
        base = sqlite3.connect(file or ":memory:", isolation_level=None)
        with contextlib.closing(base):
            base.execute(table)
            kept = dict(base.execute(rows, [about]))
            missing = [s for s in range(count) if s not in kept]
            for s, trial in zip(missing, run(missing), strict=True):
                kept[s] = json.dumps(trial)
                row = about, s, kept[s]
                base.execute("replace into trials values (?, ?, ?)", row)
    except sqlite3.Error as error:
        raise DefinitionError(
            f"'{file}' is no store of experiments ({error})."
        ) from error
    return [json.loads(kept[s]) for s in range(count)]


def _start(packed: bytes, begun: list[Any]) -> Any:
    """Start a worker process, append it to `begun`, and send it the packed drive."""
    # (One thread of BLAS, because the processes use all cores.)
    paths = [os.environ.get("PYTHONPATH"), *sys.path]
    path = os.pathsep.join(filter(None, paths))
    command = [
        sys.executable,
        "-c",
        "from hybridjax.plants.drive import serve; serve()",
    ]
    changes = {"PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    pipe = subprocess.PIPE
    environment = os.environ | changes
    begun.append(subprocess.Popen(command, stdin=pipe, stdout=pipe, env=environment))
    pickle.dump(packed, begun[-1].stdin)
    return begun[-1]


def _pack(drive: Drive) -> bytes:
    """Return the pickle of a drive. Classes in notebooks and scripts are pickled by cloudpickle, if
    it is installed.

    **Raises:** `DefinitionError` for a plant that cannot be pickled.
    """
    packer = pickle
    try:
        with contextlib.suppress(ImportError):
            import cloudpickle as packer  # type: ignore

            for module in list(sys.modules.values()):
                if getattr(module, "__spec__", packer) is None:  # (in no file)
                    packer.register_pickle_by_value(module)  # type: ignore
        return packer.dumps(drive)
    except Exception as error:
        raise DefinitionError(
            f"the plant cannot be pickled ({error}): give it `__getstate__`, or use `processes=0`."
        ) from error
