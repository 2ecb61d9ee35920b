"""Mishaps of single samples: what sensors, amplifiers and converters do."""

import numpy as np
from scipy import signal

from ...recordings.recording import Recording, Trial
from .change import Column, Names, in_signals, period_of


def noise(recording: Recording, names: Names, rng: np.random.Generator, size: float) -> Recording:
    """White noise."""
    return in_signals(
        recording, names.outputs, lambda trial, x: x + size * x.std() * rng.normal(size=len(x))
    )


def wander(recording: Recording, names: Names, rng: np.random.Generator, size: float) -> Recording:
    """The zero of each sensor walks about at random."""

    def walk(trial: Trial, x: Column) -> Column:
        return x + size * x.std() * np.cumsum(rng.normal(size=len(x))) / np.sqrt(len(x))

    return in_signals(recording, names.outputs, walk)


def drift(recording: Recording, names: Names, rng: np.random.Generator, size: float) -> Recording:
    """A slow sine, one turn over each trial."""

    def add(trial: Trial, x: Column) -> Column:
        share = (trial.time - trial.time[0]) / np.ptp(trial.time)
        return x + size * x.std() * np.sin(2 * np.pi * share)

    return in_signals(recording, names.outputs, add)


def rounding(recording: Recording, names: Names, rng: np.random.Generator, bits: int) -> Recording:
    """A converter of so many bits over the range of each signal."""

    def convert(trial: Trial, x: Column) -> Column:
        step = np.ptp(x) / 2**bits
        return np.round(x / step) * step

    return in_signals(recording, (names.input, *names.outputs), convert)


def loss(recording: Recording, names: Names, rng: np.random.Generator, share: float) -> Recording:
    """Single samples are missing."""
    return in_signals(
        recording,
        names.outputs,
        lambda trial, x: np.where(rng.random(len(x)) < share, np.nan, x),
    )


def gap(
    recording: Recording, names: Names, rng: np.random.Generator, of: str, cycles: float
) -> Recording:
    """Nothing is known of the "input" or the "outputs" in the middle of each trial."""

    def cut(trial: Trial, x: Column) -> Column:
        away = np.abs(trial.time - trial.time.mean()) / period_of(trial, names)
        return np.where(away < cycles / 2, np.nan, x)

    return in_signals(recording, (names.input,) if of == "input" else names.outputs, cut)


def hidden_events(
    recording: Recording, names: Names, rng: np.random.Generator, number: int, cycles: float
) -> Recording:
    """The outputs have gaps of this length around some events of each trial."""
    middles = {
        trial.name: rng.choice(trial.events[names.event], number, replace=False)
        for trial in recording.trials
    }

    def hide(trial: Trial, x: Column) -> Column:
        away = np.abs(trial.time[:, None] - middles[trial.name]).min(axis=1)
        return np.where(away < cycles / 2 * period_of(trial, names), np.nan, x)

    return in_signals(recording, names.outputs, hide)


def spikes(
    recording: Recording,
    names: Names,
    rng: np.random.Generator,
    of: str,
    share: float,
    size: float,
) -> Recording:
    """Single samples of the "input" or the "outputs" are far off, to either side."""

    def hit(trial: Trial, x: Column) -> Column:
        where = rng.random(len(x)) < share
        return x + where * size * x.std() * rng.choice([-1.0, 1.0], len(x))

    return in_signals(recording, (names.input,) if of == "input" else names.outputs, hit)


def placeholder(
    recording: Recording,
    names: Names,
    rng: np.random.Generator,
    value: float,
    number: int,
    cycles: float,
) -> Recording:
    """In some stretches of each trial the first output is a number that means "no value"."""

    def fail(trial: Trial, x: Column) -> Column:
        since = trial.time[:, None] - rng.uniform(trial.time[0], trial.time[-1], number)
        failed = (since > 0) & (since < cycles * period_of(trial, names))
        return np.where(failed.any(axis=1), value, x)

    return in_signals(recording, names.outputs[:1], fail)


def clipping(
    recording: Recording,
    names: Names,
    rng: np.random.Generator,
    of: str,
    low: float,
    high: float,
) -> Recording:
    """What lies beyond these quantiles of the "input", or of the first "output", is cut off."""
    return in_signals(
        recording,
        (names.input,) if of == "input" else names.outputs[:1],
        lambda trial, x: np.clip(x, *np.quantile(x, [low, high])),
    )


def freezing(
    recording: Recording,
    names: Names,
    rng: np.random.Generator,
    of: str,
    share: float,
) -> Recording:
    """In the second trial the "input", or the last of the "outputs", stays what it is for a share
    of the time."""

    def freeze(trial: Trial, x: Column) -> Column:
        first = int((1 - share) / 2 * len(x))
        last = first + round(share * len(x))
        return np.concatenate([x[:first], np.full(last - first, x[first]), x[last:]])

    which = names.input if of == "input" else names.outputs[-1]
    return in_signals(recording, (which,), freeze, only=(1,))


def overflow(
    recording: Recording, names: Names, rng: np.random.Generator, bits: int, share: float
) -> Recording:
    """Integers that hold only a share of the range begin anew at its other end."""

    def wrap(trial: Trial, x: Column) -> Column:
        step = share * np.ptp(x) / 2**bits
        return np.round((x - x.min()) / step) % 2**bits * step + x.min()

    return in_signals(recording, names.outputs[:1], wrap)


def hum(
    recording: Recording,
    names: Names,
    rng: np.random.Generator,
    frequency: float,
    size: float,
) -> Recording:
    """A sine of the mains in all signals; `frequency` in cycles per period."""

    def add(trial: Trial, x: Column) -> Column:
        turns = frequency * trial.time / period_of(trial, names)
        return x + size * x.std() * np.sin(2 * np.pi * turns)

    return in_signals(recording, (names.input, *names.outputs), add)


def crosstalk(
    recording: Recording, names: Names, rng: np.random.Generator, size: float
) -> Recording:
    """A part of the push is seen by the sensors of the outputs."""
    k = recording.column(names.input)

    def leak(trial: Trial, x: Column) -> Column:
        u = trial.values[:, k]
        return x + size * x.std() / u.std() * u

    return in_signals(recording, names.outputs, leak)


def low_pass(
    recording: Recording, names: Names, rng: np.random.Generator, edge: float
) -> Recording:
    """Sensors that follow slowly: Butterworth's filter of order 2, `edge` in cycles per period."""

    def follow(trial: Trial, x: Column) -> Column:
        rate = 1 / np.median(np.diff(trial.time))
        sos = signal.butter(2, edge / period_of(trial, names), fs=rate, output="sos")
        return signal.sosfilt(sos, x - x[0]) + x[0]

    return in_signals(recording, names.outputs, follow)


def saturation(
    recording: Recording, names: Names, rng: np.random.Generator, size: float
) -> Recording:
    """The gain of the first output's sensor falls: x becomes tanh(size x) / size."""

    def bend(trial: Trial, x: Column) -> Column:
        scale = x.std() / size
        return x.mean() + scale * np.tanh((x - x.mean()) / scale)

    return in_signals(recording, names.outputs[:1], bend)
