"""Figures of results. Every function takes result objects and returns Axes or a Figure."""

import lazy_loader


__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
