"""What estimates of HTFs need of experiments: sums over them, for each line of the spectrum.

Line k is the frequency f = k / P (cycles per period) of a DFT over P periods. The sums take the
same memory for any number of experiments, and those of two sets of experiments add.
"""

from collections.abc import Callable, Iterable
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from ..._core.boundary.containers import Stream
from ...errors import DefinitionError
from ...experiments.data import ExperimentData
from ...experiments.design.partition import check_sharing, meets_itself, regular
from .random_phases import CrestTest, compare_crest_factors


Experiments = ExperimentData | Annotated[Iterable[ExperimentData], Stream(ExperimentData, "data")]
"""Experiments, or parts of them one after the other."""


# Largest change of a line of the input from one window to the next, relative to the largest line.
# Doubled: inputs that repeat half as well pass, and the noise of their estimates is overrated.
_REPEATS = 1e-2
# Experiments that excite a line, up to which their sums are kept singly. Doubled: twice the memory;
# means of so many errors are normally distributed.
_SINGLE = 16
# Part of the largest line of all inputs below which a line is rounding. Doubled: none but rounding.
_ROUNDING = 1e-12


class Setup(NamedTuple):
    """What all experiments of one estimate have in common."""

    n_sections: int
    periods: int
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


class SumOptions(NamedTuple):
    """Which sums are wanted."""

    harmonics: Callable[[int], tuple[int, ...]]
    """The harmonics, for the number of sections."""
    threshold: float = 1e-6
    """A line is excited above this part of the largest |U| of its experiment."""
    highest: int | None = None
    """Harmonics beyond this one count as zero."""
    repeats: int = 1
    """How many windows are averaged."""


class InputSums(NamedTuple):
    """Sums of products of inputs over some experiments, for K lines."""

    power: Complex[np.ndarray, "K nu nu"]
    """Of conj(U) U^T."""
    square: Complex[np.ndarray, "K nu nu"]
    """Of U U^T: as large as the power where all phases are the same (mod 180 degrees)."""


class SingleSums(NamedTuple):
    """The sums of single experiments: the first, second, ..., R-th that excites a line."""

    power: Float[np.ndarray, "R K nu"]
    """|U|^2; zero where there is none."""
    direct: Complex[np.ndarray, "R K nu M ny"]
    """conj(U[k]) Y[k + l P]."""


class SpectralSums(NamedTuple):
    """Sums over experiments, for K lines, ascending."""

    setup: Setup
    harmonics: tuple[int, ...]
    line: Int[np.ndarray, " K"]
    mirrored: Bool[np.ndarray, " K"]
    """Lines that meet their own mirror images."""
    tried: InputSums
    """Over all experiments."""
    ran: InputSums
    """Over those that did not fail, as all that follow."""
    count: Int[np.ndarray, " K"]
    """Of experiments."""
    direct: Complex[np.ndarray, "K nu M ny"]
    """Of conj(U[k]) Y[k + l P], Y the mean over the repeated windows."""
    mirror: Complex[np.ndarray, "K nu M ny"]
    """Of U[k] Y[k + l P]."""
    energy: Float[np.ndarray, "K M ny"]
    """Of |Y[k + l P]|^2."""
    noise: Float[np.ndarray, "K M ny"]
    """Of the variance of Y[k + l P], as seen from one window to the next; zero for one window."""
    single: SingleSums | None
    """None for lines that more than 16 experiments excite."""
    crest_test: CrestTest
    repeats: int
    """How many windows were averaged."""
    summary: str = ""
    """How many experiments ran to their end."""

    def gram(self, inputs: InputSums, rows: np.ndarray, both: bool) -> Complex[np.ndarray, "k n n"]:
        """Normal matrices of Y on U, or for `both` on U and conj(U)."""
        power, square = inputs.power[rows], inputs.square[rows]
        if not both:
            return power
        upper = np.concatenate([power, square.conj()], axis=2)
        return np.concatenate([upper, np.concatenate([square, power.conj()], axis=2)], axis=1)

    def solvable(self, inputs: InputSums) -> Bool[np.ndarray, " K"]:
        """Lines with responses to all inputs (and mirror images) that can be told apart."""
        out = np.zeros(len(self.line), bool)
        for rows in (np.flatnonzero(~self.mirrored), np.flatnonzero(self.mirrored)):
            out[rows] = regular(self.gram(inputs, rows, bool(self.mirrored[rows].any())))
        return out

    def one_phase(self, inputs: InputSums) -> Bool[np.ndarray, " K"]:
        """Lines that meet their mirror images and were excited with one phase only."""
        rows = np.flatnonzero(self.mirrored)
        out = np.zeros(len(self.line), bool)
        out[rows] = regular(self.gram(inputs, rows, False))
        out[rows] &= ~regular(self.gram(inputs, rows, True))
        return out


def spectral_sums(data: Experiments, options: SumOptions) -> SpectralSums:
    """The sums over all experiments, which may come in parts.

    **Raises:** `DefinitionError` if nothing is excited, if lines of an experiment disturb each
    other, if records are too short, or if parts do not belong together.
    """
    if isinstance(data, ExperimentData):
        total, summary = _sums_of_part(data, options, 0), data.summary()
    else:
        total, count, good = None, 0, 0
        for part in data:
            if total is not None and (other := _setup(part)) != total.setup:
                raise DefinitionError(
                    f"these experiments do not belong together: some have {total.setup}, others "
                    f"{other}."
                )
            new = _sums_of_part(part, options, count)
            total = new if total is None else _add(total, new)
            count, good = count + len(part.ok), good + int(part.ok.sum())
        if total is None:
            raise DefinitionError("`data` holds no experiments.")
        summary = f"{good}/{count} ok"
    if len(total.line) == 0:
        raise DefinitionError("the inputs are zero in the window: there is nothing to estimate.")
    return total._replace(summary=summary)


def _setup(data: ExperimentData) -> Setup:
    return Setup(data.n_sections, data.periods, data.inputs, data.outputs)


def _sums_of_part(data: ExperimentData, options: SumOptions, first: int) -> SpectralSums:
    """The sums over one part, whose first experiment has the number `first`."""
    N, P, harmonics = data.n_sections, data.periods, options.harmonics(data.n_sections)
    highest = (
        None if options.highest is None else options.highest + max(map(abs, harmonics), default=0)
    )
    windows = data.windows(options.repeats)
    experiment, line, U = _excited(data, windows, options.threshold, highest, first)
    lines, place = np.unique(line, return_inverse=True)
    good = data.ok[experiment]

    def total(values, keep):
        """Sums over the entries of each line."""
        values, where = values[keep], place[keep]
        order = np.argsort(where, kind="stable")
        begin = np.flatnonzero(np.diff(where[order], prepend=-1))
        out = np.zeros((len(lines), *values.shape[1:]), values.dtype)
        if len(begin):
            out[where[order][begin]] = np.add.reduceat(values[order], begin, axis=0)
        return out

    def input_sums(keep):
        columns, rows = U[:, :, None], U[:, None, :]
        return InputSums(total(columns.conj() * rows, keep), total(columns * rows, keep))

    Y, noise = _outputs(data, windows, experiment, line, harmonics)
    by = U[:, :, None, None]
    return SpectralSums(
        _setup(data),
        harmonics,
        lines,
        meets_itself(lines, P, N, highest),
        tried=input_sums(np.ones(len(U), bool)),
        ran=input_sums(good),
        count=total(np.ones(len(U), int), good),
        direct=total(by.conj() * Y[:, None], good),
        mirror=total(by * Y[:, None], good),
        energy=total(np.abs(Y) ** 2, good),
        noise=total(noise, good),
        single=_single_sums(
            place[good], len(lines), np.abs(U[good]) ** 2, by.conj()[good] * Y[good, None]
        ),
        crest_test=_test_phases(data, lines, line, first),
        repeats=options.repeats,
    )


def _single_sums(place, lines: int, power, direct) -> SingleSums | None:
    """Entries (for lines at these places) sorted by line, and by which one of the line they are."""
    order = np.argsort(place, kind="stable")
    count = np.bincount(place, minlength=lines)
    most = int(count.max(initial=0))
    if most > _SINGLE:
        return None
    rank = np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count)
    where = rank, place[order]
    found = [np.zeros((most, lines, *x.shape[1:]), x.dtype) for x in (power, direct)]
    for out, x in zip(found, (power, direct), strict=True):
        out[where] = x[order]
    return SingleSums(*found)


def _test_phases(data: ExperimentData, lines, line, first: int) -> CrestTest:
    """Where lines are measured several times: whether their phases are random."""
    if first == 0 and len(lines) == len(line):
        return CrestTest(0, 0)
    return compare_crest_factors(data.u[:, data.window])


def _outputs(data: ExperimentData, windows: list[slice], experiment, line, harmonics):
    """Y at lines k + m P for each entry k, the mean over the windows, and its variance."""
    N, P, ny = data.n_sections, data.periods, len(data.outputs)
    if not harmonics:
        return np.zeros((len(line), 0, ny), complex), np.zeros((len(line), 0, ny))
    output = (line[:, None] + P * np.asarray(harmonics)) % (N * P)
    each = [np.fft.fft(data.y[:, w], axis=1)[experiment[:, None], output] for w in windows]
    mean = sum(each) / len(each)
    if len(each) == 1:
        return mean, np.zeros(mean.shape)
    spread = sum(np.abs(Y - mean) ** 2 for Y in each)
    return mean, spread / (len(each) - 1) / len(each)


def _excited(
    data: ExperimentData, windows: list[slice], threshold: float, highest: int | None, first: int
):
    """Experiment, line and U of every excited line, checked that they do not meet."""
    u = np.where(np.isfinite(data.u).all(axis=(1, 2), keepdims=True), data.u, 0.0)
    each = [np.fft.rfft(u[:, window], axis=1) for window in windows]
    U = sum(each) / len(each)
    size = np.abs(U)
    peak = size.max(axis=(1, 2), keepdims=True)
    if max(np.abs(x - U).max(axis=(1, 2), keepdims=True).sum() for x in each) > 0:
        worst = max(float(np.max(np.abs(x - U) / np.where(peak > 0, peak, 1))) for x in each)
        if worst > max(threshold, _REPEATS):
            raise DefinitionError(
                f"the input does not repeat: its last {len(windows)} windows of P = "
                f"{data.periods} periods differ by {worst:.2g} of the largest line. Take fewer "
                "`repeats`, or the right number of periods."
            )
    found = ((size > threshold * peak) & (size > _ROUNDING * peak.max())).any(axis=2)
    experiment, line = np.nonzero(found)
    number = found.sum(axis=1)
    most = data.periods // 2 + 1

    def hint(experiment: int) -> str:
        lines = number[experiment - first]
        if lines <= most:
            return ""
        return (
            f" ({lines} lines are excited, more than any experiment can hold: is the "
            f"input periodic over the last P = {data.periods} periods, and without noise above "
            "`threshold`?)"
        )

    check_sharing(experiment + first, line, data.periods, hint, data.n_sections, highest)
    return experiment, line, U[experiment, line]


def _add(a: SpectralSums, b: SpectralSums) -> SpectralSums:
    line = np.union1d(a.line, b.line)
    places = [np.searchsorted(line, x.line) for x in (a, b)]

    def add(x, y):
        if isinstance(x, InputSums):
            return InputSums(*map(add, x, y))
        out = np.zeros((len(line), *x.shape[1:]), x.dtype)
        out[places[0]] += x
        out[places[1]] += y
        return out

    def single():
        if a.single is None or b.single is None:
            return None
        there = [x.single.power.any(axis=2) for x in (a, b)]
        place = np.concatenate([p[np.nonzero(t)[1]] for p, t in zip(places, there, strict=True)])
        parts = zip(a.single, b.single, strict=True)
        values = [np.concatenate([x[there[0]], y[there[1]]]) for x, y in parts]
        return _single_sums(place, len(line), *values)

    sums = ("mirrored", "tried", "ran", "count", "direct", "mirror", "energy", "noise")
    both = {name: add(getattr(a, name), getattr(b, name)) for name in sums}
    return a._replace(
        line=line, single=single(), crest_test=a.crest_test.merge(b.crest_test), **both
    )
