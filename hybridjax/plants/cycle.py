"""The limit cycle of a plant (a simulator of another package): sections on it, and experiments
around it.

`find_cycle` lets the plant settle, or solves for the cycle from a guess (`returns.py`). `_measure`
then records some cycles, and returns a `PlantCycle`, whose methods run experiments. `_phase_of`
turns a family of sections into the rule by which `drive.py` recognizes a section; a further family
is added there. It must stay that the plant is on section 0 before `_measure` and before each
`_turn`, which ends on the next section 0.

The plant itself is driven by `drive.py`: if a section is at a wrong time, or an input acts too
late, look there. If a plant is said not to have settled, look at `_require_settled`; if responses
are not zero without input, at `at_rest` in `run_experiments`.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from itertools import starmap
from typing import Annotated, Any

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from .._core.arguments import Numbers, require_among
from .._core.boundary.checked import checked, checked_methods
from .._core.boundary.containers import Names
from .._core.boundary.kinds import FilePath, Index, Positive, Seed, SignalNames, Vector
from .._core.boundary.values import Reals, Whole
from .._core.execution import core_count
from .._core.findings import Finding, warn_of
from .._core.pieces.description import digest_of
from .._core.progress import counted, working
from .._core.results import Result
from .._core.showable import Showable
from .._core.signal import Signal, signals
from .._core.text import folded, listed
from ..engine.trajectory import Trajectory
from ..errors import ComputationError, DefinitionError
from ..experiments.data import ExperimentData, Simulated
from ..experiments.design.design import DISCARD
from ..experiments.run import DesignLike, check_inputs
from ..orbits.crossing import Crossing
from ..sections import families
from ..systems import chart, system
from ..systems.structure import Structure
from .amplitude import doubts_about_inputs
from .drive import At, Drive, Plant, PlantPhase, Trial, resume, run_all
from .returns import ReturnMap, Returns, measured_returns


# From this number of experiments on, the size of the inputs is tested by further runs. Fewer:
# single records, from which nothing is estimated, take twice the time.
_FEWEST = 4
Draw = Callable[[Any], Any]
Inputs = Annotated[Numbers, Reals("n inputs")]


class Recorded(system.HybridSystem):
    """The signals of a plant as states of a `HybridSystem` that is only drawn, never integrated."""

    states: tuple[str, ...] = eqx.field(static=True)
    picture: Callable[[Any], Any] | None = eqx.field(static=True)
    time_unit = "s"
    inputs = ()

    def charts(self):
        return {"plant": chart.FieldChart(lambda t, q, u: 0 * q, self.states)}

    def draw(self, chart, t, q):
        return None if self.picture is None else self.picture(q)


@checked_methods
@dataclasses.dataclass(frozen=True, eq=False)
class PlantCycle(Showable):
    """The limit cycle of a plant, as `hj.plants.find_cycle` measures it.

    **Fields:**

    - `plant`, `sections`, `inputs`, `outputs`.
    - `period`: mean duration of a cycle.
    - `cycle_outputs` (N, ny): mean outputs at the sections.
    - `state`: state of the plant on section 0, if it can be set.
    """

    plant: Plant
    sections: families.AbstractSections
    inputs: tuple[str, ...]
    outputs: tuple[Signal, ...]
    period: float
    cycle_outputs: Float[np.ndarray, "N ny"]
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
            call, with a plant that has the same attributes after `reset`. Default: none.

        **Returns:** `ExperimentData`. Failures are listed by `summary()`: missed sections, errors
        that the plant raised (a fall), NaN, other signals, no answer within the limit, random
        numbers that do not follow the seed. `simulated.late` (S, n) are the times by which steps
        ended after their sections.

        **Raises:** `DefinitionError` for a design that does not fit, and for a plant that cannot be
        made in other processes; `ComputationError` if the cycle has not settled.
        """
        N = self.sections.n_sections
        inputs = check_inputs(design, discard, N, self.inputs)
        count = min(core_count() if processes is None else processes, len(inputs))
        u = inputs.part(slice(0, len(inputs)))

        def run(rows: list[int]) -> Iterator[Trial]:
            items = ((self.seed + 1 + s, u[s].tolist()) for s in rows)
            if count:
                trials = run_all(self.drive, items, count, limit)
            else:
                trials = starmap(self.drive.run, items)
            yield from counted(trials, "experiments", len(rows))

        with working("run_experiments"):
            about = ""
            if store is not None:
                # (Without the reset, the plant's state would differ from call to call.)
                self.drive.reset(self.seed)
                cycle = self.outputs, self.cycle_outputs, self.sections, self.seed
                about = digest_of(self.drive.plant, *cycle, u)
            trials = resume(store, about, len(u), run)
        # (All rows are as long as the inputs. After the end of an experiment they are NaN.)
        S, steps = u.shape[:2]
        rows = np.full((S, steps, len(self.outputs) + 1), np.nan)
        failed_at = np.full(len(u), -1)
        for s, (values, cause) in enumerate(trials):
            of_run = np.reshape(values, (-1, rows.shape[-1]))
            rows[s, : len(values)] = of_run
            if cause:
                failed_at[s] = len(values)
        causes = tuple(cause for _, cause in trials)
        at_rest = np.tile(self.cycle_outputs, (u.shape[1] // N, 1))
        responses = rows[..., :-1] - at_rest
        findings = self._doubts_about(u, responses, failed_at, at_rest)
        warn_of(findings)
        result = np.where(failed_at < 0, Result.OK, Result.PLANT_STOPPED)
        simulated = Simulated(
            failed_at=failed_at,
            error=None,
            label=self.sections.label,
            late=rows[..., -1],
            causes=causes,
            findings=tuple(findings),
        )
        return ExperimentData(
            u,
            responses,
            n_sections=N,
            periods=inputs.periods,
            inputs=self.inputs,
            outputs=self.outputs,
            result=result,
            cycle_outputs=self.cycle_outputs,
            simulated=simulated,
        )

    def _doubts_about(
        self,
        u: Float[np.ndarray, "S n nu"],
        responses: Float[np.ndarray, "S n ny"],
        failed_at: Int[np.ndarray, " S"],
        at_rest: Float[np.ndarray, "n ny"],
    ) -> list[Finding]:
        """Return findings about the size of the inputs. The first experiment is repeated with half
        of its input, and without input. (Noise with the same seed, and the rest of a transient, are
        the same in all three.)"""
        whole = np.flatnonzero(failed_at < 0)
        if len(whole) < _FEWEST or not responses[whole[0]].any():
            return []
        s = int(whole[0])
        rows = []
        for part in (0.5, 0.0):
            inputs = part * u[s]
            seed = self.seed + 1 + s
            values, cause = self.drive.run(seed, inputs.tolist())
            if cause:
                return []
            rows.append(np.array(values)[:, :-1])
        half, without = rows
        full = responses[s] - (without - at_rest)
        return doubts_about_inputs(self, full, half - without)

    def perturbed_returns(self, coordinates: SignalNames | None = None) -> Returns:
        """Estimate the multipliers from returns of perturbed states to section 0.

        Central differences with steps of six sizes give the Jacobian of the return map. The
        scatter of returns from nearly equal states determines the steps (measured by differences
        along lines: Moré and Wild 2011). In each pair of perturbed states, the first time step has
        another length: contacts that begin at the ends of time steps then scatter at random, and
        the errors contain them. A state that is not on the cycle is moved there by Newton's method.

        **Arguments:**

        - `coordinates`: names among `plant.states` to perturb. Others keep their values. Default:
          all that do not travel (see `Returns.travelling`); at clock sections all but `time`.

        **Returns:** `Returns`, a `Fit`.

        **Raises:** `DefinitionError` for a plant whose state cannot be set, or unknown names;
        `ComputationError` if a perturbed state does not return, or the state is not on a cycle.
        """
        map = ReturnMap(self, coordinates)
        map.measure()
        return measured_returns(map)

    def trajectory(
        self, draw: Draw | None = None, u: Inputs | None = None
    ) -> Trajectory:
        """Record the signals after each step from section 0 on, for `hj.plot.animate`.

        **Arguments:**

        - `draw`: function of the signals by name that returns a `hj.systems.Drawing`, written with
          JAX. Default: none, the signals are drawn over time.
        - `u` (n, nu): inputs, each held until the next section. Default: one cycle without inputs.

        **Returns:** a `Trajectory` in the chart `plant`, from time 0 on. Where the plant raises a
        `hj.errors.ComputationError` (a fall) it ends with `Result.PLANT_STOPPED`.

        **Raises:** any other error of the plant.
        """
        if u is None:
            u = np.zeros((self.sections.n_sections, len(self.inputs)))
        drive = self.drive
        points = list[At]()
        result = Result.OK
        drive.begin(self.seed)
        try:
            for k, held in enumerate(np.asarray(u).tolist(), 1):
                drive.advance(held, k, points)
            points.append(drive.here())
        except ComputationError:
            result = Result.PLANT_STOPPED
        q = np.array([x.z for x in points])
        t = np.array([x.t for x in points])
        n = len(t)
        s = Structure(Recorded(drive.names, draw))
        rates = np.gradient(q, t, axis=0) if n > 1 else 0 * q
        events = np.full(n, -1)
        return Trajectory(
            s, t - t[0], np.zeros(n, int), q, q, rates, rates, events, result
        )

    def __repr__(self) -> str:
        return folded(
            f"PlantCycle({type(self.plant).__name__}: period {self.period:.9g}, "
            f"{len(self.cycle_outputs)} sections, {listed(self.inputs)} -> "
            f"{listed(self.outputs)})"
        )


@checked
@working("find_cycle")
def find_cycle(
    plant: Plant,
    sections: families.FamilyLike,
    outputs: SignalNames,
    *,
    cycles: Annotated[int, Whole(8, 1_000_000)] = 100,
    guess: Vector | None = None,
    seed: Seed = 0,
) -> PlantCycle:
    """Let a plant run without inputs until it repeats itself, and locate sections on its cycle.

    **Arguments:**

    - `plant`: a simulator with `reset` and `step`, see `hj.plants.Plant`.
    - `sections`: `ClockPhase` for a plant with a `period`; `KinematicPhase` of two signals, with
      numbers as `anchor`; or one or several `Crossing` of signals by name, which lie more than a
      step apart and are crossed once in each cycle.
    - `outputs`: names of signals.
    - `cycles`: number of cycles before the sections are located. A quarter as many are then
      recorded. Default: 100.
    - `guess`: a state (n,) near the cycle at time 0, from which Newton's method on the return map
      finds the cycle, also an unstable one. Default: none, the plant settles.
    - `seed`: seed of `reset`. Default: 0.

    **Returns:** `hj.plants.PlantCycle`: `period`, in the plant's unit of time; `cycle_outputs`
    (N, ny), in units of the outputs; `state` on section 0, if the plant can return it.

    **Raises:** `DefinitionError` for unknown signals, for sections that need equations, and for a
    plant that does not continue from the state that it returned; `ComputationError` if the plant
    has not settled, or returns NaN. Errors of the plant pass through.

    **Example:**

    ```python
    class Leak:
        inputs = ("u",)
        dt = 0.05
        period = 1.0

        def reset(self, seed):
            self.t = 0.0
            self.x = 0.0
            return {"x": self.x}

        def step(self, u, duration):
            self.x += duration * (np.sin(2 * np.pi * self.t) - self.x + u[0])
            self.t += duration
            return {"x": self.x}

    plant_cycle = hj.plants.find_cycle(Leak(), hj.ClockPhase(8), "x", cycles=30)
    print(plant_cycle.cycle_outputs)
    ```

    **Before:** `hj.plants.Plant`, `FMUPlant`, `MuJoCoPlant` or `GymnasiumPlant`. **After:**
    `cycle.run_experiments`, then `hj.estimate_htf`.
    """
    family = families.as_family(sections)
    drive = Drive(plant)
    drive.reset(seed)
    require_among("output", outputs, drive.names, "")
    drive.columns = tuple(map(drive.names.index, outputs))
    if guess is not None:
        if not drive.sets or np.shape(guess) != np.shape(drive.here().state):
            raise DefinitionError("`guess` must be a state, as `get_state` returns it.")
        drive.restore(At(0.0, drive.z, state=np.asarray(guess)))
        drive.step(drive.zero, drive.dt)
    # (One revolution shows whether an angle grows or decreases; near a guess, a small part of it
    # suffices.)
    drive.phase = _phase_of(drive, family, 1.0 if guess is None else 0.01)
    drive.phase.begin(drive.t, drive.z)
    settling = cycles if guess is None else 0
    for k in range(settling + 1):
        drive.warmup = drive.t
        drive.advance(drive.zero, k * family.n_sections)
    if guess is None:
        return _measure(drive, family, max(cycles // 4, 2), seed)
    returns = ReturnMap(_measure(drive, family, 1, seed))
    returns.measure()
    returns.require_on_cycle(returns.solve())
    returns(returns.x)
    return _measure(drive, family, 2, seed)


def _measure(drive: Drive, family: Any, cycles: int, seed: int) -> PlantCycle:
    """Record cycles, and prepare experiments. The plant is on section 0."""
    plant = drive.plant
    points = list[At]()
    start, at = _turn(drive, family, points)
    drive.longest = 2 * (at[-1].t - start.t)
    turns = [_turn(drive, family, points) for _ in range(cycles + 1)]
    columns = list(drive.columns)
    signals_there = [_signals_at(at) for _, at in turns]
    values = np.stack(signals_there)[..., columns]
    values = np.roll(values, 1, axis=1)  # (section 0 ends each cycle)
    drive.start, at = turns[-1]
    size = np.ptp(_signals_at(points), axis=0)[columns]
    if cycles > 1:
        _require_settled(values, size)
    if drive.sets:
        drive.restore(drive.start)
        _, again = _turn(drive, family, points)
        change = np.abs(_signals_at(again) - _signals_at(at))
        if (change[:, columns] > 1e-6 * size).any():
            raise DefinitionError(
                "`set_state` does not continue as before: save all of the state."
            )
    names = [drive.names[c] for c in columns]
    units = getattr(plant, "units", {})
    return PlantCycle(
        plant,
        family,
        inputs=Names(units=True, empty=True).take(plant.inputs),
        outputs=signals(names, [units.get(name, "") for name in names]),
        period=float(np.diff([at[-1].t for _, at in turns]).mean()),
        cycle_outputs=values.mean(axis=0),
        state=drive.start.state,
        drive=drive,
        seed=seed,
    )


def _signals_at(points: Sequence[At]) -> Float[np.ndarray, "n signals"]:
    return np.array([x.z for x in points], float)


def _turn(drive: Drive, family: Any, points: list[At]) -> tuple[At, list[At]]:
    """One cycle from section 0 on. Returns the point at which it begins, and the points on the
    sections; steps are appended to `points`."""
    start = drive.here()
    drive.phase.begin(drive.t, drive.z, on_section=True)
    sections = range(1, family.n_sections + 1)
    return start, [drive.advance(drive.zero, k, points) for k in sections]


def _require_settled(values: Float[np.ndarray, "n N ny"], size: np.ndarray) -> None:
    """Compare the first half of n cycles with the last. `size` (ny,): ranges of the outputs.

    **Raises:** `ComputationError` if the mean of an output changes by more than the output
    scatters, and by more than 1e-4 of its range.
    """
    half = len(values) // 2
    first = values[:half].mean(axis=0)
    last = values[-half:].mean(axis=0)
    change = np.abs(first - last)
    # (With a linear trend, `change` is 1.7 standard deviations of the values; with noise over ten
    # cycles, about 0.6.)
    scatter = 1.6 * values.std(axis=0)
    if (change > np.maximum(1e-4 * size, scatter)).any():
        raise ComputationError(
            "the plant has not settled: give more `cycles` or a `guess`."
        )


def _phase_of(drive: Drive, family: Any, turns: float) -> PlantPhase:
    """Return the `PlantPhase` by which a plant is taken to the sections of a family.

    **Arguments:** `turns`: the plant runs for this many revolutions of the angle, which show
    whether the angle grows or decreases.
    """
    period = getattr(drive.plant, "period", None)
    items: Any = getattr(family, "items", ())
    if items and all(map(_is_of_a_signal, items)):
        return _at_crossings(drive, items)
    anchor: Any = getattr(family, "anchor", None)
    is_number = not isinstance(anchor, Crossing)
    if is_number and period is not None and type(family) is families.ClockPhase:
        return PlantPhase(family.n_sections, period, float(anchor) * period)
    if is_number and type(family) is families.KinematicPhase:
        return _by_angle(drive, family, float(anchor), turns)
    raise DefinitionError(
        "use KinematicPhase, Crossings of signals by name, or ClockPhase and a `period`; an "
        "`anchor` must be a number."
    )


def _is_of_a_signal(crossing: Any) -> bool:
    return isinstance(getattr(crossing, "signal", None), str) and not crossing.charts


def _at_crossings(drive: Drive, crossings: Sequence[Any]) -> PlantPhase:
    """Sections where signals cross levels, one for each crossing. (A rising signal is negated, so
    that all levels fall through zero.)"""
    names = drive.names
    require_among("signal", [x.signal for x in crossings], names, "Crossing: ")
    rows = []
    for x in crossings:
        sign = 1.0 if x.direction == "falling" else -1.0
        rows.append((names.index(x.signal), sign, float(x.value)))
    return PlantPhase(len(rows), crossings=rows)


def _by_angle(
    drive: Drive, family: families.KinematicPhase, anchor: float, turns: float
) -> PlantPhase:
    """Sections by the angle of two signals. The plant runs for `turns` revolutions, which show
    whether the angle grows or decreases."""
    pair = family.position, family.velocity
    require_among("signal", pair, drive.names, "KinematicPhase(position, velocity): ")
    columns = [drive.names.index(x) for x in pair]
    center = np.zeros(2) if family.center is None else np.asarray(family.center)
    scale = np.ones(2) if family.scale is None else np.asarray(family.scale)
    axes = zip(columns, center.tolist(), scale.tolist(), strict=True)
    phase = PlantPhase(family.n_sections, axes=list(axes))
    phase.begin(drive.t, drive.z)
    began = phase.turns
    while abs(phase.turns - began) < turns:
        if drive.t > drive.longest:
            raise ComputationError(
                f"{pair} do not circle around {center.tolist()}: set `center`"
            )
        drive.step(drive.zero, drive.dt)
        phase.level(0, drive.t, drive.z)
    phase.sense = float(np.sign(phase.turns - began))
    phase.first = anchor
    return phase
