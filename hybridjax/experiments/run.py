"""Batches of experiments on a hybrid system around its limit cycle (paper Sec. V).

`run_experiments` (`stored.py`) calls `prepare`, which checks the arguments and makes a `Campaign`.
Its method `run` computes any part of the experiments, and returns `ExperimentData`. Experiments are
computed in batches, by one of three programs:

1. `_followed`: along a table of the steps and events of the cycle (`rows.py`, `passage.py`), if
   there is one;
2. `_completed`: experiments that leave this table, along a longer table;
3. `_searched`: experiments that leave the longer table, too, and all experiments if there is no
   table, by a search for events (`response.py`).

All three agree within the accuracy asked for. To find a fault, run the same inputs by `_followed`
and by `_searched`. Sizes of batches and chunks change the results by rounding only.
"""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from .._core.arguments import names
from .._core.boundary.values import Reals
from .._core.compilation import Program
from .._core.execution import Execution, in_threads
from .._core.executor import from_host, on_cpu, to_host
from .._core.meaning import require_as_made
from .._core.memo import Memory
from .._core.progress import counted
from .._core.results import Result
from .._core.signal import signals, unit_of
from ..engine.settings import EXPERIMENT
from ..errors import ComputationError, DefinitionError
from ..linear.algebra import Matrices, static_gain
from ..linear.ldtp import LDTP, Gain
from ..orbits.checks import check_outputs
from ..orbits.cycle import LimitCycle
from ..sections.linearization import linearize
from ..sections.place import as_placed
from ..sections.placed import PlacedSections, SectionsLike
from ..systems.structure import Outputs
from ..systems.system import Output, OutputNames, name_of
from .data import ExperimentData, Simulated
from .design.design import DISCARD, Design, require_inputs
from .noise import ProcessNoise
from .passage import program
from .plan import Stepping, plan_flow
from .response import (
    Course,
    Feedback,
    Response,
    flow_batch,
    require_shape,
)
from .rows import Table, Tables, tables
from .start import StartName, linearized, periodic_start, steady_start


_SAMPLES = Reals("experiments samples inputs", missing=True, infinite=True)
DesignLike = Design | Annotated[np.ndarray | jax.Array, _SAMPLES]
"""A design, or inputs. (Arrays may lie on disk: their values are checked part by part.)"""

# From this number of samples on, the program with a search for events is compiled with optimized
# loops. This takes 5 s longer, and saves 3 microseconds per sample. Fewer: short runs wait in vain.
# More: runs of 10 s take twice as long.
_LARGE = 2_000_000
# Experiments in one compiled call. On CPU: with fewer, work that is done once for a call costs
# more; with more, arrays do not fit the cache. On accelerators, more need more memory.
_BATCH = 320
_BATCH_ON_ACCELERATOR = 16384
# Fewer experiments than this are not divided among workers: smaller batches cost more than they
# gain.
_UNDIVIDED = 32
# Sizes of batches are multiples of this, the width of vector instructions. Other sizes take up to a
# third longer.
_VECTOR = 8
# Experiments of a chunk, also when inputs on disk are checked. More need more memory; fewer leave
# batches and threads unfilled.
CHUNK = 2 * _BATCH


@dataclasses.dataclass(frozen=True)
class RunOptions:
    """Options of `run_experiments`, with the same defaults and meaning."""

    start: StartName = "cycle"
    discard: int | None = None
    process_noise: ProcessNoise | None = None
    accuracy: float = EXPERIMENT
    execution: Execution | None = None
    feedback: LDTP | Gain | None = None


@dataclasses.dataclass(frozen=True)
class Inputs:
    """Inputs of a set of experiments, generated or read in parts.

    **Fields:** `source`: a design or an array (S, n, nu). `cycles`: length of the experiments in
    periods of the limit cycle. `periods`: number of the last periods that are for estimation.
    """

    source: Design | np.ndarray
    cycles: int
    periods: int

    def __len__(self) -> int:
        return (
            self.source.experiments
            if isinstance(self.source, Design)
            else len(self.source)
        )

    def part(self, rows: slice) -> Float[np.ndarray, "S n nu"]:
        """Return the inputs of consecutive experiments."""
        if isinstance(self.source, Design):
            return self.source.signals(self.cycles, rows)
        return np.asarray(self.source[rows], float)


@dataclasses.dataclass(frozen=True, eq=False)
class Campaign:
    """Experiments that differ in their inputs only. A campaign can be pickled: nothing that is
    compiled belongs to it.

    **Fields:**

    - `placed`: the sections on the limit cycle. `outputs`: recorded there.
    - `inputs`: source of the inputs. `start`: the kind of initial condition. `model`: the
        linearization that predicts it, except for starts on the cycle.
    - `stepping`: tolerances and step schedule between sections.
    - `process_noise`: as in `run_experiments`.
    - `execution`: batch size and number of threads.
    - `large`: whether searches for events have optimized loops.
    - `feedback`: a controller, or None.
    """

    placed: PlacedSections
    outputs: tuple[str | Output, ...]
    inputs: Inputs
    start: StartName
    model: LDTP | None
    stepping: Stepping
    process_noise: ProcessNoise | None
    execution: Execution
    large: bool
    feedback: Matrices | None = None

    def run(
        self, rows: slice | None = None, workers: int | None = None
    ) -> ExperimentData:
        """Run the experiments of consecutive `rows`. Default: all of them.

        **Raises:** `DefinitionError` for an output that is not defined where experiments go, and if
        the system's code has changed; `ComputationError` if a steady start is not found.
        """
        self.placed.require_current()
        require_as_made(self.outputs, "these experiments were planned")
        rows = slice(0, len(self.inputs)) if rows is None else rows
        workers = self.execution.workers if workers is None else workers
        execution = dataclasses.replace(self.execution, workers=workers)
        u = self.inputs.part(rows)
        N = self.placed.n_sections
        start, parts = self._starts(u, rows.start, execution)
        applied = u
        if self.process_noise is not None:
            applied = u + self.process_noise.draw(u.shape, N, rows.start)
        if parts is None or applied is not u:
            parts = self._flow(applied, start, execution, "experiments")
        y, result, failed_at, error, answer = self._deviations(u.shape, parts)
        self._require_outputs(y, result)
        z = self.at_sections.outputs
        label = self.placed.family.label
        inputs: tuple[str, ...] = z.structure.inputs
        if answer is not None:
            u = np.concatenate([u + answer, u], axis=2)
            inputs = inputs + signals(
                names("references", None, len(inputs)), map(unit_of, inputs)
            )
        return ExperimentData(
            u,
            y,
            n_sections=N,
            periods=self.inputs.periods,
            inputs=inputs,
            outputs=z.names,
            result=result,
            simulated=Simulated(failed_at, error, label),
            cycle_outputs=self.at_sections.on_cycle,
        )

    @property
    def at_sections(self) -> "_AtSections":
        """Outputs, compiled definitions and values at the sections, made once for the same sections
        and outputs."""
        names = tuple(x if isinstance(x, str) else id(x) for x in self.outputs)

        def make() -> _AtSections:
            z = self.placed.structure().resolve_outputs(self.outputs)
            on_cycle = np.asarray(self.placed.observe(tuple(z.items)))
            return _AtSections(
                outputs=z,
                course=Course.of(self.placed, z.items),
                on_cycle=on_cycle,
                given=self.outputs,
            )

        return _resolved.recall(self.placed, names, make)

    def _starts(
        self, u, first: int, execution: Execution
    ) -> tuple[Float[np.ndarray, "m S"], list | None]:
        """Return times and states on section 0 at which experiments start. If the search for these
        starts has already run the experiments, also return their responses (as `_flow` yields
        them).

        **Raises:** `ComputationError` if a periodic response is not found near the predicted one.
        """
        if self.model is None:
            return np.tile(to_host(self.placed).section_zero[:, None], len(u)), None
        stepping = self.stepping
        periods = self.inputs.periods
        window = u[:, : periods * self.placed.n_sections]
        predicted = periodic_start(self.placed, self.model, window)
        if self.start == "periodic":
            return predicted, None
        parts: list = []

        def flow(start, rows):
            parts[:] = self._flow(window[rows], start, execution, "steady starts")
            return np.concatenate([part.end for _, part in parts]).T

        start, change, still = steady_start(
            self.placed, self.model, stepping, periods, predicted, flow
        )
        if (change > stepping.accuracy).any():
            s = int(np.nanargmax(change))
            raise ComputationError(
                f"experiment {first + s}: no periodic response was found (Newton's last step: "
                f"{change[s]:.1e}): lower the input, or discard cycles."
            )
        start = np.where(np.isnan(change), predicted, start)
        return start, parts if still and window.shape == u.shape else None

    def _deviations(self, shape: tuple[int, int, int], responses):
        """Collect responses: deviations of outputs from the cycle (S, n, ny), result codes, samples
        of failures, errors, and the values that a controller added to the inputs (S, n, nu).
        `shape`: (S, n, nu)."""
        N = self.placed.n_sections
        base = self.at_sections.on_cycle
        S, n, _ = shape
        answer = None if self.feedback is None else np.empty(shape)
        y = np.empty((S, n // N, *base.shape))
        parts = []
        for rows, part in responses:
            np.subtract(part.y.reshape(-1, *y.shape[1:]), base, out=y[rows])
            parts.append((part.result, part.failed_at, part.error))
            if answer is not None:
                answer[rows] = part.feedback
        result, failed_at, error = map(np.concatenate, zip(*parts, strict=True))
        return (
            y.reshape(S, n, -1),
            result.astype(int),
            failed_at.astype(int),
            error,
            answer,
        )

    def _flow(
        self, u, start, execution: Execution, name: str
    ) -> Iterator[tuple[slice, Any]]:
        """Yield rows and their `Response`, batch after batch."""
        tables = self._tables
        if tables is None:
            yield from self._searched(u, start, execution, name)
            return
        size = execution.batch or len(u)
        followed = self._followed(tables.near, u, start, execution, name)
        for rows, (part, left) in followed:
            left = np.flatnonzero(left)
            yield rows, self._completed(part, left, u[rows], start[:, rows], size)

    @property
    def _tables(self) -> Tables | None:
        """The tables that experiments follow, made once for the same sections and schedule."""

        def make():
            return tables(self.placed, self.stepping.plan)

        return _tables.recall(self.stepping, None, make)

    def _completed(
        self, part: Response, left: np.ndarray, u, start, size: int
    ) -> Response:
        """A response in which the experiments that have `left` their table are replaced. They are
        run again along the longer table, in a batch of `size`; experiments that leave this one,
        too, are run by a search."""
        name = "experiments far from the cycle"
        if len(left):
            tables = self._tables
            assert tables is not None
            whole = Execution(batch=size, workers=1)
            again = u[left], start[:, left], whole, name
            ((_, (new, gone)),) = self._followed(tables.far, *again)
            part = _with_rows(part, left, new)
            left = left[gone]
        if len(left):
            few = Execution(batch=_round_up(len(left), size), workers=1)
            ((_, new),) = self._searched(u[left], start[:, left], few, name)
            part = _with_rows(part, left, new)
        return part

    def _followed(
        self, table: Table, u, start, execution: Execution, name: str
    ) -> Iterator[tuple[slice, Any]]:
        """Yield, batch after batch, the rows, their `Response` along a table, and which experiments
        have left the table."""
        further = table.form, table.rows, np.int32(table.count)

        def arguments(rows):
            return (*self._arguments(u, start, rows), *further)

        return in_batches(program, arguments, len(u), execution, name)

    def _searched(
        self, u, start, execution: Execution, name: str
    ) -> Iterator[tuple[slice, Any]]:
        """Yield rows and their `Response` with a search for events, batch after batch."""

        def arguments(rows):
            return self._arguments(u, start, rows)

        search = _LARGE_SEARCH if self.large else _SEARCH
        return in_batches(search, arguments, len(u), execution, name)

    def _arguments(self, u, start, rows: slice | np.ndarray) -> tuple:
        """Arguments of a program for some experiments."""
        loop = None
        if self.feedback is not None:
            on_cycle = jax.numpy.asarray(self.at_sections.on_cycle)
            loop = from_host(Feedback(self.feedback, on_cycle))
        # (The arrays are not changed before the program ends, so that they may share memory.)
        x, held = jax.device_put((start[:, rows], u[rows]))
        stepping = self.stepping
        return self.at_sections.course, stepping.plan, x, held, stepping.settings, loop

    def _require_outputs(self, y, result) -> None:
        finite = np.isfinite(y)
        if finite.all() or (finite.all(axis=(1, 2)) | (result != Result.OK)).all():
            return
        self.at_sections.outputs.require(*np.unique(self.placed.lanes.chart).tolist())
        raise DefinitionError(
            "an output is NaN where experiments go: define it there, or make the inputs smaller."
        )


def prepare(
    cycle: LimitCycle,
    sections: SectionsLike,
    design: DesignLike,
    outputs: OutputNames,
    options: RunOptions,
    chunk: int | None = None,
) -> Campaign:
    """Check the arguments of `run_experiments`, and do what is done once for all experiments.

    **Arguments:** `chunk`: number of experiments that run together. Default: all.
    """
    placed = as_placed(cycle, sections)
    items = (outputs,) if isinstance(outputs, str | Output) else tuple(outputs)
    check_outputs(cycle, items)
    start = options.start
    noise = options.process_noise
    feedback = None if options.feedback is None else _controller(placed, items, options)
    _require_return(cycle, placed, feedback is not None)
    discard = options.discard
    if discard is None:
        discard = DISCARD if start == "cycle" else 0
    N = placed.n_sections
    inputs = check_inputs(design, discard, N, cycle.structure.inputs)
    if noise is not None:
        noise.require(N)
    if start != "cycle" and inputs.cycles % inputs.periods:
        raise DefinitionError(
            f"start='{start}' needs inputs of whole windows: use `discard=0`."
        )
    together = len(inputs) if chunk is None else min(chunk, len(inputs))
    execution = divide(together, options.execution or Execution())
    return Campaign(
        placed=placed,
        outputs=items,
        inputs=inputs,
        start=start,
        model=None if start == "cycle" else linearized(placed),
        stepping=plan_flow(placed, options.accuracy),
        process_noise=noise,
        execution=execution,
        large=len(inputs) * inputs.cycles * N > _LARGE,
        feedback=feedback,
    )


def _controller(
    placed: PlacedSections, outputs: tuple[str | Output, ...], options: RunOptions
) -> Matrices:
    """Return the matrices of a controller.

    **Raises:** `DefinitionError` if it does not fit; `ComputationError` if the loop is unstable.
    """
    if options.start != "cycle":
        raise DefinitionError("with `feedback`, use start='cycle', and discard cycles.")
    model = linearize(placed.cycle, placed, outputs=outputs)
    F = options.feedback
    loop = model.feedback(F)  # type: ignore[arg-type]  # (not None)
    if len(loop.multipliers) and abs(loop.multipliers[0]) >= 1:
        raise ComputationError(
            "with this feedback the limit cycle is not stable: its largest multiplier is "
            f"{abs(loop.multipliers[0]):.4g} in modulus."
        )
    if isinstance(F, LDTP):
        return to_host(F.matrices)
    shape = len(model.inputs), len(model.outputs)
    return to_host(static_gain(to_host(F), model.n_sections, shape))


def check_inputs(
    design: DesignLike, discard: int, n_sections: int, inputs: tuple
) -> Inputs:
    """Return the `Inputs` of experiments, checked against the number of sections and the names of
    inputs. The first `discard` cycles are not for estimation.

    **Raises:** `DefinitionError` if they do not fit, or hold NaN.
    """
    if isinstance(design, Design):
        require_inputs(design, "system", n_sections, inputs)
        return Inputs(design, discard + design.periods, design.periods)
    u = np.asarray(
        design
    )  # may lie on disk (`numpy.memmap`), so never all of it is read at once
    require_shape(u.shape, n_sections, len(inputs))
    for k in range(0, len(u), CHUNK):
        chunk = np.asarray(u[k : k + CHUNK], float)
        finite = np.isfinite(chunk).all(axis=(1, 2))
        if not finite.all():
            raise DefinitionError(
                f"`design` has NaN or infinity in experiment {k + int(np.argmin(finite))}."
            )
    cycles = u.shape[1] // n_sections
    if discard >= cycles:
        raise DefinitionError(
            f"discard={discard} leaves none of {cycles} cycles of inputs."
        )
    return Inputs(u, cycles, cycles - discard)


def _require_return(
    cycle: LimitCycle, placed: PlacedSections, stabilized: bool
) -> None:
    """**Raises:** an error for cycles that experiments would leave."""
    if not cycle.clocked and bool(np.isfinite(placed.bound.time).any()):
        raise DefinitionError(
            f"{name_of(cycle.system)} has no clock: at clock sections nothing brings its "
            "phase back (a multiplier of exactly 1). Use sections that depend on the state "
            "(KinematicPhase, or a list of Crossing and AtEvent)."
        )
    if not cycle.is_stable and not stabilized:
        largest = np.abs(cycle.multipliers[0])
        raise ComputationError(
            f"the limit cycle is not stable (largest multiplier {largest:.4g}): stabilize it, as "
            "by `feedback`, or use `linearize` alone."
        )


class _AtSections(NamedTuple):
    outputs: Outputs
    course: Course
    on_cycle: Float[np.ndarray, "N ny"]
    given: tuple[str | Output, ...]
    """The outputs. The cache key contains their `id`, so that they must not be
    garbage-collected."""


_SEARCH = Program(flow_batch, False)
_LARGE_SEARCH = Program(flow_batch, True)
_resolved = Memory()
_tables = Memory()


def _with_rows(part: Response, rows: np.ndarray, new: Response) -> Response:
    """A response with some experiments replaced."""

    def put(x, y):
        x = np.array(x)
        x[rows] = y
        return x

    return jax.tree_util.tree_map(put, part, new)


def _round_up(count: int, most: int) -> int:
    """The size of a batch for `count` experiments. There are few sizes, so that few programs are
    compiled."""
    size = _VECTOR
    while size < count:
        size *= 2
    return min(size, most)


def divide(S: int, execution: Execution) -> Execution:
    """Return `execution` with the batch size for S experiments and the number of threads filled
    in."""
    workers = execution.threads
    if execution.batch is not None:
        size = min(execution.batch, S)
    else:
        most = _BATCH if on_cpu() else _BATCH_ON_ACCELERATOR
        # The number of batches is a multiple of the number of workers, and all batches have one
        # size.
        rounds = -(-S // (most * workers))
        size = max(-(-S // (rounds * workers)), min(_UNDIVIDED, S))
        size = min(-(-size // _VECTOR) * _VECTOR, max(S, 1))
    return dataclasses.replace(
        execution, batch=size, workers=min(workers, -(-S // size))
    )


def in_batches(
    program: Callable[..., Any],
    arguments: Callable[[slice | np.ndarray], tuple],
    S: int,
    execution: Execution,
    name: str,
) -> Iterator[tuple[slice, Any]]:
    """Yield rows and the results of `program` for them, batch after batch.

    **Arguments:** `program`: a compiled function whose results have experiments on the first axis.
    `arguments`: a function that returns the arguments of the program for some experiments.
    `execution`: from `divide`. `name`: noun of the progress line.
    """
    size = execution.batch or S

    def work(k: int):
        rows = slice(k, k + size)
        if k + size > S:  # the last batch is filled up with repetitions
            rows = np.arange(k, k + size) % S
        return jax.tree_util.tree_map(
            lambda x: np.asarray(x)[: S - k], program(*arguments(rows))
        )

    starts = range(0, S, size)
    parts = in_threads(work, starts, execution.workers or 1)
    for k, part in counted(
        zip(starts, parts, strict=True), f"batches of {name}", len(starts)
    ):
        yield slice(k, min(k + size, S)), part
