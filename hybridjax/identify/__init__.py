"""Estimates beyond the usual: fits, their bounds and errors, models from measured responses."""

from .._core.public import attach


__getattr__, __dir__, __all__ = attach(__name__, __file__)
