"""Files that hold one table: Parquet, Feather, Excel, NPZ."""

import csv
import io
import zipfile
from pathlib import Path

from ..._core.archive import read_arrays
from .columns import EVENT, Columns, Wanted, check_declared, library, reading, split_header
from .text import read_plain


def read_arrow(path: Path, wanted: Wanted) -> list[Columns]:
    """Read the wanted columns of a Parquet or Feather file.

    **Raises:** `FileFormatError` for a damaged file, or one that declares more than it can hold.
    """
    dataset = library(path, "pyarrow.dataset", "tables")
    kind = path.suffix.lower().removeprefix(".")
    with reading(path, f"{kind} file"):
        file = dataset.dataset(path, format=kind)
        names = file.schema.names
        check_declared(path, 8 * file.count_rows() * len(names))
        wanted.require(path, [split_header(x)[0] for x in names])
        kept = [x for x in names if wanted.includes(x)]
        table = file.to_table(columns=kept)
    return [Columns({name: table[name].to_numpy() for name in kept})]


def read_excel(path: Path, wanted: Wanted) -> list[Columns]:
    """Read the first sheet as a text file with a line for each of its rows.

    **Raises:** `FileFormatError` for a damaged file, one that declares more than it can hold, and
    a first sheet without a table, with the row.
    """
    openpyxl = library(path, "openpyxl", "tables")
    with reading(path, "Excel file"):
        with zipfile.ZipFile(path) as archive:
            check_declared(path, sum(x.file_size for x in archive.infolist()))
        book = openpyxl.load_workbook(path, read_only=True, data_only=True)
        names = book.sheetnames
        lines = [_line(row) for row in book.worksheets[0].iter_rows(values_only=True)]
        book.close()
    table = read_plain(path, lines)
    note = f"of {len(names)} sheets the first one, '{names[0]}', was read"
    return [table._replace(notes=(*table.notes, note)) if len(names) > 1 else table]


def _line(row: tuple) -> str:
    """Join cells with tabs, in quotes where necessary."""
    text = io.StringIO()
    cells = ["" if x is None else " ".join(str(x).split()) for x in row]
    csv.writer(text, delimiter="\t", lineterminator="").writerow(cells)
    return text.getvalue()


def read_npz(path: Path, wanted: Wanted) -> list[Columns]:
    """Read an array for each column; arrays `event NAME` hold times.

    **Raises:** as `read_arrays`.
    """
    arrays = read_arrays(path)
    events = {x.removeprefix(EVENT): arrays.pop(x) for x in list(arrays) if x.startswith(EVENT)}
    return [Columns(arrays, events=events)]
