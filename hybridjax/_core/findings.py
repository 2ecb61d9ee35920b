"""`Finding`: a doubt about data, a fit or a cycle, named by its cause.

Recordings, fits, cycles and trajectories make findings and keep them in `findings`. `refuse` raises
an error of those that are "refused", `warn_of` warns (silently, see `exceptions.py`), and
`print_findings` makes a part of what results print. A new finding is made where it is found; its
`cause` must be the same for all of its type, as tables have it as a column.

If a finding is missing or wrong, search for its `cause`: the function that has these words looks
for it, and decides by the `action` whether data are refused. If a warning names the wrong line,
look at `frames_to_user` (`call.py`).
"""

import textwrap
import warnings
from collections.abc import Iterable, Sequence
from typing import Literal

import equinox as eqx

from .call import frames_to_user
from .exceptions import DefinitionError, FindingWarning


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
    action: Literal["refused", "left out", "warned"] = eqx.field(
        static=True, default="warned"
    )

    def __repr__(self) -> str:
        head = f"{self.cause[0].upper()}{self.cause[1:]}"
        if self.action != "warned":
            head += f" ({self.action})"
        return f"{head}: {self.text}"

    def __str__(self) -> str:
        return textwrap.fill(repr(self), 98, subsequent_indent="  ")


def refuse(findings: Iterable[Finding]) -> None:
    """**Raises:** `DefinitionError` with the first finding that makes a recording useless, and the
    texts of others, one of which may be the cause."""
    findings = list(findings)
    for finding in findings:
        if finding.action == "refused":
            also = listed([x.text for x in findings if x.action != "refused"])
            raise DefinitionError(finding.text + f" (Found, too: {also})" * bool(also))


def warn_of(findings: Iterable[Finding]) -> None:
    """Emit a `FindingWarning` for each finding, at the line of the user that called the public
    function."""
    for finding in findings:
        warnings.warn(repr(finding), FindingWarning, stacklevel=1 + frames_to_user())


def print_findings(findings: Iterable[Finding], indent: str = "") -> str:
    """Return the findings as text, wrapped at 100 columns."""
    return textwrap.indent("\n".join(map(str, findings)), indent)


def listed(texts: Sequence[str]) -> str:
    """Return the first three texts, and the number of further ones."""
    return "; ".join(texts[:3]) + (
        f"; and {len(texts) - 3} more" if len(texts) > 3 else ""
    )
