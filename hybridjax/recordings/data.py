"""Data at the sections of a recorded cycle."""

import itertools

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._core.boundary.checked import checked
from .._core.boundary.kinds import PeriodCount
from .._core.html import COLORS, Curve, card, facts, picture, table
from .._core.signal import unit_of, with_unit
from ..experiments.data import ExperimentData
from ..experiments.record import Record


# Signals that a notebook draws. Doubled: twice the size.
_DRAWN = 4


class SectionData(eqx.Module):
    """Inputs and outputs of a recording at N sections of each cycle, as deviations from it.

    **Fields:**

    - `records`: `Record`s for `fit_series`, `validate`, ...: one for each stretch that is not
      interrupted. Samples in gaps are NaN, so that no equation reaches across one.
    - `times`: for each record, when it crossed its sections. `trials`: the index of its trial.
    - `cycle_inputs` (N, nu), `cycle_outputs` (N, ny): the average cycle.
    - `period`: the median. `bandwidth`: of the splines through the outputs, in Hz.
    - `n_sections`, `inputs`, `outputs`; `units` (of inputs, then outputs).
    - `spikes`: how many samples of each signal (inputs, then outputs) were left out as spikes.
    """

    records: tuple[Record, ...]
    times: tuple[Float[np.ndarray, " _"], ...]
    trials: tuple[int, ...] = eqx.field(static=True)
    cycle_inputs: Float[np.ndarray, "N nu"]
    cycle_outputs: Float[np.ndarray, "N ny"]
    period: float = eqx.field(static=True)
    bandwidth: float = eqx.field(static=True)
    spikes: tuple[int, ...] = eqx.field(static=True)

    @property
    def units(self) -> tuple[str, ...]:
        return tuple(map(unit_of, self.inputs + self.outputs))

    @property
    def n_sections(self) -> int:
        return self.records[0].n_sections

    @property
    def inputs(self) -> tuple[str, ...]:
        return self.records[0].inputs

    @property
    def outputs(self) -> tuple[str, ...]:
        return self.records[0].outputs

    @property
    def signals(self) -> tuple[str, ...]:
        """Inputs, then outputs."""
        return self.inputs + self.outputs

    @property
    def cycles(self) -> float:
        """How many cycles of samples there are."""
        return sum(len(r.u) for r in self.records) / self.n_sections

    @property
    def missing(self) -> float:
        """The share of samples with a missing input or output."""
        lost = [(np.isnan(r.y).any(axis=1) | np.isnan(r.u).any(axis=1)).sum() for r in self.records]
        return float(sum(lost)) / sum(len(r.u) for r in self.records)

    def rms(self) -> tuple[Float[np.ndarray, " nu"], Float[np.ndarray, " ny"]]:
        """Root mean squares of the deviations of inputs and outputs."""
        u, y = (np.concatenate([getattr(r, x) for r in self.records]) for x in "uy")
        return np.sqrt(np.nanmean(u**2, axis=0)), np.sqrt(np.nanmean(y**2, axis=0))

    @checked
    def experiments(self, periods: PeriodCount) -> ExperimentData:
        """The records as experiments with periodic inputs, for `estimate_htf` and its like.

        Every record is cut to whole cycles from section 0, and all to the same length.

        **Arguments:** `periods`: P, after which the inputs repeat.

        **Raises:** `DefinitionError` for records that are shorter than P, or have gaps.
        """
        N, parts = self.n_sections, []
        for r in self.records:
            first = -r.first_section % N
            parts.append((r.u[first:], r.y[first:]))
        cycles = min(len(u) for u, _ in parts) // N
        u = np.stack([u[: cycles * N] for u, _ in parts])
        y = np.stack([y[: cycles * N] for _, y in parts])
        return ExperimentData(
            u,
            y,
            n_sections=N,
            periods=periods,
            inputs=self.inputs,
            outputs=self.outputs,
        )

    def _repr_html_(self) -> str:
        known = {
            "cycles": f"{self.cycles:.5g} of {self.n_sections} sections",
            "records": str(len(self.records)),
            "period": f"{self.period:.6g} s",
            "missing": f"{100 * self.missing:.2g} %",
        }
        sizes = (f"{x:.3g}" for part in self.rms() for x in part)
        rows = list(zip(self.signals, sizes, self.units, map(str, self.spikes), strict=True))
        head = ("signal", "rms deviation", "unit", "spikes left out")
        phase = np.arange(self.n_sections) / self.n_sections
        cycles = np.concatenate([self.cycle_inputs, self.cycle_outputs], axis=1)
        drawn = [
            picture(
                [Curve(phase, own, "average cycle", color)], "phase (cycles)", with_unit(x, unit)
            )
            for x, unit, own, color in list(
                zip(self.signals, self.units, cycles.T, itertools.cycle(COLORS), strict=False)
            )[:_DRAWN]
        ]
        return card("SectionData", "", facts(known), table(head, rows), *drawn)

    def __repr__(self) -> str:
        u, y = self.rms()
        values = zip(self.signals, (*u, *y), self.units, strict=True)
        shown = ", ".join(f"{name} {x:.3g} {unit}".rstrip() for name, x, unit in values)
        lost = f", {100 * self.missing:.2g} % missing" if self.missing else ""
        struck = [f"{n} {k}" for n, k in zip(self.signals, self.spikes, strict=True) if k]
        spikes = f"; spikes left out: {', '.join(struck)}" if struck else ""
        return (
            f"SectionData({self.cycles:.5g} cycles of {self.n_sections} sections in "
            f"{len(self.records)} records{lost}; period {self.period:.6g}; rms deviations: "
            f"{shown}{spikes})"
        )
