"""What goes wrong in laboratories, by name: one table, and `mishandle`, which runs its rows."""

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
        return float(np.median(np.diff(self.trial.events[self.event])))

    @property
    def cycles(self):
        """Times since the trial's start, in cycles."""
        return (self.trial.time - self.trial.time[0]) / self.period

    @property
    def from_middle(self):
        """Distances of samples from the middle of the trial, in cycles."""
        return np.abs(self.trial.time - self.trial.time.mean()) / self.period

    def normal(self):
        return self.rng.normal(size=len(self.trial.time))

    def values(self, name):
        return self.trial.values[:, self.recording.column(name)]


SECOND = (1,)


def trials(change, only=None):
    """A mishap that replaces trials (default: all) by `change(trial, scene)`."""

    def mishap(recording, input, outputs, event, rng):
        return [
            change(t, Scene(recording, t, input, outputs, event, rng))
            if only is None or k in only else t
            for k, t in enumerate(recording.trials)
        ]  # fmt: skip

    return mishap


def signals(which, change, only=None):
    """A mishap that replaces values x of signals by `change(x, scene)`: of the input "u", of the
    outputs "y", or of both "uy"; "y0": of the first output."""

    def changed(trial, scene):
        names = {"u": [scene.input], "y": scene.outputs, "uy": [scene.input, *scene.outputs]}
        values = np.array(trial.values)
        for name in names.get(which) or [scene.outputs[int(which[1:])]]:
            k = scene.recording.column(name)
            values[:, k] = change(values[:, k], scene)
        return Trial(trial.time, values, trial.events, trial.name)

    return trials(changed, only)


def whole(change):
    """A mishap of the list of trials."""
    return lambda recording, *_: change(list(recording.trials))


def kept(trial, rows, name=None):
    """Some of the samples, and the events between them."""
    t = trial.time[rows]
    events = {k: at[(at >= t[0]) & (at <= t[-1])] for k, at in trial.events.items()}
    return Trial(t, trial.values[rows], events, name or trial.name)


def clock(change, only=None):
    """A mishap of the clock: all times t become `change(t, scene)`."""
    return trials(lambda trial, s: Trial(
        change(trial.time, s), trial.values,
        {k: change(at, s) for k, at in trial.events.items()}, trial.name), only)  # fmt: skip


def clipped(which, low, high):
    return signals(which, lambda x, s: np.clip(x, *np.quantile(x, [low, high])))


def struck(which, share):
    def hit(x, s):
        where = s.rng.random(len(x)) < share
        return x + where * 20.0 * x.std() * s.rng.choice([-1.0, 1.0], len(x))

    return signals(which, hit)


def placeholder(value, cycles):
    def fail(x, s):
        since = s.trial.time[:, None] - s.rng.uniform(s.trial.time[0], s.trial.time[-1], 5)
        return np.where(((since > 0) & (since < cycles * s.period)).any(axis=1), value, x)

    return signals("y0", fail)


def frozen(which, share):
    def freeze(x, s):
        first = int((1 - share) / 2 * len(x))
        last = first + round(share * len(x))
        return np.concatenate([x[:first], np.full(last - first, x[first]), x[last:]])

    return signals(which, freeze, SECOND)


def scaled(which, gain=1.0, offset=0.0):
    return signals(which, lambda x, s: gain * x + offset * x.std(), SECOND)


def overflow(x, s):
    step = 0.8 * np.ptp(x) / 2**12
    return np.round((x - x.min()) / step) % 2**12 * step + x.min()


def slow_sensor(x, s):
    rate = 1 / np.median(np.diff(s.trial.time))
    sos = signal.butter(2, 8.0 / s.period, fs=rate, output="sos")
    return signal.sosfilt(sos, x - x[0]) + x[0]


def hidden_events(trial, s):
    values = trial.values.copy()
    middles = s.rng.choice(trial.events[s.event], 5, replace=False)
    away = np.abs(trial.time[:, None] - middles).min(axis=1) < 0.075 * s.period
    values[np.ix_(away, [s.recording.column(x) for x in s.outputs])] = np.nan
    return Trial(trial.time, values, trial.events, trial.name)


def swapped(trial, s):
    values, places = trial.values.copy(), [s.recording.column(x) for x in s.outputs[:2]]
    values[:, places] = values[:, places[::-1]]
    return Trial(trial.time, values, trial.events, trial.name)


def pause(trial, s):
    def away(t):
        return np.abs(t - trial.time.mean()) > 2.2 * s.period

    events = {k: t[away(t)] for k, t in trial.events.items()}
    return Trial(trial.time[away(trial.time)], trial.values[away(trial.time)], events, trial.name)


def late(samples, only=None):
    def shift(trial, s):
        n, k = len(trial.time) - abs(samples), s.recording.column(s.input)
        first, start = max(samples, 0), max(-samples, 0)
        moved = kept(trial, slice(first, first + n))
        values = moved.values.copy()
        values[:, k] = trial.values[start : start + n, k]
        return Trial(moved.time, values, moved.events, trial.name)

    return trials(shift, only)


def other_clock(x, s):
    start = s.trial.time[0]
    return np.interp(start + (s.trial.time - start) * (1 - 0.005), s.trial.time, x)


def misjudged(lost=0.0, doubled=0.0, off=0.0):
    """Shares of the events vanish, or are followed by a false one; all are `off` by a standard
    deviation in cycles."""

    def misjudge(trial, s):
        at = trial.events[s.event]
        order, n = s.rng.permutation(len(at)), round(lost * len(at))
        again = order[n : n + round(doubled * len(at))]
        at = np.concatenate([np.delete(at, order[:n]), at[again] + 0.05 * s.period])
        at = np.sort(at + off * s.period * s.rng.normal(size=len(at)))
        return Trial(trial.time, trial.values, trial.events | {s.event: at}, trial.name)

    return trials(misjudge)


def thrice(x):
    return [x[0], *(kept(x[0], slice(None), f"{x[0].name} ({k})") for k in (2, 3)), *x[1:]]


# Sizes are in standard deviations of each signal.
MISHAPS = {
    # sensors, amplifiers, converters
    "white noise": signals("y", lambda x, s: x + 0.01 * x.std() * s.normal()),
    "rounded to 12 bits": signals(
        "uy", lambda x, s: np.round(x / (np.ptp(x) / 2**12)) * (np.ptp(x) / 2**12)
    ),
    "slow drift": signals(
        "y", lambda x, s: x + 0.1 * x.std() * np.sin(2 * np.pi * s.cycles / s.cycles[-1])
    ),
    "the zero wanders": signals(
        "y", lambda x, s: x + 0.1 * x.std() * np.cumsum(s.normal()) / np.sqrt(len(x))
    ),
    "hum of the mains": signals("uy", lambda x, s: x + 0.02 * x.std() * np.sin(
        2 * np.pi * 50.2 * s.trial.time / s.period)),
    "push leaks into outputs": signals("y", lambda x, s: x + (
        0.01 * x.std() / s.values(s.input).std() * s.values(s.input))),
    "slow sensors": signals("y", slow_sensor),
    "sensor saturates softly": signals("y0", lambda x, s: x.mean() + x.std() / 0.5 * np.tanh(
        (x - x.mean()) / (x.std() / 0.5))),
    "clipped at the top": clipped("y0", 0.0, 0.95),
    "clipped at both ends": clipped("y0", 0.1, 0.9),
    "push clipped": clipped("u", 0.05, 0.95),
    "integers overflow": signals("y0", overflow),
    # missing and wrong samples
    "1 % of the samples lost": signals(
        "y", lambda x, s: np.where(s.rng.random(len(x)) < 0.01, np.nan, x)
    ),
    "gap of five cycles": signals("y", lambda x, s: np.where(s.from_middle < 2.65, np.nan, x)),
    "gap of the push": signals("u", lambda x, s: np.where(s.from_middle < 1.15, np.nan, x)),
    "gaps over the crossing": trials(hidden_events),
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
        "y0", lambda x, s: x + 0.3 * x.std() * (s.trial.time > s.trial.time.mean()), SECOND
    ),
    "columns swapped in one trial": trials(swapped, SECOND),
    "an output twice": signals("y1", lambda x, s: s.values(s.outputs[0])),
    "push of another trial": signals("u", lambda x, s: np.resize(
        s.recording.trials[2].values[:, s.recording.column(s.input)], len(x)), SECOND),
    "push unrelated in all": signals("u", lambda x, s: np.roll(x, len(x) // 2)),
    "push switched on late": signals("u", lambda x, s: np.where(s.cycles < 10.0, 0.0, x)),
    "push not plugged in": signals("u", lambda x, s: 0 * x),
    "the same trial thrice": whole(thrice),
    "overlapping trials": whole(lambda x: [
        *x, kept(x[0], slice(len(x[0].time) // 2, None), f"{x[0].name}, end")]),
    # clocks
    "a third of the samples not there": trials(
        lambda trial, s: kept(trial, s.rng.random(len(trial.time)) > 1 / 3)
    ),
    "few samples": trials(lambda trial, s: kept(trial, slice(0, None, 8))),
    "jitter of the time stamps": trials(lambda trial, s: Trial(
        trial.time + 0.05 * np.median(np.diff(trial.time)) * s.rng.uniform(-1, 1, len(trial.time)),
        trial.values, trial.events, trial.name)),
    "a pause": trials(pause),
    "clock slows down": clock(lambda t, s: t + 0.05 * (t - s.trial.time[0]) ** 2 / (
        2 * np.ptp(s.trial.time))),
    "clock set forward": clock(
        lambda t, s: t + 0.3 * s.period * (t > s.trial.time.mean()), SECOND
    ),
    "clock set back": clock(lambda t, s: t - 0.3 * s.period * (t > s.trial.time.mean()), SECOND),
    "milliseconds in one trial": clock(lambda t, s: 1000.0 * t, SECOND),
    "slow clock in one trial": clock(lambda t, s: 1.1 * t, SECOND),
    "push late": late(10),
    "push early": late(-10),
    "push late in one trial": late(25, SECOND),
    "clock of the push is fast": signals("u", other_clock),
}  # fmt: skip
EVENT_MISHAPS = {
    "events lost and doubled": misjudged(lost=0.05, doubled=0.05),
    "events inexact": misjudged(off=0.0005),
    "another event in one trial": trials(lambda trial, s: Trial(
        trial.time, trial.values,
        trial.events | {s.event: trial.events[s.event] + 0.4 * s.period}, trial.name), SECOND),
}  # fmt: skip


def mishandle(recording, mishap, *, input, outputs, event, seed=0):
    """The recording of three trials or more as a mishap (or its name) would have made it. Times are
    checked as those of a file are."""
    rng = np.random.default_rng(seed)
    mishap = (MISHAPS | EVENT_MISHAPS).get(mishap, mishap)
    changed = mishap(recording, input, outputs, event, rng)
    for t in changed:
        hj.Recording(t.time, dict(zip(recording.signals, t.values.T, strict=True)), name=t.name)
    return eqx.tree_at(lambda r: r.trials, recording, tuple(changed))
