"""The response of a hybrid system around its limit cycle to inputs: many experiments in one
program.

`flow_batch` moves all experiments from section to section, each time by a search for events
(`engine/move.py`), with the first steps of a plan (`plan.py`). Each experiment is a *lane*, an
entry on the last axis of arrays. `run.py` calls it for experiments that leave the tables of
`passage.py`. `response_function` is the same for users, with derivatives. `Course` has the data of
the sections. An experiment that fails without need has its cause in `examined`, or in the search.
"""

import dataclasses
from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

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
from ..engine.move import move
from ..engine.settings import EXPERIMENT, Settings
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
    """The sections on a limit cycle, as experiments need them.

    **Fields:** `outputs`, the outputs that are recorded at the sections. The other fields are as in
    `PlacedSections` and `LimitCycle`.
    """

    system: HybridSystem
    outputs: tuple[str | Output, ...]
    bound: BoundSections
    lanes: Lanes
    period: Float[Array, ""]
    event_sequence: tuple[int, ...] = eqx.field(static=True)
    has_event_sections: bool = eqx.field(static=True)
    """Whether a section is an event."""


def course(placed: PlacedSections, outputs: Sequence[str | Output]) -> Course:
    """Return the course of experiments around a limit cycle."""
    cycle = placed.cycle
    event = placed.bound.event
    has_event_sections = is_traced(event) or bool((np.asarray(event) >= 0).any())
    return Course(
        cycle.system,
        tuple(outputs),
        placed.bound,
        placed.lanes,
        cycle.period,
        cycle.event_sequence,
        has_event_sections,
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
    s = Structure(course.system)
    period = course.period
    sequence = course.event_sequence
    z = s.resolve_outputs(course.outputs)
    N = len(course.bound.time)
    S, n, _ = u.shape
    one_turn = len(sequence)

    def many(x):
        return jnp.broadcast_to(x[..., :1], (*x.shape[:-1], S))

    lanes = jax.tree_util.tree_map(many, course.lanes)
    lanes = eqx.tree_at(lambda x: (x.t, x.q), lanes, (start[0], start[1:]))

    def examined(result, lanes, u, section):
        """The results of lanes on a section. (An event that is due at once on a section would be
        missed: it is an error.)"""
        if not course.has_event_sections:
            return result
        at_event = (result == Result.OK) & (course.bound.event[section] >= 0)
        still_s, still_lanes, still_u = fixed((s, lanes, u))
        missed = followed_at_once(still_s, still_lanes, still_u, at_event, period)
        return update_result(result, missed >= 0, Result.EVENT_ORDER)

    @jax.checkpoint
    def section(carry, xs):
        lanes, result, state = carry
        k, u = xs
        i = k % N
        j = (k + 1) % N
        answer = None
        if feedback is not None:
            # (The controller measures outputs before the input acts.)
            answer, state = feedback.answer(i, state, observe(s, z, lanes, u))
            u = u + answer
        y = jnp.where(result == Result.OK, observe(s, z, lanes, u), jnp.nan)
        turns = (j == 0).astype(jnp.int32)
        to = j[None], lanes.t, turns[None]
        target = section_target(course.bound, course.lanes, period, *to)
        target = dataclasses.replace(target, event_sequence=sequence)
        stride = plan.stride(i, S)
        moved = move(s, lanes, u, target, settings, stride, result).moved
        # An event may happen before or after a section, but the number of events in a period must
        # be that of the cycle.
        expected = course.lanes.events[j] + turns * one_turn
        wrong = jnp.abs(moved.lanes.events - expected) > 1
        result = update_result(moved.result, wrong, Result.EVENT_ORDER)
        result = examined(result, moved.lanes, u, j)
        # Times and events are counted within one turn, so that every turn is computed alike.
        t = moved.lanes.t - turns * period
        events = moved.lanes.events - turns * one_turn
        lanes = moved.lanes._replace(t=t, events=events)
        ok = result == Result.OK
        counts = ok & (moved.error > 0)
        share = jnp.where(counts, moved.error * plan.weight[i], 0.0)
        return (lanes, result, state), (y, ok, jax.lax.stop_gradient(share), answer)

    xs = (jnp.arange(n), jnp.transpose(u, (1, 2, 0)))
    states = 0 if feedback is None else feedback.matrices.A.shape[1]
    still = jnp.zeros((s.nu, 1))
    result = examined(jnp.zeros(S, jnp.int32), lanes, still, 0)
    begin: Any = (lanes, result, jnp.zeros((states, S)))
    (lanes, result, _), (y, ok, shares, answers) = jax.lax.scan(section, begin, xs)
    failed_at = jnp.where(ok.all(axis=0), -1, jnp.argmin(ok, axis=0))
    each_turn = jnp.sum(shares.reshape(n // N, N, S), axis=1)
    error = ROUNDING + plan.least + jnp.max(each_turn, axis=0)
    end = jnp.concatenate([lanes.t[None], lanes.q])
    end = jnp.where(result == Result.OK, end, jnp.nan)
    answers = None if answers is None else jnp.moveaxis(answers, -1, 0)
    return Response(
        y=jnp.moveaxis(y, -1, 0),
        result=result,
        failed_at=failed_at,
        error=error,
        end=end.T,
        feedback=answers,
    )


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
            course(placed, self.outputs),
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
