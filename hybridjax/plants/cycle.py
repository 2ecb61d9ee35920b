"""The limit cycle of a plant: the sections on it, outputs there, and experiments around it."""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float

from .._core.arguments import Numbers, require_among
from .._core.boundary.checked import checked, checked_methods
from .._core.boundary.containers import Having
from .._core.boundary.kinds import FilePath, Index, Positive, Seed, SignalNames
from .._core.boundary.values import Reals, Whole
from .._core.execution import core_count
from .._core.pieces.description import digest_of
from .._core.progress import counted, working
from .._core.results import Result
from .._core.signal import Signal, signals, unit_of
from .._core.text import listed
from ..errors import ComputationError, DefinitionError
from ..experiments.data import ExperimentData, Simulated
from ..experiments.design.design import DISCARD
from ..experiments.run import DesignLike, check_inputs
from ..orbits.crossing import Crossing
from ..sections import families
from .drive import At, Drive, Phase, Plant, Stopped, Trial, resume, run_all
from .returns import Map, Returns, returns_of


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
    - `state`: that of the plant on section 0, if it can be set.
    """

    plant: Plant
    sections: families.AbstractSections
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    period: float
    cycle_outputs: Float[np.ndarray, "N ny"]
    noise: Float[np.ndarray, "N ny"]
    late: float
    state: Any
    drive: Drive = dataclasses.field(repr=False)
    seed: int = 0

    def run_experiments(
        self,
        design: DesignLike,
        *,
        discard: Index = DISCARD,
        limit: Positive = 600.0,
        processes: Annotated[int, Whole(0, 4096)] | None = None,
        store: FilePath | None = None,
    ) -> ExperimentData:
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
        N = self.sections.n_sections
        inputs = check_inputs(design, discard, N, len(self.inputs))
        count = min(core_count() if processes is None else processes, len(inputs))
        u = inputs.part(slice(0, len(inputs)))

        def run(rows: list[int]) -> Iterator[Trial]:
            items = ((self.seed + 1 + s, u[s].tolist()) for s in rows)
            yield from counted(run_all(self.drive, items, count, limit), "experiments", len(rows))

        with working("run_experiments"):
            # (A plant is described by the cycle that was measured.)
            course = [f"{x:.6g}" for x in (self.period, *np.ravel(self.cycle_outputs))]
            names = type(self.plant).__name__, self.outputs, inputs.periods
            about = digest_of(names, course, self.sections, u, self.seed) if store else ""
            trials = resume(store, about, len(u), run)
        # (Rows are as long as the inputs, and NaN from the end of an experiment on.)
        ends, ny = [len(late) for _, late, _ in trials], len(self.outputs)
        rows = np.full((*u.shape[:2], ny + 1), np.nan)
        for s, (y, late, _) in enumerate(trials):
            rows[s, : ends[s]] = np.c_[np.reshape(y, (-1, ny)), late]
        causes = tuple(cause for _, _, cause in trials)
        failed = np.array([x != "" for x in causes])
        failed_at, label = np.where(failed, ends, -1), self.sections.label
        return ExperimentData(
            u,
            rows[..., :ny] - np.tile(self.cycle_outputs, (u.shape[1] // N, 1)),
            n_sections=N,
            periods=inputs.periods,
            inputs=self.inputs,
            outputs=self.outputs,
            result=np.where(failed, Result.PLANT_STOPPED, Result.OK),
            cycle_outputs=self.cycle_outputs,
            simulated=Simulated(failed_at, None, label, rows[..., ny], causes),
        )

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
        names = f"{listed(self.inputs)} -> {listed(self.outputs)}"
        plant, N, scatter = type(self.plant).__name__, len(self.noise), self.noise.max(axis=0)
        return (
            f"SettledCycle({plant}: period {self.period:.9g}, {N} sections, {names}; "
            f"scatter {listed([f'{x:.1g}' for x in scatter])}, late by {self.late:.1g})"
        )


@checked
@working("settle")
def settle(
    plant: PlantLike,
    sections: families.FamilyLike,
    outputs: SignalNames,
    *,
    cycles: Annotated[int, Whole(8, 1_000_000)] = 100,
    guess: Annotated[Numbers, Reals("states")] | None = None,
    seed: Seed = 0,
) -> SettledCycle:
    """Let a plant run without inputs until it repeats itself, and locate sections on its cycle.

    **Arguments:**

    - `sections`: `ClockPhase` for a plant with a `period`, or `KinematicPhase` of two signals, with
      numbers as `anchor`.
    - `outputs`: names of signals.
    - `cycles`: number of cycles before the sections are located. A quarter as many are then
      recorded. Default: 100.
    - `guess`: a state near the cycle at time 0, from which Newton's method on the return map finds
      the cycle, also an unstable one. Default: none, the plant settles.
    - `seed`: seed of `reset`. Default: 0.

    **Returns:** a `SettledCycle`.

    **Raises:** `DefinitionError` for unknown signals, for sections that need equations, and for a
    plant that does not continue from the state that it returned; `ComputationError` if the plant
    has not settled, or returns NaN. Errors of the plant pass through.
    """
    family, drive = families.as_family(sections), Drive(plant)
    try:
        drive.reset(seed)
        require_among("output", outputs, drive.names, "")
        drive.columns = tuple(map(drive.names.index, outputs))
        if guess is not None:
            drive.restore(At(0.0, drive.z, state=np.asarray(guess)))
            drive.step(drive.zero, drive.dt)
        drive.phase = _bound(drive, family, cycles if guess is None else 0)
        drive.warmup = drive.t
        drive.phase.begin(drive.t, drive.z)
        drive.advance(drive.zero, 0)
        if guess is not None:
            Map(_measure(drive, family, 1, seed)).solve()
        return _measure(drive, family, max(cycles // 4, 2) if guess is None else 2, seed)
    except Stopped as stop:
        raise ComputationError(f"without inputs {stop} (t = {drive.t:.6g}).") from stop


def _measure(
    drive: Drive, family: families.AbstractSections, cycles: int, seed: int
) -> SettledCycle:
    """Record cycles, and prepare experiments. The plant is on section 0."""
    N, plant = family.n_sections, drive.plant

    def turn() -> tuple[At, list[At]]:
        start = drive.here()
        drive.phase.begin(drive.t, drive.z, on_section=True)
        return start, [drive.advance(drive.zero, k) for k in range(1, N + 1)]

    start, at = turn()
    drive.longest = 2 * (at[-1].t - start.t)
    turns = [turn() for _ in range(cycles + 1)]
    values = np.array([[[x.z[c] for c in drive.columns] for x in at] for _, at in turns])
    values = np.roll(values, 1, axis=1)  # (section 0 ends each cycle)
    if cycles > 1:
        _require_settled(values)
    drive.start, at = turns[-1]
    if drive.sets:
        drive.restore(drive.start)
        change = np.abs(np.array([x.z for x in turn()[1]]) - [x.z for x in at])
        if (change[:, list(drive.columns)] > 1e-6 * np.ptp(values, axis=(0, 1))).any():
            text = "`get_state` must return all that its future depends on"
            raise DefinitionError(f"`set_state` does not continue as before: {text}.")
    given, units = plant.inputs, getattr(plant, "units", {})
    of_inputs = dict(given) if isinstance(given, Mapping) else {x: unit_of(x) for x in given}
    return SettledCycle(
        plant=plant,
        sections=family,
        inputs=signals(of_inputs, of_inputs.values()),
        outputs=tuple(Signal(drive.names[c], units.get(drive.names[c], "")) for c in drive.columns),
        period=float(np.diff([at[-1].t for _, at in turns]).mean()),
        cycle_outputs=values.mean(axis=0),
        noise=values.std(axis=0),
        late=max(x.late for _, at in turns for x in at),
        state=drive.start.state,
        drive=drive,
        seed=seed,
    )


def _require_settled(values: Float[np.ndarray, "c N ny"]) -> None:
    """**Raises:** `ComputationError` if outputs of both halves differ by more than they scatter."""
    half, size = len(values) // 2, np.ptp(values, axis=(0, 1))
    change = np.abs(values[:half].mean(axis=0) - values[-half:].mean(axis=0))
    # (In a trend it is 1.7 standard deviations, in noise of ten cycles 0.6.)
    if (change > np.maximum(1e-4 * size, 1.5 * values.std(axis=0))).any() or not size.all():
        worst = float((change / np.maximum(size, 1e-300)).max())
        text = f"outputs still change by {worst:.1g} of their range; give more `cycles`"
        raise ComputationError(
            f"the plant has not settled: {text}, a `guess`, or stabilize the plant."
        )


def _bound(drive: Drive, family: families.AbstractSections, cycles: int) -> Phase:
    """Run the plant for some cycles, and return the sections with the numbers of its cycle."""
    N, period = family.n_sections, getattr(drive.plant, "period", None)
    anchor = getattr(family, "anchor", None)
    kinds = families.ClockPhase, families.KinematicPhase
    if not isinstance(family, kinds) or isinstance(anchor, Crossing):
        text = "give ClockPhase or KinematicPhase, with a number as `anchor`"
        raise DefinitionError(f"a plant has no equations for these sections: {text}.")
    if isinstance(family, families.ClockPhase):
        if period is None:
            text = "set its `period`, or use KinematicPhase"
            raise DefinitionError(f"sections at equal times need a plant with a clock: {text}.")
        drive.pass_time(cycles * period)
        return Phase(N, period, float(anchor) * period)
    pair = family.position, family.velocity
    require_among("signal", pair, drive.names, "KinematicPhase(position, velocity): ")
    center = [0.0, 0.0] if family.center is None else np.asarray(family.center).tolist()
    scale = [1.0, 1.0] if family.scale is None else np.asarray(family.scale).tolist()
    phase = Phase(N, 1.0, 0.0, tuple(map(drive.names.index, pair)), center, scale)
    phase.begin(drive.t, drive.z)
    began = phase.turns
    while abs(phase.turns - began) < max(cycles, 0.01):  # (which shows the sense)
        if drive.t > (1 + cycles) * 100_000 * drive.dt:
            raise Stopped(f"{pair} do not circle around {center}")
        drive.step(drive.zero, drive.dt)
        phase.level(0, drive.t, drive.z)
    sense = math.copysign(1, phase.turns - began)
    first, scale = sense * float(anchor), (scale[0], sense * scale[1])
    return dataclasses.replace(phase, first=first, scale=scale)
