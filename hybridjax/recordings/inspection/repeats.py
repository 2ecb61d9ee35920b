"""The same twice: signals, and samples of several trials."""

from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int

from ..recording import Recording, Trial
from .finding import Finding, places
from .samples import Rows


# Of the samples of two signals, the share that must be equal. (Not to be doubled: it lies below 1.)
_EQUAL = 0.99
# Of a signal's standard deviation, the difference of two samples that are the same (written with
# other digits, say). Doubled: trials may be written with fewer digits.
_SAME = 1e-3
# Places of a trial at which another one is compared, and how many samples are. Doubled: overlaps of
# a sixteenth of a trial are found, not of an eighth.
_PROBES, _SAMPLES = 8, 64


def doubled_signals(recording: Recording, names: list[str]) -> list[Finding]:
    """Two columns with the same numbers."""
    found = []
    for a, b in combinations(names, 2):
        i, j = recording.column(a), recording.column(b)
        for trial in recording.trials:
            x, y = trial.values[:, i], trial.values[:, j]
            both = np.isfinite(x) & np.isfinite(y)
            moving = both.any() and np.ptp(x[both]) > 0
            if moving and (x == y)[both].mean() > _EQUAL:
                text = (
                    f"{a} and {b} are the same numbers in trial '{trial.name}': one of them was "
                    "copied over the other, or leave one out."
                )
                found.append(Finding("a signal twice", "refused", text))
                break
    return found


def repeated_samples(recording: Recording, names: list[str]) -> tuple[Rows, list[Finding]]:
    """For each trial, the samples that an earlier trial holds already.

    A few samples in a row are looked for in the other trial, and where they are found once (and
    only once in their own), both are compared sample by sample.
    """
    columns = [recording.column(name) for name in names]
    everything = np.concatenate([t.values[:, columns] for t in recording.trials])
    size = _SAME * np.nanstd(everything, axis=0)
    known = [np.zeros(len(t.time), bool) for t in recording.trials]
    found = []
    for i, j in combinations(range(len(recording.trials)), 2):
        a, b = (recording.trials[k] for k in (i, j))
        x, y = a.values[:, columns], b.values[:, columns]
        shift = _shift(x, y, size)
        if shift is None:
            continue
        first, last = max(0, shift), min(len(x), len(y) + shift)
        same = np.zeros(len(y), bool)
        off = np.abs(x[first:last] - y[first - shift : last - shift])
        same[first - shift : last - shift] = (~(off > size)).all(axis=1)
        if (same & ~known[j]).any():
            known[j] |= same if same.mean() <= _EQUAL else True
            found.append(_finding(a, b, same))
    return known, found


def _finding(a: Trial, b: Trial, same: Bool[np.ndarray, " n"]) -> Finding:
    if same.mean() > _EQUAL:
        text = f"all samples of trial '{b.name}' are in trial '{a.name}' already, and count once."
        return Finding("a trial twice", "left out", text)
    return Finding(
        "overlap",
        "left out",
        f"{same.sum()} samples ({places([b], [same])}) are in trial '{a.name}' too, and "
        "count once; cut one of the two.",
    )


def _shift(
    x: Float[np.ndarray, "n k"], y: Float[np.ndarray, "m k"], size: Float[np.ndarray, " k"]
) -> int | None:
    """By how many samples y comes later than x, where both hold the same."""
    n = _SAMPLES
    for at in np.linspace(0, len(y) - n, _PROBES).astype(int) if len(y) >= n else ():
        probe = y[at : at + n]
        if np.isnan(probe).any() or len(_where(y, probe, size)) > 1:
            continue
        there = _where(x, probe, size)
        if len(there) == 1:
            return int(there[0] - at)
    return None


def _where(
    x: Float[np.ndarray, "n k"], probe: Float[np.ndarray, "m k"], size: Float[np.ndarray, " k"]
) -> Int[np.ndarray, " _"]:
    at = np.arange(len(x) - len(probe) + 1)
    for k, row in enumerate(probe):
        at = at[(np.abs(x[at + k] - row) <= size).all(axis=1)]
    return at
