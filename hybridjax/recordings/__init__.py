"""Measured data: phase, section data, diagnosis, designs for hardware."""

from .._core.public import attach


__getattr__, __dir__, __all__ = attach(__name__, __file__)
