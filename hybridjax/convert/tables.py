"""Results as `pandas.DataFrame`."""

from typing import Any

import numpy as np

from .._core.arguments import package
from .._core.boundary.checked import checked
from ..identify.multiplier_estimate import MultiplierEstimate
from ..identify.rational import RationalFit
from ..linear.htf import HTF
from ..orbits.continuation import Branch
from ..orbits.limit_cycles import LimitCycles
from ..recordings.data import SectionData
from ..recordings.recording import Recording
from .xarray_datasets import to_xarray


Tabular = Recording | SectionData | HTF | LimitCycles | Branch | MultiplierEstimate | RationalFit


@checked
def to_pandas(thing: Tabular) -> Any:
    """Return a `pandas.DataFrame`.

    - `Recording`, `SectionData`: a row for each sample, with time and trial;
      `Recording.from_frame` reads one trial of it.
    - `LimitCycles`, `Branch`: a row for each cycle, with its parameters; `multipliers.0`, ...
    - `HTF`: a row for each harmonic, frequency, output and input, which are the index.
    - Fits: a row for each multiplier, with its standard error. A `RationalFit` gives a row for each
      output and pole.

    **Raises:** `DefinitionError` where pandas, or xarray, is not installed.
    """
    frame = package("pandas").DataFrame
    if isinstance(thing, MultiplierEstimate):
        values, errors = thing.multipliers, thing.standard_errors
        return frame({"multiplier": values, "modulus": np.abs(values), "standard_error": errors})
    if isinstance(thing, RationalFit):
        outputs = np.repeat(list(map(str, thing.outputs)), thing.poles.shape[1])
        poles, multipliers = thing.poles.ravel(), thing.multipliers.ravel()
        return frame({"output": outputs, "pole": poles, "multiplier": multipliers})
    dataset = to_xarray(thing)
    if isinstance(thing, HTF):
        extra = [x for x in ("input_unit", "output_unit", "scatter.freedom") if x in dataset]
        return dataset.drop_vars(extra).to_dataframe()
    row = next(iter(dataset.data_vars.values())).dims[0]
    table = {}
    for name, x in {**dataset.coords, **dataset.data_vars}.items():
        if x.dims == (row,):
            table[name] = x.values
        elif x.dims[0] == row:
            table |= {f"{name}.{k}": values for k, values in enumerate(x.values.T)}
    return frame(table)
