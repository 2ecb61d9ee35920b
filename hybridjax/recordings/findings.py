"""`Finding`: a warning about data, by its cause.

Findings about signals are made in `inspection/`, those about estimates in `fit_warnings.py`.
"""

import textwrap
import warnings
from collections.abc import Iterable, Sequence
from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ..errors import DefinitionError, FindingWarning
from .recording import Recording, Trial


# Standard deviations that count as certain. Larger: odd trials and weak responses pass. Smaller:
# chance is reported.
CLEAR = 4.0

NAME_REFERENCE = (
    "Are inputs and outputs swapped? If not, record a signal that acts on the loop from outside, "
    "and name it as the `reference`."
)


class Finding(eqx.Module):
    """A property of data, or of a fit to them, that makes a result worth less than it seems.

    **Fields:**

    - `cause`: a few words, the same for each finding of its type.
    - `text`: what was found and where, and a remedy.
    - `action`: "refused" for data that cannot be used as they are; "left out" for samples or trials
      that are treated as missing; "warned" for all others.
    """

    cause: str = eqx.field(static=True)
    text: str = eqx.field(static=True)
    action: Literal["refused", "left out", "warned"] = eqx.field(static=True, default="warned")

    def __repr__(self) -> str:
        action = "" if self.action == "warned" else f" ({self.action})"
        return f"{self.cause[0].upper()}{self.cause[1:]}{action}: {self.text}"

    def __str__(self) -> str:
        return textwrap.fill(repr(self), 98, subsequent_indent="  ")


class Inspection(eqx.Module):
    """The result of `inspect`. Printing it shows the findings.

    **Fields:** `findings`; `recording`, in which samples that are left out are missing (NaN).
    """

    findings: tuple[Finding, ...]
    recording: Recording

    def __repr__(self) -> str:
        return print_findings(self.findings) or "Nothing was found."


def refuse(findings: Iterable[Finding]) -> None:
    """**Raises:** `DefinitionError` with the first finding that makes a recording useless, and the
    texts of others, one of which may be the cause."""
    findings = list(findings)
    for finding in findings:
        if finding.action == "refused":
            also = listed([x.text for x in findings if x.action != "refused"])
            raise DefinitionError(finding.text + f" (Found, too: {also})" * bool(also))


def warn_of(findings: Iterable[Finding]) -> None:
    """Emit a `FindingWarning` for each finding."""
    for finding in findings:
        warnings.warn(repr(finding), FindingWarning, stacklevel=4)


def untried_orders(order: int, obstacle: str) -> list[Finding]:
    """Return a finding if an obstacle was met to trying larger orders than the chosen one."""
    text = f"orders above {order} could not be tried, since {obstacle}"
    return [Finding("order", text)] * bool(obstacle)


def print_findings(findings: Iterable[Finding], indent: str = "") -> str:
    """Return the findings as text, wrapped at 100 columns."""
    return textwrap.indent("\n".join(map(str, findings)), indent)


def places(trials: Iterable[Trial], bad: Iterable[Bool[np.ndarray, " _"]]) -> str:
    """Return the places of samples: `trial 'b', 3.10-3.42 s; and 4 more`."""
    texts = []
    for trial, rows in zip(trials, bad, strict=True):
        edges = np.flatnonzero(np.diff(rows.astype(int), prepend=0, append=0))
        texts += [place(trial.name, trial.time[a:b]) for a, b in edges.reshape(-1, 2)]
    return listed(texts)


def place(trial: str, time: Float[np.ndarray, " n"]) -> str:
    return f"trial '{trial}', {time[0]:.2f}-{time[-1]:.2f} s"


def listed(texts: Sequence[str]) -> str:
    """Return the first three texts, and the number of further ones."""
    return "; ".join(texts[:3]) + (f"; and {len(texts) - 3} more" if len(texts) > 3 else "")
