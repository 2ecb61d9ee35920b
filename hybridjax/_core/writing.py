"""Files and folders that appear complete or not at all, and folders of results.

Archives, figures and tables call `replacing` for single files, which replaces whatever file has the
name. Commands and reports call `results_folder`. A folder of results has a list
`.hybridjax-KIND.json` with the names of all results. Only a file that is on the list may be
replaced or removed there, and nothing is written through a link: users keep files of their own in
these folders. The order in `_put` must stay: the list has a file before it is moved into the
folder, and until it is removed, so that the next call can go on after an interruption.

If a folder is refused without need, look at `_refuse_others` and `_is_direct`; if results of an
earlier call are left, at the list (`_listed`, `_put`); if a name is refused, at `_refuse_link`.
"""

import contextlib
import json
import os
import shutil
import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Literal

from . import limits
from .exceptions import DefinitionError


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A name in the folder of `path`, for a file that takes the place of `path` at the end.

    **Raises:** `DefinitionError` if the file cannot be written, or `path` is a link or a pipe.
    """
    _refuse_link(path)
    temporary = path.parent / temporary_name()
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise DefinitionError(
            f"cannot write '{path}': {error.strerror or error}."
        ) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def _refuse_link(path: Path) -> None:
    try:
        special = path.exists() and not (path.is_file() or path.is_dir())
    except OSError as error:  # (a name that no file can have)
        raise DefinitionError(f"cannot write '{path}': {error.strerror}.") from error
    if path.is_symlink() or special:
        raise DefinitionError(
            f"'{path}' is a link or a device: choose another name, since nothing is written there."
        )


def temporary_name() -> str:
    return f".hybridjax-{uuid.uuid4().hex[:12]}"


Format = Literal["png", "pdf", "svg"]


@contextlib.contextmanager
def results_folder(folder: Path, kind: str, names: Iterable[str]) -> Iterator[Path]:
    """A new folder for results of this kind, which are moved to `folder` when all are there.

    Results of the same kind that are there already are replaced or removed. After an error `folder`
    is as it was before: folders that were made for it are removed.

    **Arguments:** `names`: of results to come, with slashes, so that a refusal comes early.

    **Raises:** `DefinitionError` if `folder` cannot be written, or holds a file of one of the names
    of the results that is a link, or not on the list.
    """
    _refuse_link(folder)
    made = [path for path in (folder, *folder.parents) if not os.path.lexists(path)]
    new = folder / temporary_name()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        new.mkdir()
        _refuse_others(folder, names, _listed(folder, kind))
        yield new
        _put(new, folder, kind)
    except OSError as error:
        raise DefinitionError(
            f"cannot write to '{folder}': {error.strerror or error}."
        ) from error
    finally:
        shutil.rmtree(new, ignore_errors=True)
        # (Those that were made in vain are empty.)
        with contextlib.suppress(OSError):
            for path in made:
                path.rmdir()


def require_free(folder: Path, kind: str, names: Iterable[str]) -> None:
    """**Raises:** `DefinitionError` if `results_folder` would refuse to write these results, before
    they are computed."""
    _refuse_link(folder)
    if folder.exists() and not folder.is_dir():
        raise DefinitionError(f"cannot write to '{folder}': it is a file.")
    _refuse_others(folder, names, _listed(folder, kind))


def _put(new: Path, folder: Path, kind: str) -> None:
    names = {
        path.relative_to(new).as_posix() for path in new.rglob("*") if path.is_file()
    }
    before = _listed(folder, kind)
    _refuse_others(folder, names, before)
    # First a list of both, so that all of them are on it after an interruption.
    _write_list(folder, kind, before | names)
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        os.replace(new / name, folder / name)
    for name in before - names:
        if _is_direct(folder, name):
            (folder / name).unlink()
    _write_list(folder, kind, names)


def _refuse_others(folder: Path, names: Iterable[str], listed: set[str]) -> None:
    for name in names:
        path = folder / name
        if path.parent.resolve() != folder.resolve() / Path(name).parent:
            raise _in_the_way(path.parent)
        if os.path.lexists(path) and not (name in listed and _is_direct(folder, name)):
            raise _in_the_way(path)


def _in_the_way(path: Path) -> DefinitionError:
    return DefinitionError(
        f"'{path}' is in the way, and was not written by hybridjax: choose another folder, or "
        "take it away."
    )


def _is_direct(folder: Path, name: str) -> bool:
    """Return whether the name is that of a file in the folder, to which no link leads."""
    root = folder.resolve()
    path = root / name
    return root in path.parents and path.resolve() == path and path.is_file()


def _listed(folder: Path, kind: str) -> set[str]:
    """Return the names of earlier results."""
    path = folder / f".hybridjax-{kind}.json"
    if not os.path.lexists(path):
        return set()
    try:
        if path.is_symlink() or not path.is_file() or path.stat().st_size > limits.TEXT:
            raise ValueError
        return set(map(str, json.loads(path.read_text())))
    except (OSError, ValueError, TypeError, RecursionError):
        raise _in_the_way(path) from None


def _write_list(folder: Path, kind: str, names: set[str]) -> None:
    with replacing(folder / f".hybridjax-{kind}.json") as path:
        path.write_text(json.dumps(sorted(names), indent=1))
