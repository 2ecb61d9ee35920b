"""Experiments on one system, one cycle and one family of sections, ready to be run part by part."""

import dataclasses
import threading
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from tqdm import tqdm

from .._core.compile import quick_jit
from .._core.garbage_collector import uncollected
from .._core.precision import require_x64, single, single_precision
from .._core.results import Result
from .._core.threads import in_threads, meanwhile, thread_count
from ..engine.settings import EXPERIMENT, SINGLE_PRECISION_EXPERIMENT, Settings
from ..errors import ComputationError, DefinitionError
from ..linear.ldtp import LDTP
from ..maps.linearize import linearize
from ..maps.place import PATIENCE, as_placed
from ..maps.placed import PlacedSections
from ..orbits.cycle import LimitCycle
from ..systems.output import Output
from ..systems.structure import Outputs, Structure
from .data import ExperimentData
from .design.design import Design
from .plan import Plan, check_accuracy, plan_flow
from .respond import respond
from .single_precision import plan_single


# Experiments in one compiled call: on CPU, where more of them leave the cache and fewer share the
# cost of what is done once for all; and elsewhere.
_BATCH, _BATCH_ON_ACCELERATOR = {"double": 320, "single": 640}, 16384
# The accuracy where none is asked for.
_ACCURACY = {"double": EXPERIMENT, "single": SINGLE_PRECISION_EXPERIMENT}
# Splitting fewer than this among workers gains nothing.
_FEW = 32
# Up to so many samples in all, a program that is compiled in half the time runs at most 0.03 s
# longer.
_SMALL = 20_000
# A multiple of the numbers that processors add at once: other batches are up to a third slower.
_VECTOR = 8


@dataclasses.dataclass(frozen=True)
class Campaign:
    """What all experiments have in common. `run` does some of them."""

    placed: PlacedSections
    source: Design | np.ndarray
    count: int
    """S, the number of experiments."""
    cycles: int
    """Their length in periods of the cycle."""
    periods: int
    outputs: Outputs
    accuracy: float
    precision: str
    rounding: float
    """The error that this precision leaves, beside that of the steps."""
    scales: Float[np.ndarray, "N n"]
    settings: Settings
    plan: Plan
    model: LDTP | None
    """Predicts the start of a periodic response; None to start on the cycle."""
    size: int
    """Experiments in one compiled call."""
    workers: int
    """Threads that run calls at the same time."""
    small: bool
    """Whether the program is compiled with little optimization, since it will not run for long."""

    def inputs(self, rows: slice) -> Float[np.ndarray, "S n nu"]:
        """The inputs of some experiments."""
        if isinstance(self.source, Design):
            return self.source.inputs(self.cycles, rows)
        return np.asarray(self.source[rows], float)

    def run(self, rows: slice, progress: bool = False) -> ExperimentData:
        """Run some of the experiments."""
        N, size = self.placed.n_sections, self.size
        u = self.inputs(rows)
        S = len(u)
        start, program = self._start(u), _respond[self.small]

        def work(k):
            some = slice(k, k + size)
            if k + size > S:  # the last batch is filled up with repetitions
                some = np.arange(k, k + size) % S
            arguments = (
                self.placed,
                self.plan,
                jnp.asarray(start[:, some]),
                jnp.asarray(u[some]),
                tuple(self.outputs.items),
                self.settings,
            )
            if self.precision == "double":
                part = _once_compiled(program, arguments)
            else:
                with single_precision():
                    part = _once_compiled(program, single(arguments))
            return [np.asarray(x)[: S - k] for x in part]

        base = np.asarray(self.placed.observe(self.outputs.items))
        y, rest = np.empty((S, u.shape[1] // N, *base.shape)), []
        parts = in_threads(work, range(0, S, size), self.workers)
        bar = tqdm(parts, "experiments", -(-S // size), disable=not progress)
        for k, (part, *others) in zip(range(0, S, size), bar, strict=True):
            np.subtract(part.reshape(len(part), *y.shape[1:]), base, out=y[k : k + size])
            rest.append(others)
        y = y.reshape(S, u.shape[1], base.shape[1])
        result, failed_at, error = map(np.concatenate, zip(*rest, strict=True))
        error = error.astype(float) + self.rounding
        finite = np.isfinite(y)
        if not (finite.all() or (finite.all(axis=(1, 2)) | (result != Result.OK)).all()):
            for a in np.unique(self.placed.lanes.chart):
                self.outputs.require(int(a))
            raise DefinitionError(
                "an output is NaN although its experiment ran well: it is not defined everywhere "
                "that the experiments go."
            )
        return ExperimentData(
            u,
            y,
            n_sections=N,
            periods=self.periods,
            inputs=self.placed.cycle.system.inputs,
            outputs=self.outputs.names,
            result=result,
            failed_at=failed_at,
            error=error,
            cycle_outputs=base,
            family=self.placed.family.label,
        )

    def _start(self, u) -> Float[np.ndarray, "n S"]:
        """Times and states in which the experiments begin, at section 0."""
        on_cycle = np.asarray(self.placed.section_zero)[:, None]
        if self.model is None:
            return np.repeat(on_cycle, len(u), axis=1)
        embed = np.asarray(self.placed.frames()[0][0])[:, : self.model.A.shape[1]]
        window = jnp.asarray(u[:, : self.periods * self.placed.n_sections])
        x0 = jax.vmap(lambda u: self.model.periodic_state(u, self.periods))(window)
        return on_cycle + embed @ np.asarray(x0).T


_respond = {True: quick_jit(respond), False: eqx.filter_jit(respond)}
_compiling, _compiled = threading.Lock(), set()


def _once_compiled(program, arguments):
    """What `program` gives. Threads that need the same one wait until one has compiled it."""
    placed, _, _, u, outputs, _ = arguments
    kind = _kind(program, placed, u.shape, outputs)
    if kind in _compiled:
        return program(*arguments)
    with _compiling, uncollected:
        out = program(*arguments)
        _compiled.add(kind)
    return out


def _kind(program, placed: PlacedSections, shape, outputs):
    """What tells compiled programs apart: `placed` and the shape of the inputs determine those of
    all other arguments."""
    leaves, structure = jax.tree_util.tree_flatten((placed, outputs))
    kinds = tuple((x.shape, x.dtype) if eqx.is_array(x) else x for x in leaves)
    return program, structure, kinds, shape


def _compile_ahead(program, placed: PlacedSections, shape, outputs) -> None:
    """Begin to compile `program` in another thread, before the values of the plan are known.

    It is traced in this one: what threads trace at the same time differs from run to run, and is
    not found again in a cache on disk.
    """
    if _kind(program, placed, shape, outputs) in _compiled:
        return
    N, n = placed.n_sections, 1 + placed.lanes.q.shape[0]
    plan = Plan(*map(jnp.asarray, np.zeros((4, N))))
    start, u = jnp.asarray(np.zeros((n, shape[0]))), jnp.asarray(np.zeros(shape))
    arguments = placed, plan, start, u, outputs, Settings(1.0, 1.0, PATIENCE)
    with uncollected:
        lowered = program.lower(*arguments)

    def finish():
        with _compiling:
            lowered.compile()

    meanwhile(finish)


def prepare(
    cycle: LimitCycle,
    sections,
    design: Design | Float[np.ndarray, "S n nu"] | Float[Array, "S n nu"],
    outputs: Sequence[str | Output] | str | Output,
    *,
    start: str = "cycle",
    discard: int | None = None,
    periods: int | None = None,
    accuracy: float | None = None,
    scale: Mapping[str, float] | None = None,
    precision: str = "double",
    chunk: int | None = None,
    batch: int | None = None,
    workers: int | None = None,
) -> Campaign:
    """Check what `run_experiments` was given, and do what is done once for all experiments.

    `chunk`: how many of them are run together; by default all.
    """
    placed = as_placed(cycle, sections)
    require_x64(cycle)
    z = Structure(cycle.system).resolve_outputs(outputs)
    if start not in ("cycle", "periodic"):
        raise DefinitionError(f"start is 'cycle' or 'periodic', not {start!r}.")
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
    if precision not in _ACCURACY:
        raise DefinitionError(f"precision is 'double' or 'single', not {precision!r}.")
    nu = len(cycle.system.inputs)
    source, count, cycles, periods = _source(design, placed.n_sections, nu, start, discard, periods)
    model = None
    if start == "periodic":
        if cycles % periods:
            raise DefinitionError(
                "a periodic start needs inputs of a whole number of windows: use `discard=0`."
            )
        model = linearize(cycle, placed, outputs=[Output("t", lambda t, q, u: t)])
    together = count if chunk is None else chunks(count, chunk)[0].stop
    size, workers = divide(together, batch, workers, precision)
    accuracy = _ACCURACY[precision] if accuracy is None else float(accuracy)
    check_accuracy(accuracy)
    samples = cycles * placed.n_sections
    small = count * samples <= _SMALL
    if precision == "double":
        _compile_ahead(_respond[small], placed, (size, samples, nu), tuple(z.items))
        planned, rounding = plan_flow(placed, accuracy, scale), 0.0
    else:
        planned, rounding = plan_single(placed, accuracy, scale)
    plan, settings, scales = planned
    return Campaign(
        placed, source, count, cycles, periods, z, accuracy, precision, rounding, scales, settings,
        plan, model, size, workers, small,
    )  # fmt: skip


def chunks(count: int, chunk: int) -> list[slice]:
    """Consecutive parts of `count` experiments, all but the last of the size `chunk`.

    **Raises:** `DefinitionError` if `chunk` is not positive.
    """
    if chunk < 1:
        raise DefinitionError(f"chunk is the number of experiments of one part, not {chunk}.")
    return [slice(k, min(k + chunk, count)) for k in range(0, count, chunk)]


def divide(
    S: int, batch: int | None, workers: int | None, precision: str = "double"
) -> tuple[int, int]:
    """The size of batches for S experiments, and how many threads share them.

    **Raises:** `DefinitionError` for numbers below one.
    """
    if batch is not None and batch < 1:
        raise DefinitionError(f"batch is the number of experiments per call, not {batch}.")
    workers = thread_count(workers)
    if batch is not None:
        size = min(batch, S)
    else:
        on_cpu = jax.default_backend() == "cpu"
        most = _BATCH[precision] if on_cpu else _BATCH_ON_ACCELERATOR
        # As many batches as there are turns of all workers, and all batches of one size.
        turns = -(-S // (most * workers))
        size = max(-(-S // (turns * workers)), min(_FEW, S))
        size = min(-(-size // _VECTOR) * _VECTOR, max(S, 1))
    return size, min(workers, -(-S // size))


def _source(design, N: int, nu: int, start: str, discard, periods):
    """Where inputs come from, the number of experiments, their cycles, and those of the window."""
    discard = (20 if start == "cycle" else 0) if discard is None else discard
    if discard < 0 or discard != int(discard):
        raise DefinitionError(f"discard is the number of cycles before the window, not {discard}.")
    if isinstance(design, Design):
        if design.n_sections != N:
            raise DefinitionError(
                f"the design is for {design.n_sections} sections, but the family has {N}."
            )
        if len(design.input_names) != nu:
            raise DefinitionError(
                f"the design has {len(design.input_names)} inputs, but the system has {nu}."
            )
        if periods not in (None, design.periods):
            raise DefinitionError(
                f"`periods` is for inputs given as an array; the design has {design.periods}."
            )
        return design, design.experiments, int(discard) + design.periods, design.periods
    if np.iscomplexobj(design):
        raise DefinitionError("inputs must be real; these are complex.")
    u = np.asarray(design)  # may lie on disk (`numpy.memmap`), so never all of it is read at once
    if u.ndim != 3 or u.shape[2] != nu or u.shape[1] % N or 0 in u.shape:
        raise DefinitionError(
            f"inputs must have the shape (experiments, samples, {nu}) with samples a multiple of "
            f"the {N} sections; got {u.shape}."
        )
    for k in range(0, len(u), 1024):
        finite = np.isfinite(np.asarray(u[k : k + 1024], float)).all(axis=(1, 2))
        if not finite.all():
            worst = k + int(np.argmin(finite))
            raise DefinitionError(f"the input of experiment {worst} is NaN or infinite.")
    cycles = u.shape[1] // N
    available = cycles - discard
    periods = available if periods is None else periods
    if not 1 <= periods <= available:
        raise DefinitionError(
            f"inputs of {cycles} cycles less {discard} discarded ones leave {available} "
            f"for estimation; got periods = {periods}."
        )
    return u, len(u), cycles, int(periods)
