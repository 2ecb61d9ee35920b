"""`SectionData`: inputs and outputs of a recording at the sections of its cycle, as deviations from
the average cycle.

`sample_sections` (`sampling.py`) makes it, and estimates of multipliers and of responses take it.
Its `records` have the form that fits to time series use. Three things must stay, since others rely
on them: inputs stand before outputs in `signals`, `units` and `spikes`; `times` and `trials` have
one entry for each of the `records`; and samples in gaps are NaN.

Nothing is sampled here: if a deviation is wrong, look at `sampling.py`. If the band of an input is
too narrow or too wide, look at `LEAST_POWER` and `input_spectrum`.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy import signal

from .._core.arguments import require_among
from .._core.boundary.checked import checked
from .._core.boundary.kinds import PeriodCount
from .._core.html import COLORS, Curve, card, picture, text
from .._core.showable import Showable
from .._core.signal import unit_of, with_unit
from .._core.text import folded, how_many, number
from ..experiments.data import ExperimentData
from ..experiments.record import SectionSeries, uninterrupted_records


# An input has power at a frequency if its power there exceeds this part of its largest power.
# Larger: bands end where transfer functions could still be identified. Smaller: rounding errors
# count as power.
LEAST_POWER = 0.01
# An input is broadband if it has power up to this part of the Nyquist frequency. Larger: every band
# has an edge. Smaller: responses contain frequencies that were not excited.
WHOLE_BAND = 0.9


class SectionData(Showable, eqx.Module):
    """Inputs and outputs of a recording at N sections of each cycle, as deviations from it.

    **Fields:**

    - `records`: `SectionSeries` for `fit_series`, `validate`, ...: one for each uninterrupted
      stretch. Samples in gaps are NaN, so that no equation reaches across one.
    - `times`: for each record, the times at its sections. `trials`: for each record, the index of
      its trial.
    - `cycle_inputs` (N, nu), `cycle_outputs` (N, ny): the average cycle.
    - `period`: the median. `bandwidth`: bandwidth of the splines through the outputs, in Hz.
    - `spikes`: for each signal (inputs, then outputs), the number of samples left out as spikes.
    - `unresolved`: median change of an output at sections if every second sample of the recording
      is left out, divided by the rms deviation of the output. It is for the output with the largest
      ratio. Noise alone gives values below 1.3.
    """

    records: tuple[SectionSeries, ...]
    times: tuple[Float[np.ndarray, " _"], ...]
    trials: tuple[int, ...] = eqx.field(static=True)
    cycle_inputs: Float[np.ndarray, "N nu"]
    cycle_outputs: Float[np.ndarray, "N ny"]
    period: float = eqx.field(static=True)
    bandwidth: float = eqx.field(static=True)
    spikes: tuple[int, ...] = eqx.field(static=True)
    unresolved: float = eqx.field(static=True, default=0.0)

    n_sections = property(lambda self: self.records[0].n_sections)
    inputs = property(lambda self: self.records[0].inputs)
    outputs = property(lambda self: self.records[0].outputs)

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of inputs, then outputs."""
        return self.inputs + self.outputs

    @property
    def units(self) -> tuple[str, ...]:
        """Units of inputs, then outputs."""
        return tuple(map(unit_of, self.signals))

    @property
    def cycles(self) -> float:
        """Number of cycles of samples."""
        return sum(len(r.u) for r in self.records) / self.n_sections

    def _deviations(self) -> Float[np.ndarray, "n nuy"]:
        """Return the deviations of inputs and outputs in all records."""
        return np.concatenate(
            [np.concatenate([r.u, r.y], axis=1) for r in self.records]
        )

    @property
    def missing(self) -> float:
        """Fraction of samples with a missing input or output."""
        return float(np.isnan(self._deviations()).any(axis=1).mean())

    def rms(self) -> tuple[Float[np.ndarray, " nu"], Float[np.ndarray, " ny"]]:
        """Return root mean squares of the deviations of inputs and outputs."""
        nu = len(self.inputs)
        size = np.sqrt(np.nanmean(self._deviations() ** 2, axis=0))
        return size[:nu], size[nu:]

    @checked
    def plot(self, *, ax: object = None) -> Any:
        """Draw for each signal the average cycle, the deviations from it, and the spectra of
        inputs.

        Left: the average cycle. Middle: deviations against phase, gray, with twice their standard
        deviation. Right: for an input, its power against frequency; for an output, its deviations
        in successive cycles, at the section where they are largest.

        **Arguments:** `ax`: three Axes per signal, inputs first. Default: a new figure.

        **Returns:** `hj.plot.Plot` with `axes` (nu + ny, 3). Phases are in cycles, frequencies in
        cycles per period, and signals in their units.

        **Raises:** `DefinitionError` if `ax` does not hold three Axes per signal.

        **Example:**

        ```python
        result.data.plot()
        ```
        """
        return super().plot(ax=ax)

    @checked
    def of_inputs(self, names: Sequence[str]) -> "SectionData":
        """Return the data with some of the inputs only."""
        require_among("input", names, self.inputs)
        columns = [self.inputs.index(name) for name in names]
        inputs = tuple(self.inputs[k] for k in columns)
        of_inputs = [self.spikes[k] for k in columns]
        of_outputs = self.spikes[len(self.inputs) :]
        return replace(
            self,
            records=tuple(
                replace(r, u=r.u[:, columns], inputs=inputs) for r in self.records
            ),
            cycle_inputs=self.cycle_inputs[:, columns],
            spikes=(*of_inputs, *of_outputs),
        )

    @checked
    def with_drift(self, cycles: int | float) -> "SectionData":
        """Let fits allow for changes of the outputs that take longer than so many cycles."""
        records = tuple(replace(r, drift=float(cycles)) for r in self.records)
        return replace(self, records=records)

    @checked
    def experiments(self, periods: PeriodCount) -> ExperimentData:
        """Return the records as experiments with periodic inputs, for `estimate_htf` and others.

        Every record is cut to whole cycles from section 0, and all to the same length.

        **Arguments:** `periods`: P, after which the inputs repeat.

        **Raises:** `DefinitionError` for records that are shorter than P, or have gaps.
        """
        N = self.n_sections
        parts = [r.part(-r.first_section % N, len(r.u)) for r in self.records]
        n = min(len(r.u) for r in parts) // N * N
        return ExperimentData(
            np.stack([r.u[:n] for r in parts]),
            np.stack([r.y[:n] for r in parts]),
            n_sections=N,
            periods=periods,
            inputs=self.inputs,
            outputs=self.outputs,
        )

    def _repr_html_(self) -> str:
        phase = np.arange(self.n_sections) / self.n_sections
        cycles = np.concatenate([self.cycle_inputs, self.cycle_outputs], axis=1)
        columns = zip(self.signals[:4], self.units, cycles.T, COLORS, strict=False)
        drawn = [
            picture(
                [Curve(phase, x, "average cycle", color)],
                "phase (cycles)",
                with_unit(name, unit),
            )
            for name, unit, x, color in columns
        ]
        return card("SectionData", "", text(repr(self)), *drawn)

    def __repr__(self) -> str:
        sizes = []
        for name, unit, x in zip(
            self.signals, self.units, np.concatenate(self.rms()), strict=True
        ):
            sizes.append(f"{name} {number(x, 3, unit)}")
        summary = (
            f"SectionData({self.cycles:.5g} cycles of "
            f"{how_many(self.n_sections, 'section', 'sections')} in "
            f"{how_many(len(self.records), 'record', 'records')}"
        )
        if self.missing:
            summary += f", {100 * self.missing:.2g} % missing"
        summary += f"; period {self.period:.6g} s; rms deviations: {', '.join(sizes)}"
        counts = zip(self.signals, self.spikes, strict=True)
        spikes = [f"{name} {count}" for name, count in counts if count]
        if spikes:
            summary += f"; spikes left out: {', '.join(spikes)}"
        return folded(summary + ")")


def whole_cycles(record: SectionSeries) -> slice:
    """Return the samples of the whole cycles of a record, from section 0 on."""
    N = record.n_sections
    first = -record.first_section % N
    cycles = (len(record.u) - first) // N
    return slice(first, first + cycles * N)


def input_spectrum(
    data: SectionData,
) -> tuple[Float[np.ndarray, " F"], Float[np.ndarray, "F nu"]]:
    """Return frequencies in cycles per period, and power spectral densities of the inputs (Welch
    1967) from windows of up to 16 cycles."""
    N = data.n_sections
    records = uninterrupted_records(data)
    longest = max(len(r.u) for r in records)
    window = N * max(1, min(16, longest // (2 * N)))
    f = np.fft.rfftfreq(window, 1 / N)
    total = np.zeros((len(f), len(data.inputs)))
    samples = 0
    for r in records:
        if len(r.u) >= window:
            _, power = signal.welch(r.u, N, nperseg=window, axis=0)
            total += len(r.u) * power
            samples += len(r.u)
    return f, total / max(samples, 1)


def input_band(data: SectionData) -> list[float]:
    """Return the frequency (cycles per period) above which an input has next to no power."""
    f, power = input_spectrum(data)
    strong = power > LEAST_POWER * power.max(axis=0)
    return [float(f[s].max(initial=0.0)) for s in strong.T]
