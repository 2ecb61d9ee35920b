"""Mishaps of whole trials and columns: what people do with cables, files and settings."""

import equinox as eqx
import numpy as np

from ...recordings.recording import Recording, Trial
from .change import Column, Names, in_signals, in_trials, kept, period_of, with_samples


def other_setting(
    recording: Recording,
    names: Names,
    rng: np.random.Generator,
    of: str,
    gain: float = 1.0,
    offset: float = 0.0,
) -> Recording:
    """Another gain or zero of the "input", or of the first "output", in the second trial; `offset`
    in standard deviations."""
    which = names.input if of == "input" else names.outputs[0]
    return in_signals(recording, (which,), lambda trial, x: gain * x + offset * x.std(), only=(1,))


def slipping(
    recording: Recording, names: Names, rng: np.random.Generator, size: float
) -> Recording:
    """The first output's sensor slips in the middle of the second trial."""

    def slip(trial: Trial, x: Column) -> Column:
        return x + size * x.std() * (trial.time > trial.time.mean())

    return in_signals(recording, names.outputs[:1], slip, only=(1,))


def swapped_columns(recording: Recording, names: Names, rng: np.random.Generator) -> Recording:
    """The first two outputs change places in the second trial."""
    i, j = (recording.column(name) for name in names.outputs[:2])

    def swap(trial: Trial) -> Trial:
        values = np.array(trial.values)
        values[:, [i, j]] = values[:, [j, i]]
        return with_samples(trial, trial.time, values)

    return in_trials(recording, swap, only=(1,))


def doubled_column(recording: Recording, names: Names, rng: np.random.Generator) -> Recording:
    """The second output is a copy of the first."""
    i = recording.column(names.outputs[0])
    return in_signals(recording, names.outputs[1:2], lambda trial, x: trial.values[:, i])


def foreign_push(recording: Recording, names: Names, rng: np.random.Generator) -> Recording:
    """The push of the second trial is that of the third."""
    u = recording.trials[2].values[:, recording.column(names.input)]
    return in_signals(recording, (names.input,), lambda trial, x: np.resize(u, len(x)), only=(1,))


def unrelated_push(recording: Recording, names: Names, rng: np.random.Generator) -> Recording:
    """The push of no trial belongs to it: each is turned by half of its length."""
    return in_signals(recording, (names.input,), lambda trial, x: np.roll(x, len(x) // 2))


def late_switch(
    recording: Recording, names: Names, rng: np.random.Generator, cycles: float
) -> Recording:
    """The sensor of the push is switched on some cycles after the beginning of each trial."""

    def off(trial: Trial, x: Column) -> Column:
        since = (trial.time - trial.time[0]) / period_of(trial, names)
        return np.where(since < cycles, 0.0, x)

    return in_signals(recording, (names.input,), off)


def no_plug(recording: Recording, names: Names, rng: np.random.Generator) -> Recording:
    """The sensor of the push is not plugged in."""
    return in_signals(recording, (names.input,), lambda trial, x: 0 * x)


def thrice(recording: Recording, names: Names, rng: np.random.Generator) -> Recording:
    """The first trial is given three times."""
    first, *others = recording.trials
    copies = [Trial(first.time, first.values, first.events, f"{first.name} ({k})") for k in (2, 3)]
    return eqx.tree_at(lambda r: r.trials, recording, (first, *copies, *others))


def overlap(recording: Recording, names: Names, rng: np.random.Generator) -> Recording:
    """The last half of the first trial is given once more, as a trial of its own."""
    first = recording.trials[0]
    last = kept(first, slice(len(first.time) // 2, None))
    more = Trial(last.time, last.values, last.events, f"{first.name}, end")
    return eqx.tree_at(lambda r: r.trials, recording, (*recording.trials, more))
