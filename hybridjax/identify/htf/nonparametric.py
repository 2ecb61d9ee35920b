"""Harmonic transfer functions from measured inputs and outputs (Sec. V)."""

import functools
from typing import Literal

import numpy as np
from jaxtyping import Float

from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Count, Index, Probability
from ..._core.precision import require_x64
from ...errors import DefinitionError
from ...linear.frequency_response import Harmonics, check_harmonics
from ...linear.htf import HTF
from .least_squares import solve_lines
from .spectral_sums import Experiments, SumOptions, spectral_sums


@checked
def estimate_htf(
    data: Experiments,
    harmonics: Harmonics | None = None,
    *,
    repeats: Count = 1,
    variance: Literal["auto", "noise", "total"] = "auto",
    highest: Index | None = None,
    half_integers: Literal["error", "skip"] = "error",
    threshold: Probability = 1e-6,
) -> HTF:
    """Estimate all harmonic transfer functions at all frequencies that the inputs excite.

    `H_l(w_k) = Y[k + l P] / U[k]`, both DFTs over the same window of the last P whole periods.
    The excited lines k are found from U itself, so any experiments will do, not only those of
    a `Design`, if they obey its rules. Where a frequency was measured more than once the
    estimate is the least-squares one. On multiples of 1/2 (other than 0 and N/2) the line meets
    its own mirror image, `Y[k + l P] = H_l(w) U[k] + H_{l + 2f}(-w) conj(U[k])`, which is solved
    for both unknowns from two or more experiments with different phases. Inputs that excite one
    line together are told apart by as many experiments. Failed experiments are left out
    (`missing_frequencies` says what is lost by that), and with several inputs only frequencies
    that were measured from each of them are kept.

    The estimate is of the best linear approximation for signals of the kind that was applied
    (Pintelon and Schoukens 2012, ch. 3): its `variance` says how well it is known. Frequencies that
    were measured in several realizations of random phases scatter by noise and by nonlinear
    distortion together; with `repeats` the scatter between windows is that of noise alone, the
    `noise_variance`. With realizations missing, `variance` itself is that of noise alone.

    **Arguments:**

    - `data`: the experiments; or parts of them one after the other, as `stream_experiments` and
      `StoredExperiments` give them, of which only sums over experiments are kept.
    - `harmonics`: which ones; None means all N (with `highest`, all up to it).
    - `repeats`: how many of the last windows of P periods are averaged.
    - `variance`: "auto" is what the experiments allow; "noise", from the repeats alone, and
      "total", from realizations, are errors where they cannot be had.
    - `highest`: harmonics beyond this one are taken as zero, as in designs with few experiments
      (`multisine(highest_harmonic=...)`).
    - `half_integers`: what to do with a multiple of 1/2 measured with one phase only.
    - `threshold`: a line counts as excited above this part of the largest |U| of its experiment.
      Raise it where the recorded input is noisy.

    **Returns:** `HTF` with ascending frequencies, source "estimate". Its `variance` is infinite
    where failed experiments have left one realization.

    **Raises:** `DefinitionError` if nothing was excited or no experiment is left; if two lines
    of one experiment disturb each other (the message names the pair); for one phase only on a
    multiple of 1/2; for too few periods or realizations for the variance asked; or for parts that
    do not belong together.
    """
    if variance == "noise" and repeats < 2:
        raise DefinitionError(
            "the variance of noise alone needs two windows or more: record P periods more, and "
            "say repeats=2."
        )
    require_x64()
    choose = functools.partial(choose_harmonics, harmonics, highest)
    sums = spectral_sums(data, SumOptions(choose, threshold, highest, repeats))
    unsolved = sums.one_phase(sums.tried)
    if unsolved.any() and half_integers == "error":
        f = sums.line[unsolved][0] / sums.setup.periods
        raise DefinitionError(
            f"f = {f:.10g} lies on a multiple of 1/2 and was measured with one phase only: "
            "measure it in a second experiment with a phase 90 degrees apart "
            "(multisine(lines='two-phase') does so), or leave it out here with "
            "half_integers='skip' and use HTF.interpolate."
        )
    rows = np.flatnonzero(sums.solvable(sums.ran))
    if len(rows) == 0:
        raise DefinitionError(
            f"no frequency is left to estimate: {sums.summary}; a frequency must have been "
            f"measured from each of the {len(sums.setup.inputs)} inputs."
        )
    found = solve_lines(sums, rows)
    if variance == "noise":
        found = found.of_noise()
    elif variance == "total":
        found.require_total(sums.line[rows] / sums.setup.periods)
    setup = sums.setup
    return HTF(
        sums.line[rows] / setup.periods,
        found.H,
        sums.harmonics,
        setup.n_sections,
        setup.inputs,
        setup.outputs,
        "estimate",
        variance=found.variance,
        noise_variance=found.noise_variance,
        scatter=found.scatter,
    )


@checked
def missing_frequencies(
    data: Experiments,
    threshold: Probability = 1e-6,
    *,
    highest: Index | None = None,
) -> Float[np.ndarray, " F"]:
    """Frequencies (cycles per period) that were excited but that `estimate_htf` has to leave out.

    Because their experiments failed, or not all inputs were applied at them, or because they lie
    on a multiple of 1/2 and one phase is all there is. `highest` as for `estimate_htf`.
    """
    sums = spectral_sums(data, SumOptions(lambda n_sections: (), threshold, highest))
    return sums.line[~sums.solvable(sums.ran)] / sums.setup.periods


def choose_harmonics(
    harmonics: Harmonics | None, highest: int | None, n_sections: int
) -> tuple[int, ...]:
    """The harmonics to estimate: those asked for, or all up to `highest`."""
    if highest is None:
        return check_harmonics(harmonics, n_sections)
    known = check_harmonics(None, n_sections)
    if harmonics is None:
        return tuple(m for m in known if abs(m) <= highest)
    chosen = check_harmonics(harmonics, n_sections)
    if max(map(abs, chosen)) > highest:
        raise DefinitionError(
            f"harmonics beyond highest = {highest} are taken as zero, so {chosen} cannot all be "
            "estimated."
        )
    return chosen
