"""Times of the events in experiments."""

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
    """Time since the start of the experiment, in the model's unit."""
    name: str
    """Name of the transition."""
    cycle: int
    section: int
    """Last section before the event, in this cycle of the experiment."""
    deviation: float
    """Delay relative to the event of the limit cycle; NaN if the cycle has another event there."""


@checked_methods
class EventTimes(eqx.Module):
    """Times of the events in S experiments, each in order of time.

    **Fields**, all on the host; rows are as long as the largest number E of events:

    - `time` (S, E): time since the limit cycle passes section 0 at the start of the experiment, in
      the model's unit; NaN beyond the last event.
    - `event` (S, E): indices into `names`, -1 beyond the last event.
    - `sample` (S, E): index i of the last sample before the event, counted from the start of the
      experiment; -1 beyond the last event.
    - `cycle_time` (C,), `cycle_event` (C,): times and indices of the events in one period of the
      limit cycle, from section 0 on.
    - `period`: period of the limit cycle. `n_sections`: N. `names`: names of the transitions.
    """

    time: Float[np.ndarray, "S E"]
    event: Int[np.ndarray, "S E"]
    sample: Int[np.ndarray, "S E"]
    cycle_time: Float[np.ndarray, " C"]
    cycle_event: Int[np.ndarray, " C"]
    period: Float[np.ndarray, ""]
    n_sections: int = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)

    def __repr__(self) -> str:
        counts = ((int(np.sum(self.event == k)), name) for k, name in enumerate(self.names))
        text = ", ".join(f"{count} {name}" for count, name in counts if count) or "no events"
        return f"EventTimes({len(self.time)} experiments: {text})"

    @property
    def count(self) -> Int[np.ndarray, " S"]:
        """The number of events of each experiment."""
        return np.sum(self.event >= 0, axis=1)

    @property
    def deviations(self) -> Float[np.ndarray, "S E"]:
        """Delays relative to the events of the limit cycle, event by event from section 0 on; NaN
        where the cycle has another event, and beyond the last event."""
        E, C = self.time.shape[1], len(self.cycle_time)
        if C == 0:
            return np.full(self.time.shape, np.nan)
        cycle, place = np.divmod(np.arange(E), C)
        expected = self.cycle_time[place] + cycle * self.period
        return np.where(self.event == self.cycle_event[place], self.time - expected, np.nan)

    def of(self, experiment: Index) -> list[ExperimentEvent]:
        """Return the events of one experiment, in order.

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
    """Return the events between sections as one list per experiment, without gaps."""
    time, event, count = (np.asarray(x) for x in log)
    S, n, K = time.shape
    sample = np.broadcast_to(np.arange(n)[:, None], (n, K))
    time = time.astype(float) + (sample // n_sections) * period
    valid = (np.arange(K) < count[..., None]).reshape(S, n * K)
    first = np.argsort(~valid, axis=1, kind="stable")[:, : valid.sum(axis=1).max(initial=0)]
    kept = np.take_along_axis(valid, first, axis=1)

    def in_rows(x, fill):
        x = np.broadcast_to(x, (S, n, K)).reshape(S, n * K)
        return np.where(kept, np.take_along_axis(x, first, axis=1), fill)

    return EventList(in_rows(time, np.nan), in_rows(event, -1).astype(int), in_rows(sample, -1))
