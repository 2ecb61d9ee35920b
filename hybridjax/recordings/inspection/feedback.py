"""Whether an input is made from the rhythm: feedback, or learning, in the loop."""

import numpy as np

from ..data import SectionData
from .finding import Finding


# Share of an input's variance over the cycle that is the same in all cycles, from which on it is
# said to follow the rhythm. Doubled: never.
_REPEATS = 0.5
# Cycles from which that can be told: of an input that knows nothing of the rhythm, one part in so
# many repeats by chance. Doubled: nothing is said of short recordings.
_FEWEST = 6


def feedback(data: SectionData) -> list[Finding]:
    """Inputs that repeat with the rhythm, whatever its period is.

    What was chosen without regard to the rhythm averages out over many cycles. An input whose
    average cycle holds most of its variance was made from the rhythm's phase or state, by a
    controller or a trigger: its deviations then depend on those of the outputs, and on what
    disturbed them, and no regression on it is free of bias (Söderström and Stoica, *System
    Identification*, 1989, ch. 10: direct identification in closed loop).
    """
    found = []
    if data.cycles < _FEWEST:
        return found
    deviations, _ = data.rms()
    for i, name in enumerate(data.inputs):
        repeated = float(np.nanvar(data.cycle_inputs[:, i]))
        share = repeated / max(repeated + float(deviations[i]) ** 2, np.finfo(float).tiny)
        if share > _REPEATS:
            text = (
                f"{100 * share:.0f} % of the variance of {name} repeats with the cycle, of an "
                f"input that knows nothing of it {100 / data.cycles:.2g} % would: it is not "
                "exogenous, but feedback, learning or a trigger. Fits take it as given, and "
                "intervals do not know of the bias: add a known perturbation to it, and name that "
                "as the input."
            )
            found.append(Finding("feedback", "warned", text))
    return found
