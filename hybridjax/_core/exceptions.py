"""The exceptions that hybridjax raises. All derive from `HybridJaxError`.

Each kind is also an error of Python of its meaning (`ValueError`, `RuntimeError`, ...), and the
public ones belong to the module `hybridjax.errors`; both must stay, as users catch them by these
names. A new public one is also a line in `errors/__init__.pyi`.

`DefinitionError` is for what a user has given, `ComputationError` for what was computed from it. If
the wrong one is raised, look where it is raised. If a `FindingWarning` is not seen, it is the
filter here, which is silent by default; if the sentence of an `UnknownAttribute` is wrong, look at
`boundary/leads.py`.
"""

import warnings
from collections.abc import Callable
from typing import Any


class FindingWarning(UserWarning):
    """A finding about data or a fit, which results print too.

    It is silent by default. A pipeline stops at the first one after
    `warnings.simplefilter("error", hybridjax.errors.FindingWarning)`.
    """

    __module__ = "hybridjax.errors"


# With the lowest priority, so that every filter of a user comes first.
warnings.simplefilter("ignore", FindingWarning, append=True)


class HybridJaxError(Exception):
    """Base class of every error raised by hybridjax on purpose."""

    __module__ = "hybridjax.errors"


class PrecisionError(HybridJaxError, TypeError):
    """The computation would run in single precision."""

    __module__ = "hybridjax.errors"


class DefinitionError(HybridJaxError, ValueError):
    """A system, section family, design or other argument is not well formed."""

    __module__ = "hybridjax.errors"


class ComputationError(HybridJaxError, RuntimeError):
    """A numerical computation failed: no convergence, a missed section, grazing, Zeno, ..."""

    __module__ = "hybridjax.errors"


class FileFormatError(HybridJaxError, ValueError):
    """A file is damaged, foreign, or of a version that this one cannot read."""

    __module__ = "hybridjax.errors"


class UnknownAttribute(HybridJaxError, AttributeError):
    """An attribute that an object, or a name that a namespace, has not. The sentence is composed
    when it is read: JAX and Python ask for many attributes that are not there."""

    def __init__(self, about: Callable[[], str]):
        # (With a `name` Python would suggest one again.)
        super().__init__(name="")
        self._about = about

    def __str__(self) -> str:
        return self._about()

    def __reduce__(self) -> Any:
        # (Processes hand on the sentence: the class may not exist elsewhere.)
        return AttributeError, (str(self),)
