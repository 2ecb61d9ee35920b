"""Families of Poincaré sections; subclass `AbstractSections` to add one."""

from .._names import attach


__getattr__, __dir__, __all__ = attach(__name__, __file__)
