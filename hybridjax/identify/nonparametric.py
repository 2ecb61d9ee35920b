"""Harmonic transfer functions from measured inputs and outputs (Sec. V)."""

from collections.abc import Iterable, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Complex, Float, Int

from .._core.errors import DefinitionError
from .._core.precision import require_x64
from ..experiments.data import ExperimentData
from ..experiments.partition import needs_two_phases
from ..periodic.htf import HTF
from ..periodic.transfer import check_harmonics
from .sums import Sums, sums_of


def estimate_htf(
    data: ExperimentData | Iterable[ExperimentData],
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

    - `data`: the experiments; or parts of them one after the other, as `stream_experiments` and
      `StoredExperiments` give them, of which only sums over experiments are kept. With several
      inputs, a line is excited by one of them at a time.
    - `harmonics`: which ones; None means all N.
    - `half_integers`: what to do with a multiple of 1/2 measured with one phase only.
    - `threshold`: a line counts as excited above this part of the largest |U| of its experiment.
      Raise it where the recorded input is noisy.

    **Returns:** `HTF` with ascending frequencies, source "estimate".

    **Raises:** `DefinitionError` if nothing was excited or no experiment is left; if two lines
    of one experiment disturb each other (the message names the pair); for one phase only on a
    multiple of 1/2; or for parts that do not belong together.
    """
    if half_integers not in ("error", "skip"):
        raise DefinitionError(f"half_integers must be 'error' or 'skip', not {half_integers!r}.")
    require_x64()
    sums = sums_of(data, threshold, lambda sections: check_harmonics(harmonics, sections))
    unsolved = sums.one_phase(sums.tried)
    if unsolved.any() and half_integers == "error":
        f = sums.line[unsolved][0] / sums.about.periods
        raise DefinitionError(
            f"f = {f:.10g} lies on a multiple of 1/2 and was measured with one phase only: "
            "measure it in a second experiment with a phase 90 degrees apart "
            "(half_integers='two-phase' in the design does so), or leave it out here with "
            "half_integers='skip' and use HTF.interpolate."
        )
    grid = _complete(sums)
    if len(grid) == 0:
        raise DefinitionError(
            f"no frequency is left to estimate: {sums.summary}; a frequency must have been "
            f"measured from each of the {len(sums.about.inputs)} inputs."
        )
    about = sums.about
    return HTF(
        grid / about.periods,
        _solve(sums, grid),
        sums.harmonics,
        about.sections,
        about.inputs,
        about.outputs,
        "estimate",
    )


def missing_frequencies(
    data: ExperimentData | Iterable[ExperimentData], threshold: float = 1e-6
) -> Float[np.ndarray, " F"]:
    """Frequencies (cycles per period) that were excited but that `estimate_htf` has to leave out.

    Because their experiments failed, or not all inputs were applied at them, or because they lie
    on a multiple of 1/2 and one phase is all there is.
    """
    sums = sums_of(data, threshold, lambda sections: ())
    return np.setdiff1d(sums.line, _complete(sums)) / sums.about.periods


def _complete(sums: Sums) -> Int[np.ndarray, " F"]:
    """The lines that can be solved for every input."""
    good = (sums.ran.power > 0) & ~sums.one_phase(sums.ran)
    line, inputs = np.unique(sums.line[good], return_counts=True)
    return line[inputs == len(sums.about.inputs)]


def _solve(sums: Sums, grid: Int[np.ndarray, " F"]) -> Complex[np.ndarray, "M F ny nu"]:
    """Least squares for each frequency and input: `Y = H_l U + G conj(U)`, G = 0 off (1/2)Z."""
    here = np.isin(sums.line, grid)
    mirrored = needs_two_phases(sums.line[here], sums.about.periods, sums.about.sections)
    mirrored = mirrored[:, None, None]
    S = sums.ran.power[here][:, None, None]
    Q = np.where(mirrored, sums.ran.square[here][:, None, None], 0)
    direct, mirror = sums.direct[here], np.where(mirrored, sums.mirror[here], 0)
    H = (S * direct - Q.conj() * mirror) / (S**2 - np.abs(Q) ** 2)
    H = H.reshape(len(grid), len(sums.about.inputs), *H.shape[1:])
    return H.transpose(2, 0, 3, 1)
