import lazy_loader


# The public names stand in `__init__.pyi`; each is imported when it is first used (PEP 562).
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__version__ = "0.1.0"
