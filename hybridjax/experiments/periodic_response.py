"""The periodic response to a periodic input, as a root that can be differentiated."""

import dataclasses

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from ..engine.settings import STEADY_START
from ..errors import DefinitionError
from ..systems.system import HybridSystem
from .response_function import ResponseFunction
from .variation import states


_MOST = 12  # steps of Newton's method


def steady_start(
    response: ResponseFunction,
    u: Float[ArrayLike, "S n nu"],
    system: HybridSystem | None = None,
    *,
    accuracy: float = STEADY_START,
) -> Float[Array, "m S"]:
    r"""Where experiments must start so that their responses repeat with their inputs.

    ```python
    start = hj.experiments.steady_start(response, u)
    y = response(u, start).y        # periodic from the first sample on
    ```

    The zero of $F(x) - x$, with F the nonlinear response over one window of the input, by Newton's
    method. Its derivatives with respect to inputs and
    parameters follow from $(I - F_x)\, dx = F_\theta\, d\theta$ at the solution, in both modes, and
    under `jit`. `run_experiments(start="steady")` does the same for data without derivatives.

    **Arguments:**

    - `response`: from `response_function`. `u`: one window of the input, n a multiple of N.
    - `system`: one with other parameters, as for `response`.
    - `accuracy`: of the start, relative to the largest entry (at least 1).

    **Returns:** times and states at section 0; NaN for experiments that fail or find no such start.
    """
    u = jnp.asarray(u, float)
    N, lanes = response.placed.n_sections, response.placed.lanes
    if u.ndim != 3 or u.shape[1] % N or 0 in u.shape:
        raise DefinitionError(
            f"inputs must have the shape (experiments, samples, inputs), samples a multiple of the "
            f"{N} sections, not {u.shape}."
        )
    cycle = jnp.concatenate([lanes.t[None], lanes.q])[:, :1]
    m, n = len(cycle), u.shape[1]
    # Time is a state on state-based sections of clocked systems only.
    moves = jnp.ones((m, 1)).at[0].set(jnp.where(response.placed.time_is_state[0], 1.0, 0.0))
    inner = dataclasses.replace(response, outputs=tuple(states(m - 1)))

    def after(x, u, system):
        once = jnp.concatenate([u, u[:, :N]], axis=1)
        return inner(once, x, system).y[:, n].T

    def defect(x, u, system):
        return (after(x, u, system) - x) * moves

    def newton(x, u, system):
        """The defect, and its derivatives along all states: (S, m, m)."""

        def column(e):
            push = jnp.broadcast_to(e[:, None], x.shape)
            return jax.jvp(lambda x: defect(x, u, system), (x,), (push,))

        values, slopes = jax.lax.map(column, jnp.eye(m))
        return values[0], jnp.transpose(slopes, (2, 1, 0)) - jnp.diag(1 - moves[:, 0])

    def solve(slope, defect):
        return jnp.linalg.solve(slope, -defect.T[..., None])[..., 0].T

    fixed = jax.lax.stop_gradient((u, system))
    begin = jnp.broadcast_to(jax.lax.stop_gradient(cycle), (m, len(u)))
    size = jnp.maximum(jnp.abs(cycle).max(), 1.0)

    def step(carry):
        x, _, _, k = carry
        values, slope = newton(x, *fixed)
        change = solve(slope, values)
        return x + change, slope, jnp.abs(change).max(axis=0) / size, k + 1

    def unfinished(carry):
        *_, worst, k = carry
        return (k < _MOST) & jnp.any(worst > accuracy)

    unknown = jnp.zeros((len(u), m, m)), jnp.full(len(u), jnp.inf)
    x, slope, worst, _ = jax.lax.while_loop(unfinished, step, (begin, *unknown, 0))
    x, slope = jax.lax.stop_gradient((jnp.where(worst <= accuracy, x, jnp.nan), slope))
    return x + solve(slope, defect(x, u, system))
