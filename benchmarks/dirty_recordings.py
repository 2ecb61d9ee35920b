"""More of what goes wrong in laboratories than tests/recordings/mishaps.py has, in the same form.

`python benchmarks/recordings.py mishaps` runs both.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import signal


sys.path.append(str(Path(__file__).parents[1] / "tests/recordings"))
from mishaps import SECOND, clock, kept, misjudged, overflow, signals, trials  # noqa: E402


def hum(frequency, size, which="uy"):
    """A tone, its frequency in cycles per period."""
    return signals(
        which,
        lambda x, s: (
            x + size * x.std() * np.sin(2 * np.pi * frequency * s.trial.time / s.period)
        ),
    )


def filtered(which, order, edge, kind="low", zero_phase=True):
    """Signals after a Butterworth filter; its edge in cycles per period."""
    apply = signal.sosfiltfilt if zero_phase else signal.sosfilt

    def change(x, s):
        rate = 1 / np.median(np.diff(s.trial.time))
        sos = signal.butter(order, edge / s.period, kind, fs=rate, output="sos")
        return apply(sos, x - x.mean()) + (kind == "low") * x.mean()

    return signals(which, change)


def steps(which, levels):
    return signals(
        which, lambda x, s: np.round(x / np.ptp(x) * levels) * np.ptp(x) / levels
    )


def held(which, samples):
    return signals(which, lambda x, s: np.repeat(x[::samples], samples)[: len(x)])


def moved(change):
    """Times of events become `change(times, scene)`."""
    return trials(
        lambda trial, s: replace(
            trial, events={s.event: np.sort(change(trial.events[s.event], s))}
        )
    )


def reverse(trial, s):
    ends = trial.time[0] + trial.time[-1]
    events = {k: np.sort(ends - at) for k, at in trial.events.items()}
    return replace(trial, values=trial.values[::-1].copy(), events=events)


def dropped(x, s):
    left = np.delete(x, s.rng.choice(len(x), 3, replace=False))
    return np.concatenate([left, np.repeat(left[-1:], 3)])


def doubled(x, s):
    rows = np.sort(s.rng.choice(len(x), 3, replace=False))
    return np.insert(x, rows, x[rows])[: len(x)]


def bridged(x, s):
    for middle in s.rng.uniform(2, s.cycles[-1] - 2, 10):
        rows = np.abs(s.cycles - middle) < 0.25
        x = np.where(rows, np.interp(s.cycles, s.cycles[~rows], x[~rows]), x)
    return x


def rounded_times(trial, s):
    time = np.round(trial.time, 2)
    rows = np.append(np.diff(time) > 0, True)
    return replace(kept(trial, rows), time=time[rows])


def ramp(s):
    """From -1/2 to 1/2 in the course of a trial."""
    return s.cycles / s.cycles[-1] - 0.5


def strange(x, s):
    return x.std() * s.normal()


MORE = {
    "hum at 0.51 of the rhythm": hum(0.51, 0.02),
    "hum at 0.98": hum(0.98, 0.02),
    "hum at 1.005": hum(1.005, 0.02),
    "hum at 1.1": hum(1.1, 0.02),
    "hum at 2.03": hum(2.03, 0.02),
    "strong hum at 1.02": hum(1.02, 0.1),
    "hum of the outputs": hum(1.02, 0.02, "y"),
    "hum of the push": hum(1.02, 0.1, "u"),
    "hum at the rhythm": hum(1.0, 0.1),
    "mains with harmonics": signals(
        "uy",
        lambda x, s: (
            x
            + 0.02
            * x.std()
            * sum(
                np.sin(2 * np.pi * k * 13.3 * s.trial.time / s.period) / k
                for k in (1, 2, 3)
            )
        ),
    ),
    "16 bits of a position overflow": signals("y0", overflow(16)),
    "16 bits of the push overflow": signals("u", overflow(16)),
    "rounded to 8 bits": steps("uy", 256),
    "an output rounded to 5 bits": steps("y0", 32),
    "velocity saturates": signals(
        "y-1", lambda x, s: x.std() * np.tanh(0.5 * x / x.std()) / 0.5
    ),
    "an output late": signals("y0", lambda x, s: np.roll(x, 4)),
    "an output late by a third of a cycle": signals("y0", lambda x, s: np.roll(x, 42)),
    "outputs smoothed": filtered("y", 2, 6.0),
    "push smoothed": filtered("u", 2, 4.0),
    "push through a filter": filtered("u", 2, 4.0, zero_phase=False),
    "outputs without their means": filtered("y", 1, 0.1, "high", zero_phase=False),
    "push without its mean": filtered("u", 1, 0.5, "high", zero_phase=False),
    "one trial backward": trials(reverse, SECOND),
    "all trials backward": trials(reverse),
    "gain of the push drifts": signals("u", lambda x, s: x * (1 + 0.3 * ramp(s))),
    "gain of an output drifts": signals("y0", lambda x, s: x * (1 + 0.02 * ramp(s))),
    "push turns its sign": signals("u", lambda x, s: x * np.sign(ramp(s))),
    "push doubled in one trial": signals("u", lambda x, s: 2 * x, SECOND),
    "push rectified": signals("u", lambda x, s: np.abs(x)),
    "dead zone of the push": signals(
        "u", lambda x, s: np.where(np.abs(x) < x.std() / 2, 0, x)
    ),
    "push constant": signals("u", lambda x, s: 0 * x + 1.0),
    "push constant in one trial": signals("u", lambda x, s: 0 * x + x.std(), SECOND),
    "push as large as its noise": signals("u", lambda x, s: x + strange(x, s)),
    "samples of an output dropped": signals("y-1", dropped),
    "samples of the push dropped": signals("u", dropped),
    "samples of an output doubled": signals("y0", doubled),
    "an output held": held("y0", 4),
    "push held": held("u", 8),
    "gaps bridged by lines": signals("y", bridged),
    "rate said 10 % wrong": clock(lambda t, s: 1.1 * t),
    "times rounded to 10 ms": trials(rounded_times),
    "late packets": clock(
        lambda t, s: (
            t + 0.1 * s.period * np.floor((t - s.trial.time[0]) / s.period / 20)
        )
    ),
    "push read with inertia": signals(
        "u", lambda x, s: x + 0.02 * np.gradient(s.values(s.outputs[-1]), s.trial.time)
    ),
    "an output is noise": signals("y0", strange),
    "noise grows": signals(
        "y", lambda x, s: x + 0.02 * (ramp(s) + 0.5) * strange(x, s)
    ),
    "noise as large as the signal": signals(
        "y", lambda x, s: x * (1 + 0.02 * s.normal())
    ),
    "subject stops": signals(
        "y", lambda x, s: np.where(ramp(s) > 0.3, x[int(0.8 * len(x))], x)
    ),
    "every other cycle higher": signals(
        "y0", lambda x, s: x + 0.02 * x.std() * (np.floor(s.cycles) % 2)
    ),
}
MORE_EVENTS = {
    "a tenth of the events lost": misjudged(lost=0.1),
    "a tenth of the events doubled": misjudged(doubled=0.1),
    "all events late": moved(lambda at, s: at + 0.02 * s.period),
    "events drift": moved(
        lambda at, s: at + 0.05 * s.period * np.linspace(0, 1, len(at))
    ),
    "events rounded to 10 ms": moved(lambda at, s: np.round(at, 2)),
    "events defined anew halfway": moved(
        lambda at, s: at + 0.02 * s.period * (np.arange(len(at)) > len(at) // 2)
    ),
}
