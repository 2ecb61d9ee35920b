"""To the objects of other libraries, and back: xarray, pandas, python-control, scipy."""

import lazy_loader


__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
