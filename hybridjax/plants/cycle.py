"""The limit cycle of a plant: the sections on it, outputs there, and experiments around it."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float

from .._core.arguments import require_among
from .._core.boundary.checked import checked, checked_methods
from .._core.boundary.containers import Having
from .._core.boundary.kinds import FilePath, Index, Positive, Seed, SignalNames
from .._core.boundary.values import Whole
from .._core.execution import core_count
from .._core.pieces.description import digest_of
from .._core.progress import counted, working
from .._core.results import Result
from .._core.signal import Signal, signals, unit_of
from .._core.text import listed
from ..errors import ComputationError, DefinitionError
from ..experiments.data import ExperimentData, Simulated
from ..experiments.design.design import DISCARD
from ..experiments.run import DesignLike, Inputs, check_inputs
from ..orbits.crossing import AtEvent, Crossing
from ..sections import families
from .drive import At, Drive, Experiment, ListWatch, PhaseWatch, Stopped, Trial
from .plant import Plant
from .processes import resume, run_all
from .returns import Returns, returns_of


PlantLike = Annotated[Plant, Having(Plant)]


@checked_methods
@dataclasses.dataclass(frozen=True, eq=False)
class SettledCycle:
    """The limit cycle of a plant, as `hj.plants.settle` measures it.

    **Fields:**

    - `plant`, `sections`, `inputs`, `outputs`.
    - `period`: mean duration of a cycle.
    - `cycle_outputs` (N, ny): mean outputs at the sections.
    - `noise` (N, ny): their standard deviations from cycle to cycle, without inputs.
    - `late`: largest time by which a step ended after its section.
    """

    plant: Plant
    sections: families.AbstractSections
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    period: float
    cycle_outputs: Float[np.ndarray, "N ny"]
    noise: Float[np.ndarray, "N ny"]
    late: float
    experiment: Experiment = dataclasses.field(repr=False)
    seed: int = 0

    def run_experiments(
        self, design: DesignLike, *, discard: Index = DISCARD, limit: Positive = 600.0,
        processes: Annotated[int, Whole(0, 4096)] | None = None, store: FilePath | None = None,
    ) -> ExperimentData:  # fmt: skip
        """Excite the plant around its cycle, and record its outputs at the sections.

        An input is held from section to section. Experiments start on section 0: from the settled
        state, or, if the plant's state cannot be set, after `reset` and the time of settling.
        Experiment s resets the plant with the seed `seed + 1 + s`.

        **Arguments:**

        - `design`: a `Design`, or inputs (S, n, nu).
        - `discard`: number of cycles before those for estimation. Default: 20.
        - `processes`: number of processes, each with a copy of the plant. 0: this process, without
            limit of time. Default: one for each core.
        - `limit`: time in seconds after which a process that has not finished an experiment is
            ended. Default: 600.
        - `store`: file of SQLite that keeps finished experiments. After an interruption, repeat the
            call. Default: none.

        **Returns:** `ExperimentData`. Failures are listed by `summary()`: missed sections, errors
        that the plant raised (a fall), NaN, other signals, no answer within the limit, random
        numbers that do not follow the seed. `simulated.late` (S, n) are the times by which steps
        ended after their sections.

        **Raises:** `DefinitionError` for a design that does not fit, and for a plant that cannot be
        made in other processes; `ComputationError` if the cycle has not settled.
        """
        inputs = check_inputs(design, discard, self.sections.n_sections, len(self.inputs))
        count = min(core_count() if processes is None else processes, len(inputs))
        u = inputs.part(slice(0, len(inputs)))

        def run(rows: list[int]) -> Iterator[Trial]:
            items = ((self.seed + 1 + s, u[s].tolist()) for s in rows)
            trials = run_all(self.experiment, items, count, limit)
            yield from counted(trials, "experiments", len(rows))

        with working("run_experiments"):
            # (A plant is described by the cycle that was measured.)
            course = [f"{x:.6g}" for x in (self.period, *np.ravel(self.cycle_outputs))]
            names = type(self.plant).__name__, self.outputs, inputs.periods
            about = digest_of(names, course, self.sections, u, self.seed) if store else ""
            return _collect(self, inputs, resume(store, about, len(u), run))

    def perturbed_returns(self, coordinates: SignalNames | None = None) -> Returns:
        """Estimate the multipliers from returns of perturbed states to section 0.

        Newton's method moves the state onto the cycle. Central differences of fourth order give the
        Jacobian of the return map, with steps that the scatter of returns from nearly equal states
        determines (measured by differences along lines: Moré and Wild 2011).

        **Arguments:**

        - `coordinates`: names among `plant.states` to perturb. Others keep their values. Leave out
          those on which nothing depends, such as the distance walked. Default: all; at
          clock sections all but `time`.

        **Returns:** `Returns`, a `MultiplierEstimate`.

        **Raises:** `DefinitionError` for a plant whose state cannot be set, or unknown names;
        `ComputationError` if a perturbed state does not return.
        """
        return returns_of(self, coordinates)

    def __repr__(self) -> str:
        spread = self.noise.max() / max(np.ptp(self.cycle_outputs), 1e-300)
        names = f"{listed(self.inputs)} -> {listed(self.outputs)}"
        return (
            f"SettledCycle({type(self.plant).__name__}: period {self.period:.9g}, "
            f"{self.sections.n_sections} sections, {names}; scatter {spread:.1g} of the range, "
            f"sections late by at most {self.late:.1g})"
        )


@checked
@working("settle")
def settle(
    plant: PlantLike, sections: families.FamilyLike, outputs: SignalNames, *,
    cycles: Annotated[int, Whole(8, 1_000_000)] = 100, seed: Seed = 0,
) -> SettledCycle:  # fmt: skip
    """Let a plant run without inputs until it repeats itself, and locate sections on its cycle.

    **Arguments:**

    - `sections`: `ClockPhase` for a plant with a `period`, `KinematicPhase` of two signals, or one
      or several `Crossing`s of signals.
    - `outputs`: names of signals.
    - `cycles`: number of cycles before the sections are located. A quarter as many are then
      recorded. Default: 100.
    - `seed`: seed of `reset`. Default: 0.

    **Returns:** a `SettledCycle`.

    **Raises:** `DefinitionError` for unknown signals, sections that need equations (events,
    functions of a state), and a plant that does not continue from the state that it returned;
    `ComputationError` if the plant fails or has not settled.
    """
    family = families.as_family(sections)
    if missing := [x for x in ("inputs", "dt", "reset", "step") if not hasattr(plant, x)]:
        raise DefinitionError(f"the plant has no `{missing[0]}` (see `hj.plants.Plant`).")
    drive = Drive(plant)
    try:
        drive.reset(seed)
        require_among("output", outputs, drive.names, "")
        drive.watch = _bound(drive, family, cycles)
        warmup = drive.t
        drive.watch.begin(drive.t, drive.z)
        drive.advance(drive.zero, 0)
        return _measure(drive, family, tuple(outputs), max(cycles // 4, 2), warmup, seed)
    except Stopped as stop:
        raise ComputationError(f"without inputs the plant failed: {stop}.") from stop


def _measure(
    drive: Drive, family: families.AbstractSections, outputs: tuple[str, ...],
    cycles: int, warmup: float, seed: int,
) -> SettledCycle:  # fmt: skip
    """Record cycles, and prepare experiments. The plant is on section 0."""
    N, names, plant = family.n_sections, drive.names, drive.plant
    columns = tuple(names.index(x) for x in outputs)

    def turn(pause: float) -> tuple[At, list[At]]:
        start = drive.here()
        drive.watch.begin(drive.t, drive.z, on_section=True)
        return start, [drive.advance(drive.zero, k, pause) for k in range(1, N + 1)]

    start, at = turn(0.0)
    drive.longest = 2 * (at[-1].t - start.t)
    # Bounces and noise last for less than an eighth of the time between sections.
    pause = drive.longest / N / 16 if isinstance(drive.watch, ListWatch) else 0.0
    turns = [turn(pause) for _ in range(cycles + 1)]
    values = np.array([[[x.z[c] for c in columns] for x in at] for _, at in turns])
    values = np.roll(values, 1, axis=1)  # (section 0 ends each cycle)
    _require_settled(values)
    start, at = turns[-1]
    if drive.sets:
        drive.restore(start)
        change = np.abs(np.array([x.z for x in turn(pause)[1]]) - [x.z for x in at])[:, columns]
        if (change > 1e-6 * np.ptp(values, axis=(0, 1))).any():
            text = "`get_state` must return all that its future depends on"
            raise DefinitionError(
                f"after `set_state` the plant does not continue as before: {text}."
            )
    experiment = Experiment(plant, drive.watch, names, columns, start, warmup, drive.longest, pause)
    given, units = plant.inputs, getattr(plant, "units", {})
    of_inputs = dict(given) if isinstance(given, Mapping) else {x: unit_of(x) for x in given}
    ends = [at[-1].t for _, at in turns]
    return SettledCycle(
        plant, family, signals(of_inputs, of_inputs.values()),
        tuple(Signal(x, unit_of(x) or units.get(x, "")) for x in outputs),
        period=float(np.diff(ends).mean()), cycle_outputs=values.mean(axis=0),
        noise=values.std(axis=0), late=max(x.late for _, at in turns for x in at),
        experiment=experiment, seed=seed,
    )  # fmt: skip


def _require_settled(values: Float[np.ndarray, "c N ny"]) -> None:
    """**Raises:** `ComputationError` if outputs of both halves differ by more than they scatter."""
    half = len(values) // 2
    first, last = values[:half], values[-half:]
    change = np.abs(first.mean(axis=0) - last.mean(axis=0)).max(axis=0)
    scatter = np.sqrt((first.var(axis=0) + last.var(axis=0)) / half).max(axis=0)
    size = np.ptp(values, axis=(0, 1))
    if (change > np.maximum(1e-4 * size, 5 * scatter)).any() or not (size > 0).all():
        worst = float((change / np.maximum(size, 1e-300)).max())
        text = f"outputs still change by {worst:.1g} of their range; give more `cycles`"
        raise ComputationError(f"the plant has not settled: {text}, or stabilize the plant.")


def _bound(drive: Drive, family: families.AbstractSections, cycles: int) -> Any:
    """Run the plant for some cycles, and return the sections with the numbers of its cycle."""
    N, anchor = family.n_sections, getattr(family, "anchor", 0.0)
    if isinstance(family, families.SectionList):
        drive.watch = ListWatch(tuple(_item(drive, x) for x in family.items))
        drive.longest = 100_000 * drive.dt
        for _ in range(cycles):
            drive.advance(drive.zero, 0)
        return drive.watch
    if isinstance(family, families.ClockPhase):
        period = getattr(drive.plant, "period", None)
        if period is None:
            text = "set its `period`, or use KinematicPhase or a Crossing"
            raise DefinitionError(f"sections at equal times need a plant with a clock: {text}.")
        drive.run(cycles * period)
        if isinstance(anchor, Crossing):
            anchor = _anchor(drive, anchor, period).t / period
        return PhaseWatch(N, period, float(anchor) * period)
    if isinstance(family, families.KinematicPhase):
        pair = family.position, family.velocity
        require_among("signal", pair, drive.names, "KinematicPhase(position, velocity): ")
        i, j = map(drive.names.index, pair)
        rows: list[tuple[float, float]] = []
        turns = 0.0
        center, scale = np.zeros(2), np.ones(2)
        while abs(turns) < cycles:
            if len(rows) > 1_000_000:  # (fewer: slow rhythms with short steps are refused)
                raise Stopped(f"its signals made {abs(turns):.3g} turns in {len(rows)} steps")
            for _ in range(max(256, len(rows) // 8)):
                drive.step(drive.zero, drive.dt)
                rows.append((drive.z[i], drive.z[j]))
            z = np.array(rows)
            low, high = np.min(z[len(z) // 2 :], axis=0), np.max(z[len(z) // 2 :], axis=0)
            center = (low + high) / 2 if family.center is None else np.asarray(family.center)
            scale = (high - low) / 2 if family.scale is None else np.asarray(family.scale)
            x, y = ((z - center) / scale).T
            angle = np.unwrap(np.arctan2(y, x))
            turns = float(angle[-1] - angle[0]) / (2 * np.pi)
        sense = float(np.sign(turns))
        watch = PhaseWatch(N, 1.0, 0.0, (i, j), center.tolist(), scale.tolist(), sense)
        if isinstance(anchor, Crossing):
            z = _anchor(drive, anchor, drive.t / abs(turns)).z
            anchor = 2 * np.pi * sense * watch.turns(0.0, z)
        return dataclasses.replace(watch, first=float(anchor))
    text = "use ClockPhase, KinematicPhase, or Crossings of signals"
    raise DefinitionError(f"{type(family).__name__} needs equations: {text}.")


def _item(drive: Drive, section: Crossing | AtEvent) -> tuple[int, float, float]:
    """Return the column, sign and value of a crossing."""
    if not isinstance(section, Crossing) or not isinstance(section.function, str):
        raise DefinitionError(f"{section}: sections of a plant are crossings of its signals.")
    require_among("signal", [section.function], drive.names, "Crossing: ")
    sign = 1.0 if section.direction == "falling" else -1.0
    return drive.names.index(section.function), sign, float(section.value)


def _anchor(drive: Drive, anchor: Crossing, period: float) -> At:
    """Return a crossing on the cycle."""
    drive.watch, drive.longest = ListWatch((_item(drive, anchor),)), 3 * period
    return [drive.advance(drive.zero, 0, period / 4) for _ in range(2)][-1]


def _collect(cycle: SettledCycle, inputs: Inputs, trials: Sequence[Trial]) -> ExperimentData:
    """Return the data of all experiments."""
    u, N = inputs.part(slice(0, len(inputs))), cycle.sections.n_sections
    S, n, _ = u.shape
    y, late = np.full((S, n, len(cycle.outputs)), np.nan), np.full((S, n), np.nan)
    failed_at, result = np.full(S, -1), np.full(S, int(Result.OK))
    for s, trial in enumerate(trials):
        k = len(trial.late)
        if k:
            y[s, :k] = trial.y - cycle.cycle_outputs[np.arange(k) % N]
        late[s, :k] = trial.late
        if trial.cause:
            failed_at[s] = k
            result[s] = Result.PLANT_STOPPED
    causes = tuple(x.cause for x in trials)
    return ExperimentData(
        u, y, n_sections=N, periods=inputs.periods, inputs=cycle.inputs, outputs=cycle.outputs,
        result=result, cycle_outputs=cycle.cycle_outputs,
        simulated=Simulated(failed_at, None, cycle.sections.label, late, causes),
    )  # fmt: skip
