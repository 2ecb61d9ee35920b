"""Exceptions, result codes of computations, and findings about data and results."""

from .._names import attach


__getattr__, __dir__, __all__ = attach(__name__, __file__)
