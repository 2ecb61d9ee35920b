"""Whether experiments speak against supposed harmonic transfer functions."""

import numpy as np
from jaxtyping import Float

from ..._core.arguments import require_same
from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Count, Index, Probability
from ..._core.precision import require_x64
from ...errors import DefinitionError
from ...linear.htf import HTF
from .least_squares import solve_lines
from .spectral_sums import Experiments, SumOptions, spectral_sums


# Distance in lines up to which two frequencies are the same. Doubled: none but rounding.
_SAME_LINE = 1e-6


@checked
def htf_p_values(
    data: Experiments,
    true: HTF,
    *,
    repeats: Count = 1,
    highest: Index | None = None,
    threshold: Probability = 1e-6,
) -> Float[np.ndarray, "M F ny nu"]:
    r"""How likely errors as large as these are, if the HTFs are the ones supposed.

    Values with p-values above 5 % are a confidence region of 95 %. It holds for errors of any
    distribution, if they are independent from one realization to the next and prefer no phase.
    Discs (`HTF.confidence_radius`) are exact for normal errors only, and those of two realizations
    too small for errors of constant size, as a single product of two cosines makes them. From four
    realizations on the region is about as large as the disc; of two it is much wider.

    **Arguments:** `data`: experiments with 2 to 16 realizations of random phases. `true`: e.g. of a
    model, at any of their frequencies. Others as for `estimate_htf`.

    **Raises:** `DefinitionError` if the two do not fit together, for a frequency that was not
    measured in several realizations or in more than 16, and for inputs that share an experiment.
    """
    require_x64()
    sums = spectral_sums(data, SumOptions(lambda N: true.harmonics, threshold, highest, repeats))
    require_same("experiments and HTFs", sums.setup, true)
    rows = np.flatnonzero(sums.solvable(sums.ran))
    apart = np.abs(np.asarray(true.f)[:, None] * sums.setup.periods - sums.line[rows])
    if not len(rows) or (apart.min(axis=1) > _SAME_LINE).any():
        f = np.asarray(true.f)[np.argmax(apart.min(axis=1, initial=np.inf))]
        raise DefinitionError(f"f = {f:.10g} was not excited or not measured.")
    rows = rows[apart.argmin(axis=1)]
    found = solve_lines(sums, rows)
    found.require_total(sums.line[rows] / sums.setup.periods)
    if found.single is None:
        raise DefinitionError(
            "p-values need at most 16 realizations, each input in experiments of its own, and no "
            "multiples of 1/2: with more realizations take `HTF.confidence_radius`."
        )
    return found.single.p_values(np.asarray(true.H))
