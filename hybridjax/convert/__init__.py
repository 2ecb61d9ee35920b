"""To the objects of other libraries, and back: xarray, pandas, python-control, scipy."""

from .._core.public import attach


__getattr__, __dir__, __all__ = attach(__name__, __file__)
