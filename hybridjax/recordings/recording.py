"""`Recording`: what a laboratory recorded, that is, sampled signals and events with units, in one
or several trials.

The constructor checks the arrays; `join` and `beside` combine recordings, and `mark` adds events.
Two things must stay: nothing is resampled or filled in (a missing sample is NaN), and the columns
of `Trial.values` have the order of `Recording.signals` in all trials.

Errors about times come from `_require_increasing`, those about events outside of the recording from
`check_events`. If `mark` misses a crossing, look at `known` there, which leaves out gaps, and at
the bandwidth; if samples are at wrong times after `beside`, look at `_beside`.
"""

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, Protocol, TypeAlias

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.optimize.elementwise import find_root

from .._core import limits
from .._core.arguments import require_among, require_equal
from .._core.boundary.checked import checked
from .._core.boundary.members import Leading, leading_on
from .._core.boundary.values import Plain
from .._core.findings import Finding, print_findings
from .._core.showable import Showable
from .._core.signal import with_unit
from .._core.text import folded, how_many
from ..errors import DefinitionError
from ..orbits.crossing import Crossing
from .formats.columns import (
    Columns,
    Table,
    assumed,
    numbers,
    parse_table,
    require_aligned,
)
from .smoothing import Bandwidth, Series, bridgeable, spline, without_spikes


# Trials that an error names. More: it is longer than a line. Fewer: times of others are hidden.
_NAMED = 3


def _has_columns(value: Any) -> bool:
    names = ("keys", "column_names", "columns")
    return any(inspect.getattr_static(value, name, None) is not None for name in names)


def _names_of_columns(table: Any) -> list[str]:
    """Return the names of the columns of a table of pyarrow, polars, pandas or a dictionary."""
    if hasattr(table, "column_names"):
        return list(table.column_names)
    return list(table.columns if hasattr(table, "columns") else table.keys())


class _Columns(Protocol):
    def __getitem__(self, name: Any, /) -> Any: ...


NamedColumns: TypeAlias = Annotated[
    _Columns, Plain("a table with named columns", _has_columns)
]
"""A table of pandas, polars or pyarrow, or a dictionary of arrays."""


@leading_on
class Trial(eqx.Module):
    """One uninterrupted run of the instruments.

    **Fields**, on the host:

    - `time` (n,): times of the samples, strictly increasing, not necessarily regular.
    - `values` (n, k): the signals; NaN where a sample is missing.
    - `events`: times of events by name, ascending; none need lie on a sample.
    - `name`: name for messages and figures.
    """

    time: Series
    values: Float[np.ndarray, "n k"]
    events: dict[str, Float[np.ndarray, " _"]]
    name: str = eqx.field(static=True)

    def __repr__(self) -> str:
        # (JAX may make a `Trial` whose leaves are not arrays.)
        is_series = isinstance(self.time, np.ndarray) and len(self.time) > 1
        return f"Trial({_summary(self).strip() if is_series else self.name})"


@checked
class Recording(Showable, eqx.Module, metaclass=Leading):
    """Sampled signals of one or several trials. Nothing is resampled.

    **Fields:**

    - `trials`: one or several `Trial`s with the same signals.
    - `signals`: names of the signals. `units`: a unit for each, "" where none was given.
    - `findings`: assumptions made while files were read.

    **Example:**

    ```python
    t = np.arange(0, 20, 0.01)
    signals = {"push": np.cos(3 * t), "angle": np.sin(2 * np.pi * t)}
    walk = hj.Recording(t, signals, events={"heel": np.arange(1, 20)}, units={"push": "N"})
    ```

    **Before:** a measurement, or `hj.read_recording`. **After:** `hj.recordings.check_recording`,
    `hj.identify_recording`.
    """

    trials: tuple[Trial, ...]
    signals: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    findings: tuple[Finding, ...] = eqx.field()

    def __init__(
        self,
        time: Any,
        signals: Mapping[str, Any] | None = None,
        *,
        events: Mapping[str, Any] | None = None,
        units: Mapping[str, str] | None = None,
        name: str = "trial",
        findings: Sequence[Finding] = (),
    ):
        """Make a recording of one trial; `join` combines several.

        **Arguments:**

        - `time` (n,): times of the samples, in seconds; strictly increasing. A table with a column
          `time`, as `from_frame` takes it, can replace times and signals.
        - `signals`: inputs and outputs by name, (n,) each; NaN where a sample is missing. Series
          of pandas must have the same index, and their samples the same order.
        - `events`: times of events by name, such as foot strikes. Those outside of the recording
            are left out, with a finding.
        - `units`: units by name. `name`: name of the trial. `findings` about the data.

        **Raises:** `DefinitionError` for arrays that do not fit together, time that repeats or runs
        backwards, and infinite values, with the sample.
        """
        where = f"trial '{name}'"
        if signals is None:
            table = _table_of(where, time, "time", events, units)
            time = table.time
            signals = table.signals
            events = table.events
            units = table.units
        units = dict(units or {})
        events = dict(events or {})
        require_aligned(where, [time, *signals.values()])
        time = numbers(where, "time", time)
        if not signals:
            raise DefinitionError(f"{where} has no signals.")
        columns = {key: numbers(where, key, values) for key, values in signals.items()}
        for key, values in columns.items():
            require_equal(f"{where}: {key} and time", "lengths", len(values), len(time))
        happened = {key: numbers(where, key, values) for key, values in events.items()}
        for key, values in (happened | columns).items():
            _require_finite(where, key, values)
        _require_increasing(where, time)
        require_among("signal", units, columns, f"{where}, `units`: ")
        both = set(happened) & set(columns)
        if both:
            raise DefinitionError(
                f"{where}: '{min(both)}' is a signal and an event: rename one."
            )
        outside: list[Finding] = []
        for key, values in happened.items():
            within, lost = check_events(where, key, values, time)
            happened[key] = np.sort(within)
            outside += lost
        values = np.stack(list(columns.values()), axis=1)
        self.trials = (
            Trial(
                time=time,
                values=values,
                events=happened,
                name=name,
            ),
        )
        self.signals = tuple(columns)
        self.units = tuple(units.get(key, "") for key in columns)
        self.findings = (*findings, *outside)

    @classmethod
    def from_frame(
        cls,
        frame: Any,
        *,
        time: str = "time",
        events: Mapping[str, Any] | None = None,
        units: Mapping[str, str] | None = None,
        name: str = "trial",
    ) -> "Recording":
        """Make a trial from a table with named columns (pandas, polars, pyarrow, a dictionary).

        **Arguments:** `time`: the column with the times; all others are signals, or events if they
        are called `event NAME`. Units may stand in the names, `time (ms)` and `force (N)`. The
        other arguments are those of `Recording`.

        **Raises:** `DefinitionError` if there is no such column, for an unknown unit of time, and
        as `Recording`; `FileFormatError` for two columns of one name.
        """
        table = _table_of(f"trial '{name}'", frame, time, events, units)
        return cls(
            table.time,
            table.signals,
            events=table.events,
            units=table.units,
            name=name,
        )

    @staticmethod
    def join(recordings: Iterable["Recording"]) -> "Recording":
        """Combine the trials of several recordings.

        **Raises:** `DefinitionError` if there is none, or signals or units differ.
        """
        recordings = list(recordings)
        if not recordings:
            raise DefinitionError("`recordings` must be one recording or more.")
        first = recordings[0]
        trials: list[Trial] = []
        findings: dict[Finding, None] = {}
        for other in recordings:
            pair = f"trials '{first.trials[0].name}' and '{other.trials[0].name}'"
            signals = sorted(first.signals)
            require_equal(pair, "signals", signals, sorted(other.signals))
            # (Not `other.column(name)`: a recording may have thousands of signals.)
            column = {name: k for k, name in enumerate(other.signals)}
            columns = [column[name] for name in first.signals]
            for name, unit, k in zip(first.signals, first.units, columns, strict=True):
                require_equal(pair, f"units of {name}", unit, other.units[k])
            findings |= dict.fromkeys(other.findings)
            if columns == sorted(columns):  # (nothing is copied)
                trials += other.trials
            else:
                trials += [
                    replace(t, values=t.values[:, columns]) for t in other.trials
                ]
        whole = eqx.tree_at(lambda r: r.findings, first, tuple(findings))
        return whole.with_trials(trials)

    @staticmethod
    def beside(recordings: Iterable["Recording"]) -> "Recording":
        """Combine signals that were recorded at the same time, each with its own sampling times.

        All share one time axis, on which a signal is missing (NaN) where it was not sampled:
        nothing is interpolated. Trials of the same position belong together; their times must count
        from the same zero.

        **Raises:** `DefinitionError` if there is none, numbers of trials differ, a signal exists
        twice, or the common axis is too long.
        """
        recordings = list(recordings)
        if len({len(x.trials) for x in recordings}) != 1:
            raise DefinitionError(
                "`recordings` must have the same number of trials each."
            )
        units: dict[str, str] = {}
        for recording in recordings:
            twice = set(recording.signals) & set(units)
            if twice:
                raise DefinitionError(
                    f"two recordings have a signal '{min(twice)}': rename one."
                )
            units |= dict(zip(recording.signals, recording.units, strict=True))
        findings = [finding for x in recordings for finding in x.findings]
        together = zip(*(x.trials for x in recordings), strict=True)
        return Recording.join([_beside(trials, units, findings) for trials in together])

    def mark(
        self,
        event: str,
        crossing: Crossing,
        *,
        bandwidth: Bandwidth = np.inf,
    ) -> "Recording":
        """Add an event at each time at which a signal crosses a level.

        A jump in the stated direction is an event; a jump in the other direction, as of an angle
        that wraps, is not. A signal that crosses the level several times within a cycle, in noise,
        makes doubled events, which `estimate_phase` leaves out. Crossings in gaps that are longer
        than three samples, and than half a wavelength at the bandwidth, are unknown, and make no
        events. Isolated spikes are ignored (see `sample_sections`).

        **Arguments:** `event`: its name. `crossing`: crossing of a signal, given by name.
        `bandwidth`: bandwidth in Hz of the smoothing spline whose crossings are taken. Default:
        infinite (the spline interpolates).

        **Raises:** `DefinitionError` for an unknown signal, one that never crosses the level, and a
        crossing of a function or in charts, which recordings do not have.
        """
        signal = signal_of(crossing)
        level = float(crossing.value)
        trials = []
        for trial, x in self.samples(signal):
            curve = spline(trial.time, without_spikes(x), bandwidth)
            t = curve.x
            y = curve(t) - level
            if crossing.direction != "rising":
                y = -y
            known = np.diff(t) <= bridgeable(t, 0.5 / bandwidth)
            rises = (y[:-1] < 0) & (y[1:] >= 0)
            at = np.flatnonzero(rises & known)
            if not len(at):
                if np.nanmin(x) < level < np.nanmax(x) and bandwidth < np.inf:
                    remedy = (
                        f"its samples cross it, but not its smoothing spline of {bandwidth:.4g} "
                        "Hz: give a larger `bandwidth`"
                    )
                else:
                    remedy = f"choose a `value` between {np.nanmin(x):.4g} and {np.nanmax(x):.4g}"
                raise DefinitionError(
                    f"trial '{trial.name}': {signal} is never seen to cross {level:g}, "
                    f"{crossing.direction}: {remedy}."
                )
            interval = (t[at], t[at + 1])
            crossed = find_root(_minus(curve, level), interval).x
            trials.append(replace(trial, events=trial.events | {event: crossed}))
        return self.with_trials(trials)

    def crop(
        self, start: float | None = None, stop: float | None = None
    ) -> "Recording":
        """Return the part of each trial between two times.

        A part has the samples from `start` on and before `stop`: two parts side by side,
        `crop(None, t)` and `crop(t, None)`, have no sample twice. Signals, units, findings and
        names stay. Events between the two times stay, except those that are more than a sample away
        from the samples that are left. A trial with fewer than two samples in between is left out.

        **Arguments:** `start` and `stop`: times in s on the clock of the trials, as in
        `recording.time`; they do not count from the first sample. Default: None, no limit.

        **Raises:** `DefinitionError` if `start` is not before `stop`, and if no trial is left.

        **Example:** without the first ten seconds:

        ```python
        later = recording.crop(10.0)
        ```
        """
        low = -np.inf if start is None else start
        high = np.inf if stop is None else stop
        if not low < high:
            raise DefinitionError(
                f"Recording.crop: `start` must be before `stop`, not {low:.10g} and {high:.10g}."
            )
        parts = [_part(trial, low, high) for trial in self.trials]
        left = [part for part in parts if len(part.time) > 1]
        if not left:
            raise DefinitionError(_about_nothing_left(self, start, stop))
        return self.with_trials(left)

    def with_trials(self, trials: Iterable[Trial]) -> "Recording":
        """Replace the trials."""
        return eqx.tree_at(lambda r: r.trials, self, tuple(trials))

    def column(self, name: str) -> int:
        """Return the column of a signal in `Trial.values`.

        **Raises:** `DefinitionError` if there is none of that name.
        """
        require_among("signal", [name], self.signals)
        return self.signals.index(name)

    def __len__(self) -> int:
        """The number of trials."""
        return len(self.trials)

    def __getitem__(self, name: str) -> Series:
        """The samples of a signal, one trial after the other: `recording["yM"]`.

        **Raises:** `DefinitionError` for a signal that does not exist.
        """
        return np.concatenate([x for _, x in self.samples(name)])

    @property
    def time(self) -> Series:
        """The times of all samples in s, one trial after the other."""
        return np.concatenate([trial.time for trial in self.trials])

    @property
    def rate(self) -> float:
        """Samples per second: one over the median time between samples."""
        return float(
            1 / np.median(np.concatenate([np.diff(t.time) for t in self.trials]))
        )

    @property
    def duration(self) -> float:
        """The length of all trials together, in s."""
        return float(sum(np.ptp(trial.time) for trial in self.trials))

    def samples(self, name: str) -> list[tuple[Trial, Series]]:
        """Return each trial with the samples of a signal."""
        return [(trial, trial.values[:, self.column(name)]) for trial in self.trials]

    def unit(self, name: str) -> str:
        """Return the unit of a signal, "" where none was given."""
        return self.units[self.column(name)]

    def __repr__(self) -> str:
        names = ", ".join(map(with_unit, self.signals, self.units))
        trials = how_many(len(self.trials), "trial", "trials")
        lines = [folded(f"Recording({trials}: {names})")]
        lines += [_summary(trial) for trial in self.trials]
        if self.findings:
            lines.append(print_findings(self.findings, "  "))
        return "\n".join(lines)


def _summary(trial: Trial) -> str:
    """Return length, rate, gaps and events of a trial on one line, or folded."""
    step = np.diff(trial.time)
    usual = float(np.median(step))
    longest = f"{step.max():.4g} s"
    uneven = "" if longest == f"{usual:.4g} s" else f", longest {longest}"
    parts = [
        f"  {trial.name}: {len(trial.time)} samples in {np.ptp(trial.time):.4g} s, every "
        f"{usual:.4g} s ({1 / usual:.4g} Hz{uneven})"
    ]
    missing = int(np.isnan(trial.values).any(axis=1).sum())
    if missing:
        parts.append(f"{missing} with gaps")
    parts += [f"{len(at)} {name}" for name, at in trial.events.items()]
    return folded("; ".join(parts), "  ")


def _table_of(
    where: str,
    frame: Any,
    time: str,
    events: Mapping[str, Any] | None,
    units: Mapping[str, str] | None,
) -> Table:
    """Return times, signals and events of a table with named columns, with further events and
    units.

    **Raises:** `DefinitionError` for data without columns, and in the cases of `parse_table`.
    """
    if not _has_columns(frame):
        raise DefinitionError(
            "Recording needs `signals`: `hj.Recording(time, {'name': samples})`, or a table with "
            f"a column `{time}`."
        )
    columns = Columns({str(key): frame[key] for key in _names_of_columns(frame)})
    table = parse_table(where, columns, time)
    return table._replace(
        events=table.events | dict(events or {}), units=table.units | dict(units or {})
    )


def _part(trial: Trial, low: float, high: float) -> Trial:
    """Return the samples and events at times from `low` on and before `high`."""

    def within(times: Series) -> Any:
        return (times >= low) & (times < high)

    kept = within(trial.time)
    time = trial.time[kept]
    events = {}
    for name, at in trial.events.items():
        inside = at[within(at)]
        events[name] = inside[_near(inside, time)] if len(time) > 1 else inside
    return replace(trial, time=time, values=trial.values[kept], events=events)


def _about_nothing_left(
    recording: Recording, start: float | None, stop: float | None
) -> str:
    if stop is None:
        asked = f"from {start:.10g} s on"
    elif start is None:
        asked = f"before {stop:.10g} s"
    else:
        asked = f"from {start:.10g} to {stop:.10g} s"
    spans = [
        f"{trial.time[0]:.6g} to {trial.time[-1]:.6g} s ('{trial.name}')"
        for trial in recording.trials[:_NAMED]
    ]
    more = ", ..." if len(recording) > _NAMED else ""
    return (
        f"Recording.crop: fewer than two samples {asked} are left: samples lie in "
        f"{', '.join(spans)}{more}."
    )


def _minus(curve: CubicSpline, level: float) -> Callable[[Series], Series]:
    return lambda t: curve(t) - level


def _beside(
    trials: Sequence[Trial],
    units: Mapping[str, str],
    findings: Sequence[Finding],
) -> Recording:
    """Return one trial with the signals of several, on a common time axis."""
    name = trials[0].name
    time = np.unique(np.concatenate([t.time for t in trials]))
    if len(time) * len(units) > limits.RECORDED:
        raise DefinitionError(
            f"trial '{name}': {len(units)} signals at {len(time)} times are too many together: "
            "choose `signals`."
        )
    values = []
    events: dict[str, Series] = {}
    for trial in trials:
        columns = np.full((len(time), trial.values.shape[1]), np.nan)
        columns[np.searchsorted(time, trial.time)] = trial.values
        values.append(columns)
        events |= trial.events
    if any(len(t.time) < len(time) for t in trials):
        text = "signals have different rates or clocks: they are missing in between."
        findings = [*findings, assumed(text)]
    signals = dict(zip(units, np.concatenate(values, axis=1).T, strict=True))
    return Recording(
        time, signals, events=events, units=units, name=name, findings=findings
    )


def _require_finite(where: str, name: str, values: Series) -> None:
    """**Raises:** `DefinitionError` for an infinite value."""
    infinite = np.flatnonzero(np.isinf(values))
    if len(infinite):
        raise DefinitionError(
            f"{where}: {name} is infinite at sample {infinite[0]}; put NaN where a sample is bad."
        )


def _require_increasing(where: str, time: Series) -> None:
    """**Raises:** `DefinitionError` for fewer than two samples, and time that does not increase."""
    if len(time) < 2:
        raise DefinitionError(
            f"{where} has {len(time)} samples, but two or more are needed."
        )
    finite = np.where(np.isinf(time), np.nan, time)
    later = np.diff(finite) > 0
    if later.all():
        return
    bad = 1 + int(np.argmin(later))
    before = time[bad - 1]
    after = time[bad]
    if not after < before:
        remedy = "leave out such samples"
    elif _begins_again(time, bad):
        # (One step passes from the last sample before the fall to the first sample after it.)
        period = before - after + float(np.nanmedian(np.diff(finite)))
        remedy = (
            "if the clock wraps, undo it (`numpy.unwrap` with "
            f"period={period:.10g}); if a new trial begins, make a trial of each part"
        )
    else:
        remedy = "sort the samples by their times"
    raise DefinitionError(
        f"{where}: time does not increase at sample {bad} ({before:.10g}, then {after:.10g}): "
        f"{remedy}."
    )


def _begins_again(time: Series, bad: int) -> bool:
    """Return whether time begins again at sample `bad`: it falls by more than half of its range so
    far, and increases afterwards."""
    so_far = np.ptp(time[:bad])
    after = time[bad : bad + 3]
    rises = bool((np.diff(after) > 0).all())
    goes_on = len(after) > 1 and rises
    jump_back = time[bad - 1] - time[bad]
    return jump_back > so_far / 2 and goes_on and bad > 2


def signal_of(crossing: Crossing) -> str:
    """Return the name of the signal that crosses a level.

    **Raises:** `DefinitionError` for a crossing of a function or in charts.
    """
    if not isinstance(crossing.signal, str) or crossing.charts is not None:
        raise DefinitionError(
            "the Crossing of a recording must name a signal, and no charts."
        )
    return crossing.signal


def check_events(
    where: str,
    name: str,
    at: Series,
    time: Float[np.ndarray, " m"],
) -> tuple[Float[np.ndarray, " k"], list[Finding]]:
    """Return the events within the recording, and a finding if others were left out. (One sample
    before its start, or after its end, is allowed.)

    **Raises:** `DefinitionError` if all events lie outside.
    """
    at = at[np.isfinite(at)]
    within = _near(at, time)
    if len(at) and not within.any():
        raise DefinitionError(
            f"{where}: all events '{name}' ({at[0]:.6g} s, ...) are outside of the recording "
            f"({time[0]:.6g} to {time[-1]:.6g} s): check their unit."
        )
    findings = []
    lost = len(at) - int(within.sum())
    if lost:
        text = f"{lost} events '{name}' outside of the recording were left out."
        findings.append(Finding("events outside", text, "left out"))
    return at[within], findings


def _near(at: Series, time: Series) -> Any:
    """Return which events happen during the recording, or within one sample of it."""
    margin = float(np.median(np.diff(time)))
    begun = at >= time[0] - margin
    not_over = at <= time[-1] + margin
    return begun & not_over
