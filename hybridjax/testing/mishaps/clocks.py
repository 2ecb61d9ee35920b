"""Mishaps of time: of stamps, of clocks that differ, and of events."""

import numpy as np
from jaxtyping import Bool

from ...recordings.recording import Recording, Trial
from .change import (
    Column,
    Names,
    in_signals,
    in_trials,
    kept,
    period_of,
    with_clock,
    with_samples,
)


def thinning(
    recording: Recording, names: Names, rng: np.random.Generator, share: float
) -> Recording:
    """A random share of the samples is not there."""
    return in_trials(recording, lambda trial: kept(trial, rng.random(len(trial.time)) > share))


def slow_sampling(
    recording: Recording, names: Names, rng: np.random.Generator, every: int
) -> Recording:
    """Few samples, with no filter that keeps high frequencies out."""
    return in_trials(recording, lambda trial: kept(trial, slice(0, None, every)))


def pause(recording: Recording, names: Names, rng: np.random.Generator, cycles: float) -> Recording:
    """Nothing is recorded for a while in the middle of each trial."""

    def interrupt(trial: Trial) -> Trial:
        def away(t: Column) -> Bool[np.ndarray, " n"]:
            return np.abs(t - trial.time.mean()) > cycles / 2 * period_of(trial, names)

        events = {k: t[away(t)] for k, t in trial.events.items()}
        rows = away(trial.time)
        return Trial(trial.time[rows], trial.values[rows], events, trial.name)

    return in_trials(recording, interrupt)


def slowing(
    recording: Recording, names: Names, rng: np.random.Generator, share: float
) -> Recording:
    """A clock that runs at another rate at the end of each trial than at its beginning."""

    def slower(trial: Trial) -> Trial:
        start, duration = trial.time[0], np.ptp(trial.time)
        return with_clock(trial, lambda t: t + share * (t - start) ** 2 / (2 * duration))

    return in_trials(recording, slower)


def other_unit(
    recording: Recording, names: Names, rng: np.random.Generator, factor: float
) -> Recording:
    """The times of the second trial are multiplied."""
    return in_trials(recording, lambda trial: with_clock(trial, lambda t: factor * t), only=(1,))


def jitter(recording: Recording, names: Names, rng: np.random.Generator, share: float) -> Recording:
    """Time stamps are off by up to a share of the time between samples."""

    def blur(trial: Trial) -> Trial:
        off = share * np.median(np.diff(trial.time)) * rng.uniform(-1, 1, len(trial.time))
        return Trial(trial.time + off, trial.values, trial.events, trial.name)

    return in_trials(recording, blur)


def clock_set(
    recording: Recording, names: Names, rng: np.random.Generator, cycles: float
) -> Recording:
    """The clock of the second trial is set forward (or back, if negative) in its middle."""

    def jump(trial: Trial) -> Trial:
        middle, ahead = trial.time.mean(), cycles * period_of(trial, names)
        return with_clock(trial, lambda t: t + ahead * (t > middle))

    jumping = in_trials(recording, jump, only=(1,))
    parts = [
        Recording(
            trial.time,
            dict(zip(recording.signals, trial.values.T, strict=True)),
            events=trial.events,
            name=trial.name,
        )
        for trial in jumping.trials
    ]
    return Recording.join(parts)  # which looks at the time stamps, as a file's would be


def late_push(
    recording: Recording,
    names: Names,
    rng: np.random.Generator,
    samples: int,
    only: tuple[int, ...] | None = None,
) -> Recording:
    """The push is recorded so many samples late (or early, if negative)."""
    k = recording.column(names.input)

    def shift(trial: Trial) -> Trial:
        n = len(trial.time) - abs(samples)
        first, from_ = max(samples, 0), max(-samples, 0)
        values = trial.values[first : first + n].copy()
        values[:, k] = trial.values[from_ : from_ + n, k]
        return with_samples(trial, trial.time[first : first + n], values)

    return in_trials(recording, shift, only)


def clock_of_push(
    recording: Recording, names: Names, rng: np.random.Generator, share: float
) -> Recording:
    """The push is recorded by another device, whose clock is fast by a share."""

    def warp(trial: Trial, x: Column) -> Column:
        start = trial.time[0]
        return np.interp(start + (trial.time - start) * (1 - share), trial.time, x)

    return in_signals(recording, (names.input,), warp)


def misjudged_events(
    recording: Recording,
    names: Names,
    rng: np.random.Generator,
    lost: float = 0.0,
    doubled: float = 0.0,
    off: float = 0.0,
) -> Recording:
    """Shares of the events vanish, or are followed by a false one; all are `off` by a standard
    deviation in cycles."""

    def misjudge(trial: Trial) -> Trial:
        at, period = trial.events[names.event], period_of(trial, names)
        order, n = rng.permutation(len(at)), round(lost * len(at))
        again = order[n : n + round(doubled * len(at))]
        at = np.concatenate([np.delete(at, order[:n]), at[again] + 0.05 * period])
        at = np.sort(at + off * period * rng.normal(size=len(at)))
        return Trial(trial.time, trial.values, trial.events | {names.event: at}, trial.name)

    return in_trials(recording, misjudge)


def other_event(
    recording: Recording, names: Names, rng: np.random.Generator, cycles: float
) -> Recording:
    """In the second trial another event, later in the cycle, bears the name."""

    def rename(trial: Trial) -> Trial:
        later = trial.events[names.event] + cycles * period_of(trial, names)
        return Trial(trial.time, trial.values, trial.events | {names.event: later}, trial.name)

    return in_trials(recording, rename, only=(1,))
