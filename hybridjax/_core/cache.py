"""`enable_compilation_cache`, public in `hj.scale`: the folder in which JAX keeps compiled programs
between processes.

JAX loads machine code from the folder and runs it unchecked, so nobody but the user may be able to
write there. The functions here make the folder and check its permissions. The command line and
workers of Dask call them too.

No check may be dropped. If a folder is refused without need, look at `_refuse_others` (who may
write to it, and to those above it), then at the end of `_private_folder` (a copy, or files that are
no programs); if programs are compiled again in each process, at `keep_programs_in` in
`jax_compat.py`.
"""

import os
import pathlib
import shutil
import stat
import tempfile
import warnings

from . import jax_compat
from .boundary.checked import checked
from .boundary.kinds import FilePath
from .exceptions import DefinitionError


# A larger file in the folder, in bytes, is no program. Smaller: the largest programs (1e8) are
# refused. Larger: a file that was put there fills the memory.
_LARGEST = 2**30
_MARK = "made-here-"


@checked
def enable_compilation_cache(folder: FilePath | None = None) -> pathlib.Path | None:
    """Keep compiled programs on disk (JAX's persistent compilation cache), so that the next process
    starts faster.

    From then on XLA prints no messages about programs that it loads.

    **Arguments:** `folder`: programs are kept in its subfolder `programs`. Loading a program
    executes it. Therefore the subfolder is not used if other users can write to it or exchange it,
    if it is a link, or if it is a copy, such as an unpacked archive. Default: `$HYBRIDJAX_CACHE`,
    or `hybridjax` in the user's cache folder (`$XDG_CACHE_HOME` or `~/.cache`).

    **Returns:** the subfolder; `None`, with a warning, if the user's cache folder cannot be used.
    Then nothing is kept.

    **Raises:** `DefinitionError` if the folder of the argument or of `$HYBRIDJAX_CACHE` cannot be
    used.

    **Example:**

    ```python
    hj.scale.enable_compilation_cache()
    ```

    **After:** every function that computes.
    """
    given = folder or os.environ.get("HYBRIDJAX_CACHE")
    try:
        programs = _private_folder(given)
    except (OSError, RuntimeError) as error:
        problem = f"cannot keep compiled programs ({error})"
        if given:
            raise DefinitionError(f"{problem}: give another folder.") from error
        warnings.warn(f"{problem}; nothing is kept.", stacklevel=3)
        return None
    jax_compat.keep_programs_in(programs)
    jax_compat.silence_xla()
    return programs


def _private_folder(given: str | os.PathLike[str] | None) -> pathlib.Path:
    """Make or check the subfolder of programs in a folder, or in the user's cache folder.

    The subfolder holds an empty file whose name has the inode of the subfolder. A copy, such as
    an unpacked archive, has another inode.

    **Raises:** `OSError` if it cannot be made, other users can write to it or exchange it, or it
    was not made here; `RuntimeError` for a user without a home.
    """
    if not given:
        base = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
        given = pathlib.Path(base, "hybridjax")
    folder = pathlib.Path(given).resolve()
    _make(folder)
    programs = folder / "programs"
    for path in programs.parents:
        _refuse_others(path, is_above=True)
    if not os.path.lexists(programs):
        new = pathlib.Path(tempfile.mkdtemp(dir=folder))
        (new / f"{_MARK}{new.stat().st_ino}").touch()
        try:
            new.rename(programs)
        except OSError:  # another process was faster
            shutil.rmtree(new)
    here = programs.lstat()
    if not stat.S_ISDIR(here.st_mode):
        raise PermissionError(f"'{programs}' is no folder")
    _refuse_others(programs, is_above=False)
    marks = [path.name for path in programs.glob(f"{_MARK}*")]
    if marks != [f"{_MARK}{here.st_ino}"]:
        raise PermissionError(f"'{programs}' was not made in this place: move it away")
    for path in jax_compat.kept_programs(programs):
        about = path.lstat()
        # (A file with several links may be another user's, too.)
        is_ours = about.st_uid == here.st_uid and about.st_nlink == 1
        if not (stat.S_ISREG(about.st_mode) and about.st_size <= _LARGEST and is_ours):
            raise PermissionError(f"'{path}' is no compiled program: move it away")
    return programs


def _make(folder: pathlib.Path) -> None:
    """Make a folder, and those above it, that only this user can write."""
    if not folder.is_dir():
        _make(folder.parent)
        folder.mkdir(mode=0o755, exist_ok=True)


def _refuse_others(path: pathlib.Path, is_above: bool) -> None:
    """**Raises:** `PermissionError` if other users can write to a folder, or, in one above it,
    rename what is not theirs."""
    if not hasattr(os, "geteuid"):
        return
    about = path.lstat()
    user = os.geteuid()
    is_open = about.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    is_alone = is_open == stat.S_IWGRP and _is_alone(about.st_gid)
    if is_above and (about.st_mode & stat.S_ISVTX or is_alone):
        is_open = False
    if is_open or about.st_uid not in (user, 0 if is_above else user):
        raise PermissionError(f"other users can write to '{path}'")


def _is_alone(number: int) -> bool:
    """Return whether a group is that of this user alone: many systems make one for each user."""
    import grp  # not on Windows
    import pwd

    try:
        group = grp.getgrgid(number)
        user = pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        return False
    return group.gr_name == user and set(group.gr_mem) <= {user}
