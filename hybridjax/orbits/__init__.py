"""Limit cycles, branches of them, trajectories, and responses to perturbations."""

from .._core.public import attach


__getattr__, __dir__, __all__ = attach(__name__, __file__)
