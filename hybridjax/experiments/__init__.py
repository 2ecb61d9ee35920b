"""Experiments beyond the usual: designs, noise, streams and stores, steady starts."""

from .._core.public import attach


__getattr__, __dir__, __all__ = attach(__name__, __file__)
