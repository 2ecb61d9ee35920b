"""Public names: where they are, and what became of earlier ones.

The `__init__.pyi` of a namespace lists its public names. Each is imported when it is first used
(PEP 562), and type checkers read the same list.
"""

import ast
import difflib
import functools
import importlib
import pathlib
from collections.abc import Callable
from typing import Any


_ROOT = pathlib.Path(__file__).parents[1]

# Names, arguments and attributes that became others before version 0.2, and those now.
_RENAMED: dict[str, str] = {}


def attach(package: str, file: str) -> tuple[Callable, Callable, list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a package whose public names are listed in its
    `__init__.pyi`."""
    homes = _homes(pathlib.Path(file).with_suffix(".pyi"))
    names = sorted(homes)

    def __getattr__(name: str) -> Any:
        home = homes.get(name)
        if home is None:
            # (With a `name` Python would suggest it again.)
            raise AttributeError(about_name(package, name, names), name="")
        module = importlib.import_module(home, package)
        is_namespace = home == f".{name}"
        return module if is_namespace else getattr(module, name)

    def __dir__() -> list[str]:
        return names

    return __getattr__, __dir__, names


def about_name(package: str, name: str, names: list[str]) -> str:
    """Return one line that leads from a name that a namespace does not have to the one that is
    meant."""
    asked = package.replace("hybridjax", "hj", 1) + f".{name}"
    place = _RENAMED.get(name, place_of(name))
    if place is not None:
        return f"{asked} is {place}"
    text = f"module {package!r} has no attribute {name!r}"
    for known in (names, list(places())):
        close = difflib.get_close_matches(name, known, n=1)
        if close:
            return f"{text}; did you mean {place_of(close[0])}?"
    return text


def place_of(name: str) -> str | None:
    """Return the place of a public name, such as `hj.plot.bode`; None if there is none."""
    return places().get(name)


@functools.cache
def places() -> dict[str, str]:
    """The place of each public name: the package's before those of its namespaces, and names of
    figures last."""
    stubs = [_ROOT / "__init__.pyi", *sorted(_ROOT.glob("*/__init__.pyi"))]
    stubs.sort(key=lambda stub: stub.parent.name == "plot")
    found: dict[str, str] = {}
    for stub in stubs:
        namespace = ".".join(["hj", *stub.parent.relative_to(_ROOT).parts])
        for name in _homes(stub):
            found.setdefault(name, f"{namespace}.{name}")
    return found


def renamed(owner: str, word: str) -> str | None:
    """Return what became of an argument of a function, or of an attribute of a class."""
    return _RENAMED.get(f"{owner}.{word}")


def _homes(stub: pathlib.Path) -> dict[str, str]:
    """The modules of the names in a stub, relative to its package."""
    homes = {}
    for statement in ast.parse(stub.read_text(encoding="utf-8")).body:
        if not isinstance(statement, ast.ImportFrom):
            continue
        package = "." * statement.level
        for alias in statement.names:
            homes[alias.name] = package + (statement.module or alias.name)
    return homes
