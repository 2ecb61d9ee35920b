"""Experiments beyond the usual: designs, noise, streams and stores, steady starts."""

from .._names import attach


__getattr__, __dir__, __all__ = attach(__name__, __file__)
