"""Data whose truth is known: simulated recordings, their dirt, a made-up periodic system."""

from .._core.public import attach


__getattr__, __dir__, __all__ = attach(__name__, __file__)
