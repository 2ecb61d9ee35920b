"""What a laboratory recorded: sampled signals, events, units, in one or several trials."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.optimize.elementwise import find_root

from .._core import limits
from .._core.arguments import require_among, require_equal
from .._core.boundary.checked import checked
from .._core.signal import with_unit
from .._core.text import folded
from ..errors import DefinitionError
from ..orbits.crossing import Crossing
from .formats.columns import Columns, numbers, parse_table, require_aligned
from .smoothing import Bandwidth, Series, bridgeable, spline, without_spikes


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


@checked
class Recording(eqx.Module):
    """Sampled signals of one or several trials. Nothing is resampled.

    **Fields:**

    - `trials`: one or several `Trial`s with the same signals.
    - `signals`: names of the signals. `units`: a unit for each, "" where none was given.
    - `notes`: assumptions made while files were read.
    """

    trials: tuple[Trial, ...]
    signals: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    notes: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        time: Any,
        signals: Mapping[str, Any],
        *,
        events: Mapping[str, Any] | None = None,
        units: Mapping[str, str] | None = None,
        name: str = "trial",
        notes: Sequence[str] = (),
    ):
        """Make a recording of one trial; `join` combines several.

        **Arguments:**

        - `time` (n,): times of the samples, in seconds; strictly increasing.
        - `signals`: inputs and outputs by name, (n,) each; NaN where a sample is missing. Series
          of pandas must have the same index, and their samples the same order.
        - `events`: times of events by name, such as foot strikes.
        - `units`: units by name. `name`: name of the trial. `notes`: remarks on the data.

        **Raises:** `DefinitionError` for arrays that do not fit together, time that repeats or runs
        backwards, and infinite values, with the sample.
        """
        where, units = f"trial '{name}'", dict(units or {})
        require_aligned(where, [time, *signals.values()])
        time = numbers(where, "time", time)
        if not signals:
            raise DefinitionError(f"{where} has no signals.")
        columns = {key: numbers(where, key, values) for key, values in signals.items()}
        happened = {
            key: numbers(where, key, values) for key, values in (events or {}).items()
        }
        for key, values in columns.items():
            require_equal(f"{where}: {key} and time", "lengths", len(values), len(time))
        for key, values in (happened | columns).items():
            if np.isinf(values).any():
                text = f"{key} is infinite at sample {int(np.argmax(np.isinf(values)))}"
                raise DefinitionError(
                    f"{where}: {text}; put NaN where a sample is bad."
                )
        if len(time) < 2:
            raise DefinitionError(
                f"{where} has {len(time)} samples, but two or more are needed."
            )
        if not (later := np.diff(np.where(np.isinf(time), np.nan, time)) > 0).all():
            bad = 1 + int(np.argmin(later))
            a, b = time[bad - 1 : bad + 1]
            advice = (
                "sort, or make a trial of each part"
                if b < a
                else "leave out such samples"
            )
            text = f"time does not increase at sample {bad} ({a:.10g}, then {b:.10g})"
            raise DefinitionError(f"{where}: {text}: {advice}.")
        require_among("signal", units, columns, f"{where}, `units`: ")
        if both := set(happened) & set(columns):
            raise DefinitionError(
                f"{where}: '{min(both)}' is a signal and an event: rename one."
            )
        happened = {
            key: np.sort(values[~np.isnan(values)]) for key, values in happened.items()
        }
        for key, values in happened.items():
            check_events(where, key, values, time)
        self.trials = (
            Trial(time, np.stack(list(columns.values()), axis=1), happened, name),
        )
        self.signals = tuple(columns)
        self.units = tuple(units.get(key, "") for key in columns)
        self.notes = tuple(notes)

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
        keys = getattr(frame, "column_names", None) or getattr(frame, "keys", list)()
        columns = Columns({str(key): frame[key] for key in keys})
        table = parse_table(f"trial '{name}'", columns, time)
        events, units = (
            table.events | dict(events or {}),
            table.units | dict(units or {}),
        )
        return cls(table.time, table.signals, events=events, units=units, name=name)

    @staticmethod
    def join(recordings: Iterable["Recording"]) -> "Recording":
        """Combine the trials of several recordings.

        **Raises:** `DefinitionError` if there is none, or signals or units differ.
        """
        recordings = list(recordings)
        if not recordings:
            raise DefinitionError("`recordings` must be one recording or more.")
        first = recordings[0]
        units = dict(zip(first.signals, first.units, strict=True))
        trials: list[Trial] = []
        for other in recordings:
            pair = f"trials '{first.trials[0].name}' and '{other.trials[0].name}'"
            require_equal(pair, "signals", sorted(units), sorted(other.signals))
            column = {key: k for k, key in enumerate(other.signals)}
            for key, unit in units.items():
                require_equal(pair, f"units of {key}", unit, other.units[column[key]])
            order = [column[key] for key in units]
            for t in other.trials:  # (signals in the same order are not copied)
                same = order == sorted(order)
                trials.append(t if same else replace(t, values=t.values[:, order]))
        notes = dict.fromkeys(note for other in recordings for note in other.notes)
        signals = dict(zip(units, trials[0].values.T, strict=True))
        return Recording(
            trials[0].time, signals, units=units, notes=[*notes]
        ).with_trials(trials)

    @staticmethod
    def beside(recordings: Iterable["Recording"]) -> "Recording":
        """Combine signals that were recorded side by side, each with times of its own.

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
        names = [name for x in recordings for name in x.signals]
        units = dict(
            zip(names, (unit for x in recordings for unit in x.units), strict=True)
        )
        notes = [note for x in recordings for note in x.notes]
        if len(units) < len(names):
            twice = next(x for x in names if names.count(x) > 1)
            raise DefinitionError(
                f"two recordings have a signal '{twice}': rename one."
            )
        out = []
        for trials in zip(*(x.trials for x in recordings), strict=True):
            name = trials[0].name
            time = np.unique(np.concatenate([t.time for t in trials]))
            if len(time) * len(names) > limits.RECORDED:
                text = (
                    f"{len(names)} signals at {len(time)} times are too many together"
                )
                raise DefinitionError(f"trial '{name}': {text}: choose `signals`.")
            if any(len(t.time) < len(time) for t in trials):
                notes.append(
                    "signals have different rates or clocks: they are missing in between"
                )
            values: list[np.ndarray] = []
            events: dict[str, np.ndarray] = {}
            for t in trials:
                values.append(np.full((len(time), t.values.shape[1]), np.nan))
                values[-1][np.searchsorted(time, t.time)] = t.values
                events |= t.events
            signals = dict(zip(names, np.concatenate(values, axis=1).T, strict=True))
            out.append(
                Recording(
                    time, signals, events=events, units=units, name=name, notes=notes
                )
            )
        return Recording.join(out)

    def mark(
        self, event: str, crossing: Crossing, *, bandwidth: Bandwidth = np.inf
    ) -> "Recording":
        """Add an event at each time at which a signal crosses a level.

        A jump in the stated direction is an event; a jump in the other direction, as of an angle
        that wraps, is not. A signal that crosses the level several times within a cycle, in noise,
        makes doubled events, which `estimate_phase` leaves out. Crossings in gaps that are longer
        than three samples, and than half a wavelength at the bandwidth, are unknown, and make no
        events. Isolated spikes are ignored (see `section_data`).

        **Arguments:** `event`: its name. `crossing`: crossing of a signal, given by name.
        `bandwidth`: bandwidth in Hz of the smoothing spline whose crossings are taken. Default:
        infinite (the spline interpolates).

        **Raises:** `DefinitionError` for an unknown signal, one that never crosses the level, and a
        crossing of a function or in charts, which recordings do not have.
        """
        signal, level, trials = signal_of(crossing), float(crossing.value), []
        sign = 1.0 if crossing.direction == "rising" else -1.0
        for trial, x in self.samples(signal):
            curve = spline(trial.time, without_spikes(x), bandwidth)
            t, y = curve.x, sign * (curve(curve.x) - level)
            longest = bridgeable(t, 0.5 / bandwidth)
            at = np.flatnonzero((y[:-1] < 0) & (y[1:] >= 0) & (np.diff(t) <= longest))
            if not len(at):
                text = f"{signal} is never seen to cross {level:g}, {crossing.direction}: choose a "
                text += f"`value` between {np.nanmin(x):.4g} and {np.nanmax(x):.4g}."
                raise DefinitionError(f"trial '{trial.name}': {text}")
            crossed = find_root(
                lambda t, curve=curve: curve(t) - level, (t[at], t[at + 1])
            ).x
            trials.append(replace(trial, events=trial.events | {event: crossed}))
        return self.with_trials(trials)

    def with_trials(self, trials: Iterable[Trial]) -> "Recording":
        """Replace the trials."""
        return eqx.tree_at(lambda r: r.trials, self, tuple(trials))

    def column(self, name: str) -> int:
        """Return the column of a signal in `Trial.values`.

        **Raises:** `DefinitionError` if there is none of that name.
        """
        require_among("signal", [name], self.signals)
        return self.signals.index(name)

    def samples(self, name: str) -> list[tuple[Trial, Series]]:
        """Return each trial with the samples of a signal."""
        return [(trial, trial.values[:, self.column(name)]) for trial in self.trials]

    def unit(self, name: str) -> str:
        """Return the unit of a signal, "" where none was given."""
        return self.units[self.column(name)]

    def __repr__(self) -> str:
        names = ", ".join(map(with_unit, self.signals, self.units))
        lines = [folded(f"Recording({len(self.trials)} trials: {names})")]
        for t in self.trials:
            step = np.diff(t.time)
            middle = float(np.median(step))
            missing = int(np.isnan(t.values).any(axis=1).sum())
            lines.append(
                folded(
                    f"  {t.name}: {len(t.time)} samples in {t.time[-1] - t.time[0]:.4g} s, every "
                    f"{middle:.4g} s ({1 / middle:.4g} Hz, longest {step.max():.4g} s)"
                    + (f"; {missing} with gaps" if missing else "")
                    + "".join(f"; {len(at)} {name}" for name, at in t.events.items()),
                    "  ",
                )
            )
        return "\n".join([*lines, *(f"  ({note})" for note in self.notes)])


def signal_of(crossing: Crossing) -> str:
    """Return the name of the signal that crosses a level.

    **Raises:** `DefinitionError` for a crossing of a function or in charts.
    """
    if not isinstance(crossing.function, str) or crossing.charts is not None:
        raise DefinitionError(
            "the Crossing of a recording must name a signal, and no charts."
        )
    return crossing.function


def check_events(
    where: str, name: str, at: Series, time: Float[np.ndarray, " m"]
) -> Float[np.ndarray, " k"]:
    """Return the events within the recording, or one sample outside of it.

    **Raises:** `DefinitionError` if all events lie outside.
    """
    at, margin = at[np.isfinite(at)], float(np.median(np.diff(time)))
    within = (at >= time[0] - margin) & (at <= time[-1] + margin)
    if len(at) and not within.any():
        text = f"are outside of the recording ({time[0]:.6g} to {time[-1]:.6g} s): check their unit"
        raise DefinitionError(
            f"{where}: all events '{name}' ({at[0]:.6g} s, ...) {text}."
        )
    return at[within]
