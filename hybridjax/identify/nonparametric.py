"""Harmonic transfer functions from measured inputs and outputs (Sec. V)."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from .._core.errors import DefinitionError
from .._core.precision import require_x64
from ..experiments.data import ExperimentData
from ..experiments.partition import check_sharing, needs_two_phases
from ..periodic.htf import HTF
from ..periodic.transfer import check_harmonics


def estimate_htf(
    data: ExperimentData,
    harmonics: int | Sequence[int] | None = None,
    *,
    half_integers: Literal["error", "skip"] = "error",
    threshold: float = 1e-6,
) -> HTF:
    """Estimate all harmonic transfer functions at all frequencies that the inputs excite.

    `H_l(w_k) = Y[k + l P] / U[k]`, both DFTs over the same window of the last P whole periods.
    The excited lines k are found from U itself, so any experiments will do, not only those of
    a `Design`, if they obey its rules. Where a frequency was measured more than once the
    estimate is the least-squares one. On multiples of 1/2 (other than 0 and N/2) the line meets
    its own mirror image, `Y[k + l P] = H_l(w) U[k] + H_{l + 2f}(-w) conj(U[k])`, which is solved
    for both unknowns from two or more experiments with different phases. Failed experiments are
    left out (`missing_frequencies` says what is lost by that), and with several inputs only
    frequencies that were measured from each of them are kept.

    **Arguments:**

    - `data`: the experiments. With several inputs, a line is excited by one of them at a time.
    - `harmonics`: which ones; None means all N.
    - `half_integers`: what to do with a multiple of 1/2 measured with one phase only.
    - `threshold`: a line counts as excited above this part of the largest |U| of its experiment.
      Raise it where the recorded input is noisy.

    **Returns:** `HTF` with ascending frequencies, source "estimate".

    **Raises:** `DefinitionError` if nothing was excited or no experiment is left; if two lines
    of one experiment disturb each other (the message names the pair); or for one phase only on a
    multiple of 1/2.
    """
    if half_integers not in ("error", "skip"):
        raise DefinitionError(f"half_integers must be 'error' or 'skip', not {half_integers!r}.")
    require_x64()
    harmonics = check_harmonics(harmonics, data.sections)
    lines = _excited(data, threshold)
    unsolved = _one_phase(lines, data)
    if unsolved.any() and half_integers == "error":
        f = lines.line[unsolved][0] / data.periods
        raise DefinitionError(
            f"f = {f:.10g} lies on a multiple of 1/2 and was measured with one phase only: "
            "measure it in a second experiment with a phase 90 degrees apart "
            "(half_integers='two-phase' in the design does so), or leave it out here with "
            "half_integers='skip' and use HTF.interpolate."
        )
    lines = lines.take(data.ok[lines.experiment])
    lines = lines.take(~_one_phase(lines, data))
    grid = _complete(lines, data)
    if len(grid) == 0:
        raise DefinitionError(
            f"no frequency is left to estimate: {data.summary()}; a frequency must have been "
            f"measured from each of the {len(data.inputs)} inputs."
        )
    lines = lines.take(np.isin(lines.line, grid))
    return HTF(
        grid / data.periods,
        _solve(lines, grid, data, np.asarray(harmonics)),
        harmonics,
        data.sections,
        data.inputs,
        data.outputs,
        "estimate",
    )


def missing_frequencies(data: ExperimentData, threshold: float = 1e-6) -> Float[np.ndarray, " F"]:
    """Frequencies (cycles per period) that were excited but that `estimate_htf` has to leave out.

    Because their experiments failed, or not all inputs were applied at them, or because they lie
    on a multiple of 1/2 and one phase is all there is.
    """
    lines = _excited(data, threshold)
    good = lines.take(data.ok[lines.experiment])
    good = good.take(~_one_phase(good, data))
    return np.setdiff1d(lines.line, _complete(good, data)) / data.periods


class _Lines(NamedTuple):
    """The excited lines: one entry per experiment, line and input, sorted by experiment."""

    experiment: Int[np.ndarray, " K"]
    line: Int[np.ndarray, " K"]
    channel: Int[np.ndarray, " K"]
    U: Complex[np.ndarray, " K"]

    def take(self, keep: Bool[np.ndarray, " K"]) -> "_Lines":
        return _Lines(*(field[keep] for field in self))


def _excited(data: ExperimentData, threshold: float) -> _Lines:
    """Find the lines in the input's own spectrum and check that they do not meet."""
    if not 0 < threshold < 1:
        raise DefinitionError(f"threshold must lie between 0 and 1, not {threshold}.")
    u = data.u[:, data.window]
    U = np.fft.rfft(np.where(np.isfinite(u).all(axis=(1, 2), keepdims=True), u, 0.0), axis=1)
    size = np.abs(U)
    peak = size.max(axis=(1, 2), keepdims=True)
    found = np.nonzero((size > threshold * peak) & (size > 1e-12 * peak.max()))
    if len(found[0]) == 0:
        raise DefinitionError("the inputs are zero in the window: there is nothing to estimate.")
    lines = _Lines(*found, U[found])
    number = np.bincount(lines.experiment, minlength=len(u))
    most = data.periods // 2 + 1

    def hint(experiment: int) -> str:
        if number[experiment] <= most:
            return ""
        return (
            f" ({number[experiment]} lines are excited, more than any experiment can hold: is the "
            f"input periodic over the last P = {data.periods} periods, and without noise above "
            "`threshold`?)"
        )

    check_sharing(lines.experiment, lines.line, data.periods, hint)
    return lines


def _one_phase(lines: _Lines, data: ExperimentData) -> Bool[np.ndarray, " K"]:
    """Lines on multiples of 1/2 that all experiments excite with the same phase (mod 180)."""
    key = lines.line * len(data.inputs) + lines.channel
    _, group = np.unique(key, return_inverse=True)
    S = np.bincount(group, np.abs(lines.U) ** 2)
    square = lines.U**2
    Q = np.hypot(np.bincount(group, square.real), np.bincount(group, square.imag))
    alike = Q > (1 - 1e-6) * S
    return needs_two_phases(lines.line, data.periods, data.sections) & alike[group]


def _complete(lines: _Lines, data: ExperimentData) -> Int[np.ndarray, " F"]:
    """The lines that were excited through every input."""
    pairs = np.unique(np.stack([lines.line, lines.channel]), axis=1)
    line, inputs = np.unique(pairs[0], return_counts=True)
    return line[inputs == len(data.inputs)]


def _solve(
    lines: _Lines,
    grid: Int[np.ndarray, " F"],
    data: ExperimentData,
    harmonics: Int[np.ndarray, " M"],
) -> Complex[np.ndarray, "M F ny nu"]:
    """Least squares for each frequency and input: `Y = H_l U + G conj(U)`, G = 0 off (1/2)Z."""
    P, nu, ny = data.periods, len(data.inputs), len(data.outputs)
    length = data.sections * P
    Y = np.fft.fft(data.y[:, data.window], axis=1)
    output = (lines.line[:, None] + P * harmonics) % length
    Y = Y[lines.experiment[:, None], output]  # (line, harmonic, output)

    # Normal equations, summed over the experiments that excite the same frequency and input.
    order = np.lexsort((lines.channel, lines.line))
    key = (lines.line * nu + lines.channel)[order]
    first = np.flatnonzero(np.diff(key, prepend=-1))

    def total(values):
        return np.add.reduceat(values[order], first)

    U = lines.U[:, None, None]
    mirrored = needs_two_phases(lines.line, P, data.sections)[:, None, None]
    S, Q = total(np.abs(U) ** 2), total(np.where(mirrored, U**2, 0))
    direct, mirror = total(U.conj() * Y), total(np.where(mirrored, U * Y, 0))
    H = (S * direct - Q.conj() * mirror) / (S**2 - np.abs(Q) ** 2)
    return H.reshape(len(grid), nu, len(harmonics), ny).transpose(2, 0, 3, 1)
