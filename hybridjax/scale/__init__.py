"""Sweeps and Monte Carlo in chunks, on one machine or many, and what makes calls faster."""

from .._core.public import attach


__getattr__, __dir__, __all__ = attach(__name__, __file__)
