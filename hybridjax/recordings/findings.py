"""Parts that all findings about recordings share: the result of an inspection (`Inspection`), and
phrases for the places of samples.

Findings about signals are made in `inspection/`, those about estimates in `fit_warnings.py`: look
there if one is missed or needless. If the times in a finding are wrong, look at `places`. The
reason in `untried_orders` comes from `Split.compare_orders` (`held_out.py`), or in a loop from
`best_order` (`identify/series/in_loop.py`).
"""

from collections.abc import Iterable

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from .._core.findings import Finding, listed, print_findings
from .._core.showable import Showable
from .recording import Recording, Trial


# A deviation of this many standard deviations counts as certain. Larger: odd trials and weak
# responses pass. Smaller: chance is reported.
CLEAR = 4.0

NAME_REFERENCE = (
    "Are inputs and outputs swapped? If not, record a signal that acts on the loop from outside, "
    "and name it as the `references`."
)


class Inspection(Showable, eqx.Module):
    """The result of `check_recording`. Printing it shows the findings.

    **Fields:** `findings`; `recording`, in which samples that are left out are missing (NaN).
    """

    findings: tuple[Finding, ...] = eqx.field()
    recording: Recording

    def __repr__(self) -> str:
        return print_findings(self.findings) or "Nothing was found."


def untried_orders(order: int, obstacle: str) -> list[Finding]:
    """Return a finding if an obstacle was met to trying larger orders than the chosen one."""
    if not obstacle:
        return []
    return [
        Finding("order", f"orders above {order} could not be tried, since {obstacle}")
    ]


def places(trials: Iterable[Trial], bad: Iterable[Bool[np.ndarray, " _"]]) -> str:
    """Return the places of samples: `trial 'b', 3.10-3.42 s; and 4 more`."""
    texts = []
    for trial, rows in zip(trials, bad, strict=True):
        edges = np.flatnonzero(np.diff(rows.astype(int), prepend=0, append=0))
        for first, end in edges.reshape(-1, 2):
            texts.append(place(trial.name, trial.time[first:end]))
    return listed(texts)


def place(trial: str, time: Float[np.ndarray, " n"]) -> str:
    return f"trial '{trial}', {time[0]:.2f}-{time[-1]:.2f} s"
