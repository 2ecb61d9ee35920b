"""Samples that are none: numbers that stand for "no value", frozen, clipped and wrapped signals."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..recording import Trial
from .finding import Finding, places, runs


# How many ranges of all other samples a number that stands for "no value" lies outside of them.
# Doubled: -999 is no longer recognized beside signals of the order of 100.
_FAR = 3.0
# The least number of equal samples in a row that are a plateau. Doubled: short plateaus pass.
_PLATEAU = 3
# Plateaus per cycle from which on they belong to the rhythm, as those of a foot on the ground.
# Doubled: a sensor that fails in every second cycle is recognized.
_BELONGS = 0.3
# A frozen sensor stays for so many cycles and samples; where plateaus belong to the rhythm, for
# so many times their length. Doubled: shorter failures pass.
_FROZEN_CYCLES, _FROZEN_SAMPLES, _FROZEN_TIMES = 0.25, 10, 4
# Of all samples, the share on plateaus at the largest (or least) value that is clipping, and how
# many times more plateaus there are than at other values. Doubled: less clipping is seen.
_CLIPPED, _MOSTLY = 0.005, 5
# Of its number of levels, the share by which an integer jumps that overflows. (Not to be doubled:
# it lies below 1.)
_WRAP = 0.5
# Rounding of integers that were scaled, in levels. Doubled: nothing changes.
_ROUNDING = 1e-3

Rows = list[Bool[np.ndarray, " _"]]


class Signal(NamedTuple):
    """One signal in each trial. `period`: the rough durations of a cycle, in samples."""

    name: str
    trials: tuple[Trial, ...]
    values: list[Float[np.ndarray, " _"]]
    period: list[float]
    is_input: bool


def placeholders(s: Signal) -> tuple[Rows, list[Finding]]:
    """Numbers such as -9999, far from all other samples."""
    bad = [_placeholders(x) for x in s.values]
    count = sum(int(b.sum()) for b in bad)
    if not count:
        return bad, []
    used = np.unique(np.concatenate([x[b] for x, b in zip(s.values, bad, strict=True)]))
    text = (
        f"{s.name} is {', '.join(f'{v:.6g}' for v in used)} at {count} samples "
        f"({places(s.trials, bad)}), which is taken for missing; write NaN, or an empty field."
    )
    return bad, [Finding("no value", "left out", text)]


def frozen(s: Signal) -> tuple[Rows, list[Finding]]:
    """A sensor that stays at one value for longer than its rhythm allows."""
    bad = [_frozen(x, p, s.is_input) for x, p in zip(s.values, s.period, strict=True)]
    count = sum(int(b.sum()) for b in bad)
    if not count:
        return bad, []
    text = (
        f"{s.name} does not change at all for {count} samples ({places(s.trials, bad)}), which are "
        "taken for missing; look for the sensor, or the wire, that failed."
    )
    return bad, [Finding("frozen", "left out", text)]


def clipped(s: Signal) -> list[Finding]:
    """Plateaus at the largest or least value, and nowhere else. One at 0 is none."""
    found = [_clipped(x) for x in s.values]
    where = [t.name for t, (count, _) in zip(s.trials, found, strict=True) if count]
    if not where:
        return []
    count, levels = sum(c for c, _ in found), next(v for c, v in found if c)
    more = f" and {len(where) - 1} more trials" if len(where) > 1 else ""
    text = (
        f"{s.name} is cut off at {' and '.join(f'{v:.4g}' for v in levels)} in trial '{where[0]}'"
        f"{more}, {count} samples: deviations beyond are not seen; choose a larger range."
    )
    return [Finding("clipped", "warned", text)]


def wrapped(s: Signal) -> list[Finding]:
    """Integers that begin anew at the other end of their range."""
    for trial, x in zip(s.trials, s.values, strict=True):
        levels = np.unique(x[np.isfinite(x)])
        if len(levels) < 2:
            continue
        step = float(np.diff(levels).min())
        count = (x - levels[0]) / step
        whole = 1 + round(float(np.nanmax(count)))
        off = np.nanmax(np.abs(count - np.round(count)))
        jumps = int((np.abs(np.diff(count)) > _WRAP * whole).sum())
        if off < _ROUNDING and whole.bit_count() == 1 and jumps > 1:
            text = (
                f"{s.name} jumps by the whole range of its {whole} levels {jumps} times in trial "
                f"'{trial.name}', as integers that overflow: undo it (`numpy.unwrap` with "
                f"period={whole * step:.6g}), or choose a larger range."
            )
            return [Finding("overflow", "refused", text)]
    return []


def _placeholders(x: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    bad = np.zeros(len(x), bool)
    for pick in (np.min, np.max) * 2:  # two of either sign
        rest = x[np.isfinite(x) & ~bad]
        if not len(rest):
            break
        value = pick(rest)
        others = rest[rest != value]
        if len(others) and np.ptp(others) > 0 and _stands_for_nothing(value):
            outside = max(others.min() - value, value - others.max())
            if outside > _FAR * np.ptp(others):
                bad |= x == value
    return bad


def _stands_for_nothing(value: float) -> bool:
    """Whether a number is one that programs write for "no value": 999, -8888, -32768, 1e20, ..."""
    size = abs(float(value))
    digits = f"{size:.0f}"
    if size == round(size) and len(digits) >= 3 and set(digits) in ({"9"}, {"8"}):
        return True
    return size in (2.0**15, 2.0**15 - 1, 2.0**16 - 1, 2.0**31, 2.0**31 - 1) or size >= 1e15


def _frozen(x: Float[np.ndarray, " n"], period: float, is_input: bool) -> Bool[np.ndarray, " n"]:
    bad = np.zeros(len(x), bool)
    first, length = runs(x)
    plateaus = length[length >= _PLATEAU]
    limit = max(_FROZEN_CYCLES * period, _FROZEN_SAMPLES)
    if len(plateaus) > _BELONGS * len(x) / period:
        if is_input:  # it is held, or rests, now and then
            return bad
        limit = max(limit, _FROZEN_TIMES * float(np.median(plateaus)))
    for a, n in zip(first[length > limit], length[length > limit], strict=True):
        if not (is_input and x[a] == 0):
            bad[a : a + n] = True
    return bad


def _clipped(x: Float[np.ndarray, " n"]) -> tuple[int, list[float]]:
    """How many samples are cut off, and at which values."""
    first, length = runs(x)
    flat = length >= _PLATEAU
    if not flat.any():
        return 0, []
    value, length = x[first[flat]], length[flat]
    ends = [v for v in (np.nanmin(x), np.nanmax(x)) if v != 0 and (value == v).sum() > 1]
    at_ends = np.isin(value, ends)
    count = int(length[at_ends].sum())
    enough = count >= max(1, _CLIPPED * len(x), _MOSTLY * length[~at_ends].sum())
    return (count, ends) if enough else (0, [])
