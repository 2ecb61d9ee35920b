"""Initial conditions of experiments: on the limit cycle, or in a periodic response."""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core.executor import from_host, to_host
from .._core.memo import Memory
from ..engine.settings import Settings
from ..linear.ldtp import LDTP
from ..linear.time_response import monodromy
from ..sections.linearize import linearize
from ..sections.placed import PlacedSections
from ..systems.system import Output
from .plan import Plan, Stepping
from .response import Course, flow_batch


StartName = Literal["cycle", "periodic", "steady"]

# Newton steps. Fewer: large inputs have no steady start. More: it takes longer to report that there
# is none.
MOST_STEPS = 12

# A linear model has at least one output. This one is defined in every chart.
_NOTHING = Output("nothing", lambda t, q, u: 0.0)
_linearized = Memory()


def linearized(placed: PlacedSections) -> LDTP:
    """Return the linearization from which starts are predicted, computed once for placed sections.

    **Raises:** as `linearize`.
    """
    make = lambda: linearize(placed.cycle, placed, outputs=[_NOTHING])  # noqa: E731
    return _linearized.recall(placed, None, make)


def periodic_start(
    placed: PlacedSections, model: LDTP, window: Float[np.ndarray, "S n nu"]
) -> Float[np.ndarray, "m S"]:
    """Return times and states on section 0 in the periodic response that `model` predicts to inputs
    that repeat the `window`."""
    embed = to_host(placed).frames()[0][0, :, : model.A.shape[1]]
    x0 = model.periodic_states(window, window.shape[1] // placed.n_sections)
    return to_host(placed).section_zero[:, None] + embed @ np.asarray(x0).T


class Prediction(NamedTuple):
    """The linearization of the map from a start to the state one window later."""

    gain: Float[Array, "m m"]
    r"""$(I - \Phi^P)^{-1} \Phi^P$ in times and states: Newton's step is the defect plus `gain`
    times the defect."""
    size: Float[Array, "m 1"]
    """Characteristic magnitudes of time and states."""
    moves: Float[Array, "m 1"]
    """0 for the time where it is no state, else 1."""
    accuracy: Float[Array, ""]


def predict(placed: PlacedSections, model: LDTP, stepping: Stepping, periods: int) -> Prediction:
    """Return the linearization over a window of `periods` periods."""
    embed, back = (x[0] for x in to_host(placed).frames())
    phi = monodromy(to_host(model.A))
    power, d = np.linalg.matrix_power(phi, periods), len(phi)
    gain = embed[:, :d] @ np.linalg.solve(np.eye(d) - power, power) @ back[:d]
    moves = np.ones((len(gain), 1))
    moves[0] = to_host(placed).time_is_state[0]
    size = stepping.scales[0][:, None]
    return Prediction(*from_host((gain, size, moves, np.array(stepping.accuracy))))


def settle_batch(
    course: Course,
    plan: Plan,
    start: Float[Array, "m S"],
    u: Float[Array, "S n nu"],
    settings: Settings,
    predicted: Prediction,
) -> tuple[Float[Array, "S m"], Float[Array, " S"]]:
    r"""Return starts whose responses to the repeated window `u` are periodic, and the last Newton
    steps relative to the sizes of the states (NaN for experiments that fail). An experiment that
    has converged is not changed any more.

    The Jacobian is that of the linearization, $\Phi^P$, as accurate as the response is linear.
    """

    def unfinished(carry):
        _, change, k = carry
        return (k < MOST_STEPS) & jnp.any(change > predicted.accuracy)

    def step(carry):
        x, change, k = carry
        active = change > predicted.accuracy  # False where the change is NaN
        defect = (flow_batch(course, plan, x, u, settings).end.T - x) * predicted.moves
        move = defect + predicted.gain @ defect
        size = jnp.max(jnp.abs(move) / predicted.size, axis=0)
        return jnp.where(active, x + move, x), jnp.where(active, size, change), k + 1

    begin = start, jnp.full(start.shape[1], jnp.inf), 0
    start, change, _ = jax.lax.while_loop(unfinished, step, begin)
    return start.T, change
