"""Experiments that estimate a quantity of interest in the fewest cycles."""

from .._core.public import attach


__getattr__, __dir__, __all__ = attach(__name__, __file__)
