"""Checks that compare trials (units, columns, clocks, cycles), and cycles within each trial.

`inspect.py` calls the functions without underscore; each yields findings, whose titles lead to the
function. Those that compare trials (`other_settings`, `clocks`, `other_cycles`) compare a number of
one trial (range, period, correlation of average cycles) with the median of the other trials. Those
that look into each trial are `coarse_stamps`, `odd_cycles`, `alternating_cycles` and
`slow_changes`. The constants are their limits: change these if a finding is missed or needless. If
a trial gets a wrong reason, look at the order of the reasons in `_difference`, which must stay: the
first that fits is reported.
"""

import itertools
from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float
from scipy import fft, stats

from ..._core.findings import Finding, listed
from ..data import SectionData, whole_cycles
from ..findings import CLEAR
from ..phase import HARMONICS, Phase
from ..recording import Recording
from ..sampling import cycle_means
from ..smoothing import Series


# Ranges of two signals are alike if their ratio is below this factor; a ratio is a power of ten if
# it differs from one by less than this factor. Larger: other gains are taken for units. Smaller:
# swapped columns of signals whose range varies pass.
_ALIKE = 1.2
# A trial has another zero if its offset exceeds this multiple of the offsets of other trials, and
# the usual range divided by this number. Larger: offsets pass if other trials scatter, and small
# ones are reported if they do not. Smaller: the reverse.
_OFF = 10.0
# Average cycles of two trials (tables of a number of values) are alike if their correlation exceeds
# this. Larger: noisy cycles are reported as different. Smaller: trials with other events or swapped
# signals pass.
_CORRELATED = 0.8
# Values of an average cycle. More: noisy cycles differ. Fewer: brief features are smeared.
_PHASES = HARMONICS // 2
# A trial has another period if the relative difference exceeds this. Larger: other speeds pass.
# Smaller: jitter is reported.
_OTHER_PERIOD = 0.02
# Least number of cycles for which a usual duration is defined. Larger: short trials are not tested.
# Smaller: chance is reported.
_STRETCH = 8
# A cycle is odd if its duration differs from the median by more than `_ODD` medians of such
# differences, and by more than the part `_ALIKE_PERIODS` of the period. Larger: lost samples pass.
# Smaller: variable rhythms are reported.
_ODD = 12.0
_ALIKE_PERIODS = 0.05
# Time stamps are coarse if the times between samples are multiples of a *grid* (the resolution of
# the clock). This is tested with at least `_STAMPS` samples, of which at most `_MOST_STEPS`
# different times between samples exist, and if the grid is at least the part `_COARSE` of the usual
# time between samples. Larger part: errors of a fifth of this time pass. Smaller: stamps in ms are
# reported.
_STAMPS = 50
_MOST_STEPS = 6
_COARSE = 0.2
# Two kinds of cycles alternate if more than this part of the variance of durations or outputs
# changes its sign from cycle to cycle. Larger: alternating steps pass. Smaller: multipliers of -0.9
# are reported in short recordings.
_ALTERNATING = 0.5
# The means over cycles are decomposed into `_COSINES` cosines over a trial. An output drifts if the
# mean power of the slowest quarter of these exceeds `_RATIO` times that of the others. Larger:
# drift passes. A ratio below 14: a multiplier of 0.9 is reported.
_COSINES = 24
_RATIO = 20.0

Cycles = Float[np.ndarray, "k P"]


def other_settings(
    recording: Recording,
    names: list[str],
    outputs: tuple[str, ...],
) -> Iterator[Finding]:
    """Find trials in which a signal has another unit or zero, or two outputs changed places. The
    search ends at the first such pair: its columns make further findings meaningless."""
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
            pair = {names[i], names[j]}
            if swapped[i, j] and pair <= set(outputs):
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
    """Return which pairs of signals have changed places: each has the usual range of the other one,
    and not its own."""
    narrower = np.minimum(width[:, None], usual_width)
    wider = np.maximum(width[:, None], usual_width)
    # alike[i, j]: signal i has the usual range of signal j.
    alike = np.abs(middle[:, None] - usual) < narrower
    alike &= narrower * _ALIKE > wider
    at_home = np.diag(alike)
    return alike & alike.T & ~(at_home[:, None] | at_home)


def _is_unit(ratio: float, is_output: bool) -> bool:
    """Return whether a ratio of ranges is that of two usual units (such as m and mm), in either
    order."""
    units = [1e3, 1e6]
    if is_output:  # pushes may be chosen to be ten times as strong
        units += [10, 180 / np.pi, 1e2]
    distance = np.abs(abs(np.log(ratio)) - np.log(units))
    return bool(distance.min() < np.log(_ALIKE))


def _levels(x: Series) -> Float[np.ndarray, "3"]:
    """Return the quantiles 10, 50 and 90 % of a signal; NaN if it has no sample."""
    x = x[np.isfinite(x)]
    if len(x):
        return np.quantile(x, [0.1, 0.5, 0.9])
    return np.full(3, np.nan)


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


def coarse_stamps(recording: Recording, names: Sequence[str]) -> Iterator[Finding]:
    """Find times that are multiples of a coarse step, which is not the time between samples."""
    for trial in recording.trials:
        for name in names:
            x = trial.values[:, recording.column(name)]
            # (Signals of other rates have times in between.)
            step = np.diff(trial.time[np.isfinite(x)])
            grid = _grid_of(step)
            if grid is None:
                continue
            yield Finding(
                "coarse time stamps",
                f"times of {name} in trial '{trial.name}' are multiples of {grid:.3g} s, samples "
                f"are {step.mean():.4g} s apart: times may be wrong by {grid / 2:.2g} s. If the "
                "samples are regular, number them: time = sample / rate.",
            )
            return


def _grid_of(step: Series) -> float | None:
    """Return the grid of which all times between samples are multiples; None if there is none, or
    if it is much smaller than these times."""
    if len(step) < _STAMPS:
        return None
    usual = float(np.median(step))
    differing = np.abs(step / usual - 1) > _COARSE / 2
    # (A few long steps are lost samples.)
    if differing.mean() < _COARSE / 2:
        return None
    ascending = np.sort(step)
    rises = np.diff(ascending)
    is_rise = rises > _COARSE / 2 * usual
    if not is_rise.any() or is_rise.sum() > _MOST_STEPS:
        return None
    grid = float(rises[is_rise].min())
    count = step / grid
    off = np.abs(count - np.round(count)).max()
    # (Steps of once and twice the usual one also come from lost samples.)
    is_multiple = abs(grid / usual - 1) < _COARSE / 2
    if off > 0.05 or is_multiple or grid < _COARSE * usual:
        return None
    return grid


def odd_cycles(recording: Recording, phase: Phase) -> Iterator[Finding]:
    """Find single cycles of another duration, and many that are two periods long."""
    missed = []
    for trial, period in zip(recording.trials, phase.periods, strict=True):
        if len(period) < _STRETCH:
            continue
        usual = float(np.median(period))
        off = np.abs(period - usual)
        by_median = _ODD * float(np.median(off))
        odd = off > max(by_median, _ALIKE_PERIODS * usual)
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


def alternating_cycles(
    data: SectionData, phase: Phase | None = None
) -> Iterator[Finding]:
    """Find cycles of two kinds that alternate, as strides that were cut at each step."""
    stretches = itertools.chain.from_iterable(phase.stretches if phase else ())
    shares = [_alternating([np.diff(part.edges())[:, None] for part in stretches])]
    for k in range(len(data.outputs)):
        by_record = []
        for record in data.records:
            y = record.y[whole_cycles(record), k]
            by_record.append(y.reshape(-1, data.n_sections))
        shares.append(_alternating(by_record))
    share = max(shares)
    if share > _ALTERNATING:
        yield Finding(
            "alternating cycles",
            f"{100 * share:.0f} % of what differs between cycles changes its sign from one to the "
            "next, as if events of the left and the right side were one list: use those of one "
            "side (every second). Otherwise the rhythm has twice the period.",
        )


def _alternating(parts: Sequence[Cycles]) -> float:
    """Return the part of the variance between cycles that changes its sign from each cycle to the
    next.

    **Arguments:** `parts`: values of successive cycles, a row for each, without a gap.
    """
    whole = np.finfo(float).tiny
    alternating = 0.0
    for values in parts:
        if len(values) < _STRETCH:
            continue
        deviation = np.nan_to_num(values - np.nanmean(values, axis=0))
        sign = np.resize([1.0, -1.0], len(values))
        amplitude = sign @ deviation / len(values)
        whole += float((deviation**2).sum())
        alternating += float((amplitude**2).sum()) * len(values)
    return alternating / whole


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
        # (In three or more trials, the trial itself hardly changes the median.)
        peers = known if len(known) > 2 else known[known != s]
        usual = np.median(mean[:, peers], axis=1)
        yield from _difference(mean[:, s], usual, names[s], outputs)


def _other_periods(phase: Phase, names: Sequence[str]) -> Iterator[Finding]:
    """Find trials with another period."""
    periods = np.array([np.median(x) if len(x) else np.nan for x in phase.periods])
    tolerance = max(_OTHER_PERIOD, CLEAR * phase.jitter)
    for s in np.flatnonzero(np.isfinite(periods)).tolist():
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
    """Return the average cycle of a signal in each trial, less its mean."""
    cycles = []
    for trial, x, parts in phase.samples(recording, name):
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
    """Find the reason why the average cycles of a trial differ from those of other trials, the
    first of these: the sign of one output, the direction of time, the start of cycles."""
    alike = _correlations(mean, usual)
    unlike = np.flatnonzero(alike <= _CORRELATED).tolist()
    if not unlike:
        return
    turned = _least_by_shift(mean[:, ::-1], usual)
    shifted = _least_by_shift(mean, usual)
    best = int(np.argmax(shifted))
    runs_backwards = max(turned) > _CORRELATED and max(turned) > max(shifted)
    if len(unlike) == 1 and alike[unlike[0]] < -_CORRELATED:
        yield _other_sign(outputs[unlike[0]], name, runs_backwards)
    elif runs_backwards:
        yield _backwards(mean, usual, name, outputs)
    elif best and shifted[best] > _CORRELATED:
        away = min(best, _PHASES - best) / _PHASES
        yield Finding(
            "another event",
            f"cycles of trial '{name}' begin {away:.2g} of a cycle away from the others.",
            "refused",
        )
    else:
        which = ", ".join(outputs[k] for k in unlike)
        yield Finding(
            "another cycle",
            f"the average cycle of {which} in trial '{name}' is not that of the others.",
        )


def _correlations(x: Cycles, usual: Cycles) -> Float[np.ndarray, " k"]:
    """Return the correlation of each output with the usual cycle."""
    squares = (x**2).sum(axis=1) * (usual**2).sum(axis=1)
    size = np.sqrt(squares)
    products = (x * usual).sum(axis=1)
    return products / np.maximum(size, np.finfo(float).tiny)


def _least_by_shift(x: Cycles, usual: Cycles) -> list[float]:
    """Return the least correlation of all outputs, for cycles that begin at each phase."""
    shifts = range(_PHASES)
    return [_correlations(np.roll(x, m, axis=1), usual).min() for m in shifts]


def _other_sign(output: str, name: str, runs_backwards: bool) -> Finding:
    remedy = "turn it."
    if runs_backwards:
        remedy = (
            "turn it; or the trial runs backwards: then reverse all of its signals."
        )
    return Finding(
        "another sign",
        f"{output} has the other sign in trial '{name}': {remedy}",
        "refused",
    )


def _backwards(
    mean: Cycles, usual: Cycles, name: str, outputs: Sequence[str]
) -> Finding:
    exchanged = [
        f"{outputs[i]} and {outputs[j]}"
        for i, j in combinations(range(len(outputs)), 2)
        if _correlations(_with_exchanged(mean, i, j), usual).min() > _CORRELATED
    ]
    or_exchanged = f"; or {exchanged[0]} have changed places" if exchanged else ""
    return Finding(
        "backwards",
        f"cycles of trial '{name}' are those of the others in reverse, as if it ran backwards: "
        f"reverse all of its signals, or leave it out{or_exchanged}.",
        "refused",
    )


def _with_exchanged(mean: Cycles, i: int, j: int) -> Cycles:
    """Return average cycles with those of two signals exchanged."""
    order = np.arange(len(mean))
    order[[i, j]] = [j, i]
    return mean[order]


def slow_changes(
    recording: Recording,
    phase: Phase,
    outputs: tuple[str, ...],
    removed: float,
) -> Iterator[Finding]:
    """Find outputs whose means over cycles change slowly, by much more than they scatter.
    `removed`: number of cycles; changes slower than this have been removed already."""
    for name in outputs:
        power = np.zeros(_COSINES)
        for trial, x, parts in phase.samples(recording, name):
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
