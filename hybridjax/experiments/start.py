"""Initial conditions of experiments: on the limit cycle, or in a periodic response.

`Campaign._starts` (`run.py`) calls `periodic_start` (the response that the linear model predicts)
or `steady_start` (the true periodic response, by Newton's method with the Jacobian of the linear
model). Both return times and states on section 0. Only the number of Newton steps depends on the
linear model: whether a start is periodic is decided by the `flow` of the experiments themselves,
and this must stay so.

`periodic_start` leaves a transient of second order in the inputs. If `steady_start` leaves one,
look at its last step and at `_LAST`; if it finds no start although inputs are small, at `gain`.
"""

from collections.abc import Callable
from typing import Literal

import numpy as np
from jaxtyping import Float

from .._core.executor import to_host
from .._core.memo import Memory
from ..linear.ldtp import LDTP
from ..linear.time_response import monodromy
from ..sections.linearization import linearize
from ..sections.placed import PlacedSections
from ..systems.system import Output
from .plan import Stepping


StartName = Literal["cycle", "periodic", "steady"]

# Largest number of Newton steps. Fewer: large inputs have no steady start. More: if there is no
# steady start, this is reported later.
MOST_STEPS = 12

# A Newton step below this part of the accuracy is not taken, so that experiments need not run
# again. Larger: starts leave a transient. Smaller: experiments run again for nothing.
_LAST = 1e-2

# A linear model has at least one output. This one is defined in every chart.
_NOTHING = Output("nothing", lambda t, q, u: 0.0)
_linearized = Memory()


def linearized(placed: PlacedSections) -> LDTP:
    """Return the linearization from which starts are predicted, computed once for placed sections.

    **Raises:** as `linearize`.
    """

    def make():
        return linearize(placed.cycle, placed, outputs=[_NOTHING])

    return _linearized.recall(placed, None, make)


def periodic_start(
    placed: PlacedSections, model: LDTP, window: Float[np.ndarray, "S n nu"]
) -> Float[np.ndarray, "m S"]:
    """Return times and states on section 0 in the periodic response that `model` predicts to inputs
    that repeat the `window`."""
    placed = to_host(placed)
    embed, *_ = placed.frames()
    embed = embed[0, :, : model.A.shape[1]]
    periods = window.shape[1] // placed.n_sections
    x0 = model.periodic_states(window, periods)
    return placed.section_zero[:, None] + embed @ np.asarray(x0).T


def steady_start(
    placed: PlacedSections,
    model: LDTP,
    stepping: Stepping,
    periods: int,
    start: Float[np.ndarray, "m S"],
    flow: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> tuple[Float[np.ndarray, "m S"], Float[np.ndarray, " S"], bool]:
    r"""Return starts from which the responses to a window of `periods` periods, repeated, are
    periodic. Also return the last Newton steps relative to the magnitudes of the states (NaN for
    experiments that fail), and whether the last call of `flow` ran all experiments from these
    starts.

    The Jacobian is that of the linearization, $\Phi^P$, as accurate as the response is linear.

    **Arguments:** `start`: the first guess. `flow(start, rows)`: times and states one window after
    the starts of the experiments `rows`.
    """
    embed, back = (x[0] for x in to_host(placed).frames())
    phi = monodromy(to_host(model.A))
    power = np.linalg.matrix_power(phi, periods)
    d = len(phi)
    scale = stepping.scales[0][:, None]
    # Newton's step is the defect plus `gain` times the defect.
    of_sections = np.linalg.solve(np.eye(d) - power, power)
    gain = embed[:, :d] @ of_sections @ back[:d]
    # Row 0 is the time. Where it is no state of the section, it stays.
    is_unknown = np.ones((len(gain), 1))
    is_unknown[0] = to_host(placed).time_is_state[0]
    change = np.full(start.shape[1], np.inf)
    start = start.copy()
    for _ in range(MOST_STEPS):
        rows = np.flatnonzero(change > stepping.accuracy)  # (not where it is NaN)
        if len(rows) == 0:
            break
        end = flow(start[:, rows], rows)
        defect = (end - start[:, rows]) * is_unknown
        step = defect + gain @ defect
        change[rows] = np.max(np.abs(step) / scale, axis=0)
        settled = (change <= _LAST * stepping.accuracy).all()
        if len(rows) == len(change) and settled:
            return start, change, True
        start[:, rows] += step
    return start, change, False
