"""`SectionSeries`: one record of inputs and outputs at the sections of a cycle, of any length and
with gaps.

Data of experiments and of recordings are made of such records (`HasRecords`). Fits to time series
call `uninterrupted_records` to get records without unknown inputs. Gaps are NaN. Fits rely on
two conventions, which must stay: `y[i]` is sampled before `u[i]` acts, and sample i lies on section
`first_section + i` (modulo N).

If a fit uses fewer samples than expected, look at `_with_known_inputs`, which cuts records and
leaves out outputs near a gap; if data are refused because outputs repeat, at `require_deviations`;
if a part of a record has the wrong section, at `SectionSeries.part`.
"""

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated, Protocol, runtime_checkable

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from .._core.arguments import Numbers, input_and_output_names, require_index
from .._core.boundary.checked import checked
from .._core.boundary.containers import Stream
from .._core.boundary.kinds import Index, NewNames, NewOptionalNames, SectionCount
from .._core.boundary.values import Number, Reals
from .._core.showable import Showable
from .._core.text import folded, listed
from ..errors import DefinitionError


Drift = Annotated[float, Number("two cycles or more", low=2, infinite=True)]


@checked
class SectionSeries(Showable, eqx.Module):
    """One stretch of recorded inputs and outputs, of any length, with any input.

    **Fields**, on the host:

    - `u` (n, nu): inputs, constant from sample i to i + 1. NaN where unknown: the record is then
      split, and the state after the gap is unknown. Without inputs (nu = 0) there is nothing to fit
      responses to.
    - `y` (n, ny): outputs minus those on the limit cycle, sampled before `u[i]` acts. NaN where a
      sample is missing or bad.
    - `n_sections`: N. `first_section`: the section of sample 0. `inputs`, `outputs`: names, or
      units by name.
    - `lead`: y[i] may depend on inputs up to `u[i + lead]`, because of smoothing or of sections
      that depend on later events.
    - `drift`: number of cycles. The outputs at each section may also contain an unknown drift that
      is slower than this. Infinite: the drift is a constant, such as an error of the subtracted
      average cycle. None: no drift. Fits cut records of more than 50 times this number.

    **Example:**

    ```python
    units = {"yM": "m", "vM": "m/s"}
    series = hj.experiments.SectionSeries(data.u[0], data.y[0], n_sections=8, outputs=units)
    print(hj.fit_series(series, order=2).multipliers)
    ```

    **After:** `hj.fit_series`, `hj.fit_ldtp`.
    """

    u: Float[np.ndarray, "n nu"]
    y: Float[np.ndarray, "n ny"]
    n_sections: int = eqx.field(static=True)
    first_section: int = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    lead: int = eqx.field(static=True, default=0)
    drift: float | None = eqx.field(static=True, default=None)

    def __init__(
        self,
        u: Annotated[Numbers, Reals("samples inputs", missing=True)],
        y: Annotated[Numbers, Reals("samples outputs", missing=True)],
        *,
        n_sections: SectionCount,
        first_section: Index = 0,
        inputs: NewOptionalNames | None = None,
        outputs: NewNames | None = None,
        lead: Index = 0,
        drift: Drift | None = None,
    ):
        """**Raises:** `DefinitionError` for shapes that do not fit together."""
        self.u = np.array(u)
        self.y = np.array(y)
        if len(self.u) != len(self.y) or 0 in (len(self.u), *self.y.shape):
            raise DefinitionError(
                f"`u` {self.u.shape} and `y` {self.y.shape} must have the same samples (their "
                "first axes), one or more."
            )
        require_index("section", first_section, n_sections)
        self.n_sections = n_sections
        self.first_section = first_section
        self.lead = lead
        self.drift = drift
        sizes = self.u.shape[1], self.y.shape[1]
        self.inputs, self.outputs = input_and_output_names(inputs, outputs, *sizes)

    @property
    def records(self) -> tuple["SectionSeries"]:
        """The record itself in a tuple, as `ExperimentData.records` and `SectionData.records`."""
        return (self,)

    def part(self, first: Index, stop: Index) -> "SectionSeries":
        """Return the samples `first`, ..., `stop - 1` as a record.

        **Raises:** `DefinitionError` if there are none.
        """
        section = (self.first_section + first) % self.n_sections
        u = self.u[first:stop]
        y = self.y[first:stop]
        return dataclasses.replace(self, u=u, y=y, first_section=section)

    def __repr__(self) -> str:
        samples = f"{len(self.u)} samples from section {self.first_section}"
        missing = int(np.isnan(self.y).any(axis=1).sum())
        if missing:
            samples += f", {missing} with gaps"
        return folded(
            f"SectionSeries({samples}; "
            f"N = {self.n_sections}; {listed(self.inputs)} -> {listed(self.outputs)})"
        )


@runtime_checkable
class HasRecords(Protocol):
    """Data made of records: `SectionSeries`, `ExperimentData`, `SectionData`."""

    @property
    def records(self) -> Sequence[SectionSeries]: ...


RecordedData = HasRecords | Annotated[Iterable[HasRecords], Stream(HasRecords, "data")]
"""Data for fits to time series: data made of records, or several such data."""


def uninterrupted_records(data: RecordedData) -> list[SectionSeries]:
    """Return all records, cut at unknown inputs: no input in the result is NaN.

    The output at an unknown input is not used, since it may depend on this input directly. With
    `lead`, the outputs up to `lead` samples earlier are not used, either.

    **Raises:** `DefinitionError` if nothing is left, or records differ in N, names, lead or drift.
    """
    parts = [data] if isinstance(data, HasRecords) else data
    records: list[SectionSeries] = []
    for part in parts:
        records.extend(part.records)
    if not records:
        raise DefinitionError(
            "`data` holds no experiment that ran well: see `data.summary()`."
        )
    if not all(record.inputs for record in records):
        raise DefinitionError(
            "`data` holds no input: name one, or use `hj.recordings.natural_multipliers`."
        )
    about = [(r.n_sections, r.inputs, r.outputs, r.lead, r.drift) for r in records]
    others = [x for x in about if x != about[0]]
    if others:
        raise DefinitionError(
            "records of `data` must have the same sections, inputs, outputs, lead and drift, not "
            f"{about[0]} and {others[0]}."
        )
    usable: list[SectionSeries] = []
    for record in records:
        usable.extend(_with_known_inputs(record))
    if not usable:
        raise DefinitionError(
            "an input is NaN at every sample: give the input that acted."
        )
    return usable


def average_cycle(
    section: Int[np.ndarray, " n"], values: Float[np.ndarray, "n k"], n_sections: int
) -> Float[np.ndarray, "N k"]:
    """Return the average values at each section; NaN where nothing was sampled."""
    total, count = np.zeros((2, n_sections, values.shape[1]))
    np.add.at(total, section, np.nan_to_num(values))
    np.add.at(count, section, np.isfinite(values))
    with np.errstate(invalid="ignore"):
        return total / count


def require_deviations(records: Sequence[SectionSeries]) -> None:
    """**Raises:** `DefinitionError` if an output is nearly the same in all cycles, though no drift
    was declared and inputs change: the output then contains the limit cycle itself instead of
    deviations."""
    N = records[0].n_sections
    nu = len(records[0].inputs)
    values = np.concatenate([np.hstack([r.u, r.y]) for r in records])
    samples = [r.first_section + np.arange(len(r.u)) for r in records]
    section = np.concatenate(samples) % N
    if records[0].drift is not None or len(values) <= 3 * N:
        return
    deviations = values - average_cycle(section, values, N)[section]
    with np.errstate(invalid="ignore"):
        power = np.nansum(values**2, axis=0)
        changes = np.nansum(deviations**2, axis=0) / power
    # (An input of zeros changes no output.)
    of_used = changes[:nu][power[:nu] > 0]
    if not len(of_used):
        return
    of_inputs = of_used.min()
    # (If inputs nearly repeat, outputs may nearly repeat, too.)
    fixed = changes[nu:] < 0.01 * of_inputs**2
    if fixed.any():
        output = records[0].outputs[int(np.argmax(fixed))]
        raise DefinitionError(
            f"{output} is nearly the same in all cycles: subtract the limit cycle from the outputs."
        )


def _with_known_inputs(record: SectionSeries) -> Iterator[SectionSeries]:
    """Yield the parts of a record in which all inputs are known. The last `lead` outputs of a part
    may depend on inputs after it, and become NaN."""
    finite = np.isfinite(record.u).all(axis=1)
    edges = np.flatnonzero(np.diff(finite.astype(int), prepend=0, append=0))
    for first, stop in edges.reshape(-1, 2).tolist():
        part = record.part(first, stop)  # (a copy)
        known = max(len(part.y) - record.lead, 0)
        part.y[known:] = np.nan
        yield part
