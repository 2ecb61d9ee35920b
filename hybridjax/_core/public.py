"""Public names by their tables, imported when they are first used."""

import difflib
from collections.abc import Callable

import lazy_loader


def attach(package: str, file: str) -> tuple[Callable, Callable, list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a package whose public names are listed in its
    `__init__.pyi`. Each name is imported when it is first used (PEP 562)."""
    find, listed, names = lazy_loader.attach_stub(package, file)

    def __getattr__(name: str):
        try:
            return find(name)
        except AttributeError as error:
            close = difflib.get_close_matches(name, names, n=1)
            text = f"module {package!r} has no attribute {name!r}"
            if close:
                text += f"; did you mean {close[0]!r}?"
            # (With a `name` Python would suggest it again.)
            raise AttributeError(text, name="") from error

    return __getattr__, listed, names
