"""A folder of compiled programs.

Loading a program executes what the file says, so only files are read that this user has written, in
a folder that nobody else can write to, and whose checksum is right. Every other file counts as
missing: what it should hold is compiled again, and takes its place.
"""

import contextlib
import hashlib
import logging
import os
import stat
from pathlib import Path

from .. import limits
from ..files.writing import temporary_name


_MAGIC = b"hybridjax program 1\n"
# Programs that are smaller than this part of what there is room for are written without a look at
# all others. Twice as much: half as many looks, and the folder may be larger for longer.
_LARGE = 2.0**-12
_log = logging.getLogger(__name__)


class ProgramStore:
    """Programs by name in a folder, which is made when it is first written to."""

    def __init__(self, folder: Path):
        self.folder = folder

    def read(self, name: str) -> bytes | None:
        """What was written under this name; `None` if it is not there, or not to be trusted."""
        path = self.folder / name
        try:
            if not _own(os.lstat(self.folder), stat.S_ISDIR):
                raise ValueError("others can write to the folder")
            with open(path, "rb", opener=_unlinked) as file:
                if not _own(os.fstat(file.fileno()), stat.S_ISREG):
                    raise ValueError("others can write to the file")
                head = file.read(len(_MAGIC) + hashlib.sha256().digest_size)
                data = file.read()
            if head != _MAGIC + _checksum(name, data):
                raise ValueError("it is damaged")
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            _log.debug("'%s' is not used: %s", path, error)
            return None
        with contextlib.suppress(OSError):
            os.utime(path)  # what is used stays longest
        return data

    def write(self, name: str, data: bytes) -> None:
        """Write a file, complete or not at all; nothing happens where that is not possible."""
        temporary = self.folder / temporary_name()
        try:
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if len(data) >= _LARGE * limits.PROGRAMS:
                self._make_room(len(data))
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
            with open(os.open(temporary, flags, 0o600), "wb") as file:
                file.write(_MAGIC + _checksum(name, data) + data)
            os.replace(temporary, self.folder / name)
        except OSError as error:
            _log.debug("'%s' is not kept: %s", name, error)
        finally:
            with contextlib.suppress(OSError):
                temporary.unlink()

    def _make_room(self, size: int) -> None:
        """Delete what has not been used for longest."""
        entries = []
        with os.scandir(self.folder) as found:
            for entry in found:
                with contextlib.suppress(OSError):
                    about = entry.stat(follow_symlinks=False)
                    entries.append((about.st_mtime, about.st_size, entry.path))
        entries.sort()
        size += sum(x[1] for x in entries)
        for _, own, path in entries:
            if size <= limits.PROGRAMS:
                return
            with contextlib.suppress(OSError):
                os.unlink(path)
                size -= own


def _unlinked(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0))


def _own(about: os.stat_result, is_kind) -> bool:
    """Whether only this user can write to it."""
    if not is_kind(about.st_mode):
        return False
    if not hasattr(os, "geteuid"):  # Windows, where a user's folders are the user's own
        return True
    return about.st_uid == os.geteuid() and not about.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _checksum(name: str, data: bytes) -> bytes:
    return hashlib.sha256(name.encode() + b"\0" + data).digest()
