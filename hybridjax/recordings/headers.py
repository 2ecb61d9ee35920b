"""What the headers of columns say: names, units, seconds."""

import re

from ..errors import DefinitionError


_SECONDS = {
    "s": 1.0, "sec": 1.0, "second": 1.0, "seconds": 1.0,
    "ms": 1e-3, "msec": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9,
    "min": 60.0, "h": 3600.0,
}  # fmt: skip
_BRACKETED = re.compile(r"(.*?)\s*[(\[]([^)\]]*)[)\]]")
_TRAILING = re.compile(rf"(.+?)(?:\s*/\s*|[\s_]+)({'|'.join(_SECONDS)})")
_FACTOR = (
    r"(?:[nuµμmckMG]?(?:s|m|g|N|V|A|Pa|W|J|Hz|K|T|L|l|bar|rad)|sec|min|h|deg|°C?|%|in|ft|lb|BW|1)"
    r"\^?[-⁻]?[0-9²³¹]*"
)
_UNIT = re.compile(rf"[(\[].*[)\]]|-|{_FACTOR}(?:[ */·.]?{_FACTOR})*")


def split_header(header: str) -> tuple[str, str]:
    """`force (N)` -> `force`, `N`."""
    match = _BRACKETED.fullmatch(header.strip())
    return (match[1].strip(), match[2].strip()) if match else (header.strip(), "")


def is_unit(text: str) -> bool:
    """Whether a field below a name is its unit: `N`, `[m/s]`, `deg`."""
    return _UNIT.fullmatch(text.strip()) is not None


def time_unit(header: str) -> str:
    """That of a column of times: `time (ms)`, `time_ms`, `t / ms` -> `ms`; "" if there is none."""
    trailing = _TRAILING.fullmatch(header.strip())
    return split_header(header)[1] or (trailing[2] if trailing else "")


def seconds(where: str, column: str, unit: str) -> float:
    """How many seconds a unit of time has; one without a name is taken as a second.

    **Raises:** `DefinitionError` for what is no unit of time.
    """
    if unit and unit not in _SECONDS:
        raise DefinitionError(
            f"{where}: the times in '{column}' are in '{unit}', which is no known unit of time: "
            "convert them to s, ms, us, ns, min or h (divide frames by the sampling rate)."
        )
    return _SECONDS[unit] if unit else 1.0
