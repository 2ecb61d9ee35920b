"""HDF5 files, and MATLAB's that are some (version 7.3)."""

from pathlib import Path
from typing import Any

import numpy as np

from ..._core import limits
from ..._core.archive import damaged
from ...errors import FileFormatError
from .columns import Columns, Wanted, missing_library
from .tree import Leaf, Place, read_tree, refuse_structs


# What MATLAB keeps for itself.
_INTERNAL = "#"


def read_hdf5(path: Path, wanted: Wanted) -> list[Columns]:
    """Datasets by their paths, such as `imu/gyro`; an attribute `units` is their unit.

    **Raises:** `FileFormatError` for what is no such file, or declares more than it can hold, and
    as `read_tree`.
    """
    return _read(path, "/", wanted)


def read_matlab_hdf5(path: Path, wanted: Wanted) -> list[Columns]:
    """Variables and fields of structs, such as `imu.gyro`.

    **Raises:** as `read_hdf5`, and for arrays of structs.
    """
    return _read(path, ".", wanted)


def _read(path: Path, separator: str, wanted: Wanted) -> list[Columns]:
    try:
        import h5py
    except ImportError as error:
        what = "HDF5 files, and MATLAB's of version 7.3,"
        raise missing_library(what, "h5py", "mat") from error
    try:
        with h5py.File(path, "r") as file:
            leaves: dict[Place, Leaf] = {}

            def visit(name: str, thing: Any) -> None:
                place = tuple(name.split("/"))
                if isinstance(thing, h5py.Dataset) and not name.startswith(_INTERNAL):
                    if h5py.check_ref_dtype(thing.dtype) and "MATLAB_class" not in thing.attrs:
                        refuse_structs(path, separator.join(place[:-1]), wanted)
                    if thing.dtype.kind in "fiu" and not _is_text(thing):
                        leaves[place] = Leaf(thing, _unit(path, name, thing))

            file.visititems(visit)
            size = 8 * sum(int(np.prod(x.array.shape)) for x in leaves.values())
            if size > limits.unpacked(path.stat().st_size):
                raise damaged(path, f"it declares arrays of {size} bytes, and is not that large")
            return read_tree(path, leaves, separator, wanted)
    except OSError as error:
        raise FileFormatError(f"'{path}' is no HDF5 file, or damaged.") from error


def _is_text(dataset: Any) -> bool:
    """Letters of MATLAB are numbers; its empty arrays hold their shape."""
    return "MATLAB_empty" in dataset.attrs or dataset.attrs.get("MATLAB_class") == b"char"


def _unit(path: Path, name: str, dataset: Any) -> str:
    unit = dataset.attrs.get("units", "")
    unit = unit.decode() if isinstance(unit, bytes) else unit
    if not isinstance(unit, str):
        raise FileFormatError(f"'{path}': the unit of '{name}' is {unit}, which is no text.")
    return unit
