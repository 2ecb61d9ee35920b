"""Samples that were not measured (placeholders, frozen, clipped and wrapped signals, copies), and
trials that differ from the others in units, columns, clocks or cycles."""

from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import fft, stats

from ..._core.findings import Finding, listed
from ..findings import CLEAR, places
from ..phase import HARMONICS, Phase
from ..recording import Recording
from ..sampling import cycle_means
from ..smoothing import RANGES, Series


# Shortest failure of a sensor: in cycles, in samples, and (where plateaus belong to the rhythm) in
# plateaus. Longer: failures pass. Shorter: slow phases of the motion are left out.
_FROZEN_CYCLES = 0.25
_FROZEN_SAMPLES = 10
_FROZEN_PLATEAUS = 4
# Least fraction of samples on plateaus at an extreme that is clipping, and its ratio to those on
# other plateaus. Larger: clipping passes. Smaller: rounded or resting signals are reported.
_CLIPPED = 0.005
_MOSTLY = 5
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
_CORRELATED = 0.8
_PHASES = HARMONICS // 2
# Relative difference of periods of trials. Larger: other speeds pass. Smaller: jitter is reported.
_OTHER_PERIOD = 0.02
# Fewest cycles that have a usual duration. Larger: short trials are not judged. Smaller: chance is.
_STRETCH = 8
# Difference from the median duration of cycles that makes an odd one, in medians of differences and
# in periods. Larger: lost samples pass. Smaller: variable rhythms are reported.
_ODD = 12.0
_ALIKE_PERIODS = 0.05
# Drift: number of cosines over a trial, and the ratio of the mean power of the slowest quarter to
# that of the others. Larger: drift passes. A ratio below 14: a multiplier of 0.9 is reported.
_COSINES = 24
_RATIO = 20.0

Cycles = Float[np.ndarray, "k P"]
Samples = Float[np.ndarray, "n k"]
Rows = Bool[np.ndarray, " n"]


def placeholders(x: Series, period: float, is_input: bool) -> Rows:
    """Find numbers such as -9999, far from all other samples."""
    whole = np.unique(x[x == np.round(x)])
    marks = [value for value in whole if _is_placeholder(abs(float(value)))]
    marked = np.isin(x, marks)
    usual = x[np.isfinite(x) & ~marked]
    if not marked.any() or not len(usual) or not np.ptp(usual):
        return np.zeros(len(x), bool)
    distance = np.maximum(usual.min() - x, x - usual.max())
    return marked & (distance > RANGES * np.ptp(usual))


def _is_placeholder(size: float) -> bool:
    """Return whether programs write this number for "no value": 999, 8888, 32768, 1e20, ..."""
    largest_integers = {2.0**15, 2.0**15 - 1, 2.0**16 - 1, 2.0**31, 2.0**31 - 1}
    if size in largest_integers or size >= 1e15:
        return True
    digits = f"{size:.0f}"
    return len(digits) >= 3 and set(digits) in ({"9"}, {"8"})


def frozen(x: Series, period: float, is_input: bool) -> Rows:
    """Find a sensor that stays at one value for longer than its rhythm allows.

    `period`: rough duration of a cycle, in samples. Inputs may rest at zero, and inputs that rest
    in most cycles are held.
    """
    first, length = _runs(x)
    plateaus = length[length >= 3]
    limit = max(_FROZEN_CYCLES * period, _FROZEN_SAMPLES)
    # Plateaus in most cycles belong to the rhythm, as those of a foot on the ground.
    in_most_cycles = len(plateaus) > 0.5 * len(x) / period
    if in_most_cycles and is_input:
        return np.zeros(len(x), bool)
    if in_most_cycles:
        limit = max(limit, _FROZEN_PLATEAUS * float(np.median(plateaus)))
    failed = length > limit
    if is_input:
        failed &= x[first] != 0
    return np.repeat(failed, length)


def _runs(x: Series) -> tuple[Int[np.ndarray, " r"], Int[np.ndarray, " r"]]:
    """Return first samples and lengths of the runs of equal values; each NaN is its own run."""
    first = np.flatnonzero(np.concatenate([[True], x[1:] != x[:-1]]))
    return first, np.diff(np.append(first, len(x)))


def clipped(recording: Recording, name: str) -> Iterator[Finding]:
    """Find plateaus at the largest or least value, and nowhere else; one at 0 is no clipping."""
    for trial, x in recording.samples(name):
        first, length = _runs(x)
        plateau = length >= 3
        value = x[first[plateau]]
        length = length[plateau]
        if not len(value):
            continue
        extremes = [v for v in (np.nanmin(x), np.nanmax(x)) if v != 0]
        ends = [v for v in extremes if (value == v).sum() > 1]
        at_ends = np.isin(value, ends)
        count = length[at_ends].sum()
        elsewhere = length[~at_ends].sum()
        if count >= max(1, _CLIPPED * len(x), _MOSTLY * elsewhere):
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
        # Whole numbers, but for rounding.
        if np.nanmax(np.abs(count - np.round(count))) >= 1e-3:
            continue
        whole = 1 + round(float(np.nanmax(count)))
        # (Of many levels, the outermost are not met.)
        bits = round(np.log2(whole))
        jumps = np.diff(count) / 2.0**bits
        up_and_down = (jumps > 0.5).any() and (jumps < -0.5).any()
        if up_and_down and abs(whole / 2.0**bits - 1) < _ALL_LEVELS:
            yield Finding(
                "overflow",
                f"{name} jumps by its whole range in trial '{trial.name}': undo it (`numpy.unwrap` "
                f"with period={2**bits * step:.6g}).",
                "refused",
            )
            return


def silent_inputs(recording: Recording, names: Iterable[str]) -> Iterator[Finding]:
    """Find inputs that are constant in some trials only."""
    for name in names:
        silent = []
        for trial, x in recording.samples(name):
            x = x[np.isfinite(x)]
            if not len(x) or not np.ptp(x):
                silent.append(f"'{trial.name}'")
        if 0 < len(silent) < len(recording.trials):
            yield Finding(
                "a silent input",
                f"{name} does not change in trial {listed(silent)}: if it acted there and was not "
                "recorded, leave the trial out.",
            )


def doubled_signals(recording: Recording, names: Sequence[str]) -> Iterator[Finding]:
    """Find two columns with the same numbers."""
    for a, b in combinations(names, 2):
        pairs = zip(recording.samples(a), recording.samples(b), strict=True)
        for (trial, x), (_, y) in pairs:
            both = np.isfinite(x) & np.isfinite(y)
            if not both.any() or not np.ptp(x[both]):
                continue
            if (x == y)[both].mean() > _EQUAL:
                yield Finding(
                    "a signal twice",
                    f"{a} and {b} are the same numbers in trial '{trial.name}': leave one out.",
                    "refused",
                )
                break


def repeated_rows(
    recording: Recording,
    names: Sequence[str],
) -> tuple[list[Rows], list[Finding]]:
    """Return for each trial the samples that an earlier trial holds already.

    Windows of successive samples are compared first. If most of those that two trials share are at
    the same distance, both trials are compared sample by sample.
    """
    columns = [recording.column(name) for name in names]
    trials = recording.trials
    values = [trial.values[:, columns] for trial in trials]
    deviation = np.ma.masked_invalid(np.concatenate(values)).std(axis=0)
    tolerance = _SAME * deviation.filled(0.0)
    keys = [_keys(x / np.where(tolerance > 0, tolerance, 1.0)) for x in values]
    repeated = [np.zeros(len(x), bool) for x in values]
    findings = []
    for i, j in combinations(range(len(trials)), 2):
        shift = _shift(keys[i], keys[j])
        if shift is None:
            continue
        same = _same_rows(values[i], values[j], shift, tolerance)
        if (same & ~repeated[j]).any():
            repeated[j] |= same
            where = places([trials[j]], [same])
            findings.append(
                Finding(
                    "a trial twice",
                    f"{where}: these samples are in trial '{trials[i].name}' too, and count once.",
                    "left out",
                )
            )
    return repeated, findings


def _keys(values: Samples) -> Float[np.ndarray, " m"]:
    """Return a number for each window of successive rows of rounded values (exactly: integers)."""
    shape = (_WINDOW, values.shape[1])
    weights = np.random.default_rng(0).integers(1, 2**20, shape).astype(float)
    rows = np.round(values)
    last = max(len(values) - _WINDOW + 1, 0)
    return np.sum([rows[k : k + last] @ weights[k] for k in range(_WINDOW)], axis=0)


def _shift(x: Float[np.ndarray, " m"], y: Float[np.ndarray, " m"]) -> int | None:
    """Return the distance at which two trials share most of their common windows, if they do."""
    _, first, second = np.intersect1d(x, y, return_indices=True)
    if not len(first):
        return None
    shifts, counts = np.unique(first - second, return_counts=True)
    if counts.max() < max(_WINDOW, len(first) / 2):
        return None
    return int(shifts[np.argmax(counts)])


def _same_rows(
    x: Samples,
    y: Samples,
    shift: int,
    tolerance: Float[np.ndarray, " k"],
) -> Rows:
    """Return the rows of y that are in x, so many rows later; all, if nearly all are."""
    same = np.zeros(len(y), bool)
    first = max(0, shift)
    last = min(len(x), len(y) + shift)
    shared = slice(first - shift, last - shift)
    differs = np.abs(x[first:last] - y[shared]) > tolerance
    same[shared] = ~differs.any(axis=1)
    if same.mean() > _EQUAL:
        same[:] = True
    return same


def other_settings(
    recording: Recording,
    names: list[str],
    outputs: tuple[str, ...],
) -> Iterator[Finding]:
    """Find trials in which a signal has another unit or zero, or two outputs changed places."""
    if len(recording.trials) < 2:
        return
    levels = [[_levels(x) for _, x in recording.samples(name)] for name in names]
    low, middle, high = np.array(levels).transpose(2, 0, 1)
    width = high - low
    for s, trial in enumerate(recording.trials):
        peers = np.delete(middle, s, axis=1)
        usual = np.median(peers, axis=1)
        usual_width = np.median(np.delete(width, s, axis=1), axis=1)
        swapped = _swapped(middle[:, s], width[:, s], usual, usual_width)
        for i, j in combinations(range(len(names)), 2):
            if swapped[i, j] and {names[i], names[j]} <= set(outputs):
                yield Finding(
                    "swapped columns",
                    f"{names[i]} and {names[j]} have changed places in trial '{trial.name}': swap "
                    "its columns.",
                    "refused",
                )
                return
        for k, name in enumerate(names):
            if not (width[k, s] > 0 and usual_width[k] > 0):
                continue
            ratio = width[k, s] / usual_width[k]
            is_output = name in outputs
            scatter = np.abs(peers[k] - usual[k]).max()
            least = max(usual_width[k] / _OFF, _OFF * scatter)
            if _is_unit(ratio, is_output):
                yield Finding(
                    "another unit",
                    f"{name} varies {ratio:.3g} times as much in trial '{trial.name}': its unit?",
                    "refused" if is_output else "warned",
                )
            elif is_output and abs(middle[k, s] - usual[k]) > least:
                yield Finding(
                    "another zero",
                    f"the median of {name} lies at {middle[k, s]:.4g} in trial '{trial.name}', at "
                    f"{usual[k]:.4g} elsewhere.",
                )


def _swapped(
    middle: Float[np.ndarray, " k"],
    width: Float[np.ndarray, " k"],
    usual: Float[np.ndarray, " k"],
    usual_width: Float[np.ndarray, " k"],
) -> Bool[np.ndarray, "k k"]:
    """Return which pairs of signals are each where the other one usually is, and not where they
    usually are themselves."""
    narrower = np.minimum(width[:, None], usual_width)
    wider = np.maximum(width[:, None], usual_width)
    # alike[i, j]: signal i is where signal j usually is.
    alike = np.abs(middle[:, None] - usual) < narrower
    alike &= narrower * _ALIKE > wider
    at_home = np.diag(alike)
    return alike & alike.T & ~(at_home[:, None] | at_home)


def _is_unit(ratio: float, is_output: bool) -> bool:
    """Return whether a ratio is one of two units, up or down."""
    units = [1e3, 1e6]
    if is_output:  # pushes may be chosen to be ten times as strong
        units += [10, 180 / np.pi, 1e2]
    distance = np.abs(abs(np.log(ratio)) - np.log(units))
    return bool(distance.min() < np.log(_ALIKE))


def _levels(x: Float[np.ndarray, " n"]) -> Float[np.ndarray, "3"]:
    """Return the quantiles 10, 50 and 90 % of a signal; NaN if it has no sample."""
    x = x[np.isfinite(x)]
    return np.quantile(x, [0.1, 0.5, 0.9]) if len(x) else np.full(3, np.nan)


def clocks(recording: Recording) -> Iterator[Finding]:
    """Find a trial with another unit of time, and jumps of clocks that are regular otherwise."""
    jumps = []
    steps = [float(np.median(np.diff(t.time))) for t in recording.trials]
    for s, trial in enumerate(recording.trials):
        others = steps[:s] + steps[s + 1 :]
        ratio = steps[s] / float(np.median(others or steps))
        thousands = round(np.log(ratio) / np.log(1000.0))
        off = abs(np.log(ratio) - thousands * np.log(1000.0))
        if thousands and off < np.log(_ALIKE):
            yield Finding(
                "another unit of time",
                f"samples of trial '{trial.name}' are {ratio:.4g} times as far apart: its unit?",
                "refused",
            )
        step = np.diff(trial.time) / steps[s]
        is_regular = (np.abs(step - 1) < 0.01).mean() > 0.95
        if is_regular:
            jumps += [
                f"trial '{trial.name}', by {steps[s] * step[k]:.3g} at {trial.time[k]:.2f} s"
                for k in np.flatnonzero(step > 5)  # fewer: lost samples
            ]
    if jumps:
        yield Finding(
            "jump of the clock",
            f"{listed(jumps)}: if this was no pause, make a trial of each part.",
        )


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
        durations = (
            f"{odd.sum()} cycles of trial '{trial.name}' last {period[odd].mean():.4g}, all others "
            f"about {usual:.4g}"
        )
        if odd.mean() < 0.1:
            yield Finding(
                "odd cycles",
                f"{durations}: if samples were lost and times numbered anew, make a trial of each "
                "part.",
            )
        elif np.abs(period[odd] / usual - 2).max() < 2 * _ALIKE_PERIODS:
            missed.append(
                f"{durations}: if events were missed, in gaps or between levels, choose others."
            )
    for text in missed:
        everywhere = len(missed) == len(recording.trials)
        yield Finding("missed events", text, "refused" if everywhere else "warned")


def other_cycles(
    recording: Recording,
    phase: Phase,
    outputs: tuple[str, ...],
) -> Iterator[Finding]:
    """Find trials with another period, sign of an output, or start of the cycles."""
    names = [trial.name for trial in recording.trials]
    yield from _other_periods(phase, names)
    if not outputs:
        return
    mean = np.array([_average_cycles(recording, phase, name) for name in outputs])
    known = np.flatnonzero(np.isfinite(mean).all(axis=(0, 2)))
    if len(known) < 2:
        return
    for s in known:
        usual = np.median(mean[:, known[known != s]], axis=1)
        yield from _difference(mean[:, s], usual, names[s], outputs)


def _other_periods(phase: Phase, names: Sequence[str]) -> Iterator[Finding]:
    """Find trials with another period."""
    periods = np.array([np.median(x) if len(x) else np.nan for x in phase.periods])
    tolerance = max(_OTHER_PERIOD, CLEAR * phase.jitter)
    for s in np.flatnonzero(np.isfinite(periods)):
        others = np.delete(periods, s)
        others = others[np.isfinite(others)]
        if not len(others):
            return
        usual = np.median(others)
        if abs(periods[s] / usual - 1) > tolerance:
            yield Finding(
                "another period",
                f"cycles of trial '{names[s]}' last {periods[s]:.4g}, of the others {usual:.4g}.",
            )


def _average_cycles(recording: Recording, phase: Phase, name: str) -> Cycles:
    """Return the mean of a signal at each phase, without the mean of all, for each trial."""
    cycles = []
    trials = phase.by_trial(recording)
    for (_, x), (trial, parts) in zip(recording.samples(name), trials, strict=True):
        at = np.full(len(x), np.nan)
        for part in parts:
            at = np.fmax(at, part.at(trial.time))
        known = np.isfinite(at) & np.isfinite(x)
        means = stats.binned_statistic(
            at[known] % 1, x[known], bins=_PHASES, range=(0, 1)
        ).statistic
        cycles.append(means - means.mean())
    return np.array(cycles)


def _difference(
    mean: Cycles,
    usual: Cycles,
    name: str,
    outputs: Sequence[str],
) -> Iterator[Finding]:
    """Find the cause of a low correlation of the average cycles of a trial with those of others."""

    def correlations(x: Cycles) -> Float[np.ndarray, " k"]:
        size = np.sqrt((x**2).sum(axis=1) * (usual**2).sum(axis=1))
        return (x * usual).sum(axis=1) / np.maximum(size, np.finfo(float).tiny)

    alike = correlations(mean)
    unlike = np.flatnonzero(alike <= _CORRELATED)
    if not len(unlike):
        return
    if len(unlike) == 1 and alike[unlike[0]] < -_CORRELATED:
        yield Finding(
            "another sign",
            f"{outputs[unlike[0]]} has the other sign in trial '{name}': turn it.",
            "refused",
        )
        return
    shifted = [correlations(np.roll(mean, m, axis=1)).min() for m in range(_PHASES)]
    best = int(np.argmax(shifted))
    if best and shifted[best] > _CORRELATED:
        away = min(best, _PHASES - best) / _PHASES
        yield Finding(
            "another event",
            f"cycles of trial '{name}' begin {away:.2g} of a cycle away from the others.",
            "refused",
        )
        return
    which = ", ".join(outputs[k] for k in unlike)
    yield Finding(
        "another cycle",
        f"the average cycle of {which} in trial '{name}' is not that of the others.",
    )


def slow_changes(
    recording: Recording,
    phase: Phase,
    outputs: tuple[str, ...],
    removed: float,
) -> Iterator[Finding]:
    """Find means over cycles that change much more slowly than they scatter, where changes slower
    than some cycles have been `removed`."""
    for name in outputs:
        power = np.zeros(_COSINES)
        trials = phase.by_trial(recording)
        for (_, x), (trial, parts) in zip(recording.samples(name), trials, strict=True):
            for part in parts:
                _, level = cycle_means(trial, x, [part], phase.period)
                if len(level) >= 2 * _COSINES:
                    waves = np.asarray(fft.dct(level, norm="ortho"))
                    power += waves[1 : _COSINES + 1] ** 2
        slow = power[: _COSINES // 4].mean()
        fast = power[_COSINES // 4 :].mean()
        if slow > _RATIO * fast:
            drift = min(50.0, removed / 2)
            yield Finding(
                "drift",
                f"{name} drifts or slips: if that is the sensor, `drift={drift:g}` takes it out.",
            )
