"""Trials that differ from the others in units, columns, clocks or cycles; slow drift."""

from collections.abc import Iterator
from itertools import combinations

import numpy as np
from jaxtyping import Float
from scipy import fft

from ..findings import CLEAR, Finding, listed
from ..phase import Phase
from ..recording import Recording
from ..sampling import cycle_means


# Factor within which ranges of two signals are alike, and a ratio is a power of ten. Larger: other
# gains are taken for units. Smaller: swapped columns of signals whose range varies pass.
_ALIKE = 1.2
# Least offset of another zero in offsets of the other trials, which is also the least fraction of a
# range. Larger: offsets pass. Smaller: scatter between trials is reported.
_OFF = 10.0
# Least correlation of average cycles that are alike, each of so many values. Larger: noisy cycles
# differ. Smaller: other events and swapped signals pass.
_CORRELATED, _PHASES = 0.8, 16
# Relative difference of periods of trials. Larger: other speeds pass. Smaller: jitter is reported.
_OTHER_PERIOD = 0.02
# Drift: number of cosines over a trial, and the ratio of the mean power of the slowest quarter to
# that of the others. Larger: drift passes. A ratio below 14: a multiplier of 0.9 is reported.
_COSINES, _RATIO = 24, 20.0


def other_settings(
    recording: Recording, names: list[str], outputs: tuple[str, ...]
) -> Iterator[Finding]:
    """Find trials in which a signal has another unit or zero, or two outputs changed places."""
    levels = [[_levels(x) for _, x in recording.samples(name)] for name in names]
    low, middle, high = np.moveaxis(levels, 2, 0)
    width = high - low
    for s, trial in enumerate(recording.trials if len(recording.trials) > 1 else ()):
        peers = np.delete(middle, s, axis=1)
        usual, range_ = np.median(peers, axis=1), np.median(np.delete(width, s, axis=1), axis=1)
        # alike[i, j]: signal i is where signal j usually is.
        widths = np.broadcast_arrays(width[:, s, None], range_)
        alike = np.abs(middle[:, s, None] - usual) < np.minimum(*widths)
        alike &= np.minimum(*widths) * _ALIKE > np.maximum(*widths)
        of_outputs = [k for k, name in enumerate(names) if name in outputs]
        for i, j in combinations(of_outputs, 2):
            if alike[i, j] and alike[j, i] and not (alike[i, i] or alike[j, j]):
                pair = f"{names[i]} and {names[j]}"
                text = f"{pair} have changed places in trial '{trial.name}': swap its columns."
                yield Finding("swapped columns", text, "refused")
                return
        for k, name in enumerate(names):
            if not (width[k, s] > 0 and range_[k] > 0):
                continue
            ratio, is_output = width[k, s] / range_[k], name in outputs
            power = round(np.log10(ratio))
            off = abs(middle[k, s] - usual[k])
            # Pushes may be chosen to be ten times as strong.
            units = (1, 2, 3, 6) if is_output else (3, 6)
            if abs(power) in units and abs(np.log(ratio / 10.0**power)) < np.log(_ALIKE):
                text = f"{name} varies {ratio:.3g} times as much in trial '{trial.name}': its unit?"
                yield Finding("another unit", text, "refused" if is_output else "warned")
            elif is_output and off > max(
                range_[k] / _OFF, _OFF * np.abs(peers[k] - usual[k]).max()
            ):
                place = f"{middle[k, s]:.4g} in trial '{trial.name}', at {usual[k]:.4g} elsewhere"
                yield Finding("another zero", f"the median of {name} lies at {place}.")


def _levels(x: Float[np.ndarray, " n"]) -> Float[np.ndarray, "3"]:
    """Return the quantiles 10, 50 and 90 % of a signal; NaN if it has no sample."""
    x = x[np.isfinite(x)]
    return np.quantile(x, [0.1, 0.5, 0.9]) if len(x) else np.full(3, np.nan)


def clocks(recording: Recording) -> Iterator[Finding]:
    """Find a trial with another unit of time, and jumps of clocks that are regular otherwise."""
    jumps = []
    steps = [float(np.median(np.diff(t.time))) for t in recording.trials]
    for s, trial in enumerate(recording.trials):
        ratio = steps[s] / float(np.median(steps[:s] + steps[s + 1 :] or steps))
        thousands = np.log(ratio) / np.log(1000.0)
        if round(thousands) and abs(thousands - round(thousands)) < np.log(_ALIKE) / np.log(1000.0):
            text = f"samples of trial '{trial.name}' are {ratio:.4g} times as far apart: its unit?"
            yield Finding("another unit of time", text, "refused")
        step = np.diff(trial.time) / steps[s]
        if (np.abs(step - 1) < 0.01).mean() > 0.95:
            jumps += [
                f"trial '{trial.name}', by {steps[s] * step[k]:.3g} at {trial.time[k]:.2f} s"
                for k in np.flatnonzero(step > 5)  # fewer: lost samples
            ]
    if jumps:
        text = f"{listed(jumps)}: if this was no pause, make a trial of each part."
        yield Finding("jump of the clock", text)


def other_cycles(recording: Recording, phase: Phase, outputs: tuple[str, ...]) -> Iterator[Finding]:
    """Find trials with another period, sign of an output, or start of the cycles."""
    names = [t.name for t in recording.trials]
    periods = np.array([np.median(p) if len(p) else np.nan for p in phase.periods])
    for s in np.flatnonzero(np.isfinite(periods)):
        peers = np.delete(periods, s)
        usual = np.median(peers[np.isfinite(peers)]) if np.isfinite(peers).any() else periods[s]
        if abs(periods[s] / usual - 1) > max(_OTHER_PERIOD, CLEAR * phase.jitter):
            text = f"cycles of trial '{names[s]}' last {periods[s]:.4g}, of the others {usual:.4g}."
            yield Finding("another period", text)
    mean = np.array([_average_cycles(recording, phase, name) for name in outputs])
    finite = np.flatnonzero(np.isfinite(mean).all(axis=(0, 2))) if outputs else np.zeros(0, int)
    for s in finite if len(finite) > 1 else ():
        usual = np.median(mean[:, finite[finite != s]], axis=1)
        yield from _difference(mean[:, s], usual, names[s], outputs)


def _average_cycles(recording: Recording, phase: Phase, name: str) -> Float[np.ndarray, "S P"]:
    """Return the mean of a signal at each phase, without the mean of all, for each trial."""
    cycles = []
    for (_, x), (trial, parts) in zip(
        recording.samples(name), phase.by_trial(recording), strict=True
    ):
        at = np.full(len(x), np.nan)
        for part in parts:
            at = np.fmax(at, part.at(trial.time))
        finite = np.isfinite(at) & np.isfinite(x)
        bins = (np.mod(at[finite], 1) * _PHASES).astype(int) % _PHASES
        with np.errstate(invalid="ignore"):
            mean = np.bincount(bins, x[finite], _PHASES) / np.bincount(bins, minlength=_PHASES)
        cycles.append(mean - mean.mean())
    return np.array(cycles)


def _difference(
    mean: Float[np.ndarray, "k P"],
    usual: Float[np.ndarray, "k P"],
    name: str,
    outputs: tuple[str, ...],
) -> Iterator[Finding]:
    """Find the cause of a low correlation of the average cycles of a trial with those of others."""

    def correlations(x):
        size = np.sqrt((x**2).sum(axis=1) * (usual**2).sum(axis=1))
        return (x * usual).sum(axis=1) / np.maximum(size, np.finfo(float).tiny)

    alike = correlations(mean)
    unlike = np.flatnonzero(alike <= _CORRELATED)
    shifted = [correlations(np.roll(mean, m, axis=1)).min() for m in range(_PHASES)]
    best = int(np.argmax(shifted))
    if len(unlike) == 1 and alike[unlike[0]] < -_CORRELATED:
        text = f"{outputs[unlike[0]]} has the other sign in trial '{name}': turn it."
        yield Finding("another sign", text, "refused")
    elif len(unlike) and best and shifted[best] > _CORRELATED:
        away = min(best, _PHASES - best) / _PHASES
        text = f"cycles of trial '{name}' begin {away:.2g} of a cycle away from the others."
        yield Finding("another event", text, "refused")
    elif len(unlike):
        which = ", ".join(outputs[k] for k in unlike)
        text = f"the average cycle of {which} in trial '{name}' is not that of the others."
        yield Finding("another cycle", text)


def slow_changes(recording: Recording, phase: Phase, outputs: tuple[str, ...]) -> Iterator[Finding]:
    """Find means over cycles that change much more slowly than they scatter."""
    for name in outputs:
        power = np.zeros(_COSINES)
        for (_, x), (trial, parts) in zip(
            recording.samples(name), phase.by_trial(recording), strict=True
        ):
            for part in parts:
                level = cycle_means(trial, x, [part], phase.period)[1]
                if len(level) >= 2 * _COSINES:
                    power += np.asarray(fft.dct(level, norm="ortho"))[1 : _COSINES + 1] ** 2
        if power[: _COSINES // 4].mean() > _RATIO * power[_COSINES // 4 :].mean():
            text = f"{name} drifts or slips: if that is the sensor, `drift=50` takes it out."
            yield Finding("drift", text)
