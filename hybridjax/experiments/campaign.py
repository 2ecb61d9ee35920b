"""Experiments on one system, one cycle and one family of sections, ready to be run part by part."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from .._core.compilation import TwoTiers
from .._core.execution import Execution
from .._core.executor import from_host
from .._core.memo import Memory
from .._core.progress import counted
from .._core.results import Result
from ..engine.settings import EXPERIMENT, SINGLE_PRECISION_EXPERIMENT
from ..errors import ComputationError, DefinitionError
from ..linear.ldtp import LDTP
from ..orbits.cycle import LimitCycle
from ..sections.place import as_placed
from ..sections.placed import PlacedSections, SectionsLike
from ..systems.output import Output
from ..systems.structure import Outputs
from .batches import divide, in_batches, precision_of
from .data import ExperimentData, Simulated
from .design.design import DISCARD
from .events import EventList, EventTimes, in_order
from .flow_batch import Course, IntervalEvents, course, flow_batch
from .inputs import DesignLike, Inputs, check_inputs
from .noise import ProcessNoise
from .options import Options, StartName
from .start import CycleStart, PeriodicStart, Start, SteadyStart, predict_start
from .steady import settle_batch
from .stepping.plan import Stepping, plan_flow
from .stepping.single_precision import plan_single


# From so many samples in all, it pays to wait for a program that is compiled thoroughly: that takes
# 10 s longer, and then 2 microseconds less for each of them. Twice as many: jobs of up to 20 s take
# twice as long.
_LARGE = 5_000_000
_ACCURACY = {"double": EXPERIMENT, "single": SINGLE_PRECISION_EXPERIMENT}


@dataclasses.dataclass(frozen=True)
class Campaign:
    """Experiments that have all in common but their inputs. `run` does some or all of them.

    **Fields:**

    - `placed`: the sections, on their limit cycle. `course`: what the program needs to know of
        them. `outputs`: what is recorded there.
    - `inputs`: where inputs come from, and which part of the records is for estimation.
    - `start`: how experiments start. `process_noise`: what acts beside their inputs.
    - `stepping`: how lanes step from section to section. `program`: `flow_batch`, compiled.
    - `record_events`: whether the times of events are recorded.
    - `execution`: how they are run, with the size of batches and the number of threads.
    """

    placed: PlacedSections
    course: Course
    outputs: Outputs
    inputs: Inputs
    start: Start
    process_noise: ProcessNoise | None
    stepping: Stepping
    program: TwoTiers
    record_events: bool
    execution: Execution

    def run(self, rows: slice | None = None) -> ExperimentData:
        """Run some of the experiments, by default all.

        **Arguments:** `rows`, consecutive ones.

        **Raises:** `DefinitionError` for an output that is not defined where experiments go;
        `ComputationError` if a steady start is not found.
        """
        rows = slice(0, len(self.inputs)) if rows is None else rows
        u = self.inputs.of(rows)
        start = self.start.states(u, rows.start)
        applied = u
        if self.process_noise is not None:
            applied = u + self.process_noise.draw(u.shape, self.placed.n_sections, rows.start)
        cycle_log = self._cycle_log() if self.record_events else None
        capacity = 0 if cycle_log is None else 1 + int(np.asarray(cycle_log.count).max())
        while True:
            y, result, failed_at, error, log = self._respond(applied, start, capacity)
            if log is None or (most := int(log.count.max(initial=0))) <= capacity:
                break
            capacity = 2 ** (most - 1).bit_length()  # as few sizes, and so programs, as possible
        self._require_outputs(y, result)
        return ExperimentData(
            u,
            y,
            n_sections=self.placed.n_sections,
            periods=self.inputs.periods,
            inputs=self.outputs.structure.inputs,
            outputs=self.outputs.names,
            result=result,
            simulated=Simulated(failed_at, error, self._events(log, cycle_log)),
            cycle_outputs=self.cycle_outputs(),
            label=self.placed.family.label,
        )

    def by(self, workers: int) -> "Campaign":
        """The same, by so many threads."""
        return dataclasses.replace(
            self, execution=dataclasses.replace(self.execution, workers=workers)
        )

    @property
    def taught(self) -> tuple[PlacedSections, Stepping, LDTP | None]:
        """What is known before the first experiment."""
        start = self.start.predicted if isinstance(self.start, SteadyStart) else self.start
        model = start.model if isinstance(start, PeriodicStart) else None
        return self.placed, self.stepping, model

    def with_taught(self, taught: tuple[PlacedSections, Stepping, LDTP | None]) -> "Campaign":
        """The same, with what another call has found out."""
        placed, stepping, model = taught
        state = self.__getstate__() | {"placed": placed, "stepping": stepping, "model": model}
        new = object.__new__(Campaign)
        new.__setstate__(state)
        return new

    def __getstate__(self) -> dict[str, Any]:
        """All but what is compiled, for other processes."""
        placed, stepping, model = self.taught
        return {
            "placed": placed, "stepping": stepping, "model": model,
            "outputs": tuple(self.outputs.items), "inputs": self.inputs, "start": self.start.name,
            "process_noise": self.process_noise, "record_events": self.record_events,
            "execution": self.execution, "large": self.program.large,
        }  # fmt: skip

    def __setstate__(self, state: dict[str, Any]) -> None:
        made = _compose(**state)
        for field in dataclasses.fields(self):
            object.__setattr__(self, field.name, getattr(made, field.name))

    def _respond(self, u, start, capacity: int):
        """Deviations of outputs from the cycle (S, n, ny), codes, samples of failures, errors, and
        the first `capacity` events between any two sections."""
        stepping, N = self.stepping, self.placed.n_sections
        base = self.cycle_outputs()

        def arguments(some):
            # (Nobody changes them before the program is done, so they may share memory.)
            x, held = jax.device_put((start[:, some], u[some]))
            return self.course, stepping.plan, x, held, stepping.settings, capacity

        S, n, _ = u.shape
        y, others = np.empty((S, n // N, *base.shape)), []
        parts = in_batches(self.program, arguments, S, self.execution)
        batches = -(-S // self.execution.batch) if self.execution.batch else None
        for some, part in counted(parts, "batches of experiments", batches):
            np.subtract(part.y.reshape(-1, *y.shape[1:]), base, out=y[some])
            others.append((part.result, part.failed_at, part.error, part.log))
        *each, logs = zip(*others, strict=True)
        result, failed_at, error = map(np.concatenate, each)
        log = IntervalEvents(*map(np.concatenate, zip(*logs, strict=True))) if capacity else None
        error = error.astype(float) + stepping.rounding
        return y.reshape(S, n, -1), result.astype(int), failed_at.astype(int), error, log

    def _require_outputs(self, y, result) -> None:
        finite = np.isfinite(y)
        if finite.all() or (finite.all(axis=(1, 2)) | (result != Result.OK)).all():
            return
        for a in np.unique(self.placed.lanes.chart):
            self.outputs.require(int(a))
        raise DefinitionError(
            "an output is NaN although its experiment ran well: it is not defined everywhere "
            "that the experiments go."
        )

    def cycle_outputs(self) -> Float[np.ndarray, "N ny"]:
        """The outputs on the limit cycle."""
        items = tuple(self.outputs.items)
        look = lambda: np.asarray(self.placed.observe(items))  # noqa: E731
        # (An `Output` may be another one at every call.)
        named = all(isinstance(item, str) for item in items)
        return _observed.recall(self.placed, items, look) if named else look()

    def _cycle_log(self) -> IntervalEvents:
        """The events of one period of the limit cycle, by the same steps as in experiments."""
        placed, stepping, N = self.placed, self.stepping, self.placed.n_sections
        start = CycleStart(placed).states(np.zeros((1, 0, 0)), 0)
        u = np.zeros((1, N, len(placed.cycle.system.inputs)))
        capacity = max(len(placed.cycle.event_sequence), 1)
        own = dataclasses.replace(self.course, outputs=())
        return TwoTiers(flow_batch, large=False)(
            own, stepping.plan, *from_host((start, u)), stepping.settings, capacity
        ).log

    def cycle_events(self) -> EventList:
        """The events of one period of the limit cycle, those of one experiment."""
        N, period = self.placed.n_sections, float(np.asarray(self.placed.cycle.period))
        return in_order(self._cycle_log(), N, period)

    def _events(
        self, log: IntervalEvents | None, cycle_log: IntervalEvents | None
    ) -> EventTimes | None:
        if log is None or cycle_log is None:
            return None
        N, period = self.placed.n_sections, np.asarray(self.placed.cycle.period)
        own, cycle = (in_order(x, N, float(period)) for x in (log, cycle_log))
        names = tuple(t.name for t in self.outputs.structure.transitions)
        return EventTimes(*own, cycle.time[0], cycle.event[0], period, n_sections=N, names=names)


def prepare(
    cycle: LimitCycle,
    sections: SectionsLike,
    design: DesignLike,
    outputs: Sequence[str | Output],
    options: Options,
    chunk: int | None = None,
    one_program: bool = False,
) -> Campaign:
    """Check what `run_experiments` was given, and do what is done once for all experiments.

    **Arguments:** `chunk`, how many of them are run together; by default all. `one_program`: all
    are run by the program that is compiled thoroughly, whatever there is.
    """
    placed = as_placed(cycle, sections)
    _resolved(placed, outputs)
    _require_return(cycle, placed)
    start, discard, accuracy = options.start, options.discard, options.accuracy
    execution = Execution() if options.execution is None else options.execution
    accuracy = _ACCURACY[execution.precision] if accuracy is None else accuracy
    discard = (DISCARD if start == "cycle" else 0) if discard is None else discard
    N, nu = placed.n_sections, len(cycle.system.inputs)
    inputs = check_inputs(design, discard, N, nu)
    if options.process_noise is not None:
        options.process_noise.require(N)
    if start != "cycle" and inputs.cycles % inputs.periods:
        raise DefinitionError(
            f"a {start} start needs inputs of a whole number of windows: use `discard=0`."
        )
    together = len(inputs) if chunk is None else chunks(len(inputs), chunk)[0].stop
    execution = divide(together, execution)
    samples = inputs.cycles * N
    large = one_program or len(inputs) * samples > _LARGE
    single = execution.precision == "single"
    stepping = (plan_single if single else plan_flow)(placed, accuracy)
    model = None if start == "cycle" else predict_start(placed, inputs.periods).model
    return _compose(
        placed=placed, stepping=stepping, model=model, outputs=outputs, inputs=inputs, start=start,
        process_noise=options.process_noise, record_events=options.record_events,
        execution=execution, large=large,
    )  # fmt: skip


def _compose(
    *,
    placed: PlacedSections,
    stepping: Stepping,
    model: LDTP | None,
    outputs: Sequence[str | Output],
    inputs: Inputs,
    start: StartName,
    process_noise: ProcessNoise | None,
    record_events: bool,
    execution: Execution,
    large: bool,
) -> Campaign:
    """A campaign from what another process can be told."""
    z = _resolved(placed, outputs)
    own = _course(placed, z, execution)
    begin: Start = CycleStart(placed)
    if model is not None:
        begin = PeriodicStart(placed, model, inputs.periods)
    if start == "steady":
        assert isinstance(begin, PeriodicStart)
        aside = dataclasses.replace(own, outputs=())
        begin = SteadyStart(begin, aside, stepping, execution, TwoTiers(settle_batch, large))
    return Campaign(
        placed, own, z, inputs, begin, process_noise, stepping, TwoTiers(flow_batch, large),
        record_events, execution,
    )  # fmt: skip


def chunks(count: int, chunk: int) -> list[slice]:
    """Consecutive parts of `count` experiments, all but the last of the size `chunk`."""
    return [slice(k, min(k + chunk, count)) for k in range(0, count, chunk)]


def _require_return(cycle: LimitCycle, placed: PlacedSections) -> None:
    """Refuse cycles that experiments would leave."""
    if not cycle.clocked and bool(np.isfinite(placed.bound.time).any()):
        raise DefinitionError(
            f"clock sections sample {type(cycle.system).__name__}, which has no clock, at fixed "
            "times: nothing brings its phase back (a multiplier of exactly 1), so that every input "
            "shifts it for good. Use sections that depend on the state (KinematicPhase, or a list "
            "of Crossing and AtEvent)."
        )
    if not cycle.stable:
        largest = np.abs(cycle.multipliers[0])
        raise ComputationError(
            f"the limit cycle is not stable (largest multiplier {largest:.4g} in modulus), so "
            "experiments would leave it: stabilize the system, or use the exact linearization "
            "(`linearize`), which needs no experiments."
        )


# States of the cycle at its sections, by their names; outputs by what was asked for; courses by
# outputs.
_observed, _outputs, _courses = Memory(), Memory(), Memory()


def _resolved(placed: PlacedSections, outputs: Sequence[str | Output]) -> Outputs:
    """Outputs at the sections; the same for the same sections and outputs."""
    names = tuple(x if isinstance(x, str) else id(x) for x in outputs)

    def make():
        # (Together with what is known by its `id`, which thereby keeps it.)
        return placed.structure().resolve_outputs(outputs), outputs

    return _outputs.recall(placed, names, make)[0]


def _course(placed: PlacedSections, outputs: Outputs, execution: Execution) -> Course:
    """The course in the precision that is asked for, once for the same sections and outputs."""

    def make():
        with precision_of(execution) as convert:
            return convert(course(placed, outputs.items)), outputs

    return _courses.recall(placed, (id(outputs), execution.precision), make)[0]
