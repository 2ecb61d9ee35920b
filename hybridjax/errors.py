"""The exceptions that hybridjax raises. All derive from `HybridJaxError`."""


class HybridJaxError(Exception):
    """Base class of every error raised by hybridjax on purpose."""


class PrecisionError(HybridJaxError, TypeError):
    """The computation would run in single precision."""


class DefinitionError(HybridJaxError, ValueError):
    """A system, section family, design or other argument is not well formed."""


class ComputationError(HybridJaxError, RuntimeError):
    """A numerical computation failed: no convergence, a missed section, grazing, Zeno, ..."""


class FileFormatError(HybridJaxError, ValueError):
    """A file is damaged, foreign, or of a version that this one cannot read."""
