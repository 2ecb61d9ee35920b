"""The dirt of real recordings, to test with: noise, quantization, drift, lost samples, gaps."""

import dataclasses
from collections.abc import Mapping, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Fraction, Index, NonNegative, Seed, SignalNames
from ..errors import DefinitionError
from ..recordings.recording import Recording, Trial


@checked
@dataclasses.dataclass(frozen=True, kw_only=True)
class Dirt:
    """What a poor laboratory does to a recording; by default nothing.

    **Fields:**

    - `noise`: standard deviation of white noise. `quantum`: what values are rounded to.
    - `drift`: amplitude of a slow sine, one turn over each trial. These three in the signals' unit.
    - `missing`: share of samples that are lost, NaN. `gap`: times of start and end of a stretch of
      NaN.
    - `irregular`: whether a random third of the samples is not there at all.
    - `lost_events`, `doubled_events`: how many events of each name vanish, or are followed by a
      false one.
    - `stretch`: the share by which the period grows from the beginning to the end of each trial,
      as if everything went slower and slower.
    - `seed`: of all of these.
    """

    noise: NonNegative = 0.0
    quantum: NonNegative = 0.0
    drift: float = 0.0
    missing: Fraction = 0.0
    gap: tuple[float, float] | None = None
    irregular: bool = False
    lost_events: Index = 0
    doubled_events: Index = 0
    stretch: float = 0.0
    seed: Seed = 0

    def __post_init__(self):
        if self.gap is not None and self.gap[0] >= self.gap[1]:
            raise DefinitionError(f"`gap` must end after it starts, but is {self.gap}.")


# How late a false event is, in median intervals. Doubled: it is still taken for a doubled one.
_FALSE_EVENT = 0.05


@checked
def spoil(recording: Recording, signals: SignalNames, dirt: Dirt) -> Recording:
    """A recording as a poor laboratory would have made it.

    **Arguments:** `signals`: those that are measured; inputs stay as they are. `dirt`: how poor.

    **Raises:** `DefinitionError` for a signal that is not there.
    """
    rng = np.random.default_rng(dirt.seed)
    columns = [recording.column(x) for x in signals]
    trials = tuple(_spoiled(trial, columns, dirt, rng) for trial in recording.trials)
    return eqx.tree_at(lambda r: r.trials, recording, trials)


def _spoiled(trial: Trial, columns: Sequence[int], dirt: Dirt, rng: np.random.Generator) -> Trial:
    n = len(trial.time)
    kept = np.sort(rng.permutation(n)[: 2 * n // 3]) if dirt.irregular else np.arange(n)
    time, values = trial.time[kept], trial.values[kept].copy()
    values[:, columns] = _measured(time, values[:, columns], dirt, rng)
    events = _misjudged(trial.events, dirt, rng)

    def slower(at):
        since = at - trial.time[0]
        return at + dirt.stretch * since**2 / (2 * np.ptp(trial.time))

    events = {name: slower(at) for name, at in events.items()}
    return Trial(slower(time), values, events, trial.name)


def _measured(
    time: Float[np.ndarray, " n"],
    y: Float[np.ndarray, "n ny"],
    dirt: Dirt,
    rng: np.random.Generator,
) -> Float[np.ndarray, "n ny"]:
    y = y + dirt.noise * rng.normal(size=y.shape)
    y += dirt.drift * np.sin(2 * np.pi * (time - time[0]) / np.ptp(time))[:, None]
    y = np.round(y / dirt.quantum) * dirt.quantum if dirt.quantum else y
    y[rng.random(len(time)) < dirt.missing] = np.nan
    if dirt.gap is not None:
        y[(time >= dirt.gap[0]) & (time < dirt.gap[1])] = np.nan
    return y


def _misjudged(
    events: Mapping[str, Float[np.ndarray, " _"]], dirt: Dirt, rng: np.random.Generator
) -> dict[str, Float[np.ndarray, " _"]]:
    out = {}
    for name, at in events.items():
        chosen = rng.permutation(len(at))[: dirt.lost_events + dirt.doubled_events]
        lost, doubled = chosen[: dirt.lost_events], chosen[dirt.lost_events :]
        false = at[doubled] + _FALSE_EVENT * np.median(np.diff(at))
        out[name] = np.sort(np.concatenate([np.delete(at, lost), false]))
    return out
