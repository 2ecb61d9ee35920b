"""Families of Poincaré sections; subclass `AbstractSections` to add one."""

from .._core.public import attach


__getattr__, __dir__, __all__ = attach(__name__, __file__)
