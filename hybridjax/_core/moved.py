"""Public names by their tables, and one line for names that are gone or have a new name."""

import difflib
import pathlib
from collections.abc import Callable, Iterable

import lazy_loader


def attach(package: str, file: str) -> tuple[Callable, Callable, list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a package whose public names are listed in its
    `__init__.pyi`, if it has one. Each name is imported when it is first used (PEP 562)."""
    find: Callable | None = None
    listed: Callable = lambda: []  # noqa: E731
    names: list[str] = []
    if pathlib.Path(file).with_suffix(".pyi").exists():
        find, listed, names = lazy_loader.attach_stub(package, file)
    prefix = package.removeprefix("hybridjax").removeprefix(".")

    def __getattr__(name: str):
        try:
            if find is None:
                raise AttributeError
            return find(name)
        except AttributeError as error:
            raise AttributeError(_message(package, prefix, name, listed())) from error

    return __getattr__, listed, names


def _message(package: str, prefix: str, name: str, names: Iterable[str]) -> str:
    """The line of `moved.txt` for this name, or for all names of a namespace that is gone, or the
    public name that is spelled most like it."""
    old = f"{prefix}.{name}".removeprefix(".")
    table = (pathlib.Path(__file__).with_name("moved.txt")).read_text().splitlines()
    rows = (row.partition(" -> ") for row in table if " -> " in row)
    moved = {key: new for keys, _, new in rows for key in keys.split(", ")}
    if old in moved:
        return f"hj.{old} is gone or has a new name: {moved[old]}."
    inside = [f"{key}: {new}" for key, new in moved.items() if key.startswith(f"{old}.")]
    if inside:
        return f"the namespace hj.{old} is gone: {'; '.join(inside)}."
    close = difflib.get_close_matches(name, names, n=1)
    suggestion = f"; did you mean {close[0]!r}?" if close else ""
    return f"module {package!r} has no attribute {name!r}{suggestion}"
