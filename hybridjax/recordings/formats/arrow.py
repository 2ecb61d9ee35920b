"""Parquet and Feather files."""

from pathlib import Path

from ..._core import limits
from ..._core.archive import damaged
from ...errors import FileFormatError
from ..headers import split_header
from .columns import Columns, Wanted, belongs, missing_library, no_such_signal


_FORMATS = {".parquet": "parquet", ".feather": "feather"}


def read_arrow(path: Path, wanted: Wanted) -> list[Columns]:
    """The wanted columns.

    **Raises:** `FileFormatError` for what is no such file, or declares more than it can hold.
    """
    try:
        from pyarrow import ArrowInvalid, dataset
    except ImportError as error:
        raise missing_library("Parquet and Feather files", "pyarrow", "tables") from error
    kind = _FORMATS[path.suffix.lower()]
    try:
        file = dataset.dataset(path, format=kind)
        rows, names = file.count_rows(), file.schema.names
        if 8 * rows * len(names) > limits.unpacked(path.stat().st_size):
            raise damaged(path, f"it declares {rows} rows, and is not that large")
        twice = {x for x in names if names.count(x) > 1}
        if twice:
            raise FileFormatError(f"'{path}' has two columns '{min(twice)}'.")
        for name in wanted.signals or ():
            if not any(belongs(split_header(x)[0], name) for x in names):
                raise no_such_signal(path, name, names)
        kept = [x for x in names if wanted.includes(x)]
        table = file.to_table(columns=kept)
    except (ArrowInvalid, OSError) as error:
        raise FileFormatError(f"'{path}' is no {kind} file, or damaged.") from error
    return [Columns({name: table[name].to_numpy() for name in kept})]
