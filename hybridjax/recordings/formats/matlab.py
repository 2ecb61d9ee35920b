"""MATLAB's files."""

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..._core import limits
from ..._core.archive import damaged
from ...errors import FileFormatError
from .columns import Columns, Wanted
from .hdf5 import read_matlab_hdf5
from .tree import Leaf, Place, read_tree, refuse_structs


# The version that is HDF5.
_HDF5 = 2
# Bytes of the header of version 5, of what stands before an element, and the kind of a packed one.
_HEADER, _TAG, _PACKED = 128, 8, 15
# Bytes that are unpacked at a time. Doubled: nothing changes.
_PIECE = 2**20


def read_matlab(path: Path, wanted: Wanted) -> list[Columns]:
    """Variables and fields of structs, such as `imu.gyro`, in files of any version.

    **Raises:** `FileFormatError` for what is no such file, declares more than it can hold, or holds
    arrays of structs, and as `read_tree`.
    """
    from scipy.io import loadmat, matlab, whosmat

    try:
        version, _ = matlab.matfile_version(path)
        if version != _HDF5:
            _check_size(path)
            names = [name for name, _, _ in whosmat(path)]
            chosen = [x for x in names if wanted.includes(x) or wanted.reaches(x)]
            found = loadmat(path, simplify_cells=True, variable_names=chosen)
    except (OSError, FileFormatError):
        raise
    except Exception as error:  # whatever broken bytes make scipy stumble over
        raise FileFormatError(f"'{path}' is no MATLAB file, or damaged.") from error
    if version == _HDF5:
        return read_matlab_hdf5(path, wanted)
    own = {name: value for name, value in found.items() if not name.startswith("__")}
    return read_tree(path, dict(_leaves(path, (), own, wanted)), ".", wanted)


def _leaves(path: Path, place: Place, value: Any, wanted: Wanted) -> Iterator[tuple[Place, Leaf]]:
    """Arrays of numbers in a struct, which is a dictionary; an array of structs is a list."""
    if isinstance(value, dict):
        for name, part in value.items():
            yield from _leaves(path, (*place, name), part, wanted)
    elif isinstance(value, list) and any(isinstance(x, dict) for x in value):
        refuse_structs(path, ".".join(place), wanted)
    elif np.asarray(value).dtype.kind in "fiu":
        yield place, Leaf(np.asarray(value))


def _check_size(path: Path) -> None:
    """**Raises:** `FileFormatError` if packed variables hold more than `limits` allow."""
    size = path.stat().st_size
    room = limits.unpacked(size)
    with open(path, "rb") as file:
        order = "little" if file.read(_HEADER)[-2:] == b"IM" else "big"
        while len(tag := file.read(_TAG)) == _TAG:
            kind, length = (int.from_bytes(x, order) for x in (tag[:4], tag[4:]))
            if kind != _PACKED:
                file.seek(length, 1)
                continue
            unpacker, data = zlib.decompressobj(), file.read(min(length, size))
            while data and not unpacker.eof:
                room -= len(unpacker.decompress(data, _PIECE))
                data = unpacker.unconsumed_tail
                if room < 0:
                    raise damaged(path, "it unpacks to more than a recording of its size would")
