"""What hybrid systems are made of: parameters, solvers, symmetries, sliding, mechanisms."""

from .._names import attach


__getattr__, __dir__, __all__ = attach(__name__, __file__)
