"""Exceptions, result codes of computations, and findings about data and results."""

from .._core.public import attach


__getattr__, __dir__, __all__ = attach(__name__, __file__)
