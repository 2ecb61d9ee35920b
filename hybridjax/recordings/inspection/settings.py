"""Trials that were recorded otherwise than the others: units, zeros, columns, clocks."""

from itertools import combinations

import numpy as np
from jaxtyping import Float

from ..recording import Recording
from .finding import Finding, listed


# The share of the samples at either end that says nothing of a signal's range. Doubled: outliers
# matter less.
_TAIL = 0.1
# Ratios of ranges that are alike; and how near to a power of ten another unit makes them. Doubled:
# larger differences pass; or, other ratios are taken for units.
_ALIKE, _NEAR_UNIT = 1.5, 1.2
# Powers of ten by which units of outputs, and of inputs, differ. (Not to be doubled: pushes may be
# chosen to be ten times as strong.)
_OUTPUT_UNITS, _INPUT_UNITS = (1, 2, 3, 6), (3, 6)
# A zero is another one if it is off by this share of the range, and so many times more than others
# are. Doubled: larger offsets pass.
_OFFSET, _OFF = 0.1, 10.0
# Steps of a regular clock differ by less than this share in nearly all (the second) samples; it
# jumps by so many steps. Doubled: larger jumps pass.
_REGULAR, _NEARLY_ALL, _JUMP = 0.01, 0.95, 5.0


def other_settings(
    recording: Recording, names: list[str], outputs: tuple[str, ...]
) -> list[Finding]:
    """Trials in which a signal has another unit or zero, or two outputs have changed places."""
    if len(recording.trials) < 2:
        return []
    columns = [recording.column(name) for name in names]
    levels = [[_levels(t.values[:, k]) for k in columns] for t in recording.trials]
    low, middle, high = np.moveaxis(np.array(levels), 2, 0)
    width = high - low
    found = []
    for s, trial in enumerate(recording.trials):
        rest = np.arange(len(recording.trials)) != s
        usual, range_ = np.median(middle[rest], axis=0), np.median(width[rest], axis=0)
        places = [k for k, name in enumerate(names) if name in outputs]
        swapped = _swapped(middle[s], width[s], usual, range_, places)
        if swapped is not None:
            a, b = (names[k] for k in swapped)
            text = f"{a} and {b} have changed places in trial '{trial.name}': swap its columns."
            found.append(Finding("swapped columns", "refused", text))
            continue
        for k, name in enumerate(names):
            if not (width[s, k] > 0 and range_[k] > 0):
                continue
            ratio = width[s, k] / range_[k]
            power = round(np.log10(ratio))
            unit = 10.0**power
            units = _OUTPUT_UNITS if name in outputs else _INPUT_UNITS
            if abs(power) in units and max(ratio / unit, unit / ratio) < _NEAR_UNIT:
                action = "refused" if name in outputs else "warned"
                text = (
                    f"{name} varies {ratio:.3g} times as much in trial '{trial.name}' as in the "
                    f"others: if its unit is another one, divide it by {unit:g}."
                )
                found.append(Finding("another unit", action, text))
                continue
            off = abs(middle[s, k] - usual[k])
            scatter = np.abs(middle[rest, k] - usual[k]).max()
            if name in outputs and off > max(_OFFSET * range_[k], _OFF * scatter):
                text = (
                    f"{name} lies at {middle[s, k]:.4g} in trial '{trial.name}', at {usual[k]:.4g} "
                    "in the others: a level that defines the phase means something else there."
                )
                found.append(Finding("another zero", "warned", text))
    return found


def _levels(x: Float[np.ndarray, " n"]) -> Float[np.ndarray, "3"]:
    """Where a signal is: a low, the middle and a high quantile; NaN if it is nowhere."""
    x = x[np.isfinite(x)]
    return np.quantile(x, [_TAIL, 0.5, 1 - _TAIL]) if len(x) else np.full(3, np.nan)


def _swapped(
    middle: Float[np.ndarray, " k"],
    width: Float[np.ndarray, " k"],
    usual: Float[np.ndarray, " k"],
    range_: Float[np.ndarray, " k"],
    places: list[int],
) -> tuple[int, int] | None:
    """Two of these signals, each of which is where the other one usually is."""

    def alike(i, j):
        ratio = width[i] / range_[j] if width[i] > 0 and range_[j] > 0 else np.inf
        near = abs(middle[i] - usual[j]) < min(width[i], range_[j])
        return near and 1 / _ALIKE < ratio < _ALIKE

    for i, j in combinations(places, 2):
        if alike(i, j) and alike(j, i) and not (alike(i, i) or alike(j, j)):
            return i, j
    return None


def clocks(recording: Recording) -> list[Finding]:
    """Time in another unit in one trial, and jumps of clocks that are regular otherwise."""
    found, jumps = [], []
    steps = [float(np.median(np.diff(t.time))) for t in recording.trials]
    for s, trial in enumerate(recording.trials):
        rest = steps[:s] + steps[s + 1 :]
        ratio = steps[s] / float(np.median(rest)) if rest else 1.0
        unit = 1000.0 ** np.round(np.log10(ratio) / 3)
        if unit != 1 and max(ratio / unit, unit / ratio) < _NEAR_UNIT:
            text = (
                f"samples of trial '{trial.name}' are {ratio:.4g} times as far apart as those of "
                "the others: if its times have another unit (milliseconds), convert them."
            )
            found.append(Finding("another unit of time", "refused", text))
        step = np.diff(trial.time) / steps[s]
        if (np.abs(step - 1) < _REGULAR).mean() > _NEARLY_ALL:
            jumps += [
                f"trial '{trial.name}', by {steps[s] * step[k]:.3g} at {trial.time[k]:.2f} s"
                for k in np.flatnonzero(step > _JUMP)
            ]
    if jumps:
        text = (
            f"the clock jumps ({listed(jumps)}): after a pause this is right; if the clock was "
            "set, make a trial of each part."
        )
        found.append(Finding("jump of the clock", "warned", text))
    return found
