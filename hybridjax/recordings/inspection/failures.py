"""Find samples that were not measured: placeholders, frozen, clipped and wrapped signals, copies.

`inspect.py` calls the functions without underscore. `placeholders`, `frozen` and `repeated_rows`
return masks of samples, which are then left out; the others yield findings. `placeholders` and
`frozen` must take the same arguments, since `inspect.py` calls both in one loop.

If good samples are left out, or a failure passes, look at the function that finds it ("no value" is
`placeholders`, "frozen" is `frozen`, "overflow" is `wrapped`), and at the constants that it uses:
they are the limits. `placeholders` uses `RANGES` of `smoothing.py` and the list in
`_is_placeholder`.
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int

from ..._core.findings import Finding, listed
from ..findings import places
from ..recording import Recording
from ..smoothing import RANGES, Series


# A sensor has failed if its value stays the same for longer than this: in cycles, in samples, and,
# if plateaus belong to the rhythm, in multiples of their median length. Longer: failures pass.
# Shorter: slow phases of the motion are left out.
_FROZEN_CYCLES = 0.25
_FROZEN_SAMPLES = 10
_FROZEN_PLATEAUS = 4
# A signal is clipped if more than this part of its samples lies on plateaus at an extreme, and many
# more than on other plateaus. Larger: clipping passes. Smaller: rounded or resting signals are
# reported.
_CLIPPED = 0.005
_MOSTLY = 5
# Jumps are overflows if the number of levels differs from a power of two by less than this part.
# Larger: impacts of a signal in integers are refused. Smaller: overflows of fast signals pass.
_ALL_LEVELS = 0.01
# Two signals, or two trials, are copies if more than this part of their samples is equal. Larger:
# copies with a few edited samples pass. Smaller: signals that rest at zero together are copies.
_EQUAL = 0.99
# Samples are equal if they differ by less than this, in standard deviations. Larger: similar cycles
# of a regular rhythm match. Smaller: copies written with fewer digits pass.
_SAME = 1e-3
# Number of samples in a window, and least number of windows that two copies share. More: short
# copies pass. Fewer: equal samples by chance are copies.
_WINDOW = 8

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
    """Find samples at which a sensor stays at one value for longer than the rhythm allows.

    `period`: rough duration of a cycle, in samples. Inputs may rest at zero, and inputs that rest
    in most cycles are held.
    """
    first, length = _runs(x)
    plateaus = length[length >= 3]
    limit = max(_FROZEN_CYCLES * period, _FROZEN_SAMPLES)
    # Plateaus in most cycles belong to the rhythm, such as those of a foot on the ground.
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
    changes = x[1:] != x[:-1]
    first = np.flatnonzero(np.concatenate([[True], changes]))
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
    """Find integers that overflow: the number of levels is a power of two, and the signal jumps up
    and down by more than half of this number."""
    for trial, x in recording.samples(name):
        levels = np.unique(x[np.isfinite(x)])
        if len(levels) < 2:
            continue
        step = float(np.diff(levels).min())
        count = (x - levels[0]) / step
        # (Whole numbers up to rounding.)
        if np.nanmax(np.abs(count - np.round(count))) >= 1e-3:
            continue
        whole = 1 + round(float(np.nanmax(count)))
        # (If there are many levels, the outermost ones do not occur.)
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

    Windows of successive samples are compared first. If two trials share windows, most of them at
    the same distance in time, the two are compared sample by sample.
    """
    columns = [recording.column(name) for name in names]
    trials = recording.trials
    values = [trial.values[:, columns] for trial in trials]
    deviation = np.ma.masked_invalid(np.concatenate(values)).std(axis=0)
    tolerance = _SAME * deviation.filled(0.0)
    unit = np.where(tolerance > 0, tolerance, 1.0)
    keys = [_keys(x / unit) for x in values]
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
    rng = np.random.default_rng(0)
    weights = rng.integers(1, 2**20, shape).astype(float)
    rows = np.round(values)
    last = max(len(values) - _WINDOW + 1, 0)
    products = [rows[k : k + last] @ weights[k] for k in range(_WINDOW)]
    return np.sum(products, axis=0)


def _shift(x: Float[np.ndarray, " m"], y: Float[np.ndarray, " m"]) -> int | None:
    """Return the distance (in samples) at which two trials share most of their common windows; None
    if there is none."""
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
    """Return the rows of y that equal rows of x, shifted by a number of rows. If nearly all are
    equal, return all."""
    same = np.zeros(len(y), bool)
    first = max(0, shift)
    last = min(len(x), len(y) + shift)
    shared = slice(first - shift, last - shift)
    differs = np.abs(x[first:last] - y[shared]) > tolerance
    same[shared] = ~differs.any(axis=1)
    if same.mean() > _EQUAL:
        same[:] = True
    return same
