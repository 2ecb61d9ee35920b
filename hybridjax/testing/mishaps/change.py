"""To change signals, or samples, of some trials of a recording."""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ...recordings.recording import Recording, Trial


Column = Float[np.ndarray, " n"]


class Names(NamedTuple):
    """Names in a recording: a push, two or more outputs, and an event of each cycle."""

    input: str
    outputs: tuple[str, ...]
    event: str


def in_trials(
    recording: Recording, change: Callable[[Trial], Trial], only: Iterable[int] | None = None
) -> Recording:
    """With some of the trials (by default all) changed."""
    chosen = range(len(recording.trials)) if only is None else only
    trials = tuple(change(t) if k in chosen else t for k, t in enumerate(recording.trials))
    return eqx.tree_at(lambda r: r.trials, recording, trials)


def in_signals(
    recording: Recording,
    names: Iterable[str],
    change: Callable[[Trial, Column], Column],
    only: Iterable[int] | None = None,
) -> Recording:
    """With x replaced by change(trial, x), for some signals and trials."""
    columns = [recording.column(name) for name in names]

    def changed(trial: Trial) -> Trial:
        values = np.array(trial.values)
        for k in columns:
            values[:, k] = change(trial, values[:, k])
        return with_samples(trial, trial.time, values)

    return in_trials(recording, changed, only)


def with_samples(trial: Trial, time: Column, values: Float[np.ndarray, "n k"]) -> Trial:
    """Other samples, with the events that lie between the first and the last of them."""
    events = {k: t[(t >= time[0]) & (t <= time[-1])] for k, t in trial.events.items()}
    return Trial(time, values, events, trial.name)


def kept(trial: Trial, rows: slice | Bool[np.ndarray, " n"]) -> Trial:
    """Some of the samples."""
    return with_samples(trial, trial.time[rows], trial.values[rows])


def with_clock(trial: Trial, clock: Callable[[Column], Column]) -> Trial:
    """Everything at times of another clock."""
    events = {k: clock(t) for k, t in trial.events.items()}
    return Trial(clock(trial.time), trial.values, events, trial.name)


def period_of(trial: Trial, names: Names) -> float:
    """The median time from event to event."""
    return float(np.median(np.diff(trial.events[names.event])))
