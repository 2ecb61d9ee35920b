"""Data at the sections of a recorded cycle."""

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy import signal

from .._core.boundary.checked import checked
from .._core.boundary.kinds import PeriodCount
from .._core.html import COLORS, Curve, card, picture, text
from .._core.signal import unit_of, with_unit
from .._core.text import folded
from ..experiments.data import ExperimentData
from ..experiments.record import Record, uninterrupted_records


# Fraction of the largest power of an input below which it identifies nothing. Larger: bands end
# where transfer functions are still identified. Smaller: rounding counts as power.
LEAST_POWER = 0.01
# Fraction of the Nyquist frequency up to which an input must have power to count as broadband.
# Larger: every band has an edge. Smaller: responses contain frequencies that were not excited.
WHOLE_BAND = 0.9


class SectionData(eqx.Module):
    """Inputs and outputs of a recording at N sections of each cycle, as deviations from it.

    **Fields:**

    - `records`: `Record`s for `fit_series`, `validate`, ...: one for each uninterrupted stretch.
      Samples in gaps are NaN, so that no equation reaches across one.
    - `times`: for each record, the times at its sections. `trials`: for each, the index of its
      trial.
    - `cycle_inputs` (N, nu), `cycle_outputs` (N, ny): the average cycle.
    - `period`: the median. `bandwidth`: bandwidth of the splines through the outputs, in Hz.
    - `spikes`: for each signal (inputs, then outputs), the number of samples left out as spikes.
    - `unresolved`: median change of an output at sections if every second sample of the recording
      were left out, relative to its rms deviation; of the output with the largest ratio. It is
      below 1.3 for noise.
    """

    records: tuple[Record, ...]
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
        size, nu = (
            np.sqrt(np.nanmean(self._deviations() ** 2, axis=0)),
            len(self.inputs),
        )
        return size[:nu], size[nu:]

    def of_inputs(self, names: Sequence[str]) -> "SectionData":
        """Return the data with some of the inputs only."""
        columns = [self.inputs.index(name) for name in names]
        inputs, cycle = (
            tuple(self.inputs[k] for k in columns),
            self.cycle_inputs[:, columns],
        )
        records = tuple(
            replace(r, u=r.u[:, columns], inputs=inputs) for r in self.records
        )
        spikes = (*(self.spikes[k] for k in columns), *self.spikes[len(self.inputs) :])
        return replace(self, records=records, cycle_inputs=cycle, spikes=spikes)

    def with_drift(self, cycles: int | float) -> "SectionData":
        """Let fits allow for changes of the outputs that take longer than so many cycles."""
        return replace(
            self, records=tuple(replace(r, drift=float(cycles)) for r in self.records)
        )

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
        u, y = np.stack([r.u[:n] for r in parts]), np.stack([r.y[:n] for r in parts])
        names = {"inputs": self.inputs, "outputs": self.outputs}
        return ExperimentData(u, y, n_sections=N, periods=periods, **names)

    def _repr_html_(self) -> str:
        phase = np.arange(self.n_sections) / self.n_sections
        cycles = np.concatenate([self.cycle_inputs, self.cycle_outputs], axis=1)
        drawn = [
            picture(
                [Curve(phase, x, "average cycle", color)],
                "phase (cycles)",
                with_unit(*name),
            )
            for *name, x, color in zip(
                self.signals[:4], self.units, cycles.T, COLORS, strict=False
            )
        ]
        return card("SectionData", "", text(repr(self)), *drawn)

    def __repr__(self) -> str:
        values = zip(self.signals, np.concatenate(self.rms()), self.units, strict=True)
        sizes = ", ".join(f"{name} {x:.3g} {unit}".rstrip() for name, x, unit in values)
        lost = f", {100 * self.missing:.2g} % missing" if self.missing else ""
        struck = [
            f"{n} {k}" for n, k in zip(self.signals, self.spikes, strict=True) if k
        ]
        spikes = f"; spikes left out: {', '.join(struck)}" if struck else ""
        return folded(
            f"SectionData({self.cycles:.5g} cycles of {self.n_sections} sections in "
            f"{len(self.records)} records{lost}; period {self.period:.6g} s; rms deviations: "
            f"{sizes}{spikes})"
        )


def input_spectrum(
    data: SectionData,
) -> tuple[Float[np.ndarray, " F"], Float[np.ndarray, "F nu"]]:
    """Return frequencies in cycles per period, and power spectral densities of the inputs (Welch
    1967) from windows of up to 16 cycles."""
    records, N = uninterrupted_records(data), data.n_sections
    length = N * max(1, min(16, max(len(r.u) for r in records) // (2 * N)))
    f = np.fft.rfftfreq(length, 1 / N)
    total, weight = np.zeros((len(f), len(data.inputs))), 0
    for r in records:
        if len(r.u) >= length:
            _, power = signal.welch(r.u, N, nperseg=length, axis=0)
            total, weight = total + len(r.u) * power, weight + len(r.u)
    return f, total / max(weight, 1)


def input_band(data: SectionData) -> list[float]:
    """Return the frequency (cycles per period) above which an input has next to no power."""
    f, power = input_spectrum(data)
    strong = power > LEAST_POWER * power.max(axis=0)
    return [float(f[np.flatnonzero(s)[-1]]) if s.any() else 0.0 for s in strong.T]
