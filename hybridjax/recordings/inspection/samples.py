"""Samples that were not measured: placeholders, frozen, clipped and wrapped signals, copies."""

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int

from ..findings import Finding, places
from ..recording import Recording
from ..smoothing import Series


# Least distance of a placeholder from all other samples, in their range. Larger: -999 passes beside
# signals of the order of 100. Smaller: genuine extremes are left out.
_FAR = 3.0
# Plateaus per cycle from which on they belong to the rhythm, as those of a foot on the ground.
# More: the rests of a limb are left out. Fewer: a sensor that fails now and then is believed.
_BELONGS = 0.3
# Shortest failure of a sensor: in cycles, in samples, and (where plateaus belong to the rhythm) in
# plateaus. Longer: failures pass. Shorter: slow phases of the motion are left out.
_FROZEN = 0.25, 10, 4
# Least fraction of samples on plateaus at an extreme that is clipping, and its ratio to those on
# other plateaus. Larger: clipping passes. Smaller: rounded or resting signals are reported.
_CLIPPED, _MOSTLY = 0.005, 5
# Fraction of equal samples that makes two signals, or two trials, copies. Larger: copies with a few
# edited samples pass. Smaller: signals that rest at zero together are copies.
_EQUAL = 0.99
# Difference of equal samples in standard deviations. Larger: similar cycles of a regular rhythm
# match. Smaller: copies written with fewer digits pass.
_SAME = 1e-3

Rows = Bool[np.ndarray, " n"]


def placeholders(x: Series, period: float, is_input: bool) -> Rows:
    """Find numbers such as -9999, far from all other samples."""
    whole = np.unique(x[x == np.round(x)])
    marked = np.isin(x, [value for value in whole if _is_placeholder(abs(float(value)))])
    usual = x[np.isfinite(x) & ~marked]
    if not marked.any() or not len(usual) or not np.ptp(usual):
        return np.zeros(len(x), bool)
    return marked & (np.maximum(usual.min() - x, x - usual.max()) > _FAR * np.ptp(usual))


def _is_placeholder(size: float) -> bool:
    """Return whether programs write this number for "no value": 999, 8888, 32768, 1e20, ..."""
    digits = f"{size:.0f}"
    if len(digits) >= 3 and set(digits) in ({"9"}, {"8"}):
        return True
    return size in (2.0**15, 2.0**15 - 1, 2.0**16 - 1, 2.0**31, 2.0**31 - 1) or size >= 1e15


def frozen(x: Series, period: float, is_input: bool) -> Rows:
    """Find a sensor that stays at one value for longer than its rhythm allows.

    `period`: rough duration of a cycle, in samples. Inputs may rest at zero, and inputs that rest
    in most cycles are held.
    """
    first, length = _runs(x)
    plateaus = length[length >= 3]
    limit = max(_FROZEN[0] * period, _FROZEN[1])
    if len(plateaus) > _BELONGS * len(x) / period:
        limit = np.inf if is_input else max(limit, _FROZEN[2] * float(np.median(plateaus)))
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
        ends = [v for v in (np.nanmin(x), np.nanmax(x)) if v != 0 and (value == v).sum() > 1]
        at_ends = np.isin(value, ends)
        count = length[at_ends].sum()
        if count >= max(1, _CLIPPED * len(x), _MOSTLY * length[~at_ends].sum()):
            levels = " and ".join(f"{v:.4g}" for v in ends)
            yield Finding("clipped", f"{name} is cut off at {levels} in trial '{trial.name}'.")
            return


def wrapped(recording: Recording, name: str) -> Iterator[Finding]:
    """Find integers that overflow: jumps by half of their levels, which are a power of two."""
    for trial, x in recording.samples(name):
        levels = np.unique(x[np.isfinite(x)])
        if len(levels) < 2:
            continue
        step = float(np.diff(levels).min())
        count = (x - levels[0]) / step
        whole = 1 + round(float(np.nanmax(count)))
        off = np.nanmax(np.abs(count - np.round(count)))
        jumps = int((np.abs(np.diff(count)) > 0.5 * whole).sum())
        if off < 1e-3 and whole.bit_count() == 1 and jumps > 1:  # scaled integers, but for rounding
            text = (
                f"{name} jumps by its whole range in trial '{trial.name}', as integers that "
                f"overflow: undo it (`numpy.unwrap` with period={whole * step:.6g})."
            )
            yield Finding("overflow", text, "refused")
            return


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


def repeated_samples(
    recording: Recording, names: Sequence[str]
) -> tuple[list[Rows], list[Finding]]:
    """Return for each trial the samples that an earlier trial holds already.

    A few samples in a row are searched for in the other trial. If they occur there once (and only
    once in their own trial), both trials are compared sample by sample.
    """
    columns, trials = [recording.column(name) for name in names], recording.trials
    values = [t.values[:, columns] for t in trials]
    size = _SAME * np.nanstd(np.concatenate(values), axis=0)
    repeated, findings = [np.zeros(len(x), bool) for x in values], []
    for i, j in combinations(range(len(trials)), 2):
        x, y = values[i], values[j]
        shift = _shift(x, y, size)
        if shift is None:
            continue
        first, last = max(0, shift), min(len(x), len(y) + shift)
        same = np.zeros(len(y), bool)
        off = np.abs(x[first:last] - y[first - shift : last - shift])
        same[first - shift : last - shift] = (~(off > size)).all(axis=1)
        same |= same.mean() > _EQUAL
        if (same & ~repeated[j]).any():
            repeated[j] |= same
            text = f"{places([trials[j]], [same])}: these samples are in trial '{trials[i].name}'"
            findings.append(Finding("a trial twice", f"{text} too, and count once.", "left out"))
    return repeated, findings


def _shift(
    x: Float[np.ndarray, "n k"], y: Float[np.ndarray, "m k"], size: Float[np.ndarray, " k"]
) -> int | None:
    """Return the number of samples by which y comes later than x, from eight probes of 64 samples:
    overlaps of an eighth of a trial are found."""
    n = 64
    for at in np.linspace(0, len(y) - n, 8).astype(int) if len(y) >= n else ():
        probe = y[at : at + n]
        if np.isnan(probe).any() or len(_where(y, probe, size)) > 1:
            continue
        matches = _where(x, probe, size)
        if len(matches) == 1:
            return int(matches[0] - at)
    return None


def _where(
    x: Float[np.ndarray, "n k"], probe: Float[np.ndarray, "m k"], size: Float[np.ndarray, " k"]
) -> Int[np.ndarray, " _"]:
    at = np.arange(len(x) - len(probe) + 1)
    for k, row in enumerate(probe):
        at = at[(np.abs(x[at + k] - row) <= size).all(axis=1)]
    return at
