"""What a family of Poincaré sections is; subclass `AbstractSections` for another one."""

import lazy_loader


__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
