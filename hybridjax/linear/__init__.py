"""Periodic linear systems between sections, and their harmonic transfer functions."""

from .._core.public import attach


__getattr__, __dir__, __all__ = attach(__name__, __file__)
