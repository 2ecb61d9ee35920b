"""The limit cycle of a plant: the sections on it, outputs there, and experiments around it."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from itertools import starmap
from typing import Annotated, Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._core.arguments import Numbers, require_among
from .._core.boundary.checked import checked, checked_methods
from .._core.boundary.containers import Names
from .._core.boundary.kinds import FilePath, Index, Positive, Seed, SignalNames, Vector
from .._core.boundary.values import Reals, Whole
from .._core.execution import core_count
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
from ..identify.multiplier_estimate import MultiplierFit
from ..orbits.crossing import Crossing
from ..sections import families
from ..systems import chart, system
from ..systems.structure import Structure
from .drive import At, Drive, Plant, PlantPhase, Trial, resume, run_all


Draw = Callable[[Any], Any]
Inputs = Annotated[Numbers, Reals("n inputs")]


class Returns(MultiplierFit):
    """Multipliers from returns of perturbed states to section 0.

    **Fields** beside those of all fits of multipliers:

    - `coordinates`: names of the numbers that were perturbed.
    - `noise` (d,): standard deviation of returns from nearly equal states.
    - `residual`: largest distance between state and return, in units of the range of the
      coordinate on the cycle.
    - `bound`: multipliers that are not listed cannot be told from 0; this is the largest modulus
      that they may have (0 if all are listed).
    """

    noise: Float[np.ndarray, " d"]
    coordinates: tuple[str, ...] = eqx.field(static=True)
    residual: float = eqx.field(static=True)
    bound: float = eqx.field(static=True)

    @property
    def model(self) -> None:
        return None

    def _about(self) -> str:
        count = len(self.coordinates)
        return (
            f"{count - len(self.multipliers)} more below {self.bound:.1g}; {count} coordinates, "
            f"residual {self.residual:.1g}"
        )


class Recorded(system.HybridSystem):
    """The signals of a plant as the states of a system that is only looked at."""

    states: tuple[str, ...] = eqx.field(static=True)
    picture: Callable[[Any], Any] | None = eqx.field(static=True)
    time_unit = "s"
    inputs = ()

    def charts(self):
        return {"plant": chart.FieldChart(lambda t, q, u: 0 * q, self.states)}

    def draw(self, chart, t, q):
        return None if self.picture is None else self.picture(q)


class _ReturnMap:
    """The return map of some coordinates of a plant on section 0, and its fixed point.

    **Fields:** `names`: of the coordinates. `x`: their values, first those of the settled state.
    `size`: their ranges on the cycle. `noise`: of returns. `h`: steps of differences. The last
    three are known after `measure`.
    """

    def __init__(self, cycle: "PlantCycle", names: SignalNames | None = None):
        plant = cycle.plant
        self.drive = cycle.drive
        if not self.drive.sets or self.drive.fixed:
            raise DefinitionError(
                "use a plant whose state can be set, with steps of any size."
            )
        self.base = np.array(cycle.state, float)
        numbered = [f"x{i}" for i in range(self.base.size)]
        states = tuple(getattr(plant, "states", numbered))
        period = getattr(plant, "period", None)
        if not names:
            timeless = period is None or isinstance(cycle.sections, families.ClockPhase)
            names = tuple(x for x in states if not (timeless and x == "time"))
        require_among("coordinate", names, states, "perturbed_returns: ")
        self.names = tuple(names)
        self.columns = [states.index(x) for x in names]
        self.shift = np.zeros(len(names))
        if period is not None and "time" in names:
            turns = round(cycle.period / period)
            self.shift[names.index("time")] = turns * period
        self.x = self.base[self.columns]
        self.n = cycle.sections.n_sections
        # (A perturbed state before a crossing must not return to it at once.)
        self.free = cycle.period / 2 if self.drive.phase.crossings else 0.0

    def __call__(
        self, x: Float[np.ndarray, " d"], points: list[At] | None = None
    ) -> Float[np.ndarray, " d"]:
        """Return the coordinates after one cycle, and append the points of its steps."""
        drive = self.drive
        state = self.base.copy()
        state[self.columns] = x
        drive.restore(drive.start._replace(state=state))
        drive.phase.begin(drive.t, drive.z, on_section=True)
        if points is None:
            drive.pass_time(self.free)
        drive.advance(drive.zero, self.n, points)
        return np.array(drive.here().state, float)[self.columns] - self.shift

    def measure(self) -> None:
        """Measure the ranges of the coordinates and the noise of returns, in 46 cycles."""
        points = list[At]()
        self(self.x, points)
        rows = np.array([x.state for x in points], float)[:, self.columns]
        size = np.ptp(rows, axis=0)
        largest = np.abs(rows).max(axis=0)
        # (A coordinate that does not move has the size of its value.)
        rest = np.where(self.x, np.abs(self.x), 1.0)
        self.size = np.where(size > 1e-9 * largest, size, rest)
        self.noise = self._noise()
        # Steps at which noise and the error of fourth order are nearly equal for a function of unit
        # derivatives; at most one percent of the range.
        step = (self.noise / self.size).max() ** 0.2 / 2
        self.h = self.size * min(step, 0.01)

    def _noise(self) -> Float[np.ndarray, " d"]:
        """Return the standard deviation of returns from nearly equal states.

        Fourth differences along lines: their variance is 70 times that of the noise (Moré and Wild
        2011, Estimating computational noise). Narrow spacing shows rounding and tolerances, wide
        spacing the events that move through the time steps of a simulator.
        """
        noise = np.finfo(float).eps * np.maximum(np.abs(self.x), self.size)
        signs = np.random.default_rng(0).choice([-1, 1], (3, len(self.x)))
        for spacing, sign in zip([1e-6, 1e-4, 1e-3], signs, strict=True):
            along = spacing * self.size * sign
            line = [self(self.x + j * along) for j in range(-7, 8)]
            differences = np.diff(line, 4, axis=0)
            noise = np.maximum(noise, np.sqrt((differences**2 / 70).mean(axis=0)))
        return noise

    def slopes(self, steps: float) -> Float[np.ndarray, "d d"]:
        """Return central differences of second order with so many steps."""
        columns = []
        for k in counted(range(len(self.x)), "coordinates", len(self.x)):
            move = np.zeros(len(self.x))
            move[k] = steps * self.h[k]
            change = self(self.x + move) - self(self.x - move)
            columns.append(change / (2 * move[k]))
        return np.stack(columns, axis=1)

    def solve(self) -> float:
        """Move x to the fixed point by Newton's method, and return the largest residual, in units
        of the sizes. The plant is then on section 0."""
        for k in range(9):
            residual = (self(self.x) - self.x) / self.size
            if k == 8 or (np.abs(residual) <= 3 * self.noise / self.size).all():
                break
            J = self.slopes(1) - np.eye(len(self.x))
            J = J * self.size / self.size[:, None]
            # (A multiplier of 1 leaves its direction as it is.)
            step = np.linalg.lstsq(J, residual, rcond=1e-6)[0]
            self.x = self.x - self.size * step
        return float(np.abs(residual).max())


class _Resolved(NamedTuple):
    """Multipliers (k,) that differ from 0, the coefficients (k,) of their polynomial, the
    covariance of these, and the largest modulus that the other multipliers may have."""

    multipliers: np.ndarray
    coefficients: np.ndarray
    covariance: np.ndarray
    bound: float


def _resolved(
    J: Float[np.ndarray, "d d"], error: Float[np.ndarray, "d d"]
) -> _Resolved:
    """Eigenvalues that differ from 0 by three standard errors, by draws within the errors."""
    draws = error * np.random.default_rng(0).standard_normal((1000, *J.shape))
    each = np.linalg.eigvals(np.concatenate([J[None], J + draws])).astype(complex)
    each = np.take_along_axis(each, np.argsort(-np.abs(each), axis=1), axis=1)
    values = each[0]
    sizes = np.abs(each)
    spread = np.sqrt(((sizes - sizes[0]) ** 2).mean(axis=0))
    count = int(np.cumprod(sizes[0] > 3 * spread).sum())
    if 0 < count < len(values) and values[count - 1].imag > 0 > values[count].imag:
        count -= 1  # (both of a pair, or none)
    polynomials = [np.atleast_1d(np.poly(x[:count])).real[1:] for x in each]
    covariance = np.cov(polynomials[1:], rowvar=False).reshape(count, count)
    largest = (sizes[0] + 3 * spread)[count:].max(initial=0)
    return _Resolved(values[:count], polynomials[0], covariance, float(largest))


@checked_methods
@dataclasses.dataclass(frozen=True, eq=False)
class PlantCycle(Showable):
    """The limit cycle of a plant, as `hj.plants.find_cycle` measures it.

    **Fields:**

    - `plant`, `sections`, `inputs`, `outputs`.
    - `period`: mean duration of a cycle.
    - `cycle_outputs` (N, ny): mean outputs at the sections.
    - `state`: that of the plant on section 0, if it can be set.
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
                # (After experiments the plant's state would be another one at each call.)
                self.drive.reset(self.seed)
                cycle = self.outputs, self.cycle_outputs, self.sections, self.seed
                about = digest_of(self.drive.plant, *cycle, u)
            trials = resume(store, about, len(u), run)
        # (Rows are as long as the inputs, and NaN from the end of an experiment on.)
        rows = np.full((*u.shape[:2], len(self.outputs) + 1), np.nan)
        failed_at = np.full(len(u), -1)
        for s, (values, cause) in enumerate(trials):
            rows[s, : len(values)] = np.reshape(values, (-1, rows.shape[-1]))
            if cause:
                failed_at[s] = len(values)
        causes = tuple(cause for _, cause in trials)
        result = np.where(failed_at < 0, Result.OK, Result.PLANT_STOPPED)
        simulated = Simulated(
            failed_at, None, self.sections.label, rows[..., -1], causes
        )
        return ExperimentData(
            u,
            rows[..., :-1] - np.tile(self.cycle_outputs, (u.shape[1] // N, 1)),
            n_sections=N,
            periods=inputs.periods,
            inputs=self.inputs,
            outputs=self.outputs,
            result=result,
            cycle_outputs=self.cycle_outputs,
            simulated=simulated,
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

        **Returns:** `Returns`, a `Fit`.

        **Raises:** `DefinitionError` for a plant whose state cannot be set, or unknown names;
        `ComputationError` if a perturbed state does not return.
        """
        map = _ReturnMap(self, coordinates)
        map.measure()
        residual = map.solve()
        fine = map.slopes(1)
        middle = map.slopes(2)
        wide = map.slopes(4)
        J = (4 * fine - middle) / 3
        coarse = (4 * middle - wide) / 3
        # (Weights 8/12 and -1/12 of four returns, each with this noise.)
        noise = np.sqrt(2 * (8**2 + 1)) / 12 * map.noise[:, None] / map.h
        # (A jump of the second derivative leaves in J an error as large as this difference.)
        error = np.hypot(noise, J - coarse)
        scale = map.size / map.size[:, None]
        resolved = _resolved(J * scale, error * scale)
        return Returns(
            resolved.multipliers,
            resolved.coefficients,
            resolved.covariance,
            10.0,  # (eleven differences in each line)
            map.noise,
            map.names,
            residual,
            resolved.bound,
        )

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
    # (One turn shows the sense of an angle; that of a guess is seen near it.)
    drive.phase = _bound(drive, family, 1.0 if guess is None else 0.01)
    drive.phase.begin(drive.t, drive.z)
    settling = cycles if guess is None else 0
    for k in range(settling + 1):
        drive.warmup = drive.t
        drive.advance(drive.zero, k * family.n_sections)
    if guess is None:
        return _measure(drive, family, max(cycles // 4, 2), seed)
    returns = _ReturnMap(_measure(drive, family, 1, seed))
    returns.measure()
    returns.solve()
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
    """One cycle from section 0 on: where it begins, and where it meets the sections."""
    start = drive.here()
    drive.phase.begin(drive.t, drive.z, on_section=True)
    sections = range(1, family.n_sections + 1)
    return start, [drive.advance(drive.zero, k, points) for k in sections]


def _require_settled(values: Float[np.ndarray, "n N ny"], size: np.ndarray) -> None:
    half = len(values) // 2
    change = np.abs(values[:half].mean(axis=0) - values[-half:].mean(axis=0))
    # (In a trend this is 1.7 standard deviations, in noise of ten cycles 0.6.)
    scatter = 1.6 * values.std(axis=0)
    if (change > np.maximum(1e-4 * size, scatter)).any():
        raise ComputationError(
            "the plant has not settled: give more `cycles` or a `guess`."
        )


def _bound(drive: Drive, family: Any, turns: float) -> PlantPhase:
    """Return the sections as a plant is taken to them. An angle first makes so many turns."""
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
    """Sections by the angle of two signals, whose sense so many turns show."""
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
