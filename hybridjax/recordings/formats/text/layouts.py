"""Where the names, the units and the numbers of a text file stand."""

from pathlib import Path

from ....errors import FileFormatError
from ...headers import is_unit, split_header
from ..columns import Columns
from .lines import is_comment, read_lines, uncommented
from .table import Table, read_table, split_line, split_names, to_number
from .trc import is_trc, read_trc
from .vicon import is_vicon, read_vicon


_END_OF_OPENSIM_HEADER = "endheader"
# Lines among which OpenSim's header is expected to end. Doubled: longer headers are understood.
_LONGEST_HEADER = 100


def read_text(path: Path) -> list[Columns]:
    """The columns of a text file: names in its first line, or as OpenSim, Motion Analysis and Vicon
    write them.

    **Raises:** `FileFormatError` for what is no table, with the line.
    """
    lines = read_lines(path)
    head = [x.strip().lower() for x in lines[:_LONGEST_HEADER]]
    if _END_OF_OPENSIM_HEADER in head:
        return [_opensim(path, lines, head.index(_END_OF_OPENSIM_HEADER))]
    if is_trc(lines):
        return [read_trc(path, lines)]
    if is_vicon(lines):
        return read_vicon(path, lines)
    return [read_plain(path, lines)]


def read_plain(path: Path, lines: list[str]) -> Columns:
    """Names in the first line that is no comment, perhaps units below, then numbers.

    **Raises:** as `read_text`.
    """
    filled = [k for k, x in enumerate(lines) if x.strip(" \t,;")]
    told = [k for k in filled if not is_comment(lines[k])]
    if not told:
        raise FileFormatError(f"'{path}' has no line with the names of its columns.")
    first, second = told[0], told[1] if len(told) > 1 else None
    below = lines[second] if second is not None else ""
    separator = _separator(lines[first], below)
    names = split_names(lines[first], separator)
    if all(to_number(x) is not None for x in names):
        # As `numpy.savetxt` writes it: the names are the last comment.
        before = [uncommented(lines[k]) for k in filled if k < first]
        separator = _separator(before[-1], lines[first]) if before else separator
        width, names = len(names), split_names(before[-1], separator) if before else []
        if len(names) != width or any(to_number(x) is not None for x in names):
            raise FileFormatError(
                f"'{path}' begins with numbers: its first line must name the columns."
            )
        return read_table(Table(path, names, lines[first:], first, separator))
    fields = split_line(below, separator)
    if len(names) == 1 and max(len(split_line(below, x)) for x in ",;\t") > 1:
        raise FileFormatError(
            f"'{path}', line {first + 1}: '{lines[first].strip()[:40]}' names one column, but "
            "there are more below it: begin lines before the names of the columns with '#'."
        )
    start = first + 1
    if second is not None and any(fields) and all(is_unit(x) for x in fields if x):
        if any(to_number(x) is None for x in fields):
            names, start = _with_units(names, fields), second + 1
    return read_table(Table(path, names, lines[start:], start, separator))


def _opensim(path: Path, lines: list[str], end: int) -> Columns:
    """A motion or storage file: facts up to `endheader`, then names, then numbers."""
    facts = dict(x.replace(" ", "").lower().split("=", 1) for x in lines[:end] if "=" in x)
    start = next((k for k in range(end + 1, len(lines)) if lines[k].strip()), None)
    if start is None:
        raise FileFormatError(f"'{path}' has no line with the names of its columns.")
    separator = "\t" if "\t" in lines[start] else ""
    names = split_names(lines[start], separator)
    found = read_table(Table(path, names, lines[start + 1 :], start + 1, separator))
    rows = len(next(iter(found.values.values())))
    if facts.get("nrows", str(rows)) != str(rows):
        raise FileFormatError(
            f"'{path}' has {rows} rows, but its header says {facts['nrows']}: it is damaged."
        )
    # Times of OpenSim are seconds.
    values = {"time (s)" if x == "time" else x: v for x, v in found.values.items()}
    degrees = ("angles are in degrees",) if facts.get("indegrees") == "yes" else ()
    return Columns(values, found.notes + degrees)


def _separator(names: str, below: str) -> str:
    """What separates names and numbers alike; else what is most often between the names."""
    counts = {x: len(split_line(names, x)) for x in "\t;,"}
    alike = [x for x, n in counts.items() if n > 1 and n == len(split_line(below, x))]
    if alike:
        return alike[0]
    if max(counts.values()) > 1:
        return max(counts, key=lambda x: counts[x])
    blanks = len(split_line(names, ""))
    return "" if blanks > 1 and blanks == len(split_line(below, "")) else ","


def _with_units(names: list[str], units: list[str]) -> list[str]:
    units = [split_header(x)[1] or x for x in units] + [""] * len(names)
    return [
        f"{name} ({unit})" if unit and name and not split_header(name)[1] else name
        for name, unit in zip(names, units, strict=False)
    ]
