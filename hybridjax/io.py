"""Designs, data, models, transfer functions and fits in files: npz with a JSON header.

A file is an ordinary npz archive: one array per array field, named like the field, and the array
`header`, a JSON text with the kind of object, its static fields and the conventions in words.
`numpy.load(path)` reads it without this package. Nothing in a file is ever executed: there is
no pickle, and only the kinds listed here are built, by their own checked constructors.
"""

import typing
from pathlib import Path
from typing import Annotated

from ._core.archive import read_module, write_module
from ._core.boundary.checked import checked
from ._core.boundary.kinds import FilePath
from ._core.boundary.values import Plain
from ._core.precision import require_x64
from .errors import DefinitionError
from .experiments.data import ExperimentData
from .experiments.design.design import Design
from .experiments.record import SectionSeries
from .fitting.model_fit import ModelFit, ParameterEstimate
from .identify.joint.fit import LDTPFit
from .identify.multiplier_estimate import MultiplierEstimate
from .identify.multipliers import StructuredFit
from .identify.rational import RationalFit
from .identify.series.fit import SeriesFit
from .linear.htf import HTF
from .linear.ldtp import LDTP
from .plants.cycle import Returns
from .recordings.natural import NaturalMultipliers


Saved: typing.TypeAlias = (
    Design
    | ExperimentData
    | HTF
    | LDTP
    | LDTPFit
    | MultiplierEstimate
    | NaturalMultipliers
    | ParameterEstimate
    | RationalFit
    | SectionSeries
    | Returns
    | SeriesFit
    | StructuredFit
)

Written = Annotated[
    Saved | ModelFit,
    Plain(
        "a design, data, a transfer function, a model or a fit",
        lambda thing: isinstance(thing, (*KINDS.values(), ModelFit)),
    ),
]

KINDS: dict[str, type] = {kind.__name__: kind for kind in typing.get_args(Saved)}


@checked
def save(path: FilePath, thing: Written) -> None:
    """Write an object to an npz file; `load` gives back an equal one, bit by bit.

    Files contain no code, and therefore no systems. A `ModelFit` is therefore written as its
    `estimate`: the numbers of the fit, without the system.

    The file appears complete or not at all: an old file of that name stays until then. With the
    suffix `.mat` it is a MATLAB file, which holds the same arrays, and a text `header` in JSON.
    Names have `_` in place of `.` there. `load` does not read MATLAB files.

    **Arguments:**

    - `path`: ends in `.npz` or `.mat`; its folder must exist.
    - `thing`: a `Design`, `ExperimentData`, `HTF`, `LDTP`, `SectionSeries`, or any fit.

    **Returns:** None.

    **Raises:** `DefinitionError` for other objects, traced or batched ones, another suffix, and
    where the file cannot be written; `PrecisionError` in single precision.

    **Example:**

    ```python
    hj.save("htf.npz", htf)
    hj.save("htf.mat", htf)
    ```

    **Before:** any function that returns one of these objects. **After:** `hj.load`.
    """
    path = Path(path)
    if isinstance(thing, ModelFit):
        thing = thing.estimate
    kind = type(thing).__name__
    if type(thing) is not KINDS.get(kind):
        raise DefinitionError(
            f"save takes {', '.join(KINDS)}; it cannot write a {kind}."
        )
    if path.suffix not in (".npz", ".mat"):
        raise DefinitionError(
            f"let the name '{path.name}' end in '.npz', or in '.mat' for MATLAB."
        )
    require_x64(thing)
    write_module(path, thing)


@checked
def load(path: FilePath) -> Saved:
    """Read an object that `save` has written.

    **Arguments:**

    - `path`: the file, which ends in `.npz`.

    **Returns:** an object of the type that was saved, with the same numbers bit by bit.

    **Raises:** `FileFormatError` if the file is damaged, was not written by `save`, or is of
    another format version; `DefinitionError` if it is not there or cannot be read;
    `PrecisionError` in single precision.

    **Example:**

    ```python
    hj.save("fit.npz", fit)
    fit = hj.load("fit.npz")
    ```

    **Before:** `hj.save`.
    """
    require_x64()
    return read_module(Path(path), KINDS)
