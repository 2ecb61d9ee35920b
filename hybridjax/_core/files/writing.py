"""Files and folders that appear complete or not at all."""

import contextlib
import os
import tempfile
import uuid
from collections.abc import Iterator
from pathlib import Path

from ...errors import DefinitionError


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A name in the folder of `path`, for a file that takes the place of `path` at the end.

    **Raises:** `DefinitionError` if the file cannot be written, or `path` is a link.
    """
    if path.is_symlink():
        raise DefinitionError(
            f"'{path}' is a link, and nothing is written through links: choose another name."
        )
    temporary = path.parent / temporary_name()
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise DefinitionError(f"cannot write '{path}': {error.strerror or error}.") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


@contextlib.contextmanager
def made_folder(folder: Path) -> Iterator[None]:
    """The folder exists and can be written. If it was made for this, and something is raised while
    it is empty, it goes again, as do those above it that were made with it.

    **Raises:** `DefinitionError` if it cannot be made or written.
    """
    new = [one for one in (folder, *folder.parents) if not os.path.lexists(one)]
    try:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
        except OSError as error:
            raise DefinitionError(
                f"cannot write to '{folder}': {error.strerror or error}."
            ) from error
        yield
    except BaseException:
        with contextlib.suppress(OSError):
            for one in new:
                one.rmdir()
        raise


def temporary_name() -> str:
    return f".hybridjax-{uuid.uuid4().hex[:12]}"
