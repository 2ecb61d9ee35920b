"""Results as `xarray.Dataset`, and back."""

import json
from typing import Any

from .._core.boundary.checked import checked
from .._core.executor import is_traced
from .._core.precision import require_x64
from ..errors import DefinitionError
from ..io import KINDS, Saved
from ..orbits.branch import Branch
from ..orbits.limit_cycles import LimitCycles
from ..recordings.data import SectionData
from ..recordings.recording import Recording
from .families import from_branch, from_limit_cycles
from .measured import from_recording, from_section_data, to_recording, to_section_data
from .modules import REST, from_module, to_module


@checked
def to_xarray(thing: Saved | Recording | SectionData | LimitCycles | Branch) -> Any:
    """An `xarray.Dataset` with named dimensions, coordinates, and units.

    - What `hj.save` writes: a variable for each array, such as `H` (harmonic, f, output, input) of
      an `HTF`, `A` (section, next_state, state) of an `LDTP`, `u` (experiment, sample, input) of
      `ExperimentData`. Inputs and outputs are coordinates, with `input_unit` and `output_unit`
      beside them.
    - `Recording`: a variable for each signal, along `sample`, with the coordinates `time` and
      `trial`; events along `occurrence`.
    - `SectionData`: the same at sections, and the `average_cycle`.
    - `LimitCycles` (along `system`) and `Branch` (along `point`): periods, multipliers and the
      like; parameters are coordinates.

    **Raises:** `DefinitionError` where xarray is not installed, for traced or batched objects, and
    for signals that are called like a coordinate; `PrecisionError` in single precision.
    """
    if is_traced(thing):
        raise DefinitionError("to_xarray needs values: call it outside of jit and derivatives.")
    require_x64()
    for kind, make in _MAKERS.items():
        if isinstance(thing, kind):
            return make(thing)
    return from_module(thing)


@checked
def from_xarray(dataset: Any) -> Saved | Recording | SectionData:
    """What `to_xarray` made a dataset of, bit by bit: one of those that `hj.save` writes, a
    `Recording`, or `SectionData`. Harmonics, frequencies, experiments, samples and signals may have
    been selected, and records of `SectionData`.

    There is no way back to `LimitCycles` and a `Branch`: their systems hold functions, which no
    dataset does. `find_limit_cycles` and `continuation` find them again from the parameters.

    **Raises:** `DefinitionError` for other datasets.
    """
    require_x64()
    try:
        rest = json.loads(dataset.attrs[REST])
        kind = rest["kind"]
    except (AttributeError, KeyError, TypeError, ValueError):
        kind = None
    if kind == Recording.__name__:
        return to_recording(dataset, rest)
    if kind == SectionData.__name__:
        return to_section_data(dataset, rest)
    if kind not in KINDS:
        raise DefinitionError(
            "`dataset` must be an xarray.Dataset that `to_xarray` made of a "
            f"{', '.join(KINDS)}, Recording or SectionData."
        )
    return to_module(dataset, rest, KINDS[kind])


_MAKERS: dict[type, Any] = {
    Recording: from_recording,
    SectionData: from_section_data,
    LimitCycles: from_limit_cycles,
    Branch: from_branch,
}
