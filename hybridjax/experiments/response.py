"""The response of a hybrid system around its limit cycle to inputs: many experiments in one
program.

`flow_batch` moves all experiments from section to section, each time by a search for events
(`engine/move.py`), with the first steps of a plan (`plan.py`). Each experiment is a *lane*, an
entry on the last axis of arrays. `run.py` calls it for experiments that leave the tables of
`passage.py` or have none, and `fitting/observations.py` for fits. `response_function` is the same
for users, with derivatives.

Times and events are counted within one turn: only so is every turn computed alike, and `scan`
compiles one move for all sections. Tests and error estimates have no derivatives (`fixed`,
`stop_gradient`).

If an output answers an input one section too early or too late, look at the order in
`_Moves.to_next_section`. If an experiment fails without need, look at `_Moves.tested` (events in
another order) or at the search. If `error` is wrong, look at `_largest_error`, and at `weight` in
`plan.py`.
"""

import dataclasses
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._core.boundary.checked import checked, checked_methods
from .._core.boundary.kinds import Numbers
from .._core.boundary.members import leading_on
from .._core.boundary.values import Reals
from .._core.executor import is_traced
from .._core.meaning import require_as_made
from .._core.precision import require_x64
from .._core.results import Result, update_result
from .._core.text import folded, listed
from ..engine.lanes import Lanes, fixed
from ..engine.move import Moved, move
from ..engine.settings import EXPERIMENT, Settings
from ..engine.target import Target
from ..errors import DefinitionError
from ..linear.algebra import Matrices
from ..orbits.checks import check_outputs
from ..orbits.cycle import LimitCycle
from ..sections.families import BoundSections
from ..sections.place import as_placed
from ..sections.placed import (
    PlacedSections,
    SectionsLike,
    followed_at_once,
    observe,
    section_target,
)
from ..systems.structure import Structure
from ..systems.system import HybridSystem, Output, OutputNames, arrays_of, name_of
from .plan import ROUNDING, Accuracy, Plan, Stepping, plan_flow


# With derivatives, the limit on the number of steps: this number between two sections if there are
# as many sections, or its square in a period. Fewer: experiments far from the cycle reach the
# limit. More: derivatives need more memory.
_STEPS = 32


@leading_on
class Response(NamedTuple):
    """The response of S experiments of n samples."""

    y: Float[Array, "S n ny"]
    """Outputs at the sections, before the new input acts; NaN after a failure."""
    result: Int[Array, " S"]
    """Codes of `Result`."""
    failed_at: Int[Array, " S"]
    """The sample at which an experiment failed, or -1."""
    error: Float[Array, " S"]
    """Estimate of the largest error of (t, q) at any section, relative to the states' scales."""
    end: Float[Array, "S m"]
    """Times and states on section 0 after the last sample, with times counted within one period, as
    at the start; NaN after a failure."""
    feedback: Float[Array, "S n nu"] | None = None
    """Values that a controller added to the inputs."""


class Feedback(NamedTuple):
    """A controller that acts at the sections, $u = r - F y$, and the outputs on the cycle."""

    matrices: Matrices
    on_cycle: Float[Array, "N ny"]

    def answer(
        self, i: Array, state: Float[Array, "m S"], y: Float[Array, "ny S"]
    ) -> tuple[Float[Array, "nu S"], Float[Array, "m S"]]:
        """Return the values that the controller adds to the inputs at section i, and its next
        state."""
        A, B, C, D, _ = (x[i] for x in self.matrices)
        deviation = y - self.on_cycle[i][:, None]
        answer = -(C @ state + D @ deviation)
        later = A @ state + B @ deviation
        return answer, later


class Course(eqx.Module):
    """The sections on a limit cycle: the parts of `PlacedSections` and of the cycle that the
    compiled programs use, under the same names.

    **Fields:** `outputs`, the outputs that are recorded at the sections. `lanes`, the states of the
    cycle at the sections.
    """

    system: HybridSystem
    outputs: tuple[str | Output, ...]
    bound: BoundSections
    lanes: Lanes
    period: Float[Array, ""]
    event_sequence: tuple[int, ...] = eqx.field(static=True)
    has_event_sections: bool = eqx.field(static=True)
    """Whether a section is an event."""

    @classmethod
    def of(cls, placed: PlacedSections, outputs: Sequence[str | Output]) -> "Course":
        """Return the course of experiments around a limit cycle."""
        cycle = placed.cycle
        event = placed.bound.event
        has_events = is_traced(event) or bool((np.asarray(event) >= 0).any())
        return cls(
            cycle.system,
            tuple(outputs),
            placed.bound,
            placed.lanes,
            cycle.period,
            cycle.event_sequence,
            has_events,
        )


def require_shape(shape: tuple[int, ...], n_sections: int, nu: int) -> None:
    """**Raises:** `DefinitionError` for inputs that are not (S, n, nu) with n a multiple of N."""
    if len(shape) != 3 or shape[2] != nu or shape[1] % n_sections or 0 in shape:
        raise DefinitionError(
            f"inputs must have the shape (experiments, periods x {n_sections}, {nu}), not {shape}."
        )


def flow_batch(
    course: Course,
    plan: Plan,
    start: Float[Array, "m S"],
    u: Float[Array, "S n nu"],
    settings: Settings,
    feedback: Feedback | None = None,
) -> Response:
    """Flow S experiments from section 0 through n sections under inputs held between them, n a
    multiple of N.

    `start` holds times and (padded) states at section 0. Differentiable in both modes; reverse mode
    stores the states at the sections and recomputes the flow between them.
    """
    N = len(course.bound.time)
    _, n, _ = u.shape
    moves = _Moves(course, plan, settings, feedback)
    samples = (jnp.arange(n), jnp.transpose(u, (1, 2, 0)))
    batch = moves.begin(start)
    batch, kept = jax.lax.scan(jax.checkpoint(moves.to_next_section), batch, samples)
    end = jnp.concatenate([batch.lanes.t[None], batch.lanes.q])
    end = jnp.where(batch.result == Result.OK, end, jnp.nan)
    answer = kept.answer
    return Response(
        y=jnp.moveaxis(kept.y, -1, 0),
        result=batch.result,
        failed_at=jnp.where(kept.ok.all(axis=0), -1, jnp.argmin(kept.ok, axis=0)),
        error=_largest_error(plan, kept.error.reshape(n // N, N, -1)),
        end=end.T,
        feedback=None if answer is None else jnp.moveaxis(answer, -1, 0),
    )


class _Batch(NamedTuple):
    """S experiments at a section."""

    lanes: Lanes
    result: Int[Array, " S"]
    controller: Float[Array, "m S"]
    """States of the controller."""


class _Sample(NamedTuple):
    """The numbers that are kept of S experiments at a section, and of their move to the next."""

    y: Float[Array, "ny S"]
    ok: Bool[Array, " S"]
    error: Float[Array, " S"]
    """The largest error that the move causes at a later section (see `Plan.weight`)."""
    answer: Float[Array, "nu S"] | None
    """Values that the controller added to the inputs."""


@dataclasses.dataclass(eq=False)
class _Moves:
    """Moves of S experiments from a section to the next."""

    course: Course
    plan: Plan
    settings: Settings
    feedback: Feedback | None

    def __post_init__(self):
        course = self.course
        self.s = Structure(course.system)
        self.z = self.s.resolve_outputs(course.outputs)
        self.N = len(course.bound.time)

    def begin(self, start: Float[Array, "m S"]) -> _Batch:
        """The experiments on section 0."""
        S = start.shape[1]

        def of_section_zero(x):
            return jnp.broadcast_to(x[..., :1], (*x.shape[:-1], S))

        lanes = jax.tree_util.tree_map(of_section_zero, self.course.lanes)
        lanes = lanes._replace(t=start[0], q=start[1:])
        no_input = jnp.zeros((self.s.nu, 1))
        ok = jnp.zeros(S, jnp.int32)
        result = self.without_missed_event(ok, lanes, no_input, 0)
        feedback = self.feedback
        states = 0 if feedback is None else feedback.matrices.A.shape[1]
        return _Batch(lanes, result, jnp.zeros((states, S)))

    def to_next_section(self, batch: _Batch, sample) -> tuple[_Batch, _Sample]:
        """Move the experiments to the next section, under an input that is held until then.

        The order matters: the controller measures before it acts, outputs are recorded before the
        move, and the values that the controller adds act from the recording on.
        """
        k, u = sample
        i = k % self.N
        j = (k + 1) % self.N
        lanes, result, controller = batch
        answer = None
        if self.feedback is not None:
            measured = observe(self.s, self.z, lanes, u)
            answer, controller = self.feedback.answer(i, controller, measured)
            u = u + answer
        y = observe(self.s, self.z, lanes, u)
        y = jnp.where(result == Result.OK, y, jnp.nan)

        turns = (j == 0).astype(jnp.int32)
        stride = self.plan.stride(i, result.shape[0])
        target = self.target(j, lanes.t, turns)
        moved = move(self.s, lanes, u, target, self.settings, stride, result).moved
        result = self.tested(moved, u, j, turns)
        lanes = self.within_one_turn(moved.lanes, turns)

        ok = result == Result.OK
        counts = ok & (moved.error > 0)
        error = jnp.where(counts, moved.error * self.plan.weight[i], 0.0)
        kept = _Sample(y, ok, jax.lax.stop_gradient(error), answer)
        return _Batch(lanes, result, controller), kept

    def target(self, j: Array, t: Float[Array, " S"], turns: Array) -> Target:
        """Section j, after `turns` further periods of the cycle (1 at its end, else 0)."""
        course = self.course
        target = section_target(
            course.bound, course.lanes, course.period, j[None], t, turns[None]
        )
        return dataclasses.replace(target, event_sequence=course.event_sequence)

    def tested(self, moved: Moved, u: Array, j: Array, turns: Array) -> Array:
        """The results of experiments that were moved to section j, with `EVENT_ORDER` for those
        that met other events than the cycle."""
        on_cycle = self.course.lanes.events[j]
        one_turn = len(self.course.event_sequence)
        # (An event may happen before a section, and on the cycle after it: a difference of 1 is
        # allowed. Events count from the start, so that differences do not add up.)
        difference = moved.lanes.events - (on_cycle + turns * one_turn)
        wrong = jnp.abs(difference) > 1
        result = update_result(moved.result, wrong, Result.EVENT_ORDER)
        return self.without_missed_event(result, moved.lanes, u, j)

    def without_missed_event(
        self, result: Array, lanes: Lanes, u: Array, j: Array | int
    ) -> Array:
        """The results, with `EVENT_ORDER` for experiments in which a second event is due at once
        after the event that is section j: the next move would begin behind it and miss it."""
        course = self.course
        if not course.has_event_sections:
            return result
        at_event = (result == Result.OK) & (course.bound.event[j] >= 0)
        s, lanes, u = fixed((self.s, lanes, u))
        missed = followed_at_once(s, lanes, u, at_event, course.period)
        return update_result(result, missed >= 0, Result.EVENT_ORDER)

    def within_one_turn(self, lanes: Lanes, turns: Array) -> Lanes:
        """Experiments with times and events counted within one turn."""
        one_turn = len(self.course.event_sequence)
        t = lanes.t - turns * self.course.period
        return lanes._replace(t=t, events=lanes.events - turns * one_turn)


def _largest_error(plan: Plan, errors: Float[Array, "p N S"]) -> Float[Array, " S"]:
    """Estimate of the largest error of each experiment, from those of its moves.

    `Plan.weight` contains the effect on all later periods if each period makes the same error. The
    errors are therefore added within a period only, and the worst period counts.
    """
    of_period = jnp.sum(errors, axis=1)
    return ROUNDING + plan.least + jnp.max(of_period, axis=0)


@checked_methods
class ResponseFunction(eqx.Module):
    """A map from inputs that are held between sections to outputs at the sections; see
    `response_function`.

    **Fields:** `placed`: the sections. `stepping`: tolerances and step schedule. `outputs`.
    """

    placed: PlacedSections
    stepping: Stepping
    outputs: tuple[str | Output, ...]

    def __repr__(self):
        s = self.placed.structure()
        names = s.resolve_outputs(self.outputs).names
        return folded(
            f"ResponseFunction({name_of(s.system)}: {listed(s.inputs)} -> {listed(names)}; "
            f"{self.placed.n_sections} sections; accuracy {self.stepping.accuracy:g})"
        )

    def __call__(
        self,
        u: Annotated[Numbers, Reals("experiments samples inputs")],
        start: Float[Array, "m S"] | None = None,
        system: HybridSystem | None = None,
    ) -> Response:
        """Return the response of S experiments.

        **Arguments:**

        - `u`: inputs, held from sample to sample, with n a multiple of the N sections.
        - `start`: times and states (padded with zeros) on section 0. Default: those of the cycle.
        - `system`: a system with other parameter values. The sections do not move with it.

        **Returns:** a `Response`: outputs `y` (S, n, ny) (not deviations), `result` (S,) codes,
        `failed_at` (S,), error estimates `error` (S,), and final states `end` (S, m). Experiments
        that fail raise no error.

        **Raises:** `DefinitionError` for inputs of another shape, and if the code of the cycle's
        system has changed.
        """
        require_x64(system)
        u = jnp.asarray(u, float)
        placed = self.placed
        require_shape(u.shape, placed.n_sections, placed.cycle.structure.nu)
        if system is None:
            placed.require_current()
            require_as_made(self.outputs, "this response function was made")
        else:

            def both(x):
                return (x.cycle.system, x.cycle.numbers)

            placed = eqx.tree_at(both, placed, (system, arrays_of(system)))
        if start is None:
            start = jnp.tile(placed.section_zero[:, None], len(u))
        return flow_batch(
            Course.of(placed, self.outputs),
            self.stepping.plan,
            start,
            u,
            self.stepping.settings,
        )


@checked
def response_function(
    cycle: LimitCycle,
    sections: SectionsLike,
    outputs: OutputNames,
    *,
    accuracy: Accuracy = EXPERIMENT,
) -> ResponseFunction:
    """Return the computation of `run_experiments` as a function for `jit`, `vmap`, `grad` and
    `jacfwd`.

    It has exact derivatives with respect to inputs, start and parameters, in both modes. Reverse
    mode stores the states at the sections and recomputes the flow between them, so its memory grows
    by a few hundred bytes per sample. Outputs of an experiment are NaN after it failed: select
    experiments by `result` before you average.

    **Arguments:** `cycle`, `sections`, `outputs` and `accuracy`: as for `run_experiments`. The
    cycle may be unstable if experiments are short.

    **Returns:** a `ResponseFunction`. Call it with inputs (S, n, nu), and, if parameters change,
    with `system=` another system of the same class. It returns a `Response` with the outputs `y`
    (S, n, ny), and a code `result` (S,) for each experiment. These outputs are whole values, unlike
    those of `ExperimentData`, which are deviations from the cycle (`data.cycle_outputs`).

    **Raises:** `DefinitionError` for outputs or sections that do not exist, or an accuracy out of
    range.

    **Example:**

    ```python
    response = hj.experiments.response_function(cycle, sections, ("yM", "vM"))
    measured = data.y[:1, :16] + np.tile(data.cycle_outputs, (2, 1))  # (two periods)
    def misfit(system):
        return ((response(data.u[:1, :16], system=system).y - measured) ** 2).sum()
    print(misfit(hj.models.VerticalHopper(k=10.1)))  # also jax.grad(misfit)(hopper)
    ```

    **Before:** `hj.find_limit_cycle`. **After:** transformations of JAX.
    """
    placed = as_placed(cycle, sections)
    z = check_outputs(cycle, outputs)
    stepping = plan_flow(placed, accuracy)
    steps = max(_STEPS, _STEPS**2 // placed.n_sections)
    settings = dataclasses.replace(stepping.settings, max_steps=steps)
    stepping = dataclasses.replace(stepping, settings=settings)
    return ResponseFunction(placed, stepping, tuple(z.items))
