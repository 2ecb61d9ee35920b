"""Samples that were not measured (placeholders, frozen, clipped and wrapped signals, copies), and
trials that differ from the others in units, columns, clocks or cycles."""

from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import fft

from ..._core.findings import Finding, listed
from ..findings import CLEAR, places
from ..phase import HARMONICS, Phase
from ..recording import Recording
from ..sampling import cycle_means
from ..smoothing import RANGES, Series


# Shortest failure of a sensor: in cycles, in samples, and (where plateaus belong to the rhythm) in
# plateaus. Longer: failures pass. Shorter: slow phases of the motion are left out.
_FROZEN = 0.25, 10, 4
# Least fraction of samples on plateaus at an extreme that is clipping, and its ratio to those on
# other plateaus. Larger: clipping passes. Smaller: rounded or resting signals are reported.
_CLIPPED, _MOSTLY = 0.005, 5
# Relative difference of the number of levels from a power of two that is an overflow. Larger:
# impacts of a signal in integers are refused. Smaller: overflows of fast signals pass.
_ALL_LEVELS = 0.01
# Fraction of equal samples that makes two signals, or two trials, copies. Larger: copies with a few
# edited samples pass. Smaller: signals that rest at zero together are copies.
_EQUAL = 0.99
# Difference of equal samples in standard deviations. Larger: similar cycles of a regular rhythm
# match. Smaller: copies written with fewer digits pass.
_SAME = 1e-3

# Samples in a window, and windows, that two copies share at least. More: short copies pass. Fewer:
# equal samples by chance are copies.
_WINDOW = 8
# Factor within which ranges of two signals are alike, and a ratio is a power of ten. Larger: other
# gains are taken for units. Smaller: swapped columns of signals whose range varies pass.
_ALIKE = 1.2
# Least offset of another zero in offsets of the other trials, which is also the least fraction of a
# range. Larger: offsets pass. Smaller: scatter between trials is reported.
_OFF = 10.0
# Least correlation of average cycles that are alike, each of so many values. Larger: noisy cycles
# differ. Smaller: other events and swapped signals pass.
_CORRELATED, _PHASES = 0.8, HARMONICS // 2
# Relative difference of periods of trials. Larger: other speeds pass. Smaller: jitter is reported.
_OTHER_PERIOD = 0.02
# Fewest cycles that have a usual duration. Larger: short trials are not judged. Smaller: chance is.
_STRETCH = 8
# Difference from the median duration of cycles that makes an odd one, in medians of differences and
# in periods. Larger: lost samples pass. Smaller: variable rhythms are reported.
_ODD, _ALIKE_PERIODS = 12.0, 0.05
# Drift: number of cosines over a trial, and the ratio of the mean power of the slowest quarter to
# that of the others. Larger: drift passes. A ratio below 14: a multiplier of 0.9 is reported.
_COSINES, _RATIO = 24, 20.0

Cycles = Float[np.ndarray, "k P"]
Rows = Bool[np.ndarray, " n"]


def placeholders(x: Series, period: float, is_input: bool) -> Rows:
    """Find numbers such as -9999, far from all other samples."""
    whole = np.unique(x[x == np.round(x)])
    marked = np.isin(
        x, [value for value in whole if _is_placeholder(abs(float(value)))]
    )
    usual = x[np.isfinite(x) & ~marked]
    if not marked.any() or not len(usual) or not np.ptp(usual):
        return np.zeros(len(x), bool)
    return marked & (
        np.maximum(usual.min() - x, x - usual.max()) > RANGES * np.ptp(usual)
    )


def _is_placeholder(size: float) -> bool:
    """Return whether programs write this number for "no value": 999, 8888, 32768, 1e20, ..."""
    digits = f"{size:.0f}"
    full = size in {2.0**15, 2.0**15 - 1, 2.0**16 - 1, 2.0**31, 2.0**31 - 1}
    return full or size >= 1e15 or (len(digits) >= 3 and set(digits) in ({"9"}, {"8"}))


def frozen(x: Series, period: float, is_input: bool) -> Rows:
    """Find a sensor that stays at one value for longer than its rhythm allows.

    `period`: rough duration of a cycle, in samples. Inputs may rest at zero, and inputs that rest
    in most cycles are held.
    """
    first, length = _runs(x)
    plateaus = length[length >= 3]
    limit = max(_FROZEN[0] * period, _FROZEN[1])
    if len(plateaus) > 0.5 * len(x) / period:  # as those of a foot on the ground
        limit = (
            np.inf if is_input else max(limit, _FROZEN[2] * float(np.median(plateaus)))
        )
    return np.repeat((length > limit) & ~(is_input & (x[first] == 0)), length)


def _runs(x: Series) -> tuple[Int[np.ndarray, " r"], Int[np.ndarray, " r"]]:
    """Return first samples and lengths of the runs of equal values; each NaN is its own run."""
    first = np.flatnonzero(np.concatenate([[True], x[1:] != x[:-1]]))
    return first, np.diff(np.append(first, len(x)))


def clipped(recording: Recording, name: str) -> Iterator[Finding]:
    """Find plateaus at the largest or least value, and nowhere else; one at 0 is no clipping."""
    for trial, x in recording.samples(name):
        first, length = _runs(x)
        value, length = x[first[length >= 3]], length[length >= 3]
        if not len(value):
            continue
        ends = [
            v for v in (np.nanmin(x), np.nanmax(x)) if v != 0 and (value == v).sum() > 1
        ]
        at_ends = np.isin(value, ends)
        count = length[at_ends].sum()
        if count >= max(1, _CLIPPED * len(x), _MOSTLY * length[~at_ends].sum()):
            levels = " and ".join(f"{v:.4g}" for v in ends)
            yield Finding(
                "clipped", f"{name} is cut off at {levels} in trial '{trial.name}'."
            )
            return


def wrapped(recording: Recording, name: str) -> Iterator[Finding]:
    """Find integers that overflow: jumps up and down by half of their levels, a power of two."""
    for trial, x in recording.samples(name):
        levels = np.unique(x[np.isfinite(x)])
        if len(levels) < 2:
            continue
        step = float(np.diff(levels).min())
        count = (x - levels[0]) / step
        whole = 1 + round(float(np.nanmax(count)))
        off = np.nanmax(np.abs(count - np.round(count)))
        bits = round(np.log2(whole))  # (of many levels, the outermost are not met)
        jumps = np.diff(count) / 2.0**bits
        both = min((jumps > 0.5).sum(), (jumps < -0.5).sum())
        if (
            off < 1e-3 and abs(whole / 2.0**bits - 1) < _ALL_LEVELS and both
        ):  # but for rounding
            remedy = f"undo it (`numpy.unwrap` with period={2**bits * step:.6g})"
            text = f"{name} jumps by its whole range in trial '{trial.name}': {remedy}."
            yield Finding("overflow", text, "refused")
            return


def silent_inputs(recording: Recording, names: Iterable[str]) -> Iterator[Finding]:
    """Find inputs that are constant in some trials only."""
    for name in names:
        samples = recording.samples(name)
        finite = [x[np.isfinite(x)] for _, x in samples]
        width: list[Any] = [np.ptp(x) if len(x) else 0.0 for x in finite]
        silent = [
            f"'{t.name}'" for (t, _), w in zip(samples, width, strict=True) if not w
        ]
        if silent and max(width):
            text = f"{name} does not change in trial {listed(silent)}: if it acted there and was "
            yield Finding("a silent input", f"{text}not recorded, leave the trial out.")


def doubled_signals(recording: Recording, names: Sequence[str]) -> Iterator[Finding]:
    """Find two columns with the same numbers."""
    for a, b in combinations(names, 2):
        for trial in recording.trials:
            x, y = (trial.values[:, recording.column(name)] for name in (a, b))
            both = np.isfinite(x) & np.isfinite(y)
            if both.any() and np.ptp(x[both]) > 0 and (x == y)[both].mean() > _EQUAL:
                text = f"{a} and {b} are the same numbers in trial '{trial.name}': leave one out."
                yield Finding("a signal twice", text, "refused")
                break


def repeated_rows(
    recording: Recording, names: Sequence[str]
) -> tuple[list[Rows], list[Finding]]:
    """Return for each trial the samples that an earlier trial holds already.

    Windows of successive samples are compared first. If most of those that two trials share are at
    the same distance, both trials are compared sample by sample.
    """
    columns, trials = [recording.column(name) for name in names], recording.trials
    values = [t.values[:, columns] for t in trials]
    size = _SAME * np.ma.masked_invalid(np.concatenate(values)).std(axis=0).filled(0.0)
    keys = [_keys(x / np.where(size > 0, size, 1.0)) for x in values]
    repeated, findings = [np.zeros(len(x), bool) for x in values], []
    for i, j in combinations(range(len(trials)), 2):
        x, y = values[i], values[j]
        _, first, second = np.intersect1d(keys[i], keys[j], return_indices=True)
        shifts, counts = np.unique(first - second, return_counts=True)
        if max(counts, default=0) < max(_WINDOW, len(first) / 2):
            continue
        shift = int(shifts[np.argmax(counts)])
        first, last = max(0, shift), min(len(x), len(y) + shift)
        same = np.zeros(len(y), bool)
        off = np.abs(x[first:last] - y[first - shift : last - shift])
        same[first - shift : last - shift] = (~(off > size)).all(axis=1)
        same |= same.mean() > _EQUAL
        if (same & ~repeated[j]).any():
            repeated[j] |= same
            text = f"{places([trials[j]], [same])}: these samples are in trial '{trials[i].name}'"
            findings.append(
                Finding("a trial twice", f"{text} too, and count once.", "left out")
            )
    return repeated, findings


def _keys(values: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " m"]:
    """Return a number for each window of successive rows of rounded values (exactly: integers)."""
    weights = (
        np.random.default_rng(0)
        .integers(1, 2**20, (_WINDOW, values.shape[1]))
        .astype(float)
    )
    rows, last = np.round(values), max(len(values) - _WINDOW + 1, 0)
    return np.sum([rows[k : k + last] @ weights[k] for k in range(_WINDOW)], axis=0)


def other_settings(
    recording: Recording, names: list[str], outputs: tuple[str, ...]
) -> Iterator[Finding]:
    """Find trials in which a signal has another unit or zero, or two outputs changed places."""
    levels = [[_levels(x) for _, x in recording.samples(name)] for name in names]
    low, middle, high = np.array(levels).transpose(2, 0, 1)
    width = high - low
    for s, trial in enumerate(recording.trials if len(recording.trials) > 1 else ()):
        peers = np.delete(middle, s, axis=1)
        usual, span = (
            np.median(peers, axis=1),
            np.median(np.delete(width, s, axis=1), axis=1),
        )
        # alike[i, j]: signal i is where signal j usually is.
        widths = np.broadcast_arrays(width[:, s, None], span)
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
            if not (width[k, s] > 0 and span[k] > 0):
                continue
            ratio, is_output = width[k, s] / span[k], name in outputs
            off = abs(middle[k, s] - usual[k])
            # Pushes may be chosen to be ten times as strong.
            units = np.log(
                (10, 180 / np.pi, 1e2, 1e3, 1e6) if is_output else (1e3, 1e6)
            )
            if np.abs(abs(np.log(ratio)) - units).min() < np.log(_ALIKE):
                text = f"{name} varies {ratio:.3g} times as much in trial '{trial.name}': its unit?"
                yield Finding(
                    "another unit", text, "refused" if is_output else "warned"
                )
            elif is_output and off > max(
                span[k] / _OFF, _OFF * np.abs(peers[k] - usual[k]).max()
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
        if round(thousands) and abs(thousands - round(thousands)) < np.log(
            _ALIKE
        ) / np.log(1000.0):
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


def odd_cycles(recording: Recording, phase: Phase) -> Iterator[Finding]:
    """Find single cycles of another duration, and many that are two periods long."""
    missed = []
    for trial, period in zip(recording.trials, phase.periods, strict=True):
        if len(period) < _STRETCH:
            continue
        usual = float(np.median(period))
        off = np.abs(period - usual)
        odd = off > max(_ODD * float(np.median(off)), _ALIKE_PERIODS * usual)
        if not odd.any():
            continue
        text = f"{odd.sum()} cycles of trial '{trial.name}' last {period[odd].mean():.4g}, all "
        text += f"others about {usual:.4g}: if "
        if odd.mean() < 0.1:
            text += (
                "samples were lost and times numbered anew, make a trial of each part."
            )
            yield Finding("odd cycles", text)
        elif np.abs(period[odd] / usual - 2).max() < 2 * _ALIKE_PERIODS:
            missed.append(
                f"{text}events were missed, in gaps or between levels, choose others."
            )
    for text in missed:
        everywhere = len(missed) == len(recording.trials)
        yield Finding("missed events", text, "refused" if everywhere else "warned")


def other_cycles(
    recording: Recording, phase: Phase, outputs: tuple[str, ...]
) -> Iterator[Finding]:
    """Find trials with another period, sign of an output, or start of the cycles."""
    names = [t.name for t in recording.trials]
    periods = np.array([np.median(p) if len(p) else np.nan for p in phase.periods])
    for s in np.flatnonzero(np.isfinite(periods)):
        peers = np.delete(periods, s)
        usual = (
            np.median(peers[np.isfinite(peers)])
            if np.isfinite(peers).any()
            else periods[s]
        )
        if abs(periods[s] / usual - 1) > max(_OTHER_PERIOD, CLEAR * phase.jitter):
            text = f"cycles of trial '{names[s]}' last {periods[s]:.4g}, of the others {usual:.4g}."
            yield Finding("another period", text)
    mean = np.array([_average_cycles(recording, phase, name) for name in outputs])
    finite = (
        np.flatnonzero(np.isfinite(mean).all(axis=(0, 2)))
        if outputs
        else np.zeros(0, int)
    )
    for s in finite if len(finite) > 1 else ():
        usual = np.median(mean[:, finite[finite != s]], axis=1)
        yield from _difference(mean[:, s], usual, names[s], list(outputs))


def _average_cycles(
    recording: Recording, phase: Phase, name: str
) -> Float[np.ndarray, "S P"]:
    """Return the mean of a signal at each phase, without the mean of all, for each trial."""
    cycles, trials = [], phase.by_trial(recording)
    for (_, x), (trial, parts) in zip(recording.samples(name), trials, strict=True):
        at = np.full(len(x), np.nan)
        for part in parts:
            at = np.fmax(at, part.at(trial.time))
        finite = np.isfinite(at) & np.isfinite(x)
        bins = (np.mod(at[finite], 1) * _PHASES).astype(int) % _PHASES
        with np.errstate(invalid="ignore"):
            mean = np.bincount(bins, x[finite], _PHASES) / np.bincount(
                bins, minlength=_PHASES
            )
        cycles.append(mean - mean.mean())
    return np.array(cycles)


def _difference(
    mean: Cycles, usual: Cycles, name: str, outputs: list[str]
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
        text = (
            f"the average cycle of {which} in trial '{name}' is not that of the others."
        )
        yield Finding("another cycle", text)


def slow_changes(
    recording: Recording, phase: Phase, outputs: tuple[str, ...], removed: float
) -> Iterator[Finding]:
    """Find means over cycles that change much more slowly than they scatter, where changes slower
    than some cycles have been `removed`."""
    for name in outputs:
        power, trials = np.zeros(_COSINES), phase.by_trial(recording)
        for (_, x), (trial, parts) in zip(recording.samples(name), trials, strict=True):
            for part in parts:
                level = cycle_means(trial, x, [part], phase.period)[1]
                if len(level) >= 2 * _COSINES:
                    power += (
                        np.asarray(fft.dct(level, norm="ortho"))[1 : _COSINES + 1] ** 2
                    )
        if power[: _COSINES // 4].mean() > _RATIO * power[_COSINES // 4 :].mean():
            text = f"{name} drifts or slips: if that is the sensor, "
            text += f"`drift={min(50.0, removed / 2):g}` takes it out."
            yield Finding("drift", text)
