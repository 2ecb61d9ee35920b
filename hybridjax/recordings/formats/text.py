"""Tables in text files: encodings, separators, names, units, numbers."""

import codecs
import csv
import re
import warnings
from collections.abc import Sequence
from contextlib import suppress
from itertools import zip_longest
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..._core.signal import with_unit
from ...errors import FileFormatError
from .columns import Columns, is_unit, split_header, two_columns


# Bytes that no text holds, in any encoding with one byte for each ASCII character.
_CONTROL = bytes(set(range(32)) - set(b"\t\n\v\f\r\x1a\x1b"))
_COMMENTS = ("#", "%", "//")
# Marks of a missing sample, in any case of letters.
_MISSING = {"", "nan", "na", "n/a", "#n/a", "null", "none"}


def read_lines(path: Path) -> list[str]:
    """Read a file in UTF-8, UTF-16 with a byte order mark, or else Latin-1, with any line ends.

    **Raises:** `FileFormatError` if it is no text.
    """
    data = path.read_bytes()
    utf_16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    if not utf_16 and len(data.translate(None, _CONTROL)) < len(data):
        raise FileFormatError(f"'{path}' is not a text file.")
    try:
        text = data.decode("utf-16" if utf_16 else "utf-8-sig")
    except UnicodeDecodeError as error:
        if utf_16:
            raise FileFormatError(f"'{path}' is not a text file.") from error
        text = data.decode("latin-1")
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def read_plain(path: Path, lines: list[str]) -> Columns:
    """Read names in the first line that is no comment, perhaps units below, then numbers.

    **Raises:** `FileFormatError` if there is no table, with the line.
    """
    filled = [k for k, x in enumerate(lines) if x.strip(" \t,;")]
    content = [k for k in filled if not lines[k].lstrip().startswith(_COMMENTS)]
    if not content:
        raise FileFormatError(f"'{path}' has no line with the names of its columns.")
    whole, content = content, _from_names(lines, content)
    first = content[0]
    below = lines[content[1]] if len(content) > 1 else ""
    separator = _separator(lines[first], below)
    names = split_names(lines[first], separator)
    if all(to_number(x) is not None for x in names):
        # As `numpy.savetxt` writes it: the names are the last comment.
        before = [lines[k].lstrip().lstrip("#%/").strip() for k in filled if k < first]
        separator = _separator(before[-1], lines[first]) if before else separator
        width, names = len(names), split_names(before[-1], separator) if before else []
        if len(names) != width or any(to_number(x) is not None for x in names):
            raise FileFormatError(
                f"'{path}' begins with numbers: its first line must be names."
            )
        return read_table(path, names, lines, first, separator)
    start, fields = first + 1, split_line(below, separator)
    units = [x for x in fields if x]
    if units and all(map(is_unit, units)) and any(to_number(x) is None for x in fields):
        below_names = zip_longest(names, fields[: len(names)], fillvalue="")
        names = [
            with_unit(x, split_header(y)[1] or y) if x else "" for x, y in below_names
        ]
        start = content[1] + 1
    table = read_table(path, names, lines, start, separator)
    skipped = ("lines above the names were left out",) * (content != whole)
    return table._replace(notes=table.notes + skipped)


def _from_names(lines: Sequence[str], content: list[int]) -> list[int]:
    """Return the lines from the names on, which are the first of the widest lines. Lines about the
    recording may stand above them."""
    for separator in "\t;,":
        fields = [split_names(lines[k], separator) for k in content[:100]]
        n = int(np.argmax([len(x) for x in fields]))
        if len(fields[-1]) > 1:
            is_data = any(
                x and to_number(x.replace(",", ".")) is not None for x in fields[n]
            )
            return content if is_data else content[n:]
    return content


def _separator(names: str, below: str) -> str:
    """Return what separates names and numbers alike, or else is most frequent between the names."""
    counts = {x: len(split_line(names, x)) for x in ("\t", ";", ",", "")}
    alike = [x for x, n in counts.items() if n > 1 and n == len(split_line(below, x))]
    return alike[0] if alike else max("\t;,"[::-1], key=lambda x: counts[x])


def split_line(line: str, separator: str) -> list[str]:
    """Return the fields of a line, stripped; "" separates at blanks, but not before a unit."""
    if not separator:
        return re.split(r"\s+(?![(\[])", line.strip()) if line.strip() else []
    if '"' not in line:
        return [x.strip() for x in line.split(separator)] if line else []
    try:
        return [x.strip() for x in next(csv.reader([line], delimiter=separator), [])]
    except csv.Error:  # a field of more than 100 kB
        return [line]


def split_names(line: str, separator: str) -> list[str]:
    """Return the fields of a line, without empty ones at its end."""
    return split_line(line.rstrip(f"{separator} \t"), separator)


def to_number(text: str) -> float | None:
    """Return the number that a field holds, NaN for a missing sample, None for other text."""
    try:
        return np.nan if text.strip().lower() in _MISSING else float(text)
    except ValueError:
        return None


def read_table(
    path: Path, headers: Sequence[str], lines: Sequence[str], start: int, sep: str
) -> Columns:
    """Read the numbers in `lines[start:]`, with one field for each header.

    Columns without a name are left out, as are empty fields after the last column. Decimal commas
    are understood where the separator is no comma.

    **Raises:** `FileFormatError` for two columns of one name, and text that is no number, with its
    line.
    """
    two_columns(path, [x for x in headers if x])
    notes = []
    lines = ["" if x.lstrip().startswith(_COMMENTS) else x for x in lines[start:]]
    if sep != "," and any("," in x for x in lines):
        notes.append("decimal commas were read as such")
        if (
            mixed := next((k for k, x in enumerate(lines) if "." in x), None)
        ) is not None:
            text = f"'{path}', line {start + mixed + 1}: there are points beside decimal commas; "
            raise FileFormatError(
                f"{text}export one of the two, and no separators of thousands."
            )
        lines = [x.replace(",", ".") for x in lines]
    values = np.zeros((0, 0))
    with suppress(ValueError), warnings.catch_warnings():  # a number in every field
        warnings.simplefilter("ignore")  # about an empty table
        values = np.loadtxt(
            lines, delimiter=sep or None, ndmin=2, comments=None, quotechar='"'
        )
    if values.shape[1] != len(headers):
        values = _by_line(path, headers, lines, start, sep)
    if not values.size:
        raise FileFormatError(f"'{path}' has a header, but no samples.")
    if not all(headers):
        notes.append("columns without a name were left out")
    columns = zip(headers, values.T, strict=True)
    return Columns({name: column for name, column in columns if name}, tuple(notes))


def _by_line(
    path: Path, headers: Sequence[str], lines: Sequence[str], start: int, separator: str
) -> Float[np.ndarray, "n k"]:
    """Read files with missing fields, or with an error whose line is to be reported."""
    rows, count = [], len(headers)
    for number, line in enumerate(lines, start + 1):
        fields = split_line(line, separator)
        if not any(fields):
            continue
        if len(fields) < count or any(fields[count:]):
            text = f"'{path}', line {number}: {len(fields)} fields, but the header names {count} "
            raise FileFormatError(
                f"{text}columns (decimal commas need another separator)."
            )
        row = [to_number(x) for x in fields[:count]]
        if None in row:
            k = row.index(None)
            text = f"column '{headers[k]}' holds '{fields[k][:40]}', which is not a number."
            raise FileFormatError(f"'{path}', line {number}: {text}")
        rows.append(row)
    return np.array(rows, float).reshape(-1, count)
