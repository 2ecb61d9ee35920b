"""Tables in text files: encodings, separators, names, units, numbers.

`layouts.py` calls `read_lines` for the lines of a file, and `read_plain` (a file without a special
layout) or `read_table` (numbers from a given line on), which return `Columns`. `_numbers_alone`
reads tables of numbers fast; `_by_line` reads all others, must give the same numbers, and is the
one that finds the line of an error. Further marks of missing samples are added to `_MISSING`.

A number that is misread has its cause in `_by_line` or `_numbers_alone`, a wrong name in
`_separator` or `_from_names`, a wrong unit in `_are_units`, a wrong letter in `read_lines`.
"""

import codecs
import csv
import re
import warnings
from collections.abc import Iterable, Sequence
from contextlib import suppress
from itertools import zip_longest
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..._core.findings import Finding
from ..._core.signal import with_unit
from ...errors import FileFormatError
from .columns import EVENT, Columns, Wanted, assumed, is_unit, split_header, two_columns


# Bytes that do not occur in texts, in any encoding with one byte for each ASCII character.
_CONTROL = bytes(set(range(32)) - set(b"\t\n\v\f\r\x1a\x1b"))
_COMMENTS = ("#", "%", "//")
# Marks of a missing sample, in any case of letters.
_MISSING = {"", "nan", "na", "n/a", "#n/a", "null", "none"}
# A sheet writes these for a cell without a number. A row that begins with one is no comment.
_ERRORS_OF_CELLS = (
    "#n/a",
    "#null!",
    "#div/0!",
    "#value!",
    "#ref!",
    "#name?",
    "#num!",
)


def read_lines(path: Path) -> list[str]:
    """Read a file in UTF-8, or UTF-16 with a byte order mark, with any line ends. Bytes that are no
    UTF-8 are read as Latin-1.

    **Raises:** `FileFormatError` if it is no text.
    """
    data = path.read_bytes()
    utf_16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    if not utf_16 and len(data.translate(None, _CONTROL)) < len(data):
        raise FileFormatError(f"'{path}' is not a text file.")
    if utf_16:
        try:
            text = data.decode("utf-16")
        except UnicodeDecodeError as error:
            raise FileFormatError(f"'{path}' is not a text file.") from error
    else:
        text = data.decode("utf-8-sig", errors=_LATIN_1)
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def _byte_of_latin_1(error: UnicodeError) -> tuple[str, int]:
    """Return the letters that bytes are in Latin-1, and where decoding goes on.

    (A single such letter, as in a comment, then does not change the rest of the file.)
    """
    if not isinstance(error, UnicodeDecodeError):
        raise error
    return error.object[error.start : error.end].decode("latin-1"), error.end


_LATIN_1 = "hybridjax.latin-1"
codecs.register_error(_LATIN_1, _byte_of_latin_1)


def _is_comment(line: str) -> bool:
    start = line.lstrip().lower()
    return start.startswith(_COMMENTS) and not start.startswith(_ERRORS_OF_CELLS)


def read_plain(path: Path, lines: list[str], wanted: Wanted) -> Columns:
    """Read names in the first line that is no comment, perhaps units below, then numbers.

    **Raises:** `FileFormatError` if there is no table, with the line.
    """
    filled = [k for k, x in enumerate(lines) if x.strip(" \t,;")]
    content = [k for k in filled if not _is_comment(lines[k])]
    if not content:
        raise FileFormatError(f"'{path}' has no line with the names of its columns.")
    above = content[0]
    content = _from_names(lines, content)
    first = content[0]
    below = lines[content[1]] if len(content) > 1 else ""
    separator = _separator(lines[first], below)
    names = split_names(lines[first], separator)
    if all(to_number(x) is not None for x in names):
        comments = [
            lines[k].lstrip().lstrip("#%/").strip() for k in filled if k < first
        ]
        return _with_names_in_comment(path, lines, first, comments, len(names), wanted)
    start = first + 1
    fields = split_line(below, separator)
    if _are_units(fields):
        names = _with_units(names, fields)
        start = content[1] + 1
    table = read_table(path, names, lines, start, separator, wanted)
    if first != above:
        table = table.with_finding(assumed("lines above the names were left out."))
    return table


def _with_names_in_comment(
    path: Path,
    lines: list[str],
    first: int,
    comments: Sequence[str],
    width: int,
    wanted: Wanted,
) -> Columns:
    """Read numbers from a line on, whose names are the last comment above: `numpy.savetxt`.

    **Raises:** `FileFormatError` if there is no such comment.
    """
    separator = _separator(comments[-1], lines[first]) if comments else ""
    names = split_names(comments[-1], separator) if comments else []
    if len(names) != width or any(to_number(x) is not None for x in names):
        raise FileFormatError(
            f"'{path}' begins with numbers: its first line must be names."
        )
    return read_table(path, names, lines, first, separator, wanted)


def _are_units(fields: Sequence[str]) -> bool:
    """Return whether the fields below names are units; numbers may look like units, too."""
    units = [x for x in fields if x]
    are_numbers = all(to_number(x) is not None for x in fields)
    return bool(units) and all(map(is_unit, units)) and not are_numbers


def _with_units(names: Sequence[str], units: Sequence[str]) -> list[str]:
    """Return headers of names and the fields below; columns without a name have no unit."""
    headers = []
    for name, field in zip_longest(names, units[: len(names)], fillvalue=""):
        _, bracketed = split_header(field)
        headers.append(with_unit(name, bracketed or field) if name else "")
    return headers


def _from_names(lines: Sequence[str], content: list[int]) -> list[int]:
    """Return the lines from the names on, which are the first of the widest lines. Lines about the
    recording may stand above them."""
    for separator in "\t;,":
        fields = [split_names(lines[k], separator) for k in content[:100]]
        if len(fields[-1]) < 2:
            continue
        widest = int(np.argmax([len(x) for x in fields]))
        numbers = [to_number(x.replace(",", ".")) for x in fields[widest] if x]
        is_data = any(number is not None for number in numbers)
        return content if is_data else content[widest:]
    return content


def _separator(names: str, below: str) -> str:
    """Return what separates names and numbers alike, or else is most frequent between the names."""
    counts = {x: len(split_line(names, x)) for x in ("\t", ";", ",", "")}
    for separator, count in counts.items():
        if count > 1 and count == len(split_line(below, separator)):
            return separator
    return max(",;\t", key=lambda x: counts[x])


def split_line(line: str, separator: str) -> list[str]:
    """Return the fields of a line, stripped; "" separates at blanks, but not before a unit."""
    is_empty = not line if separator else not line.strip()
    if is_empty:
        return []
    if not separator:
        return re.split(r"\s+(?![(\[])", line.strip())
    if '"' not in line:
        return [x.strip() for x in line.split(separator)]
    try:
        return [x.strip() for x in next(csv.reader([line], delimiter=separator), [])]
    except csv.Error:  # a field of more than 100 kB
        return [line]


def split_names(line: str, separator: str) -> list[str]:
    """Return the fields of a line, without empty ones at its end."""
    return split_line(line.rstrip(f"{separator} \t"), separator)


def to_number(text: str) -> float | None:
    """Return the number that a field holds, NaN for a missing sample, None for other text."""
    if text.strip().lower() in _MISSING:
        return np.nan
    try:
        return float(text)
    except ValueError:
        return None


def read_table(
    path: Path,
    headers: Sequence[str],
    lines: Sequence[str],
    start: int,
    sep: str,
    wanted: Wanted,
) -> Columns:
    """Read the numbers in `lines[start:]`, with one field for each header.

    Columns without a name are left out, as are empty fields after the last column, columns of texts
    alone, and texts in columns that are not wanted. Decimal commas are understood where the
    separator is no comma.

    **Raises:** `FileFormatError` for two columns of one name, and text that is no number, with its
    line.
    """
    two_columns(path, [x for x in headers if x])
    findings = []
    lines = ["" if _is_comment(x) else x for x in lines[start:]]
    if sep != "," and any("," in x for x in lines):
        findings.append(assumed("decimal commas were read as such."))
        _require_no_points(path, lines, start)
        lines = [x.replace(",", ".") for x in lines]
    values = _numbers_alone(lines, sep)
    if values.shape[1] != len(headers):
        values, texts = _by_line(path, headers, lines, start, sep, wanted)
        if texts and wanted.signals is None:
            findings.append(_about_texts(headers, texts))
        kept = [k for k in range(len(headers)) if k not in texts]
        headers = [headers[k] for k in kept]
        values = values[:, kept]
    if not values.size:
        raise FileFormatError(f"'{path}' has a header, but no samples.")
    if not all(headers):
        findings.append(assumed("columns without a name were left out."))
    columns = dict(zip(headers, values.T, strict=True))
    columns.pop("", None)
    return Columns(columns, tuple(findings))


def _about_texts(headers: Sequence[str], columns: Iterable[int]) -> Finding:
    """The finding that some columns were left out, since they have texts only."""
    names = ", ".join(f"'{headers[k]}'" for k in columns)
    return assumed(f"columns of text were left out: {names}.")


def _numbers_alone(lines: Sequence[str], sep: str) -> Float[np.ndarray, "n k"]:
    """Read lines that have a number in every field; an empty array for other lines."""
    with suppress(ValueError), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about an empty table
        return np.loadtxt(
            lines, delimiter=sep or None, ndmin=2, comments=None, quotechar='"'
        )
    return np.zeros((0, 0))


def _require_no_points(path: Path, lines: Sequence[str], start: int) -> None:
    """**Raises:** `FileFormatError` for a decimal point in a table with decimal commas."""
    for number, line in enumerate(lines, start + 1):
        if "." in line:
            raise FileFormatError(
                f"'{path}', line {number}: there are points beside decimal commas; export one of "
                "the two, and no separators of thousands."
            )


def _by_line(
    path: Path,
    headers: Sequence[str],
    lines: Sequence[str],
    start: int,
    separator: str,
    wanted: Wanted,
) -> tuple[Float[np.ndarray, "n k"], list[int]]:
    """Read files with missing fields, texts, or an error whose line is to be reported.

    **Returns:** the numbers, and the columns that hold texts and no number.
    """
    rows = []
    count = len(headers)
    first_texts: dict[int, tuple[int, str]] = {}
    for number, line in enumerate(lines, start + 1):
        fields = split_line(line, separator)
        if not any(fields):
            continue
        if len(fields) < count or any(fields[count:]):
            raise FileFormatError(
                f"'{path}', line {number}: {len(fields)} fields, but the header names {count} "
                "columns (decimal commas need another separator)."
            )
        row = [to_number(x) for x in fields[:count]]
        for k, value in enumerate(row):
            if value is None:
                row[k] = np.nan
                first_texts.setdefault(k, (number, fields[k]))
        rows.append(row)
    values = np.array(rows, float).reshape(-1, count)
    texts = []
    for k, (number, field) in first_texts.items():
        header = headers[k]
        is_required = wanted.is_time(header) or header.startswith(EVENT)
        if wanted.signals is not None:
            is_required = wanted.includes(header)
        if np.isnan(values[:, k]).all() and not is_required:
            texts.append(k)
        elif wanted.includes(header):
            raise FileFormatError(
                f"'{path}', line {number}: column '{header}' holds '{field[:40]}', which is not a "
                "number."
            )
    return values, texts
