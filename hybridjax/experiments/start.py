"""Where experiments start: on the limit cycle, or in a periodic response."""

import dataclasses
from collections.abc import Callable
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from .._core.execution import Execution
from .._core.executor import from_host, to_host
from .._core.memo import Memory
from .._core.progress import counted
from ..errors import ComputationError
from ..linear.ldtp import LDTP
from ..linear.time_response import monodromy
from ..sections.linearize import linearize
from ..sections.placed import PlacedSections
from ..systems.output import Output
from .batches import in_batches
from .flow_batch import Course
from .options import StartName
from .steady import Prediction
from .stepping.plan import Stepping


@dataclasses.dataclass(frozen=True)
class CycleStart:
    """All experiments start on the limit cycle."""

    name: ClassVar[StartName] = "cycle"
    placed: PlacedSections

    def states(self, u: Float[np.ndarray, "S n nu"], first: int) -> Float[np.ndarray, "m S"]:
        """Times and states on section 0 in which experiments begin.

        **Arguments:** their inputs, and the number of the first one of them in its set.
        """
        return np.repeat(_on_cycle(self.placed), len(u), axis=1)


@dataclasses.dataclass(frozen=True)
class PeriodicStart:
    """Experiments start in the periodic response that the linearization predicts.

    **Fields:** `model`, the linearization at `placed`; `periods` of the window that repeats.
    """

    name: ClassVar[StartName] = "periodic"
    placed: PlacedSections
    model: LDTP
    periods: int

    def states(self, u: Float[np.ndarray, "S n nu"], first: int) -> Float[np.ndarray, "m S"]:
        """As of `CycleStart`."""
        embed = to_host(self.placed).frames()[0][0, :, : self.model.A.shape[1]]
        x0 = self.model.periodic_states(self.window(u), self.periods)
        return _on_cycle(self.placed) + embed @ np.asarray(x0).T

    def window(self, u: Float[np.ndarray, "S n nu"]) -> Float[np.ndarray, "S window nu"]:
        """The inputs of one window."""
        return u[:, : self.periods * self.placed.n_sections]


@dataclasses.dataclass(frozen=True)
class SteadyStart:
    """Experiments start in the periodic response itself, found from the predicted one.

    **Fields:** `course`; `program`, `settle_batch` compiled; `stepping` and `execution`, how it is
    run.
    """

    name: ClassVar[StartName] = "steady"
    predicted: PeriodicStart
    course: Course
    stepping: Stepping
    execution: Execution
    program: Callable

    def states(self, u: Float[np.ndarray, "S n nu"], first: int) -> Float[np.ndarray, "m S"]:
        """As of `CycleStart`. Experiments that fail keep the predicted start.

        **Raises:** `ComputationError` if no periodic response is found near the predicted one.
        """
        stepping = self.stepping
        predicted, window = self.predicted.states(u, first), self.predicted.window(u)
        prediction = self._prediction()

        def arguments(some):
            start, u = from_host((predicted[:, some], window[some]))
            return self.course, stepping.plan, start, u, stepping.settings, prediction

        parts = in_batches(self.program, arguments, len(u), self.execution)
        batches = -(-len(u) // self.execution.batch) if self.execution.batch else None
        parts = [part for _, part in counted(parts, "batches of steady starts", batches)]
        start, change = (np.concatenate(x).astype(float) for x in zip(*parts, strict=True))
        if (change > stepping.accuracy).any():
            s = int(np.nanargmax(change))
            raise ComputationError(
                f"experiment {first + s}: no periodic response was found near the one that the "
                f"linearization predicts (Newton's last step is {change[s]:.1e} of the state's "
                "size): make the input smaller, or discard cycles instead."
            )
        return np.where(np.isnan(change), predicted, start.T)

    def _prediction(self) -> Prediction:
        placed, model = self.predicted.placed, self.predicted.model
        embed, back = (x[0] for x in to_host(placed).frames())
        phi = monodromy(to_host(model.A))
        power, d = np.linalg.matrix_power(phi, self.predicted.periods), len(phi)
        gain = embed[:, :d] @ np.linalg.solve(np.eye(d) - power, power) @ back[:d]
        moves = np.ones((len(gain), 1))
        moves[0] = to_host(placed).time_is_state[0]
        size = self.stepping.scales[0][:, None]
        return from_host(Prediction(gain, size, moves, np.array(self.stepping.accuracy)))


Start = CycleStart | PeriodicStart | SteadyStart


def predict_start(placed: PlacedSections, periods: int) -> PeriodicStart:
    """The periodic start for windows of so many periods; linearizes once for placed sections.

    **Raises:** as `linearize`.
    """
    model = _linearized.recall(
        placed, None, lambda: linearize(placed.cycle, placed, outputs=[_TIME])
    )
    return PeriodicStart(placed, model, periods)


_linearized = Memory()
# Starts need no outputs, but a linear model has one at least; this one is defined everywhere.
_TIME = Output("t", lambda t, q, u: t)


def _on_cycle(placed: PlacedSections) -> Float[np.ndarray, "m 1"]:
    """Time and state of the limit cycle on section 0."""
    lanes = placed.lanes
    return np.concatenate([np.asarray(lanes.t)[None], np.asarray(lanes.q)])[:, :1]
