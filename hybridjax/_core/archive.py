"""Equinox modules in npz files with a JSON header, written whole or not at all.

One array per array field, named like the field (`outer.inner` where a field is a module itself),
and the array `header`. Nothing in a file is ever executed: there is no pickle, and a reader builds
only the kinds that it asks for, by their own checked constructors. All of this must stay so, since
files come from anywhere.

`hj.save` and `hj.load` call `write_module` and `read_module`. `taken_apart` and `put_together` are
inverse to each other: a change of one needs one of the other, and `_VERSION` one more if old files
can no longer be read. If a result cannot be saved, compare its fields with their annotations
(`_matches`). If a good file is refused, look at `_read_header`, `_check_sizes` and `_array`; if its
content is, at `put_together`, or at the constructor of the result.
"""

import dataclasses
import inspect
import io
import json
import math
import os
import reprlib
import textwrap
import types
import typing
import zipfile
from collections.abc import Iterator, Mapping
from errno import EINVAL
from pathlib import Path
from typing import Any, NamedTuple, cast

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import jaxtyped

from .. import __version__
from . import limits
from .exceptions import DefinitionError, FileFormatError, HybridJaxError
from .signal import Signal
from .writing import replacing


_FORMAT = "hybridjax"
_VERSION = 2
_HEADER = "header"


def write_module(path: Path, thing: eqx.Module) -> None:
    """Write a module whose fields are arrays, modules, `None`, or static values of JSON, to an npz
    or MATLAB file.

    **Raises:** `DefinitionError` if a field is not what its annotation says, or the file cannot be
    written.
    """
    kind = type(thing).__name__
    wrong = _wrong_field(thing)
    if wrong is not None:
        raise DefinitionError(
            f"this {kind} cannot be saved: its {wrong}, a wrong type or shape."
        )
    static, arrays = taken_apart(thing)
    header = {
        "format": _FORMAT,
        "format_version": _VERSION,
        "package_version": __version__,
        "kind": kind,
        "static": static,
        "units": {str(name): name.unit for name in signals_in(static)},
        "arrays": {
            name: f"{array.dtype}{list(array.shape)}" for name, array in arrays.items()
        },
        "conventions": inspect.cleandoc(type(thing).__doc__ or ""),
    }
    text = json.dumps(header, indent=1, default=lambda x: x.item())
    with replacing(path) as temporary, open(temporary, "xb") as file:
        if path.suffix == ".mat":
            # (MATLAB has no names that begin with `_`: they are private, and of no use there.)
            named = {
                name.replace(".", "_"): array
                for name, array in arrays.items()
                if not name.startswith("_")
            }
            scipy.io.savemat(file, {_HEADER: text, **named})
        else:
            np.savez(file, allow_pickle=False, **{_HEADER: np.array(text)}, **arrays)
        file.flush()
        os.fsync(file.fileno())


def read_module(path: Path, kinds: Mapping[str, type]) -> Any:
    """Read a module of one of these kinds.

    **Raises:** `DefinitionError` if the file cannot be read; `FileFormatError` if it is damaged, of
    another format or version, or holds something else.
    """
    try:
        members = read_arrays(path)
    except OSError as error:
        raise DefinitionError(f"cannot read '{path}': {error.strerror}.") from error
    header = _read_header(path, members.pop(_HEADER, None), kinds)
    kind = kinds[header["kind"]]
    static = restored(header["static"], header["units"])
    if set(header["arrays"]) != set(members):
        raise damaged(path, "its arrays are not those that its header lists")
    try:
        return put_together(kind, static, members)
    except (HybridJaxError, TypeError, ValueError, IndexError, AttributeError) as error:
        # (Whatever a constructor objects to: its text is shown as it is.)
        reason = textwrap.shorten(str(error), 200)
        raise damaged(path, f"its content is no {kind.__name__} ({reason})") from error


class _Field(NamedTuple):
    """A field of a module or of a named tuple."""

    name: str
    type: Any
    static: bool
    required: bool


def _fields_of(kind: type) -> list[_Field]:
    """Return the fields of a module or of a named tuple, whose `bool` fields count as static."""
    if issubclass(kind, tuple):
        hints = typing.get_type_hints(kind)
        return [
            _Field(
                name=name,
                type=x,
                static=x is bool,
                required=True,
            )
            for name, x in hints.items()
        ]
    fields = []
    for x in dataclasses.fields(cast(Any, kind)):
        is_static = x.metadata.get("static", False)
        is_required = x.default is dataclasses.MISSING
        fields.append(
            _Field(
                name=x.name,
                type=x.type,
                static=is_static,
                required=is_required,
            )
        )
    return fields


def _is_made_of_fields(value: Any) -> bool:
    return isinstance(value, eqx.Module) or hasattr(value, "_fields")


def taken_apart(
    thing: eqx.Module | tuple,
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Static fields and arrays; a module or a named tuple among the fields becomes a dictionary of
    its own static fields, and arrays with its name before theirs. A list of arrays becomes their
    number, and arrays with the name and an index. Modules in a tuple have static fields only."""
    static: dict[str, Any] = {}
    arrays: dict[str, np.ndarray] = {}
    for field in _fields_of(type(thing)):
        value = getattr(thing, field.name)
        if field.static:
            static[field.name] = value
        elif _is_made_of_fields(value):
            static[field.name], inner = taken_apart(value)
            arrays |= {f"{field.name}.{name}": array for name, array in inner.items()}
        elif isinstance(value, list):
            static[field.name] = len(value)
            arrays |= {f"{field.name}.{k}": np.asarray(x) for k, x in enumerate(value)}
        elif isinstance(value, tuple):
            static[field.name] = [taken_apart(x)[0] for x in value]
        elif value is not None:
            arrays[field.name] = np.asarray(value)
    return static, arrays


def put_together(kind: type, static: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """The module that `taken_apart` took apart. Fields that are not there are `None`, or have
    their defaults where they are static.

    **Raises:** `ValueError` for other fields, or a value that is not what its annotation says.
    """
    other = ValueError(f"its fields are not those of {kind.__name__}")
    if not isinstance(static, dict):
        raise other
    static = dict(static)
    arrays = dict(arrays)
    values = {}
    for field in _fields_of(kind):
        if not field.static:
            values[field.name] = _taken(field, static, arrays, other)
        elif field.name in static:
            values[field.name] = _setting(field, static.pop(field.name))
        elif field.required:
            raise other
    if static or arrays:
        raise other
    module = kind(**values)
    wrong = _wrong_field(module)
    if wrong is not None:
        raise ValueError(wrong)
    return module


def _setting(field: _Field, value: Any) -> Any:
    """The value of a static field.

    **Raises:** `ValueError` for a value that is not what the annotation says.
    """
    if not _matches(value, field.type):
        raise ValueError(f"{field.name} is {reprlib.repr(value)}")
    return value


def _taken(
    field: _Field,
    static: dict[str, Any],
    arrays: dict[str, np.ndarray],
    other: ValueError,
) -> Any:
    """The value of a field of arrays or modules, whose parts leave `static` and `arrays`.

    **Raises:** `other` if parts of a list are missing.
    """
    name = field.name
    inner = _module_in(field.type)
    item = _item_of(field.type)
    if typing.get_origin(field.type) is list:
        count = static.pop(name, None)
        if not _matches(count, int):
            raise other
        names = [f"{name}.{k}" for k in range(count)]
        if any(x not in arrays for x in names):
            raise other
        return [arrays.pop(x) for x in names]
    if item is not None:
        return tuple(put_together(item, x, {}) for x in static.pop(name, ()))
    if inner is not None and name in static:
        names = [x for x in arrays if x.startswith(f"{name}.")]
        part = {x.removeprefix(f"{name}."): arrays.pop(x) for x in names}
        return put_together(inner, static.pop(name), part)
    return arrays.pop(name, None)


def options_of(hint: Any) -> tuple[Any, ...]:
    """The types of which a field may be."""
    return typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)


def _module_in(hint: Any) -> type | None:
    """The kind of module, or of named tuple, that a field of this type may hold."""
    classes = (x for x in options_of(hint) if isinstance(x, type))
    made = (x for x in classes if issubclass(x, eqx.Module) or hasattr(x, "_fields"))
    return next(made, None)


def _item_of(hint: Any) -> type | None:
    """The kind of module of which a field of this type holds a tuple."""
    if typing.get_origin(hint) is not tuple:
        return None
    return _module_in(typing.get_args(hint)[0])


def _read_header(
    path: Path, array: np.ndarray | None, kinds: Mapping[str, type]
) -> dict[str, Any]:
    """Return the header in the array `header` of a file.

    **Raises:** `FileFormatError` if there is none, if it is of another format or version or of a
    kind that is not among `kinds`, or if parts are missing.
    """
    try:
        if array is None or array.nbytes > limits.TEXT:
            raise ValueError
        header = json.loads(array.item())
        name = header["format"]
        version = header["format_version"]
    except (AttributeError, ValueError, TypeError, KeyError, RecursionError):
        name = None
    if name != _FORMAT:
        raise FileFormatError(
            f"'{path}' was not written by `hj.save`, whose files alone are read."
        )
    if version != _VERSION:
        raise FileFormatError(
            f"'{path}' has format version {version}, not {_VERSION}: use hybridjax "
            f"{header.get('package_version')}."
        )
    kind = header.get("kind")
    if not isinstance(kind, str) or kind not in kinds:
        raise FileFormatError(
            f"'{path}' holds a {kind!r}; `load` reads {', '.join(kinds)} only."
        )
    header.setdefault("units", {})  # (files written before units were kept)
    parts = [header.get(part) for part in ("static", "arrays", "units")]
    if not all(isinstance(part, dict) for part in parts):
        raise damaged(path, "its header is incomplete")
    return header


def signals_in(value: Any) -> Iterator[Signal]:
    """All names with a unit."""
    if isinstance(value, Signal) and value.unit:
        yield value
    if isinstance(value, dict):
        value = tuple(value.values())
    if isinstance(value, tuple):
        for part in value:
            yield from signals_in(part)


def restored(value: Any, units: Mapping[str, str]) -> Any:
    """JSON's lists as the tuples that they were, and names with their units."""
    if isinstance(value, dict):
        return {key: restored(part, units) for key, part in value.items()}
    if isinstance(value, list):
        return tuple(restored(part, units) for part in value)
    if isinstance(value, str) and value in units:
        return Signal(value, str(units[value]))
    return value


def _wrong_field(thing: eqx.Module | tuple) -> str | None:
    """The first field that is not what its annotation says; array axes of one name must agree."""
    with jaxtyped("context"):
        for field in _fields_of(type(thing)):
            value = getattr(thing, field.name)
            if not _matches(value, field.type):
                if hasattr(value, "dtype"):
                    return f"{field.name} is {value.dtype}{value.shape}"
                return f"{field.name} is {value!r}"
            if _is_made_of_fields(value):
                wrong = _wrong_field(value)
                if wrong is not None:
                    return f"{field.name}.{wrong}"
    return None


def _matches(value: Any, hint: Any) -> bool:
    """Return whether a value is what an annotation says, of the forms that annotations of fields
    have."""
    origin = typing.get_origin(hint)
    arguments = typing.get_args(hint)
    if origin is typing.Annotated:
        return _matches(value, arguments[0])
    if origin is typing.Literal:
        return value in arguments
    if origin is types.UnionType or origin is typing.Union:
        return any(_matches(value, option) for option in arguments)
    if origin is tuple:  # tuple[X, ...], the only form in use
        return isinstance(value, tuple) and all(
            _matches(x, arguments[0]) for x in value
        )
    if origin is list:  # of arrays whose shapes differ
        return isinstance(value, list) and all(isinstance(x, np.ndarray) for x in value)
    if hint is int:  # none that is larger than a header may declare
        whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
        return whole and bool(abs(value) <= limits.PERIODS)
    return isinstance(value, hint)


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays by name. Members are read whole, so that their checksums are checked.

    **Raises:** `OSError` if the file cannot be read; `FileFormatError` if it is damaged, no npz
    file, holds Python objects, or declares more than `limits` allow.
    """
    if path.stat().st_size == 0:  # also of a pipe or device, which may have no end
        raise FileFormatError(f"'{path}' is empty: write it again.")
    with open(path, "rb") as file:
        try:
            with zipfile.ZipFile(file) as archive:
                members = archive.infolist()
                _check_sizes(members, path.stat().st_size)
                return {
                    m.filename.removesuffix(".npy"): _array(archive, m) for m in members
                }
        except Exception as error:
            # (Whatever broken bytes make zipfile and numpy stumble over. A place outside of the
            # file is EINVAL; what else the system reports is no damage. The text is shown as it
            # is.)
            if (
                isinstance(error, MemoryError)
                or getattr(error, "errno", EINVAL) != EINVAL
            ):
                raise
            raise damaged(path, str(error) or type(error).__name__) from error


def damaged(path: Path, reason: str) -> FileFormatError:
    return FileFormatError(
        f"'{path}' is damaged, or no npz file: {reason.rstrip('.')}."
    )


def _check_sizes(members: list[zipfile.ZipInfo], packed: int) -> None:
    """**Raises:** `ValueError` if arrays are larger than a file of `packed` bytes may hold, or two
    have one name."""
    size = sum(m.file_size for m in members)
    most = limits.unpacked(packed)
    if size > most:
        raise ValueError(
            f"it declares arrays of {size} bytes, but packs them into {packed}"
        )
    if len({m.filename for m in members}) < len(members):
        raise ValueError("two of its arrays have one name")


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """Read an array, after its header was found to declare as many bytes as there are.

    **Raises:** `ValueError` for Python objects, and for another size.
    """
    with archive.open(member) as stream:
        major, minor = np.lib.format.read_magic(stream)
        read_header = getattr(np.lib.format, f"read_array_header_{major}_{minor}")
        shape, _, dtype = read_header(stream)
        declared = stream.tell() + math.prod(shape) * dtype.itemsize
    if dtype.hasobject:
        raise ValueError(f"'{member.filename}' holds Python objects")
    if declared != member.file_size or math.prod(shape) > member.file_size:
        raise ValueError(
            f"'{member.filename}' declares the shape {shape}, and is not that large"
        )
    return np.lib.format.read_array(
        io.BytesIO(archive.read(member)), allow_pickle=False
    )
