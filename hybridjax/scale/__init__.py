"""Sweeps and Monte Carlo in pieces, on one machine or many, with results as labeled arrays."""

from .._core.moved import attach


__getattr__, __dir__, __all__ = attach(__name__, __file__)
