"""From sampled signals to data at the sections of a cycle."""

from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from ..errors import DefinitionError
from ..experiments.data import ExperimentData
from ..identify.series.layout import Record
from .phase import Definition, Phase, Winding, estimate_phase
from .recording import Recording, Trial
from .smoothing import gaps, inside, means, nearest, spline


_GAP = 1.0  # times the time between sections: a longer one leaves a sample out


class SectionData(eqx.Module):
    """Inputs and outputs of a recording at N sections of each cycle, as deviations from it.

    **Fields:**

    - `records`: `Record`s for `fit_series`, `validate`, ...: one for each stretch that is not
      interrupted. Samples in gaps are NaN, so that no equation reaches across one.
    - `times`: for each record, when it crossed its sections. `trials`: the index of its trial.
    - `cycle_inputs` (N, nu), `cycle_outputs` (N, ny): the average cycle.
    - `period`: the median. `bandwidth`: of the splines through the outputs, in Hz.
    - `n_sections`, `inputs`, `outputs`, `units` (of inputs, then outputs).
    """

    records: tuple[Record, ...]
    times: tuple[Float[np.ndarray, " _"], ...]
    trials: tuple[int, ...] = eqx.field(static=True)
    cycle_inputs: Float[np.ndarray, "N nu"]
    cycle_outputs: Float[np.ndarray, "N ny"]
    period: float = eqx.field(static=True)
    bandwidth: float = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)

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

    def experiments(self, periods: int) -> ExperimentData:
        """The records as experiments with periodic inputs, for `estimate_htf` and its like.

        Every record is cut to whole cycles from section 0, and all to the same length.

        **Arguments:** `periods`: P, after which the inputs repeat.

        **Raises:** `DefinitionError` for records that are shorter than P, or have gaps.
        """
        N, parts = self.n_sections, []
        for r in self.records:
            first = -r.start % N
            parts.append((r.u[first:], r.y[first:]))
        cycles = min(len(u) for u, _ in parts) // N
        u = np.stack([u[: cycles * N] for u, _ in parts])
        y = np.stack([y[: cycles * N] for _, y in parts])
        about = {"inputs": self.inputs, "outputs": self.outputs, "label": "recorded"}
        return ExperimentData(u, y, n_sections=N, periods=periods, **about)

    def __repr__(self) -> str:
        u, y = self.rms()
        values = zip(self.inputs + self.outputs, (*u, *y), self.units, strict=True)
        shown = ", ".join(f"{name} {x:.3g} {unit}".rstrip() for name, x, unit in values)
        lost = f", {100 * self.missing:.2g} % missing" if self.missing else ""
        return (
            f"SectionData({self.cycles:.5g} cycles of {self.n_sections} sections in "
            f"{len(self.records)} records{lost}; period {self.period:.6g}; rms deviations: {shown})"
        )


def section_data(
    recording: Recording,
    phase: Phase | Definition,
    *,
    inputs: str | Sequence[str],
    outputs: str | Sequence[str],
    n_sections: int = 32,
    bandwidth: int | float | None = None,
    sampled: Literal["mean", "middle"] = "mean",
    time: Literal["clock", "duration"] | None = None,
    drift: int | float | None = None,
    max_gap: int | float | None = None,
) -> SectionData:
    """Sample a recording at N phases of each cycle.

    **Arguments:**

    - `phase`: what `estimate_phase` found, or what it should find.
    - `inputs`, `outputs`: names of signals.
    - `n_sections`: N, equally spaced in phase.
    - `bandwidth`: in Hz, of the smoothing splines through the outputs (see `spline`); by default N
      per period, which averages over about one section. Infinite: interpolating cubic splines.
    - `sampled`: inputs are their "mean" from each section to the next (they are taken as
      linear between samples), or the sample next to the "middle", for one that is held from section
      to section.
    - `time`: an extra output that tells when a section was crossed: "clock" for systems that are
      driven by a clock, the time minus the clock's; "duration" for others, the time since the
      section before.
    - `drift`: the outputs may drift, more slowly than in so many cycles, for reasons other than
      the inputs (those of the sensors, say): fits allow for it, section by section, by cosines. By
      default only for the average cycle of each trial not being known exactly. It also moves the
      phase: take it out of the signals before (`without_drift`), as `identify_recording`
      does.
    - `max_gap`: the longest time without a sample that a spline may bridge; by default the
      mean time between sections, but not less than three samples.

    **Raises:** `DefinitionError` for names that are not there, and a recording without a whole
    cycle.
    """
    inputs = (inputs,) if isinstance(inputs, str) else tuple(inputs)
    outputs = (outputs,) if isinstance(outputs, str) else tuple(outputs)
    for name in (*inputs, *outputs):
        column = [t.values[:, recording.column(name)] for t in recording.trials]
        if not any(np.nanmax(x) > np.nanmin(x) for x in column if np.isfinite(x).any()):
            kind = "input" if name in inputs else "output"
            raise DefinitionError(f"the {kind} {name} is constant in all trials.")
    if n_sections < 1:
        raise DefinitionError(f"there must be one section or more, not {n_sections}.")
    if drift is not None and drift < 4:
        raise DefinitionError(f"drift takes more than four cycles, not {drift}.")
    if not isinstance(phase, Phase):
        phase = estimate_phase(recording, phase)
    if len(phase.stretches) != len(recording.trials):
        raise DefinitionError(
            f"the phase is of {len(phase.stretches)} trials, the recording has "
            f"{len(recording.trials)}."
        )
    bandwidth = n_sections / phase.period if bandwidth is None else bandwidth
    found, trials = [], []
    for number, trial in enumerate(recording.trials):
        sampler = _Sampler(recording, trial, inputs, outputs, bandwidth, sampled)
        longest = max_gap
        if longest is None:
            step = float(np.median(np.diff(trial.time)))
            longest = max(_GAP * phase.period / n_sections, 3.001 * step)
        parts = [sampler(s, n_sections, longest) for s in phase.stretches[number]]
        parts = [p for p in parts if p is not None]
        if time is not None:
            parts = _with_times(parts, n_sections, phase.period, time)
        found += _deviations(parts, n_sections)
        trials += [number] * len(parts)
    if not found:
        raise DefinitionError("the recording holds no whole cycle to sample.")
    names = outputs if time is None else (*outputs, "time" if time == "clock" else "duration")
    # A smoothing spline averages over neighbors to both sides.
    lead = phase.lead * n_sections + (0 if np.isinf(bandwidth) else 1)
    about = {"n_sections": n_sections, "inputs": inputs, "outputs": names, "lead": lead}
    about["drift"] = np.inf if drift is None else drift
    records = [Record(p.u, p.y, start=int(p.k[0]) % n_sections, **about) for p, _ in found]
    units = [recording.unit(name) for name in (*inputs, *outputs)]
    weights = [len(p.k) for p, _ in found]
    cycle = np.average([mean for _, mean in found], axis=0, weights=weights)
    return SectionData(
        tuple(records),
        tuple(p.t for p, _ in found),
        tuple(trials),
        cycle[:, : len(inputs)],
        cycle[:, len(inputs) :],
        phase.period,
        float(bandwidth),
        (*units, *([] if time is None else ["s"])),
    )


class _Part(eqx.Module):
    """Samples of one stretch, at sections k[0], k[0] + 1, ... of its count."""

    k: Int[np.ndarray, " n"]
    t: Float[np.ndarray, " n"]
    u: Float[np.ndarray, "n nu"]
    y: Float[np.ndarray, "n ny"]


class _Sampler:
    """The signals of a trial as functions of time."""

    def __init__(self, recording: Recording, trial: Trial, inputs, outputs, bandwidth, sampled):
        self.time, self.sampled = trial.time, sampled
        self.inputs = [trial.values[:, recording.column(name)] for name in inputs]
        self.outputs = [trial.values[:, recording.column(name)] for name in outputs]
        self.curves = [spline(trial.time, x, bandwidth) for x in self.outputs]

    def __call__(self, winding: Winding, n_sections: int, longest: int | float) -> _Part | None:
        first, last = winding.phase[[0, -1]] * n_sections
        k = np.arange(np.ceil(first - 1e-9), np.floor(last + 1e-9) + 1).astype(int)
        if len(k) <= n_sections:
            return None
        t = winding.when(k / n_sections)
        u = np.stack([self._input(x, t, longest) for x in self.inputs], axis=1)
        y = np.stack([curve(t[:-1]) for curve in self.curves], axis=1)
        for i, x in enumerate(self.outputs):
            holes = gaps(self.time, np.isfinite(x), longest)
            y[inside(holes, t[:-1], t[:-1]), i] = np.nan
        return _Part(k[:-1], t[:-1], u, y)

    def _input(self, x, t, longest: int | float):
        seen = np.isfinite(x)
        if self.sampled == "middle":
            u = nearest(self.time, x, (t[:-1] + t[1:]) / 2)
        else:
            u = means(self.time, x, t)
        u[inside(gaps(self.time, seen, longest), t[:-1], t[1:])] = np.nan
        return u


def _with_times(parts: list[_Part], N: int, period: float, kind: str) -> list[_Part]:
    """The time of crossing as one more output."""
    if kind == "duration":
        return [
            eqx.tree_at(lambda p: p.y, p, np.column_stack([p.y, np.diff(p.t, prepend=np.nan)]))
            for p in parts
        ]
    # t = T cycle + a[section]: cycles are counted through gaps.
    cycles = [
        p.k // N + round((p.t[0] - parts[0].t[0]) / period - (p.k[0] - parts[0].k[0]) / N)
        for p in parts
    ]
    section = np.concatenate([p.k % N for p in parts])
    t, cycle = np.concatenate([p.t for p in parts]), np.concatenate(cycles).astype(float)
    count = np.maximum(np.bincount(section, minlength=N), 1)
    x = cycle - (np.bincount(section, cycle, N) / count)[section]
    z = t - (np.bincount(section, t, N) / count)[section]
    deviation = z - (x @ z) / (x @ x) * x
    edges = np.cumsum([len(p.k) for p in parts])[:-1]
    return [
        eqx.tree_at(lambda p: p.y, p, np.column_stack([p.y, d]))
        for p, d in zip(parts, np.split(deviation, edges), strict=True)
    ]


def _deviations(parts: list[_Part], N: int):
    """Each part minus the trial's average cycle, and that cycle."""
    if not parts:
        return []
    section = np.concatenate([p.k % N for p in parts])
    values = np.concatenate([np.concatenate([p.u, p.y], axis=1) for p in parts])
    seen = np.isfinite(values)
    mean = np.full((N, values.shape[1]), np.nan)
    for n, i in np.ndindex(mean.shape):
        rows = (section == n) & seen[:, i]
        if rows.any():
            mean[n, i] = values[rows, i].mean()
    values = values - mean[section]
    nu = parts[0].u.shape[1]
    edges = np.cumsum([len(p.k) for p in parts])[:-1]
    return [
        (eqx.tree_at(lambda p: (p.u, p.y), p, (v[:, :nu], v[:, nu:])), mean)
        for p, v in zip(parts, np.split(values, edges), strict=True)
    ]
