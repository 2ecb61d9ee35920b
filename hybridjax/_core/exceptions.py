"""The exceptions that hybridjax raises. All derive from `HybridJaxError`."""

import warnings


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
