"""Events of a simulated rhythm whose phase response curve is known."""

from collections.abc import Sequence
from typing import Annotated

import numpy as np

from .._core.arguments import Numbers
from .._core.boundary.checked import checked
from .._core.boundary.kinds import NonNegative, Positive, Seed
from .._core.boundary.values import Reals
from ..errors import DefinitionError
from ..recordings.recording import Recording


# Steps in a cycle at most this part of it long. Doubled: crossings are missed by 1.4 times as much.
_STEP = 0.005


@checked
def simulate_beats(
    curve: Annotated[Numbers, Reals("n")],
    force: Annotated[Numbers, Reals("S m")],
    *,
    rate: Positive = 500,
    rhythm: Positive | Sequence[Positive] = 1.0,
    jitter: NonNegative = 0.0,
    seed: Seed = 0,
) -> Recording:
    r"""Events of $d\varphi = (w + Z(\varphi)\,I)\,dt + s \sqrt{w}\,dW$, one where the phase is 1,
    which begins anew at 0.

    **Arguments:**

    - `curve`: Z, at n equal steps of the phase from 0 on, in cycles per second and unit of the
      input; linear in between.
    - `force`: I, for S trials of m samples, `rate` of them in a second; linear between samples.
    - `rhythm`: w, in cycles per second, of all trials or of each.
    - `jitter`: s, the standard deviation of the phase that a cycle adds.

    **Returns:** a `Recording` with S trials, the input `u` and the events `beat`.

    **Raises:** `DefinitionError` for a curve without values, or not as many rhythms as trials.
    """
    force = np.asarray(force, float)
    S, m = force.shape
    if not force.size:
        raise DefinitionError("`force` needs at least one sample of one trial.")
    if not len(np.asarray(curve)):
        raise DefinitionError("`curve` needs at least one value.")
    if np.size(rhythm) not in (1, S):
        raise DefinitionError(f"`rhythm` must be one number, or one for each of {S} trials.")
    w = np.broadcast_to(np.asarray(rhythm, float), S)
    steps = int(np.ceil(w.max() / (rate * _STEP)))
    h = 1 / (rate * steps)
    table = np.asarray(curve, float)
    n = len(table)
    table = np.append(table, table[0])
    rng = np.random.default_rng(seed)

    def at(phase):
        place = (phase % 1.0) * n
        low = np.minimum(place.astype(int), n - 1)
        return table[low] + (place - low) * (table[low + 1] - table[low])

    phase, events = rng.uniform(size=S), [[] for _ in range(S)]
    for i in range((m - 1) * steps):
        k, part = i // steps, (i % steps + 0.5) / steps
        u = (1 - part) * force[:, k] + part * force[:, k + 1]
        z = at(phase + (w + at(phase) * u) * h / 2)  # the middle of the step
        move = (w + z * u) * h + jitter * np.sqrt(w * h) * rng.standard_normal(S)
        after = np.maximum(phase + move, 0.0)
        for trial in np.flatnonzero(after >= 1):
            events[trial].append((i + (1 - phase[trial]) / move[trial]) * h)
        phase = np.where(after >= 1, after - 1, after)
    time = np.arange(m) / rate
    trials = [
        Recording(time, {"u": u}, events={"beat": np.array(at)}, name=f"trial {k}")
        for k, (u, at) in enumerate(zip(force, events, strict=True))
    ]
    return Recording.join(trials)
