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


ROOT = pathlib.Path(__file__).parent

# Earlier names of version 0.2, with their places now.
RENAMED: dict[str, str] = {}


def attach(package: str, file: str) -> tuple[Callable, Callable, list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a package whose public names are listed in its
    `__init__.pyi`."""
    homes = _homes(pathlib.Path(file).with_suffix(".pyi"))
    names = sorted(homes)

    def __getattr__(name: str) -> Any:
        home = homes.get(name)
        if home is None:
            # (With a `name` Python would suggest it again.)
            raise AttributeError(_elsewhere(package, name, names), name="")
        module = importlib.import_module(home, package)
        is_namespace = home == f".{name}"
        return module if is_namespace else getattr(module, name)

    def __dir__() -> list[str]:
        return names

    return __getattr__, __dir__, names


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


@functools.cache
def _places() -> dict[str, list[str]]:
    """Where each public name is: `hj.orbits.Settings`."""
    places: dict[str, list[str]] = {}
    for stub in [ROOT / "__init__.pyi", *sorted(ROOT.glob("*/__init__.pyi"))]:
        namespace = ".".join(["hj", *stub.parent.relative_to(ROOT).parts])
        for name in _homes(stub):
            places.setdefault(name, []).append(f"{namespace}.{name}")
    return places


def _elsewhere(package: str, name: str, names: list[str]) -> str:
    """One line that leads from a name that a namespace does not have to one that is there."""
    asked = package.replace("hybridjax", "hj", 1) + f".{name}"
    if name in RENAMED:
        return f"{asked} is {RENAMED[name]}"
    if name in _places():
        return f"{asked} is {' or '.join(_places()[name])}"
    text = f"module {package!r} has no attribute {name!r}"
    close = difflib.get_close_matches(name, names, n=1)
    if close:
        return f"{text}; did you mean {close[0]!r}?"
    close = difflib.get_close_matches(name, _places(), n=1)
    if close:
        return f"{text}; did you mean {_places()[close[0]][0]!r}?"
    return text
