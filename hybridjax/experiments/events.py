"""When the events of experiments happened."""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from .._core.boundary.checked import checked_methods
from .._core.boundary.kinds import Index
from ..errors import DefinitionError
from .flow_batch import IntervalEvents


class ExperimentEvent(NamedTuple):
    """One event of one experiment."""

    time: float
    """From the experiment's beginning, in the model's unit."""
    name: str
    """Of the transition."""
    cycle: int
    section: int
    """The last section before the event, in this cycle of the experiment."""
    deviation: float
    """How much later it is than on the limit cycle, or NaN for one that is not the cycle's."""


@checked_methods
class EventTimes(eqx.Module):
    """When the events of S experiments happened, each in order of time.

    **Fields**, all on the host; rows are as long as the largest number E of events:

    - `time` (S, E): from the experiments' beginning, the moment at which the limit cycle passes
      section 0, in the model's unit of time; NaN beyond the last event.
    - `event` (S, E): indices into `names`, -1 beyond the last event.
    - `sample` (S, E): the event lies between samples i and i + 1, sections i and i + 1 counted
      from the beginning; -1 beyond the last event.
    - `cycle_time` (C,), `cycle_event` (C,): the same of one period of the limit cycle itself, from
      section 0 on.
    - `period`: of the limit cycle. `n_sections`: N. `names`: of the system's transitions.
    """

    time: Float[np.ndarray, "S E"]
    event: Int[np.ndarray, "S E"]
    sample: Int[np.ndarray, "S E"]
    cycle_time: Float[np.ndarray, " C"]
    cycle_event: Int[np.ndarray, " C"]
    period: Float[np.ndarray, ""]
    n_sections: int = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)

    @property
    def count(self) -> Int[np.ndarray, " S"]:
        """The number of events of each experiment."""
        return np.sum(self.event >= 0, axis=1)

    @property
    def deviations(self) -> Float[np.ndarray, "S E"]:
        """How much later events are than on the limit cycle, event by event from section 0 on; NaN
        where another event happened than on the cycle, and beyond the last event."""
        E, C = self.time.shape[1], len(self.cycle_time)
        if C == 0:
            return np.full(self.time.shape, np.nan)
        turn, place = np.divmod(np.arange(E), C)
        expected = self.cycle_time[place] + turn * self.period
        return np.where(self.event == self.cycle_event[place], self.time - expected, np.nan)

    def of(self, experiment: Index) -> list[ExperimentEvent]:
        """The events of one experiment, in order.

        **Raises:** `DefinitionError` for an experiment that does not exist.
        """
        if experiment >= len(self.time):
            raise DefinitionError(
                f"there is no experiment {experiment}; there are {len(self.time)}."
            )
        late = self.deviations[experiment]
        return [
            ExperimentEvent(
                float(self.time[experiment, e]),
                self.names[self.event[experiment, e]],
                *divmod(int(self.sample[experiment, e]), self.n_sections),
                float(late[e]),
            )
            for e in range(int(self.count[experiment]))
        ]


class EventList(NamedTuple):
    """Events of S experiments, in order; see `EventTimes`."""

    time: Float[np.ndarray, "S E"]
    event: Int[np.ndarray, "S E"]
    sample: Int[np.ndarray, "S E"]


def in_order(log: IntervalEvents, n_sections: int, period: float) -> EventList:
    """Events one after the other from those between sections, without gaps."""
    time, event, count = (np.asarray(x) for x in log)
    S, n, K = time.shape
    sample = np.broadcast_to(np.arange(n)[:, None], (n, K))
    time = time.astype(float) + (sample // n_sections) * period
    here = (np.arange(K) < count[..., None]).reshape(S, n * K)
    first = np.argsort(~here, axis=1, kind="stable")[:, : here.sum(axis=1).max(initial=0)]
    kept = np.take_along_axis(here, first, axis=1)

    def listed(x, beyond):
        x = np.broadcast_to(x, (S, n, K)).reshape(S, n * K)
        return np.where(kept, np.take_along_axis(x, first, axis=1), beyond)

    return EventList(listed(time, np.nan), listed(event, -1).astype(int), listed(sample, -1))
