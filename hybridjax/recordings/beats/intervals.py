"""Intervals from event to event, and the input during each of them."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ...errors import DefinitionError
from ..phase.winding import Phase
from ..recording import Recording
from ..smoothing import bridgeable, gaps, inside


# Steps in a median interval of its trial. Doubled: a 16th of the error of integration, in twice
# the time.
_STEPS = 32
# How far, in longest intervals of the trial, the input is looked at. Doubled: slower models are
# followed to their end, with twice the memory.
_REACH = 1.5
# Intervals that are computed together. Doubled: nothing changes but memory.
_CHUNK = 4096
# Intervals of a trial, at least. Doubled: shorter trials are left out.
_FEWEST = 3


class Intervals(NamedTuple):
    """All intervals of a recording between events that nothing interrupts, trial by trial."""

    start: Float[np.ndarray, " L"]
    """When each begins, in s."""
    duration: Float[np.ndarray, " L"]
    trial: Int[np.ndarray, " L"]
    """Counted over the trials that have intervals."""
    names: tuple[str, ...]
    """Of these trials."""
    step: Float[np.ndarray, " L"]
    """Of integration, in s."""
    inputs: list[Float[np.ndarray, "nodes chunk"]]
    """At the half steps since the start of each interval, for `_CHUNK` intervals at a time."""

    @property
    def trials(self) -> int:
        return len(self.names)

    def chunks(self) -> Iterator[tuple[slice, Float[np.ndarray, "nodes chunk"]]]:
        """Places of intervals, and their inputs."""
        for k, values in enumerate(self.inputs):
            yield slice(k * _CHUNK, k * _CHUNK + values.shape[1]), values

    def sums(self, values: Float[np.ndarray, " L"]) -> Float[np.ndarray, " trials"]:
        """Sums over each trial."""
        return np.bincount(self.trial, values, self.trials)

    @property
    def deviations(self) -> Float[np.ndarray, " L"]:
        """Of durations from the mean of their trial."""
        return (
            self.duration
            - (self.sums(self.duration) / self.sums(np.ones(len(self.trial))))[self.trial]
        )

    def blocks(self, length: int) -> Int[np.ndarray, " L"]:
        """The number of the block to which each belongs: successive intervals of one trial."""
        place = np.concatenate([np.arange(n) for n in np.bincount(self.trial)])
        counts = np.bincount(self.trial)[self.trial]
        own = np.minimum(place // length, np.maximum(counts // length, 1) - 1)
        both = self.trial * (own.max() + 1) + own
        return np.unique(both, return_inverse=True)[1]


def intervals_of(recording: Recording, phase: Phase, name: str) -> Intervals:
    """The intervals between events, with the input of that name, linear between its samples.

    **Raises:** `DefinitionError` for a phase that is not one of events, of other trials, an input
    that is missing or constant, events at which it was not recorded, and too few intervals.
    """
    if len(phase.stretches) != len(recording.trials):
        raise DefinitionError(
            f"the phase is of {len(phase.stretches)} trials, the recording has "
            f"{len(recording.trials)}."
        )
    if not all(w.linear for parts in phase.stretches for w in parts):
        raise DefinitionError(
            "`phase` must be one of events (`AtEvent`) or crossings: an angle has no intervals."
        )
    column, found, outside = recording.column(name), [], 0
    for trial, parts in zip(recording.trials, phase.stretches, strict=True):
        x = trial.values[:, column]
        seen = np.isfinite(x)
        if seen.sum() < 2:
            raise DefinitionError(f"trial '{trial.name}' has no samples of the input {name}.")
        start = np.concatenate([np.zeros(0), *(w.time[:-1] for w in parts)])
        duration = np.concatenate([np.zeros(0), *(np.diff(w.time) for w in parts)])
        holes = gaps(trial.time, seen, bridgeable(trial.time, seen))
        known = ~inside(holes, start + 1e-9 * duration, start + (1 - 1e-9) * duration)
        outside += int((~known).sum())
        if known.sum() >= _FEWEST:
            found.append((trial.name, trial.time[seen], x[seen], start[known], duration[known]))
    total = sum(len(f[3]) for f in found)
    if not found:
        lost = f"; {outside} lie where {name} was not recorded" if outside else ""
        raise DefinitionError(
            f"the recording holds too few intervals between events during which {name} is known: "
            f"a trial needs {_FEWEST} or more{lost}."
        )
    if not any(np.ptp(x) > 0 for _, _, x, _, _ in found):
        raise DefinitionError(f"the input {name} is constant in all trials.")
    names, inputs, steps = tuple(f[0] for f in found), [], []
    counts = [len(f[3]) for f in found]
    trial = np.repeat(np.arange(len(found)), counts)
    step = np.repeat([float(np.median(f[4])) / _STEPS for f in found], counts)
    steps = np.repeat([_REACH * f[4].max() for f in found], counts) / step
    start, duration = (np.concatenate([f[k] for f in found]) for k in (3, 4))
    for first in range(0, total, _CHUNK):
        rows = np.arange(first, min(first + _CHUNK, total))
        nodes = np.arange(2 * int(np.ceil(steps[rows].max())) + 1) / 2
        values = np.empty((len(nodes), len(rows)))
        for k in np.unique(trial[rows]):
            own = trial[rows] == k
            at = start[rows[own]] + nodes[:, None] * step[rows[own]]
            values[:, own] = np.interp(at, found[k][1], found[k][2])
        inputs.append(values)
    return Intervals(start, duration, trial, names, step, inputs)
