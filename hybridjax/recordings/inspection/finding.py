"""What an inspection finds, and where."""

from collections.abc import Iterable, Sequence
from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from ..recording import Recording, Trial


# Places that are named one by one. Doubled: longer sentences.
_FEW = 3


class Finding(eqx.Module):
    """Something about a recording that makes it worth less than it seems.

    **Fields:**

    - `cause`: in a few words, the same for each finding of its kind.
    - `action`: "refused", what cannot be used as it is; "left out", samples or trials that are
      treated as missing; "warned".
    - `text`: what was found and where, and what to do.
    """

    cause: str = eqx.field(static=True)
    action: Literal["refused", "left out", "warned"] = eqx.field(static=True)
    text: str = eqx.field(static=True)

    def __repr__(self) -> str:
        return f"{self.cause[0].upper()}{self.cause[1:]} ({self.action}): {self.text}"


class Inspection(eqx.Module):
    """What `inspect` found. Printing it shows the findings.

    **Fields:** `findings`; `recording`, in which what is left out is missing (NaN).
    """

    findings: tuple[Finding, ...]
    recording: Recording

    def __repr__(self) -> str:
        return "\n".join(map(repr, self.findings)) or "Nothing was found."


def places(trials: Iterable[Trial], bad: Iterable[Bool[np.ndarray, " _"]]) -> str:
    """Where samples are: `trial 'b', 3.10-3.42 s; and 4 more`."""
    found = []
    for trial, rows in zip(trials, bad, strict=True):
        edges = np.flatnonzero(np.diff(rows.astype(int), prepend=0, append=0))
        for a, b in edges.reshape(-1, 2):
            found.append(f"trial '{trial.name}', {trial.time[a]:.2f}-{trial.time[b - 1]:.2f} s")
    return listed(found)


def listed(found: Sequence[str]) -> str:
    """The first few places, and how many more there are."""
    more = f"; and {len(found) - _FEW} more" if len(found) > _FEW else ""
    return "; ".join(found[:_FEW]) + more


def runs(x: Float[np.ndarray, " n"]) -> tuple[Int[np.ndarray, " r"], Int[np.ndarray, " r"]]:
    """First samples, and lengths, of the runs of equal values; each NaN is a run of its own."""
    first = np.flatnonzero(np.concatenate([[True], x[1:] != x[:-1]]))
    return first, np.diff(np.append(first, len(x)))
