"""Recordings whose truth is known, to try a method before an animal is measured.

`simulate_recording` applies a sampled force to a system, `simulate_beats` an input to a phase
model, and `add_artifacts` corrupts a recording. The tests of the estimates from recordings rely on
their accuracy. If a simulated signal is wrong, look at the steps of the force in
`simulate_recording`, and otherwise at `experiments/response.py`; if events are late, at `_STEP`.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any

import jax.numpy as jnp
import numpy as np

from .._core.arguments import Numbers
from .._core.boundary.checked import checked
from .._core.boundary.kinds import (
    Count,
    Fraction,
    NonNegative,
    Positive,
    Seed,
    SignalNames,
)
from .._core.boundary.values import Reals
from .._core.compilation import quick_jit
from .._core.limits import SECTIONS
from .._core.signal import unit_of
from ..errors import DefinitionError
from ..experiments.response import response_function
from ..orbits.checks import check_outputs
from ..orbits.cycle import LimitCycle
from ..recordings.read import RecordingLike, as_recording
from ..recordings.recording import Recording
from ..sections.families import ClockPhase
from ..systems.system import OutputNames


# Longest step of `simulate_beats`, in cycles. Longer: events are late by more than the noise of
# measured ones (the error grows as the root of the step). Shorter: simulations take longer.
_STEP = 0.005


@checked
def simulate_recording(
    cycle: LimitCycle,
    force: Annotated[Numbers, Reals("trials samples inputs")],
    outputs: OutputNames,
    *,
    rate: Positive = 500,
    steps: Count = 4,
) -> Recording:
    """Simulate the recording of a system that is perturbed by a sampled force.

    The force is linear between samples. It is applied in steps of equal length, each with the
    value at its middle; the error is of second order in their length.

    **Arguments:**

    - `cycle`: the limit cycle on which all trials start.
    - `force` (S, n, nu): samples of S trials, in units of the inputs.
    - `outputs`: names or `Output`s to be recorded in addition to the inputs.
    - `rate`: samples per unit of time, changed slightly so that a whole number of them fits into
      a period. Default: 500.
    - `steps`: number of steps of the force from sample to sample. Default: 4.

    **Returns:** `hj.Recording` with S trials of inputs and outputs, in their units. A trial that
    fails ends there.

    **Raises:** `DefinitionError` in the cases of `response_function`.

    **Example:**

    ```python
    force = hj.experiments.random_input(60, 50, bandwidth=8, rms=0.02, seed=1)
    recording = hj.testing.simulate_recording(cycle, force[None], ("yM", "vM"), rate=50, steps=1)
    ```

    **Before:** `hj.find_limit_cycle`, `hj.experiments.random_input`. **After:**
    `hj.identify_recording`.
    """
    recorded = check_outputs(cycle, outputs)
    force = np.asarray(force, float)
    inputs = cycle.structure.inputs
    if force.shape[1] < 2 or force.shape[2] != len(inputs):
        raise DefinitionError(
            f"`force` has shape {force.shape}, but needs two samples or more of {len(inputs)} "
            f"inputs ({', '.join(inputs)}): its axes are trials, samples, inputs."
        )
    period = float(cycle.period)
    if not 1 <= rate * period * steps <= SECTIONS:
        raise DefinitionError(
            f"`rate` and `steps` give {rate * period * steps:.3g} steps in a period, but they may "
            f"be 1 to {SECTIONS}."
        )
    K = round(rate * period)
    S, n, nu = force.shape
    # (A power of two: recordings of other lengths share a compiled program.)
    cycles = 1 << (-(-(n - 1) // K) - 1).bit_length()
    rest = np.zeros((S, cycles * K + 1 - n, nu))
    x = np.concatenate([force, rest], axis=1)
    middle = (np.arange(steps) + 0.5) / steps
    change = np.diff(x, axis=1)[:, :, None]
    forced = change * middle[:, None]
    u = x[:, :-1, None] + forced
    response = response_function(cycle, ClockPhase(K * steps), outputs)
    held = jnp.asarray(u.reshape(S, -1, nu))
    y = np.asarray(_respond(response, held))[:, ::steps]
    names = inputs + recorded.names
    units = dict(zip(names, map(unit_of, names), strict=True))
    time = np.arange(y.shape[1]) * period / K
    trials = []
    for k in range(S):
        finite = int(np.isfinite(y[k]).all(axis=1).sum())
        good = slice(0, min(n, finite))
        forces = force[k, good].T
        columns = [*forces, *y[k, good].T]
        signals = dict(zip(names, columns, strict=True))
        trials.append(Recording(time[good], signals, units=units, name=f"trial {k}"))
    return Recording.join(trials)


_respond = quick_jit(lambda response, u: response(u).y)


@checked
def add_artifacts(
    recording: RecordingLike,
    signals: SignalNames,
    *,
    noise: NonNegative = 0.0,
    quantum: NonNegative = 0.0,
    missing: Fraction = 0.0,
    gap: tuple[float, float] | None = None,
    spikes: Fraction = 0.0,
    seed: Seed = 0,
) -> Recording:
    """Corrupt some signals of a recording, as poor measurements would.

    **Arguments:**

    - `recording`: the recording, which stays as it is, or the path of its file, or a table
      (`hj.Recording.from_frame`).
    - `signals`: names of the corrupted signals; all others stay as they are.
    - `noise`: standard deviation of white noise. `quantum`: step to which values are rounded. Both
      in the unit of the signals. Default: 0.
    - `missing`: fraction of samples that are lost (NaN). Default: 0.
    - `gap`: times of the start and the end of an interval without samples, in seconds. Default:
      None.
    - `spikes`: fraction of samples that are off by 20 standard deviations of their signal. Default:
      0.
    - `seed`: seed of the random numbers. Default: 0.

    **Returns:** `hj.Recording` with the same trials, times, signals and events.

    **Raises:** `DefinitionError` for a signal that does not exist, and a gap that ends before it
    starts.

    **Example:**

    ```python
    poor = hj.testing.add_artifacts(recording, ("yM", "vM"), noise=1e-4, missing=0.01, seed=1)
    ```

    **Before:** `hj.testing.simulate_recording`. **After:** `hj.recordings.check_recording`.
    """
    if gap is not None and gap[0] >= gap[1]:
        raise DefinitionError(f"`gap` must end after it starts, but is {gap}.")
    recording = as_recording(recording)
    rng = np.random.default_rng(seed)
    columns = [recording.column(x) for x in signals]
    trials = []
    for trial in recording.trials:
        values = np.array(trial.values)
        time = trial.time
        error = rng.normal(size=(len(time), len(columns)))
        y = values[:, columns] + noise * error
        y = np.round(y / quantum) * quantum if quantum else y
        if spikes:
            struck = rng.random(y.shape) < spikes
            sign = rng.choice([-1, 1], y.shape)
            y += 20.0 * np.nanstd(y, axis=0) * sign * struck
        y[rng.random(len(time)) < missing] = np.nan
        if gap is not None:
            y[(time >= gap[0]) & (time < gap[1])] = np.nan
        values[:, columns] = y
        trials.append(replace(trial, values=values))
    return recording.with_trials(trials)


@checked
def simulate_beats(
    curve: Annotated[Numbers, Reals("n")],
    force: Annotated[Numbers, Reals("trials samples")],
    *,
    rate: Positive = 500,
    rhythm: Positive | Sequence[Positive] = 1.0,
    jitter: NonNegative = 0.0,
    seed: Seed = 0,
) -> Recording:
    r"""Simulate events of $d\varphi = (w + Z(\varphi)\,I)\,dt + s \sqrt{w}\,dW$.

    An event happens where the phase reaches 1; the phase then restarts at 0.

    **Arguments:**

    - `curve` (n,): Z at n equal steps of the phase from 0 on, in cycles per second and unit of the
      input; linear in between.
    - `force` (S, m): I, for S trials of m samples; linear between samples.
    - `rate`: samples per second. Default: 500.
    - `rhythm`: w, in cycles per second, for all trials or for each. Default: 1.
    - `jitter`: s, standard deviation that a cycle adds to the phase, in cycles. Default: 0.
    - `seed`: seed of the random numbers. Default: 0.

    **Returns:** `hj.Recording` with S trials, the input `u` and the events `beat`, times in
    seconds.

    **Raises:** `DefinitionError` for a curve or a force without values, not as many rhythms as
    trials, or a rhythm above the `rate` of the force.

    **Example:**

    ```python
    z = 0.2 * np.sin(2 * np.pi * np.arange(50) / 50)
    force = 0.5 * np.ones((2, 1000))
    beats = hj.testing.simulate_beats(z, force, rate=100, jitter=0.02)
    ```

    **Before:** none; the curve is known. **After:** `hj.recordings.phase_response`.
    """
    force = np.asarray(force, float)
    table = np.asarray(curve, float)
    S, m = force.shape
    n = len(table)
    if not n or not S:
        raise DefinitionError("`curve` and `force` need at least one value.")
    if np.size(rhythm) not in (1, S) or np.max(rhythm) > rate:
        raise DefinitionError(f"`rhythm` must be one number or {S}, none above `rate`.")
    w = np.broadcast_to(np.asarray(rhythm, float), S)
    steps = int(np.ceil(w.max() / (rate * _STEP)))
    h = 1 / (rate * steps)
    nodes = np.arange(n + 1) / n
    table = np.append(table, table[0])
    rng = np.random.default_rng(seed)

    def at(phase):
        return np.interp(phase % 1.0, nodes, table)

    phase: Any = rng.uniform(size=S)
    events: list[list[float]] = [[] for _ in range(S)]
    for i in range((m - 1) * steps):
        k = i // steps
        part = (i % steps + 0.5) / steps
        begin = force[:, k]
        end = force[:, k + 1]
        u = (1 - part) * begin + part * end
        half_way = phase + (w + at(phase) * u) * h / 2
        z = at(half_way)  # the middle of the step
        drawn = jitter * np.sqrt(w * h) * rng.standard_normal(S)
        move: Any = (w + z * u) * h + drawn
        after = np.maximum(phase + move, 0.0)
        for trial in np.flatnonzero(after >= 1):
            share = (1 - phase[trial]) / move[trial]
            events[trial].append((i + share) * h)
        phase = np.where(after >= 1, after - 1, after)
    time = np.arange(m) / rate
    trials = [
        Recording(time, {"u": u}, events={"beat": np.array(at)}, name=f"trial {k}")
        for k, (u, at) in enumerate(zip(force, events, strict=True))
    ]
    return Recording.join(trials)
