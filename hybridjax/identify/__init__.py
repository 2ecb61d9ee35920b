"""Estimates beyond the usual: fits, their bounds and errors, models from measured responses."""

import lazy_loader


__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
