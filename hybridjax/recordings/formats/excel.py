"""Excel files."""

import csv
import io
import zipfile
from pathlib import Path

from ..._core import limits
from ..._core.archive import damaged
from ...errors import FileFormatError
from .columns import Columns, Wanted, missing_library
from .text.layouts import read_plain


def read_excel(path: Path, wanted: Wanted) -> list[Columns]:
    """The first sheet, read as a text file with a line for each of its rows would be.

    **Raises:** `FileFormatError` for what is no such file, declares more than it can hold, or has
    no table on its first sheet, with the row.
    """
    try:
        import openpyxl
    except ImportError as error:
        raise missing_library("Excel files", "openpyxl", "tables") from error
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(x.file_size for x in archive.infolist())
        if size > limits.unpacked(path.stat().st_size):
            raise damaged(path, f"it declares {size} bytes, and is not that large")
        book = openpyxl.load_workbook(path, read_only=True, data_only=True)
    except (
        zipfile.BadZipFile,
        KeyError,
        ValueError,
        openpyxl.utils.exceptions.InvalidFileException,
    ) as error:
        raise FileFormatError(f"'{path}' is no Excel file, or damaged.") from error
    names = book.sheetnames
    lines = [_line(row) for row in book.worksheets[0].iter_rows(values_only=True)]
    book.close()
    found = read_plain(path, lines)
    if len(names) > 1:
        note = f"of {len(names)} sheets the first one, '{names[0]}', was read"
        found = found._replace(notes=(*found.notes, note))
    return [found]


def _line(row: tuple) -> str:
    """Cells with tabs between them, in quotes where they need some."""
    text = io.StringIO()
    cells = ["" if x is None else " ".join(str(x).split()) for x in row]
    csv.writer(text, delimiter="\t", lineterminator="").writerow(cells)
    return text.getvalue()
