"""From sampled signals to data at the sections of a cycle, and the removal of slow drift."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import compress
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.signal import detrend

from .._core.arguments import require_equal
from .._core.boundary.checked import checked
from .._core.boundary.kinds import OptionalNames, SectionCount, SignalNames
from .._core.boundary.values import Number
from .._core.findings import warn_of
from .._core.signal import Signal
from ..errors import DefinitionError
from ..experiments.record import Record, average_cycle
from ..identify.descent import ROUNDING
from . import smoothing
from .data import SectionData
from .fit_warnings import slow_sampling
from .phase import HARMONICS, LONGEST_GAP, Phase, Winding
from .phase_estimation import PhaseDefinition, estimate_phase
from .recording import Recording, Trial
from .smoothing import (
    FEWEST,
    Bandwidth,
    Series,
    bridgeable,
    gaps,
    inside,
    means,
    spline,
)


DriftCycles = Annotated[float, Number("four cycles or more", low=4, infinite=True)]
"""Shortest duration of a drift; infinite: a constant. Shorter: responses to the inputs are removed
with the drift."""


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
) -> SectionData:
    """Sample a recording at N phases of each cycle.

    Isolated spikes of up to three samples count as missing samples; `spikes` is their number.
    Transients at the same phase of most cycles (impacts) are kept, and so are pulses of an input
    that is not smooth.

    Splines bridge gaps up to the mean time between sections, but not less than three samples of a
    signal. Outputs are NaN at sections in longer gaps, in their own samples or in those of the
    angle that is the phase; inputs are NaN if their interval touches a gap in their own.

    **Arguments:**

    - `phase`: the result of `estimate_phase`, or a definition for it.
    - `inputs`, `outputs`: names of signals. Without outputs, `()`, only the times of the events are
      known: `timing` is then "duration". Without inputs, `()`, the data are for
      `natural_multipliers`.
    - `n_sections`: N, equally spaced in phase. Default: the number of the family of a
      `KinematicPhase`, and 32 for other phases.
    - `bandwidth`: bandwidth in Hz of the smoothing splines through the outputs (see `spline`).
      Default: N per period, which averages over about one section. Infinite: interpolating cubic
      splines.
    - `sampled`: "mean" for the mean of an input from each section to the next (it is taken as
      linear between samples), or "middle" for the sample nearest to the middle, for an input that
      is held from section to section (zero-order hold).
    - `timing`: an extra output with the time at which a section was crossed: "clock" for systems
      driven by a clock, the time minus that of the clock; "duration" for others, the time since the
      section before.

    The average cycle of each trial is subtracted, and the records let fits allow for a constant
    that remains (`Record.drift`). Drift of sensors also moves the phase: remove it from the signals
    before (`without_drift`), as `identify_recording` does.

    **Raises:** `DefinitionError` for unknown names, no names, constant signals, outputs or times
    that repeat from cycle to cycle, a bandwidth below the rate of the rhythm, another number of
    sections than the family's, a recording without a whole cycle, and as `estimate_phase`.
    """
    inputs, outputs = tuple(inputs), tuple(outputs)
    for name in (*inputs, *outputs):
        values = [x[np.isfinite(x)] for _, x in recording.samples(name)]
        if not any(len(x) and np.ptp(x) for x in values):
            raise DefinitionError(
                f"{name} is constant in all trials: repair it, or leave it out."
            )
    if not (inputs or outputs):
        raise DefinitionError(
            "events alone determine no multipliers: name inputs or outputs."
        )
    if not outputs and timing is None:
        timing = "duration"
    if not isinstance(phase, Phase):
        phase = estimate_phase(recording, phase)
    if None not in (n_sections, phase.n_sections):
        require_equal(
            "`n_sections` and phase", "n_sections", n_sections, phase.n_sections
        )
    N = n_sections or phase.n_sections or HARMONICS
    bandwidth = N / phase.period if bandwidth is None else float(bandwidth)
    smoothing.require_passing(bandwidth, 1 / phase.period)
    nu, columns = len(inputs), [recording.column(x) for x in (*inputs, *outputs)]
    parts, trials, cycles, spikes = [], [], [], np.zeros(len(columns), int)
    for number, (trial, stretches) in enumerate(phase.by_trial(recording)):
        signals, struck = _without_spikes(
            trial.time, trial.values[:, columns], nu, stretches
        )
        spikes += struck
        for name, count in zip(
            (*inputs, *outputs), np.isfinite(signals).sum(axis=0), strict=True
        ):
            if (
                count < 2 * FEWEST
            ):  # (a half of them is left out to see what interpolation loses)
                text = f"trial '{trial.name}' has {count} samples of {name}: leave the trial out."
                raise DefinitionError(text)
        sections = _sample(
            trial.time, signals, nu, stretches, N, phase.period, bandwidth, sampled
        )
        if timing is not None:
            sections = _with_times(sections, N, phase.period, timing)
        if not sections:
            continue
        k = np.concatenate([x.k for x in sections]) % N
        mean = average_cycle(k, np.concatenate([x.values for x in sections]), N)
        parts += [x._replace(values=x.values - mean[x.k % N]) for x in sections]
        trials += [number] * len(sections)
        cycles += [mean] * len(sections)
    if not parts:
        raise DefinitionError(
            "the recording holds no whole cycle without gaps: record longer."
        )
    cycle = np.average(cycles, axis=0, weights=[len(x.k) for x in parts])
    _require_changes(parts, cycle, nu, outputs)
    names = [Signal(x, recording.unit(x)) for x in (*inputs, *outputs)]
    if timing is not None:
        names.append(Signal("time" if timing == "clock" else "duration", "s"))
        spikes = np.append(spikes, 0)
        part, trial = max(
            zip(parts, trials, strict=True), key=lambda pair: len(pair[0].k)
        )
        _require_times(part, N, float(np.median(np.diff(recording.trials[trial].time))))
    # A smoothing spline averages over neighbors on both sides.
    lead = phase.lead * N + (0 if np.isinf(bandwidth) else 1)
    change = np.median(np.concatenate([x.change for x in parts]), axis=0)
    squares = np.concatenate([x.values[:, nu : nu + len(outputs)] ** 2 for x in parts])
    size = np.maximum(np.nanmean(squares, axis=0), np.finfo(float).tiny)
    about: dict[str, Any] = {"n_sections": N, "lead": lead, "drift": np.inf}
    about |= {"inputs": tuple(names[:nu]), "outputs": tuple(names[nu:])}
    records = (
        Record(*np.split(x.values, [nu], 1), first_section=int(x.k[0]) % N, **about)
        for x in parts
    )
    data = SectionData(
        tuple(records),
        tuple(x.t for x in parts),
        tuple(trials),
        cycle[:, :nu],
        cycle[:, nu:],
        phase.period,
        bandwidth,
        tuple(spikes.tolist()),
        float(np.sqrt(change / size).max(initial=0)),
    )
    warn_of(slow_sampling(data))
    return data


def _without_spikes(
    time: Series,
    signals: Float[np.ndarray, "n nuy"],
    nu: int,
    stretches: Sequence[Winding],
) -> tuple[Float[np.ndarray, "n nuy"], Int[np.ndarray, " nuy"]]:
    """Return signals (nu inputs, then outputs) without isolated spikes, and their numbers."""
    signals, counts = signals.copy(), []
    times, phases, cycle = [np.zeros(0)], [np.zeros(0)], 0.0
    for w in (
        stretches
    ):  # the phase continues from stretch to stretch, each from a new cycle on
        times.append(w.time)
        phases.append(w.phase - np.floor(w.phase[0]) + cycle)
        cycle = np.ceil(phases[-1][-1])
    time_of, phase = np.concatenate(times), np.concatenate(phases)
    for i, x in enumerate(signals.T):
        heights = (smoothing.input_spikes if i < nu else smoothing.spike_heights)(x)
        at = np.flatnonzero(heights)
        if len(at) and len(time_of):
            phase_there = np.interp(time[at], time_of, phase)
            at = at[~smoothing.recurring(heights[at], phase_there, np.ptp(phase))]
        x[at] = np.nan
        counts.append(len(at))
    return signals, np.array(counts)


class _Sections(NamedTuple):
    """Samples of one stretch at sections k[0], k[0] + 1, ...; whether the phase was observed."""

    k: Int[np.ndarray, " n"]
    t: Series
    observed: Bool[np.ndarray, " n"]
    values: Float[np.ndarray, "n nuy"]
    change: Float[np.ndarray, "n ny"]
    """Mean squares of changes of the outputs, if every second sample is left out."""


def _require_changes(
    parts: list[_Sections],
    cycle: Float[np.ndarray, "N nuy"],
    nu: int,
    outputs: Sequence[str],
) -> None:
    """**Raises:** `DefinitionError` for an output that most cycles repeat, but no input."""
    whole = [x.values[: len(x.k) // len(cycle) * len(cycle)] for x in parts]
    whole = [x.reshape(-1, *cycle.shape) for x in whole]
    steps = np.concatenate([np.abs(np.diff(x, axis=0)).max(axis=1) for x in whole])
    steps = np.sort(np.nan_to_num(steps, nan=np.inf), axis=0)[len(steps) // 2 :]
    same = steps.min(axis=0, initial=np.inf) <= 1e3 * ROUNDING * np.abs(cycle).max(
        axis=0
    )
    for name in compress(outputs, same[nu:] & ~same[:nu].any()):
        text = f"{name} is the same in all cycles, but for rounding: it holds no deviations. "
        raise DefinitionError(f"{text}Record it while it varies, or leave it out.")


def _require_times(part: _Sections, N: int, step: float) -> None:
    """**Raises:** `DefinitionError` for times that deviate by rounding, or by interpolation, whose
    errors depend on the place of a crossing between samples, which are `step` seconds apart."""
    at = np.flatnonzero((part.k % N == 0) & np.isfinite(part.values[:, -1]))[
        3:-3
    ]  # (no ends)
    if len(at) > 20:  # (of fewer cycles, the seven waves below explain too much)
        t, late = part.t[at], detrend(part.values[at, -1])
        waves = np.exp(2j * np.pi / step * np.outer(t - detrend(t), np.arange(4))).view(
            float
        )
        left = late - waves @ np.linalg.lstsq(waves, late)[0]
        # (Of interpolation errors 0.4 % are left, of deviations by the rhythm 95 %.)
        if left.std() <= 0.1 * late.std() + ROUNDING * t[-1]:
            raise DefinitionError(
                "the times of sections deviate only by rounding and interpolation between samples, "
                "as if the phase were the clock's own: use outputs, not times, or another phase."
            )


def _sample(
    time: Series,
    signals: Float[np.ndarray, "n nuy"],
    nu: int,
    stretches: Sequence[Winding],
    N: int,
    period: float,
    bandwidth: float,
    sampled: Literal["mean", "middle"],
) -> list[_Sections]:
    """Sample a trial (nu inputs, then outputs) in stretches of a whole cycle; NaN in gaps."""
    sections, kept = [], [np.flatnonzero(np.isfinite(x)) for x in signals.T[nu:]]
    curves = [
        [spline(time[k], x[k], bandwidth) for k in (at, at[::2], at[1::2])]
        for x, at in zip(signals.T[nu:], kept, strict=True)
    ]
    for w in stretches:
        first, last = w.phase[[0, -1]] * N
        k = np.arange(np.ceil(first - 1e-9), np.floor(last + 1e-9) + 1).astype(
            int
        )  # rounding
        if len(k) <= N:
            continue
        t = np.clip(w.when(k / N), *w.time[[0, -1]])
        start, end = t[:-1], t[1:]
        observed = ~inside(
            w.gaps[np.diff(w.gaps, axis=1)[:, 0] > period / N], start, start
        )
        values, change = (np.zeros((len(start), signals.shape[1] - k)) for k in (0, nu))
        for i, x in enumerate(signals.T):
            finite = np.isfinite(x)
            holes = gaps(time[finite], bridgeable(time[finite], period / N))
            lost = inside(holes, start, end)
            if i >= nu:
                values[:, i], *halves = (curve(start) for curve in curves[i - nu])
                change[:, i - nu] = np.mean((halves - values[:, i]) ** 2, axis=0)
                lost = inside(holes, start, start) | ~observed
            elif sampled == "mean":
                values[:, i] = means(time, x, t)
            else:
                at = time[finite]
                values[:, i] = x[finite][
                    np.searchsorted((at[:-1] + at[1:]) / 2, (start + end) / 2)
                ]
            values[lost, i] = np.nan
        sections.append(_Sections(k[:-1], start, observed, values, change))
    return sections


def _with_times(
    parts: list[_Sections], N: int, period: float, timing: Literal["clock", "duration"]
) -> list[_Sections]:
    """Append the time of crossing as an output."""
    late = [np.diff(np.where(p.observed, p.t, np.nan), prepend=np.nan) for p in parts]
    if timing == "clock" and parts:
        # A line through the times of each section, t = T cycle + a[section], all with the same
        # slope T; cycles are counted through gaps.
        cycles = [
            p.k // N
            + round((p.t[0] - parts[0].t[0]) / period - (p.k[0] - parts[0].k[0]) / N)
            for p in parts
        ]
        section = np.concatenate([p.k % N for p in parts])
        both = np.stack(
            [np.concatenate(cycles), np.concatenate([p.t for p in parts])], axis=1
        )
        x, z = (both - average_cycle(section, both, N)[section]).T
        z = np.where(
            np.concatenate([p.observed for p in parts]),
            z - (x @ z) / (x @ x) * x,
            np.nan,
        )
        late = np.split(z, np.cumsum([len(p.k) for p in parts])[:-1])
    pairs = zip(parts, late, strict=True)
    return [p._replace(values=np.column_stack([p.values, z])) for p, z in pairs]


@checked
def without_drift(
    recording: Recording, phase: Phase, signals: SignalNames, cycles: DriftCycles
) -> Recording:
    """Remove the slow drift of some signals, such as that of sensors.

    The means of a signal over each cycle are smoothed by a spline, which passes one half of changes
    that take twice as many `cycles`, and subtracted; the overall mean stays. A phase estimated from
    the drifting signals is good enough; estimate it again from the result.

    **Raises:** `DefinitionError` for unknown signals, fewer than four cycles, or a phase of other
    trials.
    """
    columns, trials = [recording.column(x) for x in signals], []
    for trial, stretches in phase.by_trial(recording):
        values = trial.values.copy()
        for k in columns:
            middle, level = cycle_means(
                trial, smoothing.without_spikes(values[:, k]), stretches, phase.period
            )
            if (
                len(middle) >= FEWEST and cycles < np.inf
            ):  # (a constant drift is the mean)
                slow = spline(
                    middle, level - level.mean(), 0.5 / (cycles * phase.period)
                )
                values[:, k] -= slow(np.clip(trial.time, middle[0], middle[-1]))
        trials.append(replace(trial, values=values))
    return recording.with_trials(trials)


def cycle_means(
    trial: Trial, x: Series, stretches: Sequence[Winding], period: float
) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " c"]]:
    """Return the middle of each cycle without a long gap, and the mean of a signal over it."""
    holes = gaps(trial.time[np.isfinite(x)], LONGEST_GAP * period)
    middles, levels = [np.zeros(0)], [np.zeros(0)]
    for edges in (w.edges() for w in stretches):
        whole = ~inside(holes, edges[:-1], edges[1:])
        middles.append(((edges[:-1] + edges[1:]) / 2)[whole])
        levels.append(means(trial.time, x, edges)[whole])
    return np.concatenate(middles), np.concatenate(levels)
