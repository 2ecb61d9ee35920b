"""What objects print: numbers with units, arrays by shape and range, modules by their fields.

Most `__repr__` of the package call these functions. The constants set how much is shown, and tests
compare printed texts. If a number has too many or too few digits, look at `rounded`,
`standard_error` and `number`; if lines break badly, at `folded`; if a field is shown badly, at
`value` and `_array`.
"""

import dataclasses
import re
import textwrap
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import numpy as np

from .executor import is_traced, is_tracer
from .signal import unit_of, with_unit


# Characters of a line. More: lines wrap in a notebook. Fewer: short modules take a screen.
_WIDTH = 100
# Arrays with up to this many numbers are printed in full; of larger ones, only shape and range.
# More: fields of a module no longer stand on one line.
_FEW = 4
# Decimals up to which a standard error has no power of ten. More: zeros to count. Fewer: errors of
# usual fits look unlike their values.
_PLAIN_DECIMALS = 6
# Digits of a number without a standard error, or with a tiny one. More: digits that differ between
# machines. Fewer: fits of data without noise look less accurate than they are.
_MOST_DIGITS = 9


def p_value(p: float) -> str:
    """`p < 0.001`, `p = 0.03`, `p > 0.99`: no more digits than it deserves."""
    if p < 1e-3:
        return "p < 0.001"
    return "p > 0.99" if p > 0.99 else f"p = {p:.2g}"


def listed(names: Iterable[str]) -> str:
    """Names with their units."""
    return ", ".join(with_unit(name, unit_of(name)) for name in names) or "none"


def columns(rows: Iterable[tuple[str, ...]]) -> str:
    """Lines with aligned columns, indented."""
    rows = list(rows)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(map(str.ljust, row, widths)) for row in rows)
    return "".join(f"\n  {line.rstrip()}" for line in lines)


def folded(text: str, indent: str = "") -> str:
    """A text of parts between semicolons; where it has more characters than a line, with each part
    on a line of its own, indented below the first."""
    if len(text) <= _WIDTH:
        return text
    # (Numbers with their errors, and the two of a range, are never apart.)
    joined = re.sub(r"(?<=\d) to (?=\d)", "\0to\0", text.replace(" ± ", "\0±\0"))
    parts = re.split(r";\s+", joined)
    width = _WIDTH - 2 - len(indent)
    lines = [textwrap.fill(x, width, subsequent_indent="  ") for x in parts]
    whole = ";\n".join(lines).replace("\0", " ")
    return whole.replace("\n", f"\n  {indent}")


def value(x: Any) -> str:
    """A number, array, module or whatever else a field holds, on one line: of a module that needs
    more (a network, a system) how many numbers it holds."""
    if is_tracer(x):
        return f"traced {x.dtype}{list(x.shape)}"
    if isinstance(x, jax.Array | np.ndarray | np.generic):
        return _array(np.asarray(x))
    if isinstance(x, float):
        return f"{x:.6g}"
    if isinstance(x, tuple | list):
        inside = ", ".join(map(value, x))
        return f"({inside},)" if len(x) == 1 else f"({inside})"
    text = getattr(x, "__name__", None) or repr(x)
    has_own_text = type(x).__repr__ is not eqx.Module.__repr__ and "\n" not in text
    if has_own_text or not isinstance(x, eqx.Module):
        return text
    leaves = jax.tree_util.tree_leaves(eqx.filter(x, eqx.is_array))
    count = sum(leaf.size for leaf in leaves)
    return f"{type(x).__name__}({count} numbers)"


def number(x: Any, digits: int = 6, unit: str = "") -> str:
    """One number with its unit; what JAX traces by its kind."""
    if is_traced(x):
        return f"{value(x)} {unit}".rstrip()
    z = complex(x)
    text = f"{z.real:.{digits}g}"
    if z.imag:
        text += f"{z.imag:+.{digits}g}j"
    return f"{text} {unit}".rstrip()


def rounded(x: Any, error: Any) -> str:
    """A number, real or complex, up to the second digit of its standard error: at least two digits,
    at most nine; nine without an error, three if it is infinite."""
    if np.isinf(error):
        return number(x, 3)
    z = complex(x)
    size = max(abs(z.real), abs(z.imag))
    if not (np.isfinite(size) and np.isfinite(error) and error > 0):
        return number(x, _MOST_DIGITS)
    places = 1 - _exponent(error)
    if size > 0:
        fewest = 1 - _exponent(size)
        most = _MOST_DIGITS - 1 - _exponent(size)
        places = min(max(places, fewest), most)
    real = _to_places(z.real, places)
    if z.imag == 0:
        return real
    imaginary = _to_places(z.imag, places, "+")
    return f"{real}{imaginary}j"


def standard_error(error: Any) -> str:
    """A standard error with two digits; `unknown` if the data do not determine the estimate."""
    if not np.isfinite(error):
        return "unknown"
    if error == 0:
        return "0"
    return _to_places(float(error), 1 - _exponent(error), most=_PLAIN_DECIMALS)


def _exponent(x: Any) -> int:
    """The power of ten of the first digit of a number that is rounded to two digits."""
    return int(f"{x:.1e}".partition("e")[2])


def _to_places(x: float, places: int, sign: str = "-", most: int = _MOST_DIGITS) -> str:
    """A number with so many decimals; a negative count rounds to tens, hundreds, and so on. Powers
    of ten stand where zeros would be many."""
    x = round(x, places) + 0.0  # (no -0)
    if places > most or places < -2:
        digits = max(_exponent(abs(x)) + places, 0) if x else 0
        return f"{x:{sign}.{digits}e}"
    return f"{x:{sign}.{max(places, 0)}f}"


def how_many(count: int, one: str, several: str) -> str:
    """A number with its noun: `how_many(1, "trial", "trials")`."""
    return f"{count} {one if count == 1 else several}"


def signal_values(names: Iterable[str], values: Iterable[Any]) -> str:
    """Numbers of three digits after the names of signals, in their units."""
    words = []
    for name, x in zip(names, values, strict=True):
        words.append(f"{name} {number(x, 3, unit_of(name))}")
    return ", ".join(words)


def fields(self: Any) -> str:
    """A module by its fields, without those that are None (a `__repr__`)."""
    kind = type(self).__name__
    shown = []
    for field in dataclasses.fields(self):
        content = getattr(self, field.name) if field.repr else None
        if content is not None:
            shown.append(f"{field.name}={value(content)}")
    line = ", ".join(shown)
    if len(kind) + len(line) + 2 <= _WIDTH:
        return f"{kind}({line})"
    lines = [textwrap.fill(x, _WIDTH - 3, subsequent_indent="  ") for x in shown]
    inside = textwrap.indent(",\n".join(lines), "  ")
    return f"{kind}(\n{inside},\n)"


def _array(x: np.ndarray) -> str:
    if x.ndim == 0:
        return number(x) if x.dtype.kind in "fc" else str(x.item())
    if x.ndim == 1 and x.size <= _FEW:
        return value(tuple(x))
    shape = " x ".join(map(str, x.shape))
    if x.ndim == 1:
        shape += " numbers"
    if x.dtype.kind not in "iuf" or not np.isfinite(x).any():
        return f"{shape} ({x.dtype})"
    low = np.nanmin(x)
    high = np.nanmax(x)
    if low == high:
        return f"{shape}, all {low:.6g}"
    return f"{shape}, {low:.6g} to {high:.6g}"
