"""What `hj.save` writes, as `xarray.Dataset`, and back.

Axes of arrays have names in the annotations of fields; these become dimensions. Names of signals
and numbers of harmonics become their coordinates, and what has no place elsewhere an attribute, as
JSON.
"""

import json
import types
import typing
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import numpy as np

from .._core.archive import put_together, restored, signals_in, taken_apart
from .._core.arguments import package
from .._core.signal import Signal, unit_of
from ..errors import DefinitionError, HybridJaxError
from ..linear.ldtp import LDTP


# The attribute with all that has no place elsewhere.
REST = "hybridjax"

# What axes are called, by their names in annotations.
_AXES = {
    "S": "experiment", "n": "sample", "N": "section", "M": "harmonic", "F": "f",
    "ny": "output", "nu": "input", "d": "multiplier",
}  # fmt: skip
_STATES = {
    "A": ("section", "next_state", "state"),
    "B": ("section", "next_state", "input"),
    "C": ("section", "output", "state"),
}
# Dimensions whose coordinates are a field beside the arrays.
_COORDINATES = {"input": "inputs", "output": "outputs", "harmonic": "harmonics"}


def from_module(thing: eqx.Module) -> Any:
    """The dataset of a module whose fields are arrays, modules, or static values of JSON."""
    static, arrays = taken_apart(thing)
    coordinates: dict[str, Any] = {}
    for dimension, field in _COORDINATES.items():
        values = static.pop(field, None)
        if values is not None:
            coordinates[dimension] = list(map(_plain, values))
            if isinstance(values[0], str):
                coordinates[f"{dimension}_unit"] = dimension, list(map(unit_of, values))
    variables = {name: (_axes(type(thing), name), array) for name, array in arrays.items()}
    coordinates |= {name: variables.pop(name) for name in {"f"} & set(variables)}
    rest = {
        "kind": type(thing).__name__,
        "static": static,
        "units": {str(name): name.unit for name in signals_in(static)},
    }
    attributes = {REST: json.dumps(rest, default=lambda x: x.item())}
    return package("xarray").Dataset(variables, coordinates, attributes)


def to_module(dataset: Any, rest: Mapping[str, Any], kind: type) -> Any:
    """The module of a dataset of `from_module`; coordinates may have been selected.

    **Raises:** `DefinitionError` if it is none.
    """
    try:
        static = restored(rest["static"], rest["units"])
        for dimension, field in _COORDINATES.items():
            if dimension in dataset.coords:
                static[field] = tuple(x.item() for x in dataset[dimension].values)
            if f"{dimension}_unit" in dataset.coords:
                units = dataset[f"{dimension}_unit"].values
                static[field] = tuple(map(Signal, static[field], map(str, units)))
        arrays = {
            str(name): np.asarray(dataset[name].transpose(*_axes(kind, str(name))).values)
            for name in {*dataset.data_vars, *({"f"} & set(dataset.coords))}
        }
        return put_together(kind, static, arrays)
    except (HybridJaxError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise DefinitionError(f"the dataset is no {kind.__name__}: {error}") from error


def _axes(kind: type, name: str) -> tuple[str, ...]:
    """The dimensions of a field; `outer.inner` is one of a module in a field."""
    if kind is LDTP and name in _STATES:
        return _STATES[name]
    hint: Any = kind
    for part in name.split("."):
        module = next(x for x in _options(hint) if isinstance(x, type) and hasattr(x, "__mro__"))
        hint = module.__dataclass_fields__[part].type
    shaped = next(x for x in _options(hint) if hasattr(x, "dim_str"))
    axes: list[str] = []
    for axis in shaped.dim_str.split():
        axis = _AXES.get(axis, axis)
        axes.append(f"{axis}_{axes.count(axis) + 1}" if axis in axes else axis)
    return tuple(axes)


def _options(hint: Any) -> tuple[Any, ...]:
    return typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)


def _plain(value: str | int) -> str | int:
    return str(value) if isinstance(value, str) else int(value)
