"""Figures of results. Every function takes result objects and returns Axes or a Figure."""

from .._core.public import attach


__getattr__, __dir__, __all__ = attach(__name__, __file__)
