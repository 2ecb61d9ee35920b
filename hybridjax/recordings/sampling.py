"""From sampled signals to data at the sections of a cycle."""

from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from .._core.boundary.checked import checked
from .._core.boundary.kinds import OptionalNames, SectionCount
from .._core.signal import Signal
from ..errors import DefinitionError
from ..experiments.record import Record
from .data import SectionData
from .drift import DriftCycles, check_drift
from .phase.estimation import PhaseDefinition, estimate_phase
from .phase.winding import Phase, Winding, count_on
from .recording import Recording, Trial
from .smoothing import FEWEST, Bandwidth, bridgeable, gaps, inside, means, nearest, spline
from .spikes import input_spikes, recurring, spike_heights


# The longest gap that a spline bridges: so many times from section to section, but not less than
# three samples. Doubled: samples are made up in the middle of gaps twice as long.
_GAP_SECTIONS = 1.0
# The number of sections where neither the call nor the phase says it. Doubled: half the time from
# section to section, twice the bandwidth.
_N_SECTIONS = 32
# Rounding of the phase, in sections, at the ends of a stretch. Doubled: nothing changes.
_ROUNDING = 1e-9


@checked
def section_data(
    recording: Recording,
    phase: Phase | PhaseDefinition,
    *,
    inputs: OptionalNames,
    outputs: OptionalNames,
    n_sections: SectionCount | None = None,
    bandwidth: Bandwidth | None = None,
    sampled: Literal["mean", "middle"] = "mean",
    timing: Literal["clock", "duration"] | None = None,
    drift: DriftCycles | None = None,
    max_gap: Bandwidth | None = None,
) -> SectionData:
    """Sample a recording at N phases of each cycle.

    Isolated spikes, which stick out of all around them for up to three samples, are left out as if
    they were missing, and counted in `spikes`; but not those that come at the same phase of most
    cycles (impacts), nor pulses of an input that is not smooth otherwise.

    **Arguments:**

    - `phase`: what `estimate_phase` found, or what it should find.
    - `inputs`, `outputs`: names of signals. Without outputs, `()`, the times of the events are all
      that is known: `timing` is then "duration". Without inputs, `()`, the data are for
      `natural_multipliers`.
    - `n_sections`: N, equally spaced in phase; by default the family's of a `KinematicPhase`, and
      32 for other phases.
    - `bandwidth`: in Hz, of the smoothing splines through the outputs (see `spline`); by default N
      per period, which averages over about one section. Infinite: interpolating cubic splines.
    - `sampled`: inputs are their "mean" from each section to the next (they are taken as
      linear between samples), or the sample next to the "middle", for one that is held from section
      to section.
    - `timing`: an extra output that tells when a section was crossed: "clock" for systems that are
      driven by a clock, the time minus the clock's; "duration" for others, the time since the
      section before.
    - `drift`: the outputs may drift, more slowly than in so many cycles, for reasons other than
      the inputs (those of the sensors, say): fits allow for it, section by section, by cosines. By
      default only for the average cycle of each trial not being known exactly. It also moves the
      phase: take it out of the signals before (`without_drift`), as `identify_recording`
      does.
    - `max_gap`: the longest time without a sample that a spline may bridge; by default the
      mean time between sections, but not less than three samples of a signal. Outputs are NaN at
      sections in longer gaps, of their own or of the signals of an angle that is the phase; inputs
      if their interval touches a gap of their own.

    **Raises:** `DefinitionError` for names that are not there, constant signals, another number of
    sections than the family's, a recording without a whole cycle, and as `estimate_phase`.
    """
    _refuse_constant(recording, inputs, outputs)
    if drift is not None:
        check_drift(drift)
    if not outputs and timing is None:
        timing = "duration"
    if not isinstance(phase, Phase):
        phase = estimate_phase(recording, phase)
    if len(phase.stretches) != len(recording.trials):
        raise DefinitionError(
            f"the phase is of {len(phase.stretches)} trials, the recording has "
            f"{len(recording.trials)}."
        )
    N = _number_of_sections(n_sections, phase)
    bandwidth = N / phase.period if bandwidth is None else float(bandwidth)
    found, trials, spikes = [], [], np.zeros(len(inputs) + len(outputs), int)
    for number, trial in enumerate(recording.trials):
        stretches = phase.stretches[number]
        trial, struck = _without_spikes(recording, trial, stretches, inputs, outputs)
        spikes += struck
        sampler = _Sampler(recording, trial, inputs, outputs, bandwidth, sampled)
        parts = [sampler(s, N, phase.period, max_gap) for s in phase.stretches[number]]
        parts = [p for p in parts if p is not None]
        if timing is not None:
            parts = _with_times(parts, N, phase.period, timing)
        found += _deviations(parts, N)
        trials += [number] * len(parts)
    if not found:
        raise DefinitionError("the recording holds no whole cycle to sample.")
    inputs, outputs = (
        tuple(Signal(name, recording.unit(name)) for name in names) for names in (inputs, outputs)
    )
    if timing is not None:
        outputs = (*outputs, Signal(_TIME[timing], "s"))
        spikes = np.append(spikes, 0)
    # A smoothing spline averages over neighbors to both sides.
    lead = phase.lead * N + (0 if np.isinf(bandwidth) else 1)
    records = [
        Record(
            part.u,
            part.y,
            n_sections=N,
            first_section=int(part.k[0]) % N,
            inputs=inputs,
            outputs=outputs,
            lead=lead,
            drift=np.inf if drift is None else drift,
        )
        for part, _ in found
    ]
    weights = [len(part.k) for part, _ in found]
    cycle = np.average([mean for _, mean in found], axis=0, weights=weights)
    return SectionData(
        records=tuple(records),
        times=tuple(part.t for part, _ in found),
        trials=tuple(trials),
        cycle_inputs=cycle[:, : len(inputs)],
        cycle_outputs=cycle[:, len(inputs) :],
        period=phase.period,
        bandwidth=bandwidth,
        spikes=tuple(spikes.tolist()),
    )


# Names of the outputs that `timing` adds.
_TIME = {"clock": "time", "duration": "duration"}


def _refuse_constant(
    recording: Recording, inputs: tuple[str, ...], outputs: tuple[str, ...]
) -> None:
    for name in (*inputs, *outputs):
        column = [t.values[:, recording.column(name)] for t in recording.trials]
        if not any(np.nanmax(x) > np.nanmin(x) for x in column if np.isfinite(x).any()):
            kind = "input" if name in inputs else "output"
            raise DefinitionError(f"the {kind} {name} is constant in all trials.")


def _number_of_sections(given: int | None, phase: Phase) -> int:
    """N, which the call or the phase's family may say."""
    if None not in (given, phase.n_sections) and given != phase.n_sections:
        raise DefinitionError(
            f"n_sections is {given}, but the phase is that of a family of {phase.n_sections} "
            "sections: give it once."
        )
    N = next((n for n in (given, phase.n_sections) if n is not None), _N_SECTIONS)
    return N


def _without_spikes(
    recording: Recording,
    trial: Trial,
    stretches: Sequence[Winding],
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
) -> tuple[Trial, Int[np.ndarray, " nuy"]]:
    """A trial in which samples of spikes are missing, and their numbers, of inputs and outputs."""
    values, counts = trial.values.copy(), []
    time, phase = count_on(stretches)
    for name in (*inputs, *outputs):
        x = values[:, recording.column(name)]
        heights = (input_spikes if name in inputs else spike_heights)(x)
        at = np.flatnonzero(heights)
        if len(at) and len(time):
            own = np.interp(trial.time[at], time, phase)
            at = at[~recurring(heights[at], own, np.ptp(phase))]
        x[at] = np.nan
        counts.append(len(at))
    return Trial(trial.time, values, trial.events, trial.name), np.array(counts)


class _Part(eqx.Module):
    """Samples of one stretch, at sections k[0], k[0] + 1, ... of its count; whether the phase was
    seen there."""

    k: Int[np.ndarray, " n"]
    t: Float[np.ndarray, " n"]
    seen: Bool[np.ndarray, " n"]
    u: Float[np.ndarray, "n nu"]
    y: Float[np.ndarray, "n ny"]


class _Sampler:
    """The signals of a trial as functions of time."""

    def __init__(
        self,
        recording: Recording,
        trial: Trial,
        inputs: tuple[str, ...],
        outputs: tuple[str, ...],
        bandwidth: float,
        sampled: Literal["mean", "middle"],
    ):
        self.time, self.sampled = trial.time, sampled
        for name in (*inputs, *outputs):
            seen = int(np.isfinite(trial.values[:, recording.column(name)]).sum())
            if seen < FEWEST:
                raise DefinitionError(
                    f"trial '{trial.name}' has {seen} samples of {name}: leave the trial out."
                )
        self.inputs = [trial.values[:, recording.column(name)] for name in inputs]
        self.outputs = [trial.values[:, recording.column(name)] for name in outputs]
        self.curves = [spline(trial.time, x, bandwidth) for x in self.outputs]

    def __call__(
        self, winding: Winding, n_sections: int, period: float, max_gap: int | float | None
    ) -> _Part | None:
        """At the sections of one stretch, if that holds a whole cycle; NaN in gaps."""
        first, last = winding.phase[[0, -1]] * n_sections
        k = np.arange(np.ceil(first - _ROUNDING), np.floor(last + _ROUNDING) + 1).astype(int)
        if len(k) <= n_sections:
            return None
        t = np.clip(winding.when(k / n_sections), *winding.time[[0, -1]])
        section = _GAP_SECTIONS * period / n_sections

        def holes(x):
            known = np.isfinite(x)
            longest = bridgeable(self.time, known, section) if max_gap is None else max_gap
            return gaps(self.time, known, longest)

        unseen = np.diff(winding.gaps, axis=1)[:, 0] > (section if max_gap is None else max_gap)
        seen = ~inside(winding.gaps[unseen], t[:-1], t[:-1])
        u, y = np.zeros((len(k) - 1, len(self.inputs))), np.zeros((len(k) - 1, len(self.outputs)))
        for i, x in enumerate(self.inputs):
            u[:, i] = self._input(x, t, holes(x))
        for i, curve in enumerate(self.curves):
            y[:, i] = curve(t[:-1])
        for i, x in enumerate(self.outputs):
            y[inside(holes(x), t[:-1], t[:-1]) | ~seen, i] = np.nan
        return _Part(k[:-1], t[:-1], seen, u, y)

    def _input(
        self,
        x: Float[np.ndarray, " n"],
        t: Float[np.ndarray, " m1"],
        holes: Float[np.ndarray, "g 2"],
    ) -> Float[np.ndarray, " m"]:
        if self.sampled == "middle":
            u = nearest(self.time, x, (t[:-1] + t[1:]) / 2)
        else:
            u = means(self.time, x, t)
        u[inside(holes, t[:-1], t[1:])] = np.nan
        return u


def _with_times(
    parts: list[_Part], N: int, period: float, timing: Literal["clock", "duration"]
) -> list[_Part]:
    """The time of crossing as one more output."""
    if timing == "duration":
        durations = [np.diff(np.where(p.seen, p.t, np.nan), prepend=np.nan) for p in parts]
        return [_with_output(p, d) for p, d in zip(parts, durations, strict=True)]
    # A line through the times of each section, t = T cycle + a[section], all with the same slope T;
    # cycles are counted through gaps.
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
    deviations = zip(parts, np.split(deviation, edges), strict=True)
    return [_with_output(p, np.where(p.seen, d, np.nan)) for p, d in deviations]


def _with_output(part: _Part, values: Float[np.ndarray, " n"]) -> _Part:
    return eqx.tree_at(lambda p: p.y, part, np.column_stack([part.y, values]))


def _deviations(parts: list[_Part], N: int) -> list[tuple[_Part, Float[np.ndarray, "N nuy"]]]:
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
