"""Arrays of npz files, which are read only after a look at what they declare."""

import io
import math
import zipfile
from pathlib import Path

import numpy as np

from ...errors import FileFormatError
from .. import limits


_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays by name. Members are read whole, so that their checksums are checked.

    **Raises:** `OSError` if the file cannot be read; `FileFormatError` if it is damaged, no npz
    file, holds Python objects, or declares more than `limits` allow.
    """
    with open(path, "rb") as file:
        if not zipfile.is_zipfile(file):
            raise FileFormatError(f"'{path}' is not an npz file, or is damaged.")
        try:
            with zipfile.ZipFile(file) as archive:
                members = archive.infolist()
                _check_sizes(members, path.stat().st_size)
                return {m.filename.removesuffix(".npy"): _array(archive, m) for m in members}
        except Exception as error:  # whatever broken bytes make zipfile and numpy stumble over
            raise damaged(path, str(error) or type(error).__name__) from error


def damaged(path: Path, reason: str) -> FileFormatError:
    return FileFormatError(f"'{path}' is damaged: {reason.rstrip('.')}.")


def _check_sizes(members: list[zipfile.ZipInfo], packed: int) -> None:
    size, most = sum(m.file_size for m in members), limits.unpacked(packed)
    if size > most:
        raise ValueError(f"it declares arrays of {size} bytes, but packs them into {packed}")
    if len({m.filename for m in members}) < len(members):
        raise ValueError("two of its arrays have one name")


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(member) as stream:
        version = np.lib.format.read_magic(stream)
        if version not in _HEADERS:
            raise ValueError(f"an array is of version {version}")
        shape, _, dtype = _HEADERS[version](stream)
        declared = stream.tell() + math.prod(shape) * dtype.itemsize
    if dtype.hasobject:
        raise ValueError(f"'{member.filename}' holds Python objects")
    if declared != member.file_size or math.prod(shape) > member.file_size:
        raise ValueError(f"'{member.filename}' declares the shape {shape}, and is not that large")
    return np.lib.format.read_array(io.BytesIO(archive.read(member)), allow_pickle=False)
