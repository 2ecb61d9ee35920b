"""The dirt of real recordings, to test with: noise, quantization, drift, lost samples, gaps."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np

from ..recordings.recording import Recording


class _Slower(NamedTuple):
    start: float
    span: float
    stretch: float

    def __call__(self, time: np.ndarray) -> np.ndarray:
        since = time - self.start
        return time + self.stretch * since**2 / (2 * self.span)


def spoil(
    recording: Recording,
    signals: Sequence[str],
    *,
    noise: float = 0.0,
    quantum: float = 0.0,
    drift: float = 0.0,
    missing: float = 0.0,
    gap: tuple[float, float] | None = None,
    irregular: bool = False,
    lost: int = 0,
    doubled: int = 0,
    stretch: float = 0.0,
    seed: int = 0,
) -> Recording:
    """A recording as a poor laboratory would have made it.

    **Arguments:**

    - `signals`: those that are measured; inputs stay as they are.
    - `noise`: standard deviation of white noise. `quantum`: what values are rounded to.
    - `drift`: amplitude of a slow sine, one turn over each trial.
    - `missing`: share of samples that are lost, NaN. `gap`: start and end of a stretch of NaN.
    - `irregular`: a random third of the samples is not there at all.
    - `lost`, `doubled`: how many events of each kind vanish, or are followed by a false one.
    - `stretch`: the share by which the period grows from the beginning to the end of each trial,
      as if everything went slower and slower.
    - `seed`: of all of these.
    """
    rng = np.random.default_rng(seed)
    columns = [recording.column(x) for x in signals]
    trials = []
    for trial in recording.trials:
        n = len(trial.time)
        kept = np.sort(rng.permutation(n)[: 2 * n // 3]) if irregular else np.arange(n)
        time, values = trial.time[kept], trial.values[kept].copy()
        y = values[:, columns] + noise * rng.normal(size=(len(time), len(columns)))
        span = np.ptp(time)
        y += drift * np.sin(2 * np.pi * (time - time[0]) / span)[:, None]
        y = np.round(y / quantum) * quantum if quantum else y
        y[rng.random(len(time)) < missing] = np.nan
        if gap is not None:
            y[(time >= gap[0]) & (time < gap[1])] = np.nan
        values[:, columns] = y
        events = {}
        for name, at in trial.events.items():
            chosen = rng.permutation(len(at))[: lost + doubled]
            false = at[chosen[lost:]] + 0.05 * np.median(np.diff(at))
            events[name] = np.sort(np.concatenate([np.delete(at, chosen[:lost]), false]))
        slower = _Slower(trial.time[0], np.ptp(trial.time), stretch)
        parts = (slower(time), values, {name: slower(at) for name, at in events.items()})
        trials.append(eqx.tree_at(lambda t: (t.time, t.values, t.events), trial, parts))
    return eqx.tree_at(lambda r: r.trials, recording, tuple(trials))
