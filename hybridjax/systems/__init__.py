"""What hybrid systems are made of: parameters, solvers, symmetries, sliding, mechanisms."""

from .._core.public import attach


__getattr__, __dir__, __all__ = attach(__name__, __file__)
