"""Public names by their tables, imported when they are first used."""

import ast
import difflib
import functools
import importlib
import pathlib
import sys
import types
from collections.abc import Callable
from typing import Any

import lazy_loader


_ROOT = pathlib.Path(__file__).parents[1]


class Namespace(types.ModuleType):
    """A module that says what to call, if it is called itself."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        raise TypeError(_leads().about_called(self.__name__))


def _leads() -> Any:
    """Return the tables of errors. (Where names are right, they are not imported.)"""
    return importlib.import_module(".boundary.leads", __package__)


def attach(package: str, file: str) -> tuple[Callable, Callable, list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a package whose public names are listed in its
    `__init__.pyi`. Each name is imported when it is first used (PEP 562)."""
    find, listed, names = lazy_loader.attach_stub(package, file)
    sys.modules[package].__class__ = Namespace

    def __getattr__(name: str):
        try:
            return find(name)
        except AttributeError as error:
            # (With a `name` Python would suggest it again.)
            text = about_name(package, name, names)
            raise AttributeError(text, name="") from error

    return __getattr__, listed, names


def about_name(package: str, name: str, names: list[str]) -> str:
    """Return the sentence about a name that a module has not: where it is, or which is meant."""
    head = f"module {package!r} has no attribute {name!r}"
    leads = _leads()
    lead = leads.about_name(package, name)
    if lead is not None:
        return f"{head}: {lead}"
    place = place_of(name)
    if place is not None:
        return f"{head}: it is `{place}`"
    close = difflib.get_close_matches(name, names, n=1)
    if close:
        return f"{head}; did you mean {close[0]!r}?"
    elsewhere = difflib.get_close_matches(name, places(), n=1)
    if elsewhere:
        return f"{head}; did you mean `{place_of(elsewhere[0])}`?"
    lead = leads.about_namespace(package)
    return f"{head}: {lead}" if lead else head


def place_of(name: str) -> str | None:
    """Return the place of a public name, such as `hj.plot.bode`; None if there is none."""
    return places().get(name)


@functools.cache
def places() -> dict[str, str]:
    """The place of each public name: the package's before those of its namespaces."""
    found: dict[str, str] = {}
    for stub in sorted(_ROOT.glob("**/__init__.pyi"), key=lambda file: len(file.parts)):
        parts = stub.parent.relative_to(_ROOT).parts
        for statement in ast.parse(stub.read_text()).body:
            if isinstance(statement, ast.ImportFrom):
                for alias in statement.names:
                    name = alias.asname or alias.name
                    found.setdefault(name, ".".join(("hj", *parts, name)))
    return found
