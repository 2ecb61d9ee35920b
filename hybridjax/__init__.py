from ._core.public import attach


# The public names stand in `__init__.pyi`; each is imported when it is first used (PEP 562).
__getattr__, __dir__, __all__ = attach(__name__, __file__)

__version__ = "0.2.0.dev0"
