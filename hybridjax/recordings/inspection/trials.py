"""Trials that differ from the others in units, columns, clocks or cycles; slow drift."""

from collections.abc import Iterator
from itertools import combinations

import numpy as np
from jaxtyping import Float

from ..findings import Finding, listed
from ..phase import Phase, Winding
from ..recording import Recording, Trial
from ..sampling import cycle_means


# Factor within which ranges of two signals are alike, and a ratio is a power of ten. Larger: other
# gains are taken for units. Smaller: swapped columns of signals whose range varies pass.
_ALIKE = 1.2
# Least offset of another zero: in ranges, and in those of the other trials. Larger: offsets pass.
# Smaller: scatter between trials is reported.
_OFFSET, _OFF = 0.1, 10.0
# Least correlation of average cycles that are alike. Larger: noisy cycles differ. Smaller: other
# events and swapped signals pass.
_CORRELATED = 0.8
_PHASES = 16
# Relative difference of periods of trials, and its ratio to the jitter. Larger: other speeds pass.
# Smaller: jitter is reported.
_OTHER_PERIOD, _SCATTERS = 0.02, 5.0
# Drift: ratio of the mean power of the first 6 cosines over a trial to that of the next 18. Larger:
# drift passes. Smaller than 14: a multiplier of 0.9 is reported.
_SLOW, _FASTER, _RATIO = 6, 24, 20.0


def other_settings(
    recording: Recording, names: list[str], outputs: tuple[str, ...]
) -> Iterator[Finding]:
    """Find trials in which a signal has another unit or zero, or two outputs changed places."""
    trials = recording.trials
    if len(trials) < 2:
        return
    columns = [recording.column(name) for name in names]
    levels = np.array([[_levels(t.values[:, k]) for k in columns] for t in trials])
    middle, width = levels[..., 1], levels[..., 2] - levels[..., 0]
    of_outputs = [k for k, name in enumerate(names) if name in outputs]
    for s, trial in enumerate(trials):
        peers = np.arange(len(trials)) != s
        usual, range_ = np.median(middle[peers], axis=0), np.median(width[peers], axis=0)

        # alike[i, j]: signal i is where signal j usually is.
        widths = np.broadcast_arrays(width[s][:, None], range_)
        alike = np.abs(middle[s][:, None] - usual) < np.minimum(*widths)
        alike &= np.minimum(*widths) * _ALIKE > np.maximum(*widths)
        swapped = [
            (names[i], names[j])
            for i, j in combinations(of_outputs, 2)
            if alike[i, j] and alike[j, i] and not (alike[i, i] or alike[j, j])
        ]
        if swapped:
            a, b = swapped[0]
            text = f"{a} and {b} have changed places in trial '{trial.name}': swap its columns."
            yield Finding("swapped columns", text, "refused")
            continue
        for k, name in enumerate(names):
            if not (width[s, k] > 0 and range_[k] > 0):
                continue
            ratio = width[s, k] / range_[k]
            power = round(np.log10(ratio))
            unit = 10.0**power
            # Pushes may be chosen to be ten times as strong.
            units = (1, 2, 3, 6) if name in outputs else (3, 6)
            if abs(power) in units and max(ratio / unit, unit / ratio) < _ALIKE:
                text = f"{name} varies {ratio:.3g} times as much in trial '{trial.name}': its unit?"
                yield Finding("another unit", text, "refused" if name in outputs else "warned")
                continue
            off = abs(middle[s, k] - usual[k])
            scatter = np.abs(middle[peers, k] - usual[k]).max()
            if name in outputs and off > max(_OFFSET * range_[k], _OFF * scatter):
                place = f"{middle[s, k]:.4g} in trial '{trial.name}', at {usual[k]:.4g} elsewhere"
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
        peers = steps[:s] + steps[s + 1 :]
        ratio = steps[s] / float(np.median(peers)) if peers else 1.0
        unit = 1000.0 ** np.round(np.log10(ratio) / 3)
        if unit != 1 and max(ratio / unit, unit / ratio) < _ALIKE:
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
    for s, trial in enumerate(recording.trials):
        peers = [p for k, p in enumerate(phase.periods) if k != s and len(p)]
        if not len(phase.periods[s]) or not peers:
            continue
        period, usual = np.median(phase.periods[s]), np.median([np.median(p) for p in peers])
        if abs(period / usual - 1) > max(_OTHER_PERIOD, _SCATTERS * phase.jitter):
            text = f"cycles of trial '{trial.name}' last {period:.4g}, of the others {usual:.4g}."
            yield Finding("another period", text)
    if not outputs:
        return
    columns = [recording.column(name) for name in outputs]
    pairs = phase.by_trial(recording)
    mean = np.array([[_average(t, k, parts) for k in columns] for t, parts in pairs])
    finite = np.flatnonzero(np.isfinite(mean).all(axis=(1, 2)))
    for s in finite.tolist() if len(finite) > 1 else ():
        usual = np.median(mean[finite[finite != s]], axis=0)
        yield from _difference(mean[s], usual, recording.trials[s].name, outputs)


def _average(trial: Trial, column: int, parts: tuple[Winding, ...]) -> Float[np.ndarray, " P"]:
    """Return the mean of a signal at each phase, without the mean of all."""
    x, at = trial.values[:, column], np.full(len(trial.time), np.nan)
    for part in parts:
        at = np.fmax(at, part.at(trial.time))
    finite = np.isfinite(at) & np.isfinite(x)
    bins = (np.mod(at[finite], 1) * _PHASES).astype(int) % _PHASES
    count = np.bincount(bins, minlength=_PHASES)
    with np.errstate(invalid="ignore"):
        mean = np.bincount(bins, x[finite], _PHASES) / count
    return mean - mean.mean()


def _difference(
    mean: Float[np.ndarray, "k P"],
    usual: Float[np.ndarray, "k P"],
    name: str,
    outputs: tuple[str, ...],
) -> Iterator[Finding]:
    def correlations(x):
        size = np.sqrt((x**2).sum(axis=1) * (usual**2).sum(axis=1))
        return (x * usual).sum(axis=1) / np.maximum(size, np.finfo(float).tiny)

    alike = correlations(mean)
    if (alike > _CORRELATED).all():
        return
    for k in np.flatnonzero(alike < -_CORRELATED):
        if (np.delete(alike, k) > _CORRELATED).all():
            text = f"{outputs[k]} has the other sign in trial '{name}': turn it."
            yield Finding("another sign", text, "refused")
            return
    shifted = [correlations(np.roll(mean, m, axis=1)).min() for m in range(_PHASES)]
    best = int(np.argmax(shifted))
    if best and shifted[best] > _CORRELATED:
        away = min(best, _PHASES - best) / _PHASES
        text = f"cycles of trial '{name}' begin {away:.2g} of a cycle away from the others."
        yield Finding("another event", text, "refused")
        return
    which = ", ".join(outputs[k] for k in np.flatnonzero(alike <= _CORRELATED))
    text = f"the average cycle of {which} in trial '{name}' is not that of the others."
    yield Finding("another cycle", text)


def slow_changes(recording: Recording, phase: Phase, outputs: tuple[str, ...]) -> Iterator[Finding]:
    """Find means over cycles that change much more slowly than they scatter."""
    for name in outputs:
        slow, faster = 0.0, 0.0
        for trial, parts in phase.by_trial(recording):
            for part in parts:
                x = trial.values[:, recording.column(name)]
                level = cycle_means(trial, x, [part], phase.period)[1]
                n, k = len(level), np.arange(1, _FASTER + 1)
                if n >= 2 * _FASTER:
                    c = np.cos(np.pi * k[:, None] * (np.arange(n) + 0.5) / n) @ level / np.sqrt(n)
                    slow += float((c[:_SLOW] ** 2).mean())
                    faster += float((c[_SLOW:] ** 2).mean())
        if slow > _RATIO * faster:
            text = f"{name} drifts or slips: if that is the sensor, `drift=50` takes it out."
            yield Finding("drift", text)
