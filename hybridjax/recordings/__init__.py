"""Measured data: phase, section data, advice, designs for hardware."""

from .._names import attach


__getattr__, __dir__, __all__ = attach(__name__, __file__)
