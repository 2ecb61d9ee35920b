"""How much of the output a linear periodic system explains."""

import functools

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Count, Index, Probability
from ..._core.precision import require_x64
from ...errors import DefinitionError
from ...linear.frequency_response import Harmonics
from .least_squares import solve_lines
from .nonparametric import choose_harmonics
from .spectral_sums import Experiments, SumOptions, spectral_sums


class Coherence(eqx.Module):
    """The part of the output's power that harmonic transfer functions explain.

    **Fields:**

    - `f` (F,): input frequencies. `harmonics`: m of the first axis. `outputs`: names.
    - `values` (M, F, ny): for the output line f + m, between 0 and 1. All of 1 but noise and
      distortion, however much the other harmonics take: no other input line answers there.
    - `total` (ny,): over all of these lines together, weighted by their power.
    """

    f: Float[np.ndarray, " F"]
    values: Float[np.ndarray, "M F ny"]
    total: Float[np.ndarray, " ny"]
    harmonics: tuple[int, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)


@checked
def estimate_coherence(
    data: Experiments,
    harmonics: Harmonics | None = None,
    *,
    repeats: Count = 1,
    highest: Index | None = None,
    threshold: Probability = 1e-6,
) -> Coherence:
    """The coherence of inputs with the outputs that they cause at shifted frequencies.

    The usual coherence compares U and Y at the same frequency, and falls short of 1 for a periodic
    system without any noise, since power goes to f + m. Here each output line is compared with the
    one input line that leads to it (several inputs together, if they excite it together), over all
    realizations; the degrees of freedom of the fit are taken into account.

    **Arguments:** as for `estimate_htf`.

    **Raises:** `DefinitionError` as `estimate_htf`, and for lines measured in one realization only.
    """
    require_x64()
    choose = functools.partial(choose_harmonics, harmonics, highest)
    sums = spectral_sums(data, SumOptions(choose, threshold, highest, repeats))
    rows = np.flatnonzero(sums.solvable(sums.ran))
    found = solve_lines(sums, rows)
    seen = found.realizations > 0
    if not seen.any():
        raise DefinitionError(
            "no line was measured in several realizations, without which everything is explained: "
            "apply more of them (`Design.realizations`)."
        )
    power = sums.energy[rows][seen].transpose(1, 0, 2)
    values = found.coherence[:, seen]
    total = np.sum(values * power, axis=(0, 1)) / np.sum(power, axis=(0, 1))
    f = sums.line[rows][seen] / sums.setup.periods
    return Coherence(f, values, total, sums.harmonics, sums.setup.outputs)
