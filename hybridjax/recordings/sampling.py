"""`sample_sections`: from sampled signals to data at the sections of a cycle; and `without_drift`,
the removal of slow drift.

`sample_sections` takes the stages in order, trial by trial (`_sample_trials`): isolated spikes are
left out, splines through the outputs are evaluated where the phase crosses a section (`_Output`),
inputs become one value for each interval between sections (`_held`), and the average cycle is
subtracted. `_records` then makes a record of each stretch of the phase, and the result is a
`SectionData`. The order must stay: a spike must not reach a spline, and the average cycle is that
of all stretches of a trial. In arrays, inputs stand first, then outputs, and times of crossing
last.

A wrong output has its cause in `_Output`, an input that is shifted by a section in `_held`, a wrong
time of crossing in `_with_times`, and NaN where there are samples in `_long_gaps`. If data are
refused without need, look at `_require_changes` and `_require_times`.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import compress
from typing import Annotated, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.interpolate import CubicSpline
from scipy.signal import detrend

from .._core.arguments import require_equal
from .._core.boundary.checked import checked
from .._core.boundary.kinds import OptionalNames, SectionCount, SignalNames
from .._core.boundary.values import Number
from .._core.findings import warn_of
from .._core.signal import Signal
from ..errors import DefinitionError
from ..experiments.record import SectionSeries, average_cycle
from ..identify.descent import ROUNDING
from . import smoothing
from .data import SectionData
from .fit_warnings import slow_sampling
from .phase import HARMONICS, LONGEST_GAP, Phase, Winding
from .phase_estimation import PhaseDefinition, estimate_phase
from .read import RecordingLike, as_recording
from .recording import Recording, Trial
from .smoothing import (
    FEWEST,
    Bandwidth,
    Series,
    bridgeable,
    gaps,
    inside,
    means,
    require_passing,
    spline,
)


Signals = Float[np.ndarray, "n k"]
"""Several signals, sample by sample."""
DriftCycles = Annotated[float, Number("four cycles or more", low=4, infinite=True)]
"""Shortest duration of a drift; infinite: a constant. Shorter: responses to the inputs are removed
with the drift."""


@checked
def sample_sections(
    recording: RecordingLike,
    sections: Phase | PhaseDefinition,
    *,
    inputs: OptionalNames,
    outputs: OptionalNames,
    n_sections: SectionCount | None = None,
    bandwidth: Bandwidth | None = None,
    sampled: Literal["mean", "middle"] = "mean",
    timing: Literal["clock", "duration"] | None = None,
) -> SectionData:
    """Sample a recording at N phases of each cycle.

    Isolated spikes of up to three samples count as missing samples; `spikes` is their number.
    Transients at the same phase of most cycles (impacts) are kept, and so are pulses of an input
    that is not smooth.

    Splines bridge gaps up to the mean time between sections, but not less than three samples of a
    signal. In longer gaps, values are NaN. An output is NaN if its section lies in a gap of its own
    samples, or of the samples of the angle that is the phase. An input is NaN if the interval from
    its section to the next touches a gap of its own samples.

    **Arguments:**

    - `recording`: the recording, or the path of its file, or a table (`hj.Recording.from_frame`).
    - `sections`: the result of `estimate_phase`, or its argument `sections`.
    - `inputs`, `outputs`: names of signals. Without outputs, `()`, only the times of the events are
      known: `timing` is then "duration". Without inputs, `()`, the data are for
      `natural_multipliers`.
    - `n_sections`: N, equally spaced in phase. Default: the number of the family of a
      `KinematicPhase`, and 32 for other phases.
    - `bandwidth`: bandwidth in Hz of the smoothing splines through the outputs (see `spline`).
      Default: N per period, which averages over about one section. Infinite: interpolating cubic
      splines.
    - `sampled`: "mean" takes the mean of an input from each section to the next, with linear
      interpolation between samples. "middle" takes the sample nearest to the middle, for an input
      that is held from section to section (zero-order hold).
    - `timing`: an additional output with the time at which a section was crossed. "clock": the time
      minus that of the clock, for systems driven by a clock. "duration": the time since the section
      before, for other systems.

    The average cycle of each trial is subtracted, and the records let fits allow for a constant
    that remains (`SectionSeries.drift`). Drift of sensors also moves the phase: remove it from the
    signals before (`without_drift`), as `identify_recording` does.

    **Returns:** `hj.recordings.SectionData`: `records`, a tuple of `SectionSeries` with inputs u
    (n, nu) and outputs y (n, ny), deviations from the average cycle in units of the signals;
    `times`, in seconds; `cycle_inputs` (N, nu) and `cycle_outputs` (N, ny), the average cycle.

    **Raises:** `DefinitionError` for unknown names, no names, constant signals, outputs or times
    that repeat from cycle to cycle, a bandwidth below the rate of the rhythm, another number of
    sections than the family's, a recording without a whole cycle, and in the cases of
    `estimate_phase`.

    **Example:**

    ```python
    names = {"inputs": "u", "outputs": ("yM", "vM")}
    sampled = hj.recordings.sample_sections(recording, apex, n_sections=8, **names)
    fit = hj.fit_series(sampled, order=2)
    ```

    **Before:** `hj.recordings.estimate_phase`. **After:** `hj.select_order`, `hj.fit_series`.
    """
    inputs = tuple(inputs)
    outputs = tuple(outputs)
    recording = as_recording(recording)
    _require_signals(recording, (*inputs, *outputs))
    phase = sections
    if not isinstance(phase, Phase):
        phase = estimate_phase(recording, phase)
    N = _number_of_sections(n_sections, phase)
    if not outputs and timing is None:
        timing = "duration"
    if bandwidth is None:
        bandwidth = N / phase.period
    require_passing(bandwidth, 1 / phase.period)
    plan = _Plan(
        inputs=inputs,
        outputs=outputs,
        n_sections=N,
        period=phase.period,
        bandwidth=float(bandwidth),
        sampled=sampled,
        timing=timing,
    )
    parts, spikes = _sample_trials(recording, phase, plan)
    if not parts:
        raise DefinitionError(
            "the recording holds no whole cycle without gaps: record longer."
        )
    lengths = [len(part.k) for part in parts]
    cycle = np.average([part.cycle for part in parts], axis=0, weights=lengths)
    _require_changes(parts, cycle, plan)
    if timing is not None:
        longest = parts[int(np.argmax(lengths))]
        time = recording.trials[longest.trial].time
        _require_times(longest, N, float(np.median(np.diff(time))))
    # A smoothing spline averages over neighbors on both sides.
    smoothed = 0 if np.isinf(bandwidth) else 1
    nu = len(inputs)
    data = SectionData(
        records=_records(recording, parts, plan, phase.lead * N + smoothed),
        times=tuple(part.t for part in parts),
        trials=tuple(part.trial for part in parts),
        cycle_inputs=cycle[:, :nu],
        cycle_outputs=cycle[:, nu:],
        period=phase.period,
        bandwidth=plan.bandwidth,
        spikes=spikes,
        unresolved=_unresolved(parts, plan),
    )
    warn_of(slow_sampling(data))
    return data


class _Plan(NamedTuple):
    """Options of sampling, the same for all trials. The fields are the arguments of
    `sample_sections`."""

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    n_sections: int
    period: float
    bandwidth: float
    sampled: Literal["mean", "middle"]
    timing: Literal["clock", "duration"] | None

    @property
    def signals(self) -> tuple[str, ...]:
        return self.inputs + self.outputs

    @property
    def of_outputs(self) -> slice:
        """The columns of the outputs, without times of crossing."""
        return slice(len(self.inputs), len(self.signals))


class _Sections(NamedTuple):
    """Samples of one stretch at sections k[0], k[0] + 1, ..."""

    trial: int
    k: Int[np.ndarray, " n"]
    t: Series
    observed: Bool[np.ndarray, " n"]
    """Whether the phase was observed, not interpolated."""
    values: Signals
    """Inputs, outputs, and times of crossing if they are wanted."""
    change: Signals
    """Mean squares of changes of the outputs, if every second sample is left out."""
    cycle: Signals
    """Average values of the trial at each section, which are subtracted."""


def _number_of_sections(n_sections: int | None, phase: Phase) -> int:
    if n_sections is not None and phase.n_sections is not None:
        require_equal(
            "`n_sections` and phase", "n_sections", n_sections, phase.n_sections
        )
    return n_sections or phase.n_sections or HARMONICS


def _require_signals(recording: Recording, names: Sequence[str]) -> None:
    """**Raises:** `DefinitionError` for no signals, and for one that is constant."""
    for name in names:
        samples = [x[np.isfinite(x)] for _, x in recording.samples(name)]
        if not any(len(x) and np.ptp(x) for x in samples):
            raise DefinitionError(
                f"{name} is constant in all trials: repair it, or leave it out."
            )
    if not names:
        raise DefinitionError(
            "events alone determine no multipliers: name inputs or outputs."
        )


def _sample_trials(
    recording: Recording,
    phase: Phase,
    plan: _Plan,
) -> tuple[list[_Sections], tuple[int, ...]]:
    """Return the samples of all stretches as deviations from the average cycle of their trial, and
    the number of samples of each signal that were left out as spikes."""
    N = plan.n_sections
    columns = [recording.column(name) for name in plan.signals]
    parts: list[_Sections] = []
    spikes = np.zeros(len(columns), int)
    for number, (trial, stretches) in enumerate(phase.by_trial(recording)):
        signals, counts = _without_spikes(trial, columns, stretches, len(plan.inputs))
        spikes += counts
        for name, x in zip(plan.signals, signals.T, strict=True):
            samples = int(np.isfinite(x).sum())
            # (One half of the samples is left out to estimate the error of interpolation.)
            if samples < 2 * FEWEST:
                raise DefinitionError(
                    f"trial '{trial.name}' has {samples} samples of {name}: leave the trial out."
                )
        sections = _sample(number, trial.time, signals, stretches, plan)
        if not sections:
            continue
        if plan.timing is not None:
            sections = _with_times(sections, plan)
        section = np.concatenate([x.k % N for x in sections])
        values = np.concatenate([x.values for x in sections])
        cycle = average_cycle(section, values, N)
        for x in sections:
            deviations = x.values - cycle[x.k % N]
            parts.append(x._replace(values=deviations, cycle=cycle))
    if plan.timing is not None:
        spikes = np.append(spikes, 0)
    return parts, tuple(spikes.tolist())


def _records(
    recording: Recording,
    parts: list[_Sections],
    plan: _Plan,
    lead: int,
) -> tuple[SectionSeries, ...]:
    """Return a record of each stretch, which allows for a constant that remains."""
    names = [Signal(name, recording.unit(name)) for name in plan.signals]
    if plan.timing is not None:
        names.append(Signal("time" if plan.timing == "clock" else "duration", "s"))
    nu = len(plan.inputs)
    return tuple(
        SectionSeries(
            part.values[:, :nu],
            part.values[:, nu:],
            n_sections=plan.n_sections,
            first_section=int(part.k[0]) % plan.n_sections,
            inputs=tuple(names[:nu]),
            outputs=tuple(names[nu:]),
            lead=lead,
            drift=np.inf,
        )
        for part in parts
    )


def _unresolved(parts: list[_Sections], plan: _Plan) -> float:
    """Return the median change of an output if every second sample is left out, relative to its rms
    deviation; of the output with the largest ratio."""
    deviations = np.concatenate([part.values[:, plan.of_outputs] for part in parts])
    size = np.nanmean(deviations**2, axis=0)
    change = np.median(np.concatenate([part.change for part in parts]), axis=0)
    ratio = change / np.maximum(size, np.finfo(float).tiny)
    return float(np.sqrt(ratio).max(initial=0))


def _without_spikes(
    trial: Trial,
    columns: Sequence[int],
    stretches: Sequence[Winding],
    nu: int,
) -> tuple[Signals, Int[np.ndarray, " nuy"]]:
    """Return signals (nu inputs, then outputs) without isolated spikes, and their numbers."""
    signals = trial.values[:, columns]
    counts = np.zeros(len(columns), int)
    time, phase = _counted_through(stretches)
    for i, x in enumerate(signals.T):
        heights = smoothing.input_spikes(x) if i < nu else smoothing.spike_heights(x)
        at = np.flatnonzero(heights)
        if len(at) and len(time):
            phase_there = np.interp(trial.time[at], time, phase)
            of_motion = smoothing.recurring(heights[at], phase_there, np.ptp(phase))
            at = at[~of_motion]
        x[at] = np.nan
        counts[i] = len(at)
    return signals, counts


def _counted_through(stretches: Sequence[Winding]) -> tuple[Series, Series]:
    """Return times and phases of all stretches of a trial, counted on such that each stretch begins
    in a new cycle."""
    times = [np.zeros(0)]
    phases = [np.zeros(0)]
    cycle = 0.0
    for stretch in stretches:
        times.append(stretch.time)
        phases.append(stretch.phase - np.floor(stretch.phase[0]) + cycle)
        cycle = np.ceil(phases[-1][-1])
    return np.concatenate(times), np.concatenate(phases)


def _require_changes(
    parts: list[_Sections],
    cycle: Float[np.ndarray, "N nuy"],
    plan: _Plan,
) -> None:
    """**Raises:** `DefinitionError` for an output that most cycles repeat, but no input."""
    steps = []
    for part in parts:
        whole = len(part.k) // len(cycle) * len(cycle)
        cycles = part.values[:whole].reshape(-1, *cycle.shape)
        steps.append(np.abs(np.diff(cycles, axis=0)).max(axis=1))
    sizes = np.sort(np.nan_to_num(np.concatenate(steps), nan=np.inf), axis=0)
    larger_half = sizes[len(sizes) // 2 :]
    rounding = 1e3 * ROUNDING * np.abs(cycle).max(axis=0)
    repeats = larger_half.min(axis=0, initial=np.inf) <= rounding
    if repeats[: len(plan.inputs)].any():
        return
    for name in compress(plan.outputs, repeats[plan.of_outputs]):
        raise DefinitionError(
            f"{name} is the same in all cycles, but for rounding: it holds no deviations. "
            "Record it while it varies, or leave it out."
        )


def _require_times(part: _Sections, N: int, step: float) -> None:
    """**Raises:** `DefinitionError` for times of crossing whose deviations are errors of rounding
    or interpolation. (Errors of interpolation depend on the position of a crossing between samples,
    which are `step` seconds apart.)"""
    is_anchor = part.k % N == 0
    known = is_anchor & np.isfinite(part.values[:, -1])
    inner = np.flatnonzero(known)[3:-3]
    # (With fewer cycles, the seven waves below would explain too much.)
    if len(inner) <= 20:
        return
    t = part.t[inner]
    late = detrend(part.values[inner, -1])
    place = (t - detrend(t)) / step
    angle = 2 * np.pi * np.outer(place, np.arange(4))
    waves = np.exp(1j * angle).view(float)
    unexplained = late - waves @ np.linalg.lstsq(waves, late)[0]
    # (After regression, 0.4 % of interpolation errors are left, but 95 % of real deviations.)
    allowed = 0.1 * late.std() + ROUNDING * t[-1]
    if unexplained.std() <= allowed:
        raise DefinitionError(
            "the times of sections deviate only by rounding and interpolation between samples, "
            "as if the phase were the clock's own: use outputs, not times, or another phase."
        )


def _sample(
    trial: int,
    time: Series,
    signals: Signals,
    stretches: Sequence[Winding],
    plan: _Plan,
) -> list[_Sections]:
    """Sample the signals of a trial in all stretches of at least one cycle; NaN in gaps."""
    N = plan.n_sections
    nu = len(plan.inputs)
    of_output = [_Output.through(time, x, plan) for x in signals.T[nu:]]
    sections = []
    for stretch in stretches:
        k = _crossed(stretch, N)
        if len(k) <= N:
            continue
        t = stretch.when(k / N)
        t = np.clip(t, stretch.time[0], stretch.time[-1])
        start = t[:-1]
        lengths = np.diff(stretch.gaps, axis=1)[:, 0]
        long_gaps = lengths > plan.period / N
        observed = ~inside(stretch.gaps[long_gaps], start, start)
        values = np.zeros((len(start), signals.shape[1]))
        change = np.zeros((len(start), len(of_output)))
        for i, x in enumerate(signals.T[:nu]):
            known = np.isfinite(x)
            values[:, i] = _held(time[known], x[known], t, plan)
        for i, output in enumerate(of_output):
            at_start = output.at(start)
            values[:, nu + i] = np.where(observed, at_start, np.nan)
            change[:, i] = output.change(start)
        none = np.zeros((0, 0))
        sections.append(
            _Sections(
                trial=trial,
                k=k[:-1],
                t=start,
                observed=observed,
                values=values,
                change=change,
                cycle=none,
            )
        )
    return sections


def _crossed(stretch: Winding, N: int) -> Int[np.ndarray, " n1"]:
    """Return the sections that a stretch crosses, counted from phase 0."""
    rounding = 1e-9
    first = np.ceil(stretch.phase[0] * N - rounding)
    last = np.floor(stretch.phase[-1] * N + rounding)
    return np.arange(first, last + 1).astype(int)


def _long_gaps(time: Series, plan: _Plan) -> Float[np.ndarray, "g 2"]:
    """Return the gaps between samples of one signal that splines do not bridge."""
    return gaps(time, bridgeable(time, plan.period / plan.n_sections))


class _Output(NamedTuple):
    """An output as a function of time."""

    curve: CubicSpline
    halves: tuple[CubicSpline, CubicSpline]
    """Splines through the even samples, and through the odd ones."""
    gaps: Float[np.ndarray, "g 2"]

    @classmethod
    def through(cls, time: Series, values: Series, plan: _Plan) -> "_Output":
        finite = np.flatnonzero(np.isfinite(values))

        def through(samples: Int[np.ndarray, " _"]) -> CubicSpline:
            return spline(time[samples], values[samples], plan.bandwidth)

        halves = through(finite[::2]), through(finite[1::2])
        return cls(through(finite), halves, _long_gaps(time[finite], plan))

    def at(self, time: Series) -> Series:
        """Return the output at some times; NaN in long gaps."""
        return np.where(inside(self.gaps, time, time), np.nan, self.curve(time))

    def change(self, time: Series) -> Series:
        """Return the mean square of the changes if every second sample is left out."""
        whole = self.curve(time)
        return np.mean([(half(time) - whole) ** 2 for half in self.halves], axis=0)


def _held(time: Series, values: Series, edges: Series, plan: _Plan) -> Series:
    """Return the value of an input between each two successive times, as a mean or from the sample
    in the middle; NaN if the interval touches a long gap."""
    start = edges[:-1]
    end = edges[1:]
    if plan.sampled == "mean":
        held = means(time, values, edges)
    else:
        halfway = (time[:-1] + time[1:]) / 2
        held = values[np.searchsorted(halfway, (start + end) / 2)]
    return np.where(inside(_long_gaps(time, plan), start, end), np.nan, held)


def _with_times(parts: list[_Sections], plan: _Plan) -> list[_Sections]:
    """Append the time of crossing as an output, NaN where the phase was not observed."""
    times = [np.where(x.observed, x.t, np.nan) for x in parts]
    if plan.timing == "clock":
        late = _after_clock(parts, times, plan)
    else:
        late = [np.diff(t, prepend=np.nan) for t in times]
    return [
        part._replace(values=np.column_stack([part.values, x]))
        for part, x in zip(parts, late, strict=True)
    ]


def _after_clock(
    parts: list[_Sections],
    times: list[Series],
    plan: _Plan,
) -> list[Series]:
    """Return the deviations of times from those of an even rhythm, t = T cycle + a[section], with
    one period T for all sections. Cycles are counted across gaps."""
    N = plan.n_sections
    first = parts[0]
    begin = first.t[0] / plan.period - first.k[0] / N
    cycles = [
        part.k // N + round(part.t[0] / plan.period - part.k[0] / N - begin)
        for part in parts
    ]
    section = np.concatenate([part.k % N for part in parts])
    both = np.column_stack(
        [np.concatenate(cycles), np.concatenate([part.t for part in parts])]
    )
    cycle, time = (both - average_cycle(section, both, N)[section]).T
    slope = (cycle @ time) / (cycle @ cycle)
    is_missing = np.isnan(np.concatenate(times))
    late = np.where(is_missing, np.nan, time - slope * cycle)
    ends = np.cumsum([len(part.k) for part in parts])
    return np.split(late, ends[:-1])


@checked
def without_drift(
    recording: Recording,
    phase: Phase,
    signals: SignalNames,
    cycles: DriftCycles,
) -> Recording:
    """Remove the slow drift of some signals, such as that of sensors.

    The means of a signal over each cycle are smoothed by a spline, which passes one half of changes
    that take twice as many `cycles`, and subtracted; the overall mean stays. A phase estimated from
    the drifting signals is good enough; estimate it again from the result.

    **Raises:** `DefinitionError` for unknown signals, fewer than four cycles, or a phase of other
    trials.
    """
    columns = [recording.column(name) for name in signals]
    trials = []
    for trial, stretches in phase.by_trial(recording):
        values = trial.values.copy()
        for k in columns:
            smooth = smoothing.without_spikes(values[:, k])
            middle, level = cycle_means(trial, smooth, stretches, phase.period)
            # (A constant drift is the mean, which is kept.)
            if len(middle) >= FEWEST and cycles < np.inf:
                bandwidth = 0.5 / (cycles * phase.period)
                drift = spline(middle, level - level.mean(), bandwidth)
                within = np.clip(trial.time, middle[0], middle[-1])
                values[:, k] -= drift(within)
        trials.append(replace(trial, values=values))
    return recording.with_trials(trials)


def cycle_means(
    trial: Trial,
    x: Series,
    stretches: Sequence[Winding],
    period: float,
) -> tuple[Series, Series]:
    """Return the middle of each cycle without a long gap, and the mean of a signal over it."""
    holes = gaps(trial.time[np.isfinite(x)], LONGEST_GAP * period)
    middles = [np.zeros(0)]
    levels = [np.zeros(0)]
    for stretch in stretches:
        edges = stretch.edges()
        start = edges[:-1]
        end = edges[1:]
        whole = ~inside(holes, start, end)
        middles.append((start + end)[whole] / 2)
        levels.append(means(trial.time, x, edges)[whole])
    return np.concatenate(middles), np.concatenate(levels)
