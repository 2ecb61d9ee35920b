"""What limit cycles and branches of them are made of."""

from .._core.moved import attach


__getattr__, __dir__, __all__ = attach(__name__, __file__)
