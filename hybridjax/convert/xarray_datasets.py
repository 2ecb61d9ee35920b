"""Results as `xarray.Dataset`, and back where `hj.save` writes them.

| of an object | becomes in the dataset | by |
|---|---|---|
| arrays | variables; the names of axes in annotations become dimensions | `_axes`, `_AXES` |
| names of signals, numbers of harmonics | coordinates | `_COORDINATES` |
| all other fields | JSON in the attribute `hybridjax` | `_from_module` |

`from_xarray` goes the same way back (`_coordinates`, `_arrays`). `Recording`, `SectionData`,
`LimitCycles` and `Branch` only become datasets, each by a function of its own. A change of one way
needs one of the other; names of dimensions and coordinates must stay, as users select by them. A
new name of an axis in annotations gets its dimension in `_AXES`.

If an array has wrong dimensions, look at `_axes`; if a good dataset is refused, at `_require_order`
for parts of one, then at the constructor that `put_together` calls (`_core/archive.py`).
"""

import json
from typing import Any

import equinox as eqx
import numpy as np

from .._core.archive import options_of, put_together, restored, signals_in, taken_apart
from .._core.arguments import package
from .._core.boundary.checked import checked
from .._core.precision import require_x64
from .._core.signal import Signal, unit_of
from ..errors import DefinitionError, HybridJaxError
from ..fitting.model_fit import ModelFit
from ..io import KINDS, Saved
from ..linear.ldtp import LDTP
from ..orbits.branches import Branch
from ..orbits.limit_cycles import LimitCycles
from ..recordings.data import SectionData
from ..recordings.recording import Recording
from ..systems.system import arrays_of, unit_of_parameter


# The attribute with all that has no place elsewhere, as JSON.
_HEADER = "hybridjax"
# Names of coordinates and of the variable of events, which no signal may have.
_RESERVED = {"time", "trial", "event", "event_time", "event_trial"}
# Dimensions, by the names of axes in annotations.
_AXES = {
    "S": "experiment",
    "n": "sample",
    "N": "section",
    "M": "harmonic",
    "F": "frequency",
    "ny": "output",
    "nu": "input",
    "d": "multiplier",
}
_STATES = {
    "A": ("section", "next_state", "state"),
    "B": ("section", "next_state", "input"),
    "C": ("section", "output", "state"),
}
# Dimensions with an order in time.
_ORDERED = {"section", "sample"}
# Dimensions whose coordinates are a field beside the arrays.
_COORDINATES = {"input": "inputs", "output": "outputs", "harmonic": "harmonics"}


@checked
def to_xarray(
    thing: Saved | ModelFit | Recording | SectionData | LimitCycles | Branch,
) -> Any:
    """Return an `xarray.Dataset` with named dimensions, coordinates, and units.

    - Objects that `hj.save` writes: a variable for each array, such as `H` (harmonic, frequency,
      output, input) of an `HTF`, `A` (section, next_state, state) of an `LDTP`, `u` (experiment,
      sample, input) of `ExperimentData`. Inputs and outputs are coordinates, with `input_unit` and
      `output_unit` beside them. For a `ModelFit`, the dataset has its numbers, without its system.
    - `Recording`: a variable for each signal, along `sample`, with the coordinates `time` and
      `trial`; events along `occurrence`.
    - `SectionData`: the same at sections, and the `average_cycle`.
    - `LimitCycles` (along `system`) and `Branch` (along `point`): periods, multipliers and
      iterations; parameters are coordinates.

    **Arguments:**

    - `thing`: an object of one of these types.

    **Returns:** an `xarray.Dataset`.

    **Raises:** `DefinitionError` where xarray is not installed, for traced or batched objects, and
    for signals that are called like a coordinate; `PrecisionError` in single precision.

    **Example:**

    ```python
    dataset = hj.convert.to_xarray(htf)
    print(dataset.H.sel(harmonic=0, output="yM"))
    ```

    **Before:** any function that returns one of these objects. **After:** `hj.convert.from_xarray`.
    """
    require_x64()
    if isinstance(thing, ModelFit):
        thing = thing.estimate
    if isinstance(thing, Recording):
        return _from_recording(thing)
    if isinstance(thing, SectionData):
        return _from_section_data(thing)
    if isinstance(thing, LimitCycles):
        return _from_limit_cycles(thing, "system")
    return _from_branch(thing) if isinstance(thing, Branch) else _from_module(thing)


@checked
def from_xarray(dataset: Any) -> Saved:
    """Return the object from which `to_xarray` made a dataset, with the same numbers bit by bit.

    **Arguments:** `dataset`: an `xarray.Dataset` from `to_xarray`, made of an object
    that `hj.save` can write. It may also be a part of such a dataset. A part may select
    harmonics, frequencies, experiments and signals. Its samples must be consecutive,
    with the first at section 0.

    **Returns:** an object of the type that `to_xarray` was given.

    **Raises:** `DefinitionError` for other datasets; `PrecisionError` in single precision.

    **Example:**

    ```python
    dataset = hj.convert.to_xarray(htf)
    low = hj.convert.from_xarray(dataset.sel(harmonic=[-1, 0, 1]))
    ```

    **Before:** `hj.convert.to_xarray`.
    """
    require_x64()
    try:
        header = json.loads(dataset.attrs[_HEADER])
        kind = KINDS[header["kind"]]
    except (AttributeError, KeyError, TypeError, ValueError):
        raise DefinitionError(
            "`dataset` must be an xarray.Dataset that `to_xarray` made of a "
            f"{', '.join(KINDS)}."
        ) from None
    static = restored(header["static"], header["units"])
    try:
        _require_order(dataset, header["sizes"], static)
        static |= _coordinates(dataset)
        return put_together(kind, static, _arrays(kind, dataset))
    except (
        HybridJaxError,
        LookupError,
        TypeError,
        ValueError,
        AttributeError,
    ) as error:
        raise DefinitionError(
            f"`dataset` was changed since `to_xarray` made it of a {header['kind']}: {error}"
        ) from error


def _coordinates(dataset: Any) -> dict[str, tuple]:
    """The fields that are coordinates of a dataset: names of signals, and harmonics."""
    fields = {}
    for dimension, field in _COORDINATES.items():
        if dimension not in dataset.coords:
            continue
        fields[field] = tuple(x.item() for x in dataset[dimension].values)
        if f"{dimension}_unit" in dataset.coords:
            units = dataset[f"{dimension}_unit"].values
            fields[field] = tuple(map(Signal, fields[field], map(str, units)))
    return fields


def _require_order(dataset: Any, sizes: dict[str, int], static: dict[str, Any]) -> None:
    """**Raises:** `DefinitionError` for a part that does not begin at section 0, or has gaps; of
    sections, all must be there."""
    for dimension, size in sizes.items():
        order = dataset[dimension].values
        needs_all = dimension == "section"
        n_sections = size if needs_all else static["n_sections"]
        begins_late = order[0] % n_sections != 0
        has_gaps = (np.diff(order) != 1).any()
        lacks_some = needs_all and len(order) < size
        if begins_late or has_gaps or lacks_some:
            raise DefinitionError(f"`{dimension}` must be in order, from section 0 on.")


def _arrays(kind: type, dataset: Any) -> dict[str, np.ndarray]:
    """The arrays of an object of this type, by the names of its fields."""
    arrays = {}
    if "frequency" in dataset.coords:
        arrays["frequencies"] = np.asarray(dataset["frequency"].values)
    for name in map(str, dataset.data_vars):
        array = dataset[name]
        array = array.transpose(*_axes(kind, name, array.ndim))
        arrays[name] = np.asarray(array.values)
    return arrays


def _from_module(module: eqx.Module) -> Any:
    """The dataset of an object that `hj.save` can write."""
    static, arrays = taken_apart(module)
    coordinates: dict[str, Any] = {}
    for dimension, field in _COORDINATES.items():
        values = static.pop(field, None)
        if values is not None:
            coordinates[dimension] = [
                str(x) if isinstance(x, str) else int(x) for x in values
            ]
            if isinstance(values[0], str):
                coordinates[f"{dimension}_unit"] = dimension, list(map(unit_of, values))
    kind = type(module)
    variables = {name: (_axes(kind, name, x.ndim), x) for name, x in arrays.items()}
    if "frequencies" in variables:
        coordinates["frequency"] = variables.pop("frequencies")
    units = {str(name): name.unit for name in signals_in(static)}
    dataset = package("xarray").Dataset(variables, coordinates)
    sizes = {x: n for x, n in dataset.sizes.items() if x in _ORDERED}
    header = {"kind": kind.__name__, "static": static, "units": units, "sizes": sizes}
    text = json.dumps(header, default=lambda x: x.item())
    order = {x: np.arange(n) for x, n in sizes.items()}
    return dataset.assign_coords(order).assign_attrs({_HEADER: text})


def _axes(kind: type, name: str, ndim: int) -> tuple[str, ...]:
    """Return the dimensions of a field; `outer.inner` is one of a module in a field. Private arrays
    and those of a model in a fit have dimensions of their own."""
    if kind is LDTP and name in _STATES:
        return _STATES[name]
    own = tuple(f"{name}, axis {k}" for k in range(ndim))
    if name.startswith("_"):
        return own
    hint: Any = kind
    for part in name.split("."):
        module = next(
            x for x in options_of(hint) if isinstance(x, type) and hasattr(x, "__mro__")
        )
        if module is LDTP and kind is not LDTP:
            return own
        hint = module.__dataclass_fields__[part].type  # type: ignore[attr-defined]
    shaped = next(x for x in options_of(hint) if hasattr(x, "dim_str"))
    axes: list[str] = []
    for axis in str(shaped.dim_str).split():
        axis = _AXES.get(axis, axis)
        axes.append(f"{axis}_{axes.count(axis) + 1}" if axis in axes else axis)
    return tuple(axes)


def _from_recording(recording: Recording) -> Any:
    trials = recording.trials
    variables = _signals(recording, np.concatenate([t.values for t in trials]))
    event = list[str]()
    event_time = list[float]()
    event_trial = list[int]()
    for s, trial in enumerate(trials):
        for name, times in trial.events.items():
            event += [name] * len(times)
            event_time += list(times)
            event_trial += [s] * len(times)
    variables["event"] = "occurrence", np.array(event, str)
    lengths = [len(trial.time) for trial in trials]
    time = np.concatenate([trial.time for trial in trials])
    seconds = {"units": "s"}
    coordinates = {
        "time": ("sample", time, seconds),
        "trial": ("sample", np.repeat(np.arange(len(trials)), lengths)),
        "event_time": ("occurrence", np.array(event_time, float), seconds),
        "event_trial": ("occurrence", np.array(event_trial, int)),
    }
    return package("xarray").Dataset(variables, coordinates)


def _from_section_data(data: SectionData) -> Any:
    records = data.records
    N = data.n_sections
    lengths = [len(r.u) for r in records]
    values = [np.concatenate([r.u, r.y], axis=1) for r in records]
    variables = _signals(data, np.concatenate(values))
    cycle = np.concatenate([data.cycle_inputs, data.cycle_outputs], axis=1)
    variables["average_cycle"] = ("phase", "signal"), cycle
    samples = [r.first_section + np.arange(len(r.u)) for r in records]
    coordinates = {
        "time": ("sample", np.concatenate(data.times), {"units": "s"}),
        "trial": ("sample", np.repeat(data.trials, lengths)),
        "record": ("sample", np.repeat(np.arange(len(records)), lengths)),
        "section": ("sample", np.concatenate(samples) % N),
        "phase": np.arange(N) / N,
        "signal": list(map(str, data.signals)),
    }
    attributes = {"n_sections": N, "period": data.period, "bandwidth": data.bandwidth}
    return package("xarray").Dataset(variables, coordinates, attributes)


def _from_limit_cycles(cycles: LimitCycles, dimension: str) -> Any:
    """Return the dataset of cycles, with those numbers of the systems that differ by coordinate: a
    number of a part has its path, with dots, as name."""
    variables: dict[str, Any] = {
        name: (dimension, np.asarray(getattr(cycles, name)))
        for name in ("period", "residual", "iterations", "result")
    }
    variables["multipliers"] = (dimension, "multiplier"), cycles.multipliers
    parameters = {}
    for name, leaf in arrays_of(cycles.systems).items():
        if leaf.shape == (len(cycles),):
            unit = unit_of_parameter(cycles.systems, name)
            parameters[name] = _variable(dimension, np.asarray(leaf), unit)
    return package("xarray").Dataset(variables, parameters)


def _from_branch(branch: Branch) -> Any:
    """Return the dataset of the cycles, with the kinds of bifurcations ("" for other points) and
    the stability of the cycles."""
    kinds = np.full(len(branch), "", dtype="U16")
    for point in branch.bifurcations:
        kinds[point.index] = point.kind
    return _from_limit_cycles(branch.cycles, "point").assign(
        multipliers=(("point", "multiplier"), branch.multipliers),
        stable=("point", branch.stable),
        kind=("point", kinds),
    )


def _signals(data: Recording | SectionData, values: np.ndarray) -> dict[str, Any]:
    """Return a variable for each signal, along the samples.

    **Raises:** `DefinitionError` for signals that are called like a coordinate.
    """
    reserved = _RESERVED & set(data.signals)
    if reserved:
        raise DefinitionError(
            f"'{min(reserved)}' is also the name of a coordinate: rename it."
        )
    triples = zip(data.signals, data.units, values.T, strict=True)
    return {str(name): _variable("sample", x, unit) for name, unit, x in triples}


def _variable(dimension: str, values: np.ndarray, unit: str | None) -> tuple:
    return dimension, values, {"units": unit} if unit else {}
