"""Libraries that are installed only where they are wanted."""

import importlib
from types import ModuleType

from ..errors import DefinitionError


def package(name: str) -> ModuleType:
    """A library.

    **Raises:** `DefinitionError` if it is not installed; extras are called like the libraries.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        extra = _EXTRAS.get(name, name)
        raise DefinitionError(
            f"this needs the package {name}, which is not installed: "
            f"`pip install 'hybridjax[{extra}]'`."
        ) from error


# The extra of a library that is not called like it.
_EXTRAS = {"pandas": "tables", "distributed": "scale", "zarr": "scale"}
