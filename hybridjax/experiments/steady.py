"""Starts from which the responses to periodic inputs are periodic, by Newton's method."""

import dataclasses
from collections.abc import Callable
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Numbers, Positive
from .._core.boundary.values import Reals
from .._core.precision import require_x64
from ..engine.settings import STEADY_START, Settings
from ..errors import DefinitionError
from ..systems.system import HybridSystem
from .flow_batch import Course, flow_batch
from .response_function import ResponseFunction
from .stepping.plan import Plan


# Steps of Newton's method. Twice as many let larger inputs have a steady start, and take twice as
# long to find that there is none.
MOST_STEPS = 12


class NewtonState(NamedTuple):
    """Where Newton's method has come to, for S experiments."""

    start: Float[Array, "m S"]
    """Times and states on section 0."""
    change: Float[Array, " S"]
    """The last step, relative to the sizes of the states; NaN for experiments that failed."""
    slope: Float[Array, "S m m"] | None
    """The derivatives with which it was taken, if `step` gives them."""


def settle(
    step: Callable[[Float[Array, "m S"]], tuple[Float[Array, "m S"], Array | None]],
    start: Float[Array, "m S"],
    size: Float[Array, "m #S"],
    accuracy: float | Float[Array, ""],
    slope: Float[Array, "S m m"] | None = None,
) -> NewtonState:
    """Newton's method for all experiments side by side, until no step is larger than `accuracy`
    times `size`. An experiment that is done stays where it is.

    **Arguments:** `step` gives Newton's step, and the derivatives that it was taken with or None;
    `slope`, an array for these.
    """

    def unfinished(carry):
        settled, k = carry
        return (k < MOST_STEPS) & jnp.any(settled.change > accuracy)

    def advance(carry):
        settled, k = carry
        on = settled.change > accuracy  # not where it is NaN
        move, slope = step(settled.start)
        change = jnp.max(jnp.abs(move) / size, axis=0)
        new = NewtonState(settled.start + move, change, slope)
        return jax.tree_util.tree_map(lambda x, y: _choose(on, x, y), new, settled), k + 1

    begin = NewtonState(start, jnp.full(start.shape[1], jnp.inf), slope)
    return jax.lax.while_loop(unfinished, advance, (begin, 0))[0]


def _choose(on: Bool[Array, " S"], x: Array, y: Array) -> Array:
    """`x` for some experiments, `y` for the others; these are the first axis of three, and the last
    otherwise."""
    return jnp.where(on[:, None, None] if x.ndim == 3 else on, x, y)


class Prediction(NamedTuple):
    """What the linearization knows of the way from a start to where it leads P periods later."""

    gain: Float[Array, "m m"]
    r"""$(I - \Phi^P)^{-1} \Phi^P$ in times and states: what Newton's step has beside the defect."""
    size: Float[Array, "m 1"]
    """Sizes of time and states."""
    moves: Float[Array, "m 1"]
    """0 for time where it is no state, else 1."""
    accuracy: Float[Array, ""]


def settle_batch(
    course: Course,
    plan: Plan,
    start: Float[Array, "m S"],
    u: Float[Array, "S n nu"],
    settings: Settings,
    predicted: Prediction,
) -> tuple[Float[Array, "S m"], Float[Array, " S"]]:
    r"""Starts of S experiments under one window `u` of a periodic input, and the last steps towards
    them relative to the states' sizes.

    The Jacobian is that of the linearization, $\Phi^P$, as precise as the response is linear.
    """

    def step(x):
        defect = (flow_batch(course, plan, x, u, settings).end.T - x) * predicted.moves
        return defect + predicted.gain @ defect, None

    settled = settle(step, start, predicted.size, predicted.accuracy)
    return settled.start.T, settled.change


@checked
def steady_start(
    response: ResponseFunction,
    u: Annotated[Numbers, Reals("S n nu")],
    system: HybridSystem | None = None,
    *,
    accuracy: Positive = STEADY_START,
) -> Float[Array, "m S"]:
    r"""Where experiments must start so that their responses repeat with their inputs.

    ```python
    start = hj.experiments.steady_start(response, u)
    y = response(u, start).y        # periodic from the first sample on
    ```

    The zero of $F(x) - x$, with F the nonlinear response over one window of the input, by Newton's
    method with the exact Jacobian. Its derivatives with respect to inputs and parameters follow
    from $(I - F_x)\, dx = F_\theta\, d\theta$ at the solution, in both modes, and under `jit`.
    `run_experiments(start="steady")` does the same for data without derivatives.

    **Arguments:**

    - `response`: from `response_function`. `u`: one window of the input, n a multiple of N.
    - `system`: one with other parameters, as for `response`.
    - `accuracy`: of the start, relative to the sizes of time and states on the cycle.

    **Returns:** times and states at section 0; NaN for experiments that fail or find no such start.

    **Raises:** `DefinitionError` for inputs of another shape.
    """
    require_x64(system)
    u = jnp.asarray(u, float)
    N, lanes = response.placed.n_sections, response.placed.lanes
    if u.ndim != 3 or u.shape[1] % N or 0 in u.shape:
        raise DefinitionError(
            f"inputs must have the shape (experiments, samples, inputs), samples a multiple of the "
            f"{N} sections, not {u.shape}."
        )
    cycle = jnp.concatenate([lanes.t[None], lanes.q])[:, :1]
    m = len(cycle)
    # Time is a state on state-based sections of clocked systems only.
    moves = jnp.ones((m, 1)).at[0].set(jnp.where(response.placed.time_is_state[0], 1.0, 0.0))
    inner = dataclasses.replace(response, outputs=())

    def defect(x, u, system):
        return (inner(u, x, system).end.T - x) * moves

    def newton(x, u, system):
        """Newton's step, and the derivatives of the defect along all states."""

        def column(e):
            push = jnp.broadcast_to(e[:, None], x.shape)
            return jax.jvp(lambda x: defect(x, u, system), (x,), (push,))

        values, slopes = jax.lax.map(column, jnp.eye(m))
        slope = jnp.transpose(slopes, (2, 1, 0)) - jnp.diag(1 - moves[:, 0])
        return solve(slope, values[0]), slope

    def solve(slope, defect):
        return jnp.linalg.solve(slope, -defect.T[..., None])[..., 0].T

    fixed = jax.lax.stop_gradient((u, system))
    begin = jnp.broadcast_to(jax.lax.stop_gradient(cycle), (m, len(u)))
    size = jnp.asarray(response.stepping.scales)[0][:, None]
    settled = settle(lambda x: newton(x, *fixed), begin, size, accuracy, jnp.zeros((len(u), m, m)))
    start = jnp.where(settled.change <= accuracy, settled.start, jnp.nan)
    start, slope = jax.lax.stop_gradient((start, settled.slope))
    return start + solve(slope, defect(start, u, system))
