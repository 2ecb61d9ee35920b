"""What an estimate needs of experiments: sums over them, for each line and input.

They take the same memory for any number of experiments, and those of two sets of experiments add.
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from .._core.errors import DefinitionError
from ..experiments.data import ExperimentData
from ..experiments.partition import check_sharing, needs_two_phases


class About(NamedTuple):
    """What all experiments of one estimate have in common."""

    sections: int
    periods: int
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


class Phases(NamedTuple):
    """Sums over some experiments, for K pairs of a line and an input."""

    power: Float[np.ndarray, " K"]
    """Of |U|^2."""
    square: Complex[np.ndarray, " K"]
    """Of U^2: as large as the power where all phases are the same (mod 180 degrees)."""


class Sums(NamedTuple):
    """Sums over experiments, for K pairs of a line and an input, ascending."""

    about: About
    harmonics: tuple[int, ...]
    line: Int[np.ndarray, " K"]
    channel: Int[np.ndarray, " K"]
    tried: Phases
    """Over all experiments."""
    ran: Phases
    """Over those that did not fail."""
    direct: Complex[np.ndarray, "K M ny"]
    """Of conj(U[k]) Y[k + l P], over those that did not fail."""
    mirror: Complex[np.ndarray, "K M ny"]
    """Of U[k] Y[k + l P]."""
    summary: str

    def one_phase(self, phases: Phases) -> Bool[np.ndarray, " K"]:
        """Lines on multiples of 1/2 that were excited with one phase only."""
        alike = np.abs(phases.square) > (1 - 1e-6) * phases.power
        return needs_two_phases(self.line, self.about.periods, self.about.sections) & alike


def sums_of(
    data: ExperimentData | Iterable[ExperimentData],
    threshold: float,
    choose: Callable[[int], tuple[int, ...]],
) -> Sums:
    """The sums over all experiments, which may come in parts.

    **Arguments:** `choose` gives the harmonics for the number of sections.

    **Raises:** `DefinitionError` if nothing is excited, if lines of an experiment disturb each
    other, or if parts do not belong together.
    """
    if not 0 < threshold < 1:
        raise DefinitionError(f"threshold must lie between 0 and 1, not {threshold}.")
    if isinstance(data, ExperimentData):
        total, summary = _sums(data, threshold, choose(data.sections), 0), data.summary()
    else:
        total, count, good = None, 0, 0
        for part in data:
            if total is not None and (other := _about(part)) != total.about:
                raise DefinitionError(
                    f"these experiments do not belong together: some have {total.about}, others "
                    f"{other}."
                )
            harmonics = choose(part.sections) if total is None else total.harmonics
            new = _sums(part, threshold, harmonics, count)
            total = new if total is None else _add(total, new)
            count, good = count + len(part.ok), good + int(part.ok.sum())
        if total is None:
            raise DefinitionError("there are no experiments: what was given has no parts.")
        summary = f"{good}/{count} ok"
    if len(total.line) == 0:
        raise DefinitionError("the inputs are zero in the window: there is nothing to estimate.")
    return total._replace(summary=summary)


def _about(data: ExperimentData) -> About:
    return About(data.sections, data.periods, data.inputs, data.outputs)


def _sums(data: ExperimentData, threshold: float, harmonics: tuple[int, ...], first: int) -> Sums:
    """The sums over one part, whose first experiment has the number `first`."""
    experiment, line, channel, U = _excited(data, threshold, first)
    pair, place = np.unique(line * len(data.inputs) + channel, return_inverse=True)
    good = data.ok[experiment]

    def total(values, keep):
        """Sums over the entries of each pair."""
        values, where = values[keep], place[keep]
        order = np.argsort(where, kind="stable")
        begin = np.flatnonzero(np.diff(where[order], prepend=-1))
        out = np.zeros((len(pair), *values.shape[1:]), values.dtype)
        if len(begin):
            out[where[order][begin]] = np.add.reduceat(values[order], begin, axis=0)
        return out

    def phases(keep):
        return Phases(total(np.abs(U) ** 2, keep), total(U**2, keep))

    everything = np.ones(len(U), bool)
    Y = np.zeros((len(U), 0, len(data.outputs)), complex)
    if harmonics:
        output = line[:, None] + data.periods * np.asarray(harmonics)
        output %= data.sections * data.periods
        Y = np.fft.fft(data.y[:, data.window], axis=1)[experiment[:, None], output]
    by = U[:, None, None]
    return Sums(
        _about(data),
        harmonics,
        *np.divmod(pair, len(data.inputs)),
        tried=phases(everything),
        ran=phases(good),
        direct=total(by.conj() * Y, good),
        mirror=total(by * Y, good),
        summary="",
    )


def _excited(data: ExperimentData, threshold: float, first: int):
    """Experiment, line, input and U of every excited line, checked that they do not meet."""
    u = data.u[:, data.window]
    U = np.fft.rfft(np.where(np.isfinite(u).all(axis=(1, 2), keepdims=True), u, 0.0), axis=1)
    size = np.abs(U)
    peak = size.max(axis=(1, 2), keepdims=True)
    found = np.nonzero((size > threshold * peak) & (size > 1e-12 * peak.max()))
    experiment, line, channel = found
    number = np.bincount(experiment, minlength=len(u))
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

    check_sharing(experiment + first, line, data.periods, hint)
    return experiment, line, channel, U[found]


def _add(a: Sums, b: Sums) -> Sums:
    nu = len(a.about.inputs)
    pairs = [x.line * nu + x.channel for x in (a, b)]
    pair = np.union1d(*pairs)
    places = [np.searchsorted(pair, x) for x in pairs]

    def add(x, y):
        out = np.zeros((len(pair), *x.shape[1:]), x.dtype)
        out[places[0]] += x
        out[places[1]] += y
        return out

    return Sums(
        a.about,
        a.harmonics,
        *np.divmod(pair, nu),
        Phases(*map(add, a.tried, b.tried)),
        Phases(*map(add, a.ran, b.ran)),
        add(a.direct, b.direct),
        add(a.mirror, b.mirror),
        "",
    )
