"""Results as `pandas.DataFrame`."""

from typing import Any

import numpy as np

from .._core.arguments import package
from .._core.boundary.checked import checked
from ..identify.multiplier_estimate import MultiplierFit
from ..identify.rational import RationalFit
from ..linear.htf import HTF
from ..orbits.branches import Branch
from ..orbits.limit_cycles import LimitCycles
from ..recordings.data import SectionData
from ..recordings.recording import Recording
from .xarray_datasets import to_xarray


Tabular = (
    Recording | SectionData | HTF | LimitCycles | Branch | MultiplierFit | RationalFit
)


@checked
def to_pandas(thing: Tabular) -> Any:
    """Return a `pandas.DataFrame`.

    - `Recording`, `SectionData`: a row for each sample, with time and trial;
      `Recording.from_frame` reads one trial of it.
    - `LimitCycles`, `Branch`: a row for each cycle, with its parameters; `multipliers.0.real`, ...
    - `HTF`: a row for each harmonic, frequency, output and input, which are the index.
    - Fits: a row for each multiplier. A `RationalFit` gives a row for each output and pole.

    Complex numbers get columns for their real and imaginary part, which R and CSV files can hold; H
    and multipliers their modulus, too. `standard_error` is the root of the expected squared
    distance from the true value; `real_error` and `imaginary_error` are those of the parts.

    **Arguments:**

    - `thing`: an object of one of these types.

    **Returns:** a `pandas.DataFrame`.

    **Raises:** `DefinitionError` where pandas, or xarray, is not installed.

    **Example:**

    ```python
    hj.convert.to_pandas(htf).to_csv("htf.csv")
    print(hj.convert.to_pandas(fit))
    ```

    **Before:** a recording, limit cycles, HTFs or a fit.
    """
    frame = package("pandas").DataFrame
    if isinstance(thing, MultiplierFit):
        real, imaginary = np.sqrt(
            np.diagonal(thing.multiplier_covariances, axis1=1, axis2=2)
        ).T
        errors = {"real_error": real, "imaginary_error": imaginary}
        errors["standard_error"] = thing.standard_errors
        return frame({**_parts("", thing.multipliers), **errors})
    if isinstance(thing, RationalFit):
        outputs = np.repeat(list(map(str, thing.outputs)), thing.poles.shape[1])
        poles = _parts("pole_", thing.poles.ravel())
        return frame(
            {"output": outputs, **poles, **_parts("", thing.multipliers.ravel())}
        )
    dataset = to_xarray(thing)
    if isinstance(thing, HTF):
        rows = dataset[[x for x in ("H", "variance") if x in dataset]].to_dataframe()
        parts = _parts("", rows["H"].values)
        if "variance" in rows:
            parts["standard_error"] = np.sqrt(rows["variance"].values)
        return rows[[]].assign(**parts)
    row = next(iter(dataset.data_vars.values())).dims[0]
    table: dict[str, Any] = {}
    for name, x in {**dataset.coords, **dataset.data_vars}.items():
        if x.dims[0] != row:
            continue
        numbers = {name: x.values}
        if x.ndim > 1:
            numbers = {f"{name}.{k}": values for k, values in enumerate(x.values.T)}
        for key, values in numbers.items():
            table |= (
                _parts(f"{key}.", values) if np.iscomplexobj(values) else {key: values}
            )
    return frame(table)


def _parts(prefix: str, z: np.ndarray) -> dict[str, np.ndarray]:
    parts = {"real": np.real(z), "imaginary": np.imag(z), "modulus": np.abs(z)}
    return {f"{prefix}{name}": values for name, values in parts.items()}
