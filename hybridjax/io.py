"""Designs, data, models, transfer functions and fits in files: npz with a JSON header.

A file is an ordinary npz archive: one array per array field, named like the field, and the array
`header`, a JSON text with the kind of object, its static fields and the conventions in words.
`numpy.load(path)` reads it without this package. Nothing in a file is ever executed: there is
no pickle, and only the kinds listed here are built, by their own checked constructors.
"""

import contextlib
import dataclasses
import inspect
import io
import json
import os
import types
import typing
import uuid
import zipfile
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import jaxtyped

from . import __version__
from ._core.precision import require_x64
from ._core.tracing import is_traced
from .errors import DefinitionError, FileFormatError, HybridJaxError
from .experiments.data import ExperimentData
from .experiments.design.design import Design
from .experiments.record import Record
from .identify.multipliers.structured import StructuredFit
from .identify.rational.fit import RationalFit
from .identify.series.series_fit import SeriesFit
from .linear.htf import HTF
from .linear.ldtp import LDTP


Saved = Design | ExperimentData | HTF | LDTP | RationalFit | Record | SeriesFit | StructuredFit

_KINDS: dict[str, type] = {kind.__name__: kind for kind in typing.get_args(Saved)}
_FORMAT, _VERSION = "hybridjax", 1
_HEADER = "header"


def save(path: str | os.PathLike, thing: Any) -> None:
    """Write an object to an npz file; `load` gives back an equal one, bit by bit.

    The file appears complete or not at all: an old file of that name stays until then.

    **Arguments:**

    - `path`: ends in `.npz`; its folder must exist.
    - `thing`: a `Design`, `ExperimentData`, `HTF`, `LDTP`, `RationalFit`, `Record`, `SeriesFit`
      or `StructuredFit`.

    **Raises:** `DefinitionError` for other objects, traced or batched ones, another suffix, and
    where the file cannot be written; `PrecisionError` in single precision.
    """
    path = Path(path)
    kind = type(thing).__name__
    if type(thing) is not _KINDS.get(kind):
        raise DefinitionError(f"save takes {_list(_KINDS)}; it cannot write a {kind}.")
    if path.suffix != ".npz":
        raise DefinitionError(f"save writes npz files: let the name '{path.name}' end in '.npz'.")
    if is_traced(thing):
        raise DefinitionError("save needs values: call it outside of jit, vmap and derivatives.")
    require_x64(thing)
    if (wrong := _wrong_field(thing)) is not None:
        raise DefinitionError(f"this {kind} cannot be saved: {wrong}.")
    arrays, static = {}, {}
    for field in dataclasses.fields(thing):
        value = getattr(thing, field.name)
        if field.metadata.get("static", False):
            static[field.name] = value
        elif value is not None:
            arrays[field.name] = np.asarray(value)
    header = {
        "format": _FORMAT,
        "format_version": _VERSION,
        "package_version": __version__,
        "kind": kind,
        "static": static,
        "arrays": {name: f"{array.dtype}{list(array.shape)}" for name, array in arrays.items()},
        "conventions": inspect.cleandoc(type(thing).__doc__ or ""),
    }
    text = json.dumps(header, indent=1, default=lambda x: x.item())
    _write(path, {_HEADER: np.array(text), **arrays})


def load(path: str | os.PathLike) -> Saved:
    """Read an object that `save` has written.

    **Raises:** `FileFormatError` if the file is damaged, was not written by `save`, or is of
    another format version; `DefinitionError` if it is not there or cannot be read;
    `PrecisionError` in single precision.
    """
    require_x64()
    path = Path(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DefinitionError(f"cannot read '{path}': {error.strerror}.") from error
    members = _unpack(path, content)
    header = _read_header(path, members.pop(_HEADER, None))
    kind = _KINDS[header["kind"]]
    static, listed = header["static"], header["arrays"]
    fields = dataclasses.fields(kind)
    known = {f.name: f.metadata.get("static", False) for f in fields}
    if set(listed) != set(members):
        raise _damaged(path, "its arrays are not those that its header lists")
    later = {f.name for f in fields if f.default is not dataclasses.MISSING}
    given, all_static = set(static), {n for n in known if known[n]}
    if not all_static - later <= given <= all_static or any(known.get(n, True) for n in listed):
        raise _damaged(path, f"its fields are not those of {kind.__name__}")
    absent = {name: None for name in known if not known[name] and name not in listed}
    values = {name: _tuples(value) for name, value in static.items()}
    try:
        thing = kind(**values, **members, **absent)
    except (HybridJaxError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise _damaged(path, f"its content is no {kind.__name__} ({error})") from error
    if (wrong := _wrong_field(thing)) is not None:
        raise _damaged(path, wrong)
    return thing


def _write(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """All or nothing: a temporary file in the same folder takes the place of `path`."""
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        with open(temporary, "xb") as file:
            np.savez(file, allow_pickle=False, **arrays)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise DefinitionError(f"cannot write '{path}': {error.strerror}.") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def _unpack(path: Path, content: bytes) -> dict[str, np.ndarray]:
    """The arrays of an npz file. Whole members are read, so that their checksums are checked."""
    if not zipfile.is_zipfile(io.BytesIO(content)):
        raise FileFormatError(f"'{path}' is not an npz file, or is damaged.")
    try:
        arrays = {}
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            for info in archive.infolist():
                if info.file_size > len(content):  # `save` does not compress
                    raise ValueError("a member is larger than the file")
                stream = io.BytesIO(archive.read(info))
                array = np.lib.format.read_array(stream, allow_pickle=False)
                if stream.read(1):
                    raise ValueError("an array ends before its data")
                arrays[info.filename.removesuffix(".npy")] = array
        return arrays
    except Exception as error:  # whatever broken bytes make zipfile and numpy stumble over
        raise _damaged(path, str(error) or type(error).__name__) from error


def _read_header(path: Path, array: np.ndarray | None) -> dict[str, Any]:
    try:
        header = json.loads(array.item())
        name, version = header["format"], header["format_version"]
    except (AttributeError, ValueError, TypeError, KeyError, RecursionError):
        name = None
    if name != _FORMAT:
        raise FileFormatError(f"'{path}' was not written by hybridjax.save.")
    if version != _VERSION:
        raise FileFormatError(
            f"'{path}' has format version {version} (hybridjax {header.get('package_version')}), "
            f"but hybridjax {__version__} reads version {_VERSION}: use a matching hybridjax."
        )
    kind = header.get("kind")
    if not isinstance(kind, str) or kind not in _KINDS:
        raise FileFormatError(f"'{path}' holds a {kind!r}; load knows {_list(_KINDS)}.")
    if not all(isinstance(header.get(part), dict) for part in ("static", "arrays")):
        raise _damaged(path, "its header is incomplete")
    return header


def _damaged(path: Path, reason: str) -> FileFormatError:
    return FileFormatError(f"'{path}' is damaged: {reason.rstrip('.')}.")


def _tuples(value: Any) -> Any:
    """JSON's lists as the tuples that they were."""
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _wrong_field(thing: eqx.Module) -> str | None:
    """The first field that is not what its annotation says; array axes of one name must agree."""
    with jaxtyped("context"):
        for field in dataclasses.fields(thing):
            value = getattr(thing, field.name)
            if not _matches(value, field.type):
                what = f"{value.dtype}{value.shape}" if hasattr(value, "dtype") else repr(value)
                return f"{field.name} is {what}"
    return None


def _matches(value: Any, hint: Any) -> bool:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is types.UnionType or origin is typing.Union:
        return any(_matches(value, option) for option in arguments)
    if origin is tuple:  # tuple[X, ...], the only form in use
        return isinstance(value, tuple) and all(_matches(x, arguments[0]) for x in value)
    if hint is int:
        return isinstance(value, int | np.integer) and not isinstance(value, bool)
    return isinstance(value, hint)


def _list(names) -> str:
    return ", ".join(names)
