"""What goes wrong in laboratories, by name: one table, and `mishandle`, which runs its rows."""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import numpy as np
from scipy import signal

import hybridjax as hj
from hybridjax.recordings.recording import Trial


class Scene(NamedTuple):
    """One trial of a recording with the input `u`, two or more outputs, and an event per cycle."""

    recording: hj.Recording
    trial: Trial
    input: str
    outputs: tuple[str, ...]
    event: str
    rng: np.random.Generator

    @property
    def period(self):
        durations = np.diff(self.trial.events[self.event])
        return float(np.median(durations))

    @property
    def cycles(self):
        """Times since the trial's start, in cycles."""
        elapsed = self.trial.time - self.trial.time[0]
        return elapsed / self.period

    @property
    def from_middle(self):
        """Distances of samples from the middle of the trial, in cycles."""
        middle = self.trial.time.mean()
        distance = np.abs(self.trial.time - middle)
        return distance / self.period

    def normal(self):
        return self.rng.normal(size=len(self.trial.time))

    def values(self, name):
        return self.trial.values[:, self.recording.column(name)]


SECOND = (1,)


def trials(change, only=None):
    """A mishap that replaces trials (default: all) by `change(trial, scene)`."""

    def mishap(recording, *names):
        return [
            change(t, Scene(recording, t, *names)) if only is None or k in only else t
            for k, t in enumerate(recording.trials)
        ]

    return mishap


def signals(which, change, only=None):
    """A mishap that replaces values x of signals by `change(x, scene)`: of the input "u", of the
    outputs "y", or of both "uy"; "y0": of the first output."""

    def changed(trial, s):
        names = {"u": [s.input], "y": s.outputs, "uy": [s.input, *s.outputs]}
        values = np.array(trial.values)
        for name in names.get(which) or [s.outputs[int(which[1:])]]:
            k = s.recording.column(name)
            values[:, k] = change(values[:, k], s)
        return replace(trial, values=values)

    return trials(changed, only)


def kept(trial, rows):
    """Some of the samples, and the events between them."""
    t = trial.time[rows]
    events = {k: at[(at >= t[0]) & (at <= t[-1])] for k, at in trial.events.items()}
    return Trial(t, trial.values[rows], events, trial.name)


def clock(change, only=None):
    """A mishap of the clock: all times t become `change(t, scene)`."""

    def changed(trial, s):
        events = {k: change(at, s) for k, at in trial.events.items()}
        return replace(trial, time=change(trial.time, s), events=events)

    return trials(changed, only)


def clipped(which, low, high):
    return signals(which, lambda x, s: np.clip(x, *np.quantile(x, [low, high])))


def struck(which, share):
    return signals(
        which,
        lambda x, s: (
            x
            + (s.rng.random(len(x)) < share)
            * (20.0 * x.std() * s.rng.choice([-1.0, 1.0], len(x)))
        ),
    )


def placeholder(value, cycles):
    def fail(x, s):
        since = s.trial.time[:, None] - s.rng.uniform(
            s.trial.time[0], s.trial.time[-1], 5
        )
        return np.where(
            ((since > 0) & (since < cycles * s.period)).any(axis=1), value, x
        )

    return signals("y0", fail)


def frozen(which, share):
    def freeze(x, s):
        part = (1 - share) / 2
        first = int(part * len(x))
        rows = np.arange(len(x))
        return np.where(
            (rows >= first) & (rows < first + round(share * len(x))), x[first], x
        )

    return signals(which, freeze, SECOND)


def scaled(which, gain=1.0, offset=0.0):
    return signals(which, lambda x, s: gain * x + offset * x.std(), SECOND)


def overflow(bits):
    def wrap(x, s):
        step = 0.8 * np.ptp(x) / 2**bits
        codes = np.round((x - x.min()) / step)
        return codes % 2**bits * step + x.min()

    return wrap


def renumbered(trial, s):
    n = len(trial.time)
    step = np.median(np.diff(trial.time))
    t = kept(
        trial, ~np.isin(np.arange(n) // 32, s.rng.choice(n // 32, 3, replace=False))
    )
    elapsed = step * np.arange(len(t.time))
    time = trial.time[0] + elapsed
    events = {k: np.interp(at, t.time, time) for k, at in t.events.items()}
    return replace(t, time=time, events=events)


def slow_sensor(x, s):
    step = np.median(np.diff(s.trial.time))
    rate = 1 / step
    sos = signal.butter(2, 8.0 / s.period, fs=rate, output="sos")
    return signal.sosfilt(sos, x - x[0]) + x[0]


def hidden(choose):
    """Outputs are missing around those events that `choose(events, scene)` returns."""

    def hide(trial, s):
        values = trial.values.copy()
        middles = choose(trial.events[s.event], s)
        apart = trial.time[:, None] - middles
        distance = np.abs(apart)
        away = distance.min(axis=1) < 0.075 * s.period
        columns = [s.recording.column(x) for x in s.outputs]
        values[np.ix_(away, columns)] = np.nan
        return replace(trial, values=values)

    return trials(hide)


def swapped(trial, s):
    values = trial.values.copy()
    places = [s.recording.column(x) for x in s.outputs[:2]]
    values[:, places] = values[:, places[::-1]]
    return replace(trial, values=values)


def pause(trial, s):
    events = {
        k: t[np.abs(t - trial.time.mean()) > 2.2 * s.period]
        for k, t in trial.events.items()
    }
    return replace(kept(trial, s.from_middle > 2.2), events=events)


def late(samples, only=None):
    def shift(trial, s):
        k = s.recording.column(s.input)
        values = trial.values.copy()
        values[:, k] = np.roll(values[:, k], samples)
        rows = slice(samples, None) if samples > 0 else slice(None, samples)
        return kept(replace(trial, values=values), rows)

    return trials(shift, only)


def other_clock(x, s):
    start = s.trial.time[0]
    since = s.trial.time - start
    later = start + since * (1 - 0.005)
    return np.interp(later, s.trial.time, x)


def misjudged(lost=0.0, doubled=0.0, off=0.0):
    """Shares of the events vanish, or are followed by a false one; all are `off` by a standard
    deviation in cycles."""

    def misjudge(trial, s):
        at = trial.events[s.event]
        order = s.rng.permutation(len(at))
        n = round(lost * len(at))
        count = round(doubled * len(at))
        again = order[n : n + count]
        missed = np.delete(at, order[:n])
        doubles = at[again] + 0.05 * s.period
        at = np.concatenate([missed, doubles])
        errors = s.rng.normal(size=len(at))
        late = off * s.period * errors
        at = np.sort(at + late)
        return replace(trial, events=trial.events | {s.event: at})

    return trials(misjudge)


def with_copies(recording, *_):
    first, *more = recording.trials
    return [first, *(replace(first, name=f"{first.name} ({k})") for k in (2, 3)), *more]


def with_end(recording, *_):
    half = len(recording.trials[0].time) // 2
    end = kept(recording.trials[0], slice(half, None))
    return [*recording.trials, replace(end, name="end")]


# Sizes are in standard deviations of each signal.
MISHAPS = {
    # sensors, amplifiers, converters
    "white noise": signals("y", lambda x, s: x + 0.01 * x.std() * s.normal()),
    "rounded to 12 bits": signals(
        "uy", lambda x, s: np.ptp(x) / 2**12 * np.round(x / (np.ptp(x) / 2**12))
    ),
    "slow drift": signals(
        "y",
        lambda x, s: x + 0.1 * x.std() * np.sin(2 * np.pi * s.cycles / s.cycles[-1]),
    ),
    "the zero wanders": signals(
        "y", lambda x, s: x + 0.1 * x.std() * (np.cumsum(s.normal()) / np.sqrt(len(x)))
    ),
    "hum of the mains": signals(
        "uy",
        lambda x, s: (
            x + 0.02 * x.std() * np.sin(2 * np.pi * 50.2 * s.trial.time / s.period)
        ),
    ),
    "hum near the rhythm": signals(
        "uy",
        lambda x, s: (
            x + 0.02 * x.std() * np.sin(2 * np.pi * 1.02 * s.trial.time / s.period)
        ),
    ),
    "push leaks into outputs": signals(
        "y",
        lambda x, s: x + (0.01 * x.std() / s.values(s.input).std() * s.values(s.input)),
    ),
    "slow sensors": signals("y", slow_sensor),
    "sensor saturates softly": signals(
        "y0",
        lambda x, s: (
            x.mean() + x.std() / 0.5 * np.tanh((x - x.mean()) / (x.std() / 0.5))
        ),
    ),
    "clipped at the top": clipped("y0", 0.0, 0.95),
    "clipped at both ends": clipped("y0", 0.1, 0.9),
    "push clipped": clipped("u", 0.05, 0.95),
    "integers overflow": signals("y0", overflow(12)),
    "16 bits overflow": signals("y-1", overflow(16)),
    # missing and wrong samples
    "1 % of the samples lost": signals(
        "y", lambda x, s: np.where(s.rng.random(len(x)) < 0.01, np.nan, x)
    ),
    "gap of five cycles": signals(
        "y", lambda x, s: np.where(s.from_middle < 2.65, np.nan, x)
    ),
    "gap of the push": signals(
        "u", lambda x, s: np.where(s.from_middle < 1.15, np.nan, x)
    ),
    "gaps over the crossing": hidden(lambda at, s: s.rng.choice(at, 5, replace=False)),
    "a gap over each seventh crossing": hidden(lambda at, s: at[::7]),
    "packets lost and renumbered": trials(renumbered),
    "0.1 % spikes": struck("y", 0.001),
    "1 % spikes": struck("y", 0.01),
    "0.1 % spikes of the push": struck("u", 0.001),
    "-9999 for no value": placeholder(-9999.0, 0.2),
    "0 for no value": placeholder(0.0, 0.7),
    "output frozen for a while": frozen("y-1", 0.2),
    "output frozen": frozen("y-1", 1.0),
    "push frozen for a while": frozen("u", 0.2),
    # cables, settings, files
    "millimeters in one trial": scaled("y0", 1000.0),
    "kilonewtons in one trial": scaled("u", 0.001),
    "sign of an output in one trial": scaled("y0", -1.0),
    "sign of the push in one trial": scaled("u", -1.0),
    "other gain in one trial": scaled("y0", 1.1),
    "other zero in one trial": scaled("y0", offset=0.5),
    "sensor slips in one trial": signals(
        "y0",
        lambda x, s: x + 0.3 * x.std() * (s.trial.time > s.trial.time.mean()),
        SECOND,
    ),
    "columns swapped in one trial": trials(swapped, SECOND),
    "an output twice": signals("y1", lambda x, s: s.values(s.outputs[0])),
    "push of another trial": signals(
        "u",
        lambda x, s: np.resize(
            s.recording.trials[2].values[:, s.recording.column(s.input)], len(x)
        ),
        SECOND,
    ),
    "push unrelated in all": signals("u", lambda x, s: np.roll(x, len(x) // 2)),
    "push switched on late": signals(
        "u", lambda x, s: np.where(s.cycles < 10.0, 0.0, x)
    ),
    "push lost in two trials": signals("u", lambda x, s: 0 * x, (1, 2)),
    "push not plugged in": signals("u", lambda x, s: 0 * x),
    "the same trial thrice": with_copies,
    "overlapping trials": with_end,
    # clocks
    "a third of the samples not there": trials(
        lambda trial, s: kept(trial, s.rng.random(len(trial.time)) > 1 / 3)
    ),
    "few samples": trials(lambda trial, s: kept(trial, slice(0, None, 8))),
    "jitter of the time stamps": trials(
        lambda trial, s: replace(
            trial,
            time=trial.time
            + (
                0.05
                * np.median(np.diff(trial.time))
                * s.rng.uniform(-1, 1, len(trial.time))
            ),
        )
    ),
    "a pause": trials(pause),
    "clock slows down": clock(
        lambda t, s: t + 0.05 * (t - s.trial.time[0]) ** 2 / (2 * np.ptp(s.trial.time))
    ),
    "clock set forward": clock(
        lambda t, s: t + 0.3 * s.period * (t > s.trial.time.mean()), SECOND
    ),
    "clock set back": clock(
        lambda t, s: t - 0.3 * s.period * (t > s.trial.time.mean()), SECOND
    ),
    "milliseconds in one trial": clock(lambda t, s: 1000.0 * t, SECOND),
    "slow clock in one trial": clock(lambda t, s: 1.1 * t, SECOND),
    "push late": late(10),
    "push early": late(-10),
    "push late in one trial": late(25, SECOND),
    "clock of the push is fast": signals("u", other_clock),
    "push feels an output": signals(
        "u",
        lambda x, s: (
            x
            + 0.3
            * x.std()
            * (s.values(s.outputs[0]) - s.values(s.outputs[0]).mean())
            / s.values(s.outputs[0]).std()
        ),
    ),
}
EVENT_MISHAPS = {
    "events lost and doubled": misjudged(lost=0.05, doubled=0.05),
    "events inexact": misjudged(off=0.0005),
    "events jitter": misjudged(off=0.01),
    "another event in one trial": trials(
        lambda trial, s: replace(
            trial, events={s.event: trial.events[s.event] + 0.4 * s.period}
        ),
        SECOND,
    ),
}


def mishandle(recording, mishap, *, input, outputs, event, seed=0):
    """The recording of three trials or more as a mishap (or its name) would have made it. Times are
    checked as those of a file are."""
    rng = np.random.default_rng(seed)
    mishap = (MISHAPS | EVENT_MISHAPS).get(mishap, mishap)
    changed = mishap(recording, input, outputs, event, rng)
    for t in changed:
        hj.Recording(
            t.time, dict(zip(recording.signals, t.values.T, strict=True)), name=t.name
        )
    return eqx.tree_at(lambda r: r.trials, recording, tuple(changed))
