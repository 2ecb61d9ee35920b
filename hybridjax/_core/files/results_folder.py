"""Folders of results, in which nothing of anybody else is touched.

A list beside the results, `.hybridjax-KIND.json`, holds the name and the digest of each of them. A
file that is on it, and that nobody has changed since, may be replaced and removed; no other.
"""

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path, PurePosixPath

from ...errors import DefinitionError
from .. import limits
from .writing import made_folder, replacing, temporary_name


Digests = dict[str, list[str]]
"""By name, which contents a file may have if it is one of ours."""


@contextlib.contextmanager
def results_folder(folder: Path, kind: str, names: Iterable[str] = ()) -> Iterator[Path]:
    """A new folder for results of this kind, which are put into `folder` when all are there.

    Results of the same kind that are there already are replaced or removed. After an error `folder`
    is as it was before.

    **Arguments:** `names`: of results to come, with slashes, so that a refusal comes early.

    **Raises:** `DefinitionError` if `folder` cannot be written, or holds a file of one of the names
    of the results that is a link, not on the list, or changed since.
    """
    with made_folder(folder):
        _refuse_others(folder, names, _listed(folder, kind))
        new = folder / temporary_name()
        try:
            new.mkdir()
            yield new
            _put(new, folder, kind)
        except OSError as error:
            raise DefinitionError(
                f"cannot write to '{folder}': {error.strerror or error}."
            ) from error
        finally:
            shutil.rmtree(new, ignore_errors=True)


def _put(new: Path, folder: Path, kind: str) -> None:
    files = (path for path in new.rglob("*") if path.is_file())
    digests = {path.relative_to(new).as_posix(): [_digest(path)] for path in files}
    before = _listed(folder, kind)
    _refuse_others(folder, digests, before)
    # First a list of both, so that whoever is interrupted finds all of them on it.
    either = {name: before.get(name, []) + digests.get(name, []) for name in before | digests}
    _write_list(folder, kind, either)
    for name in digests:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        os.replace(new / name, folder / name)
    for name in before.keys() - digests.keys():
        if _is_own(folder, name, before):
            (folder / name).unlink()
    _write_list(folder, kind, digests)


def _refuse_others(folder: Path, names: Iterable[str], own: Digests) -> None:
    for name in names:
        for above in list(PurePosixPath(name).parents)[:-1]:
            if os.path.lexists(folder / above) and not _is_folder(folder / above):
                raise _other(folder / above)
        if os.path.lexists(folder / name) and not _is_own(folder, name, own):
            raise _other(folder / name)


def _other(path: Path) -> DefinitionError:
    return DefinitionError(
        f"'{path}' is in the way, and was not written by hybridjax or was changed since: choose "
        "another folder, or take it away."
    )


def _is_own(folder: Path, name: str, own: Digests) -> bool:
    path = folder / name
    above = list(PurePosixPath(name).parents)[:-1]
    return (
        all(_is_folder(folder / one) for one in above)
        and path.is_file()
        and not path.is_symlink()
        and _digest(path) in own.get(name, ())
    )


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


def _listed(folder: Path, kind: str) -> Digests:
    path = _list(folder, kind)
    if not os.path.lexists(path):
        return {}
    try:
        if path.is_symlink() or path.stat().st_size > limits.TEXT:
            raise ValueError
        return {_name(name): list(map(str, digests)) for name, digests in _items(path)}
    except (OSError, ValueError, TypeError, RecursionError):
        raise _other(path) from None


def _items(path: Path):
    listed = json.loads(path.read_text())
    if not isinstance(listed, Mapping):
        raise ValueError
    return listed.items()


def _name(text: str) -> str:
    """A name inside of the folder."""
    name = PurePosixPath(text)
    if name.is_absolute() or ".." in name.parts or not name.parts:
        raise ValueError
    return text


def _write_list(folder: Path, kind: str, digests: Digests) -> None:
    with replacing(_list(folder, kind)) as path:
        path.write_text(json.dumps(digests, indent=1))


def _list(folder: Path, kind: str) -> Path:
    return folder / f".hybridjax-{kind}.json"


def _digest(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
