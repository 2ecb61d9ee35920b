"""JAX's persistent compilation cache, switched on by request."""

import os
import pathlib

import jax

from ...errors import DefinitionError
from ..boundary.checked import checked
from ..boundary.kinds import Path
from .loader_messages import silence_for_good


_folder: pathlib.Path | None = None


def folder() -> pathlib.Path | None:
    """Where compiled programs are kept, if they are."""
    return _folder


@checked
def enable_compilation_cache(folder: Path | None = None) -> pathlib.Path:
    """Keep compiled programs on disk, so that the next process starts faster.

    What XLA says about programs that it loads is not shown from then on.

    **Arguments:** `folder`, by default `$HYBRIDJAX_CACHE`, or `hybridjax` in the user's cache
    folder (`$XDG_CACHE_HOME` or `~/.cache`).

    **Returns:** the folder in use.

    **Raises:** `DefinitionError` if it cannot be made.
    """
    if folder is None:
        base = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
        folder = os.environ.get("HYBRIDJAX_CACHE") or pathlib.Path(base) / "hybridjax"
    folder = pathlib.Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DefinitionError(
            f"cannot keep compiled programs in '{folder}' ({error.strerror}): set HYBRIDJAX_CACHE "
            "to another folder."
        ) from error
    global _folder
    _folder = folder
    silence_for_good()
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # The smallest programs too: those of users' functions come before everything else.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    return folder
