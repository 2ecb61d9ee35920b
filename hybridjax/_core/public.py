"""Public names by their tables, imported when they are first used."""

import ast
import difflib
import functools
import importlib
import pathlib
from collections.abc import Callable

import lazy_loader


_ROOT = pathlib.Path(__file__).parents[1]


def attach(package: str, file: str) -> tuple[Callable, Callable, list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a package whose public names are listed in its
    `__init__.pyi`. Each name is imported when it is first used (PEP 562)."""
    find, listed, names = lazy_loader.attach_stub(package, file)

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
    place = place_of(name)
    if place is not None:
        return f"{head}: it is `{place}`"
    # (The table is not needed, and not imported, where names are right.)
    leads = importlib.import_module(".boundary.leads", __package__)
    call = leads.NAMES.get(name)
    if call is not None:
        return f"{head}: use `{call}`"
    close = difflib.get_close_matches(name, names, n=1)
    if close:
        return f"{head}; did you mean {close[0]!r}?"
    elsewhere = difflib.get_close_matches(name, places(), n=1)
    if elsewhere:
        return f"{head}; did you mean `{place_of(elsewhere[0])}`?"
    return head


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
