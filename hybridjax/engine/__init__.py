"""The engine: flow of many lanes through events, its records and its derivatives."""

from .._core.moved import attach


__getattr__, __dir__, __all__ = attach(__name__, __file__)
