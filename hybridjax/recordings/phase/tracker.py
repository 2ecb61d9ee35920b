"""Phase in real time: from the past only."""

import math
from typing import Annotated

import numpy as np
from jaxtyping import Float

from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Positive
from ..._core.boundary.values import Number
from ...errors import DefinitionError


# Bandwidth of the loop in cycles per cycle. Doubled: changes of the rate are followed twice as
# fast, with more of the noise.
_LOOP_HARMONICS = 5

Sample = Annotated[float, Number("a finite number or NaN", missing=True)]


@checked
class PhaseTracker:
    """Follows a phase sample by sample, for hardware that acts at phases.

    A phase-locked loop of second order: phase and rate are predicted, and corrected by the
    difference to the angle that is measured, critically damped. It follows a constant rate without
    lag, and never runs backwards. In a gap it goes on at its rate.
    """

    def __init__(
        self,
        center: tuple[float, float],
        scale: tuple[Positive, Positive],
        rate: float,
        *,
        anchor: float = 0.0,
        bandwidth: Positive | None = None,
    ):
        """**Arguments:** `center`, `scale` and `anchor` (rad) as in `KinematicPhase`; `rate`:
        cycles per second to begin with, negative if the angle decreases; `bandwidth` of the loop in
        Hz, by default five times the rate.

        **Raises:** `DefinitionError` for a rate of zero.
        """
        if rate == 0:
            raise DefinitionError("`rate` must not be 0: a tracker needs to know the direction.")
        self.center, self.scale, self.anchor = center, scale, anchor
        self.sense = math.copysign(1.0, rate)
        self.rate = abs(rate)
        self.gain = 2 * math.pi * (_LOOP_HARMONICS * abs(rate) if bandwidth is None else bandwidth)
        self.time: float | None = None
        self.phase: float | None = None
        self._loop = 0.0

    def update(self, time: float, position: Sample, velocity: Sample) -> float | None:
        """The phase in cycles after one more sample, counted from the first one; NaN are skipped.

        **Returns:** None before the first good sample.

        **Raises:** `DefinitionError` if time does not grow.
        """
        x = (position - self.center[0]) / self.scale[0]
        y = (velocity - self.center[1]) / self.scale[1]
        if math.isnan(x + y):
            return self.phase
        measured = self.sense * (math.atan2(y, x) - self.anchor) / (2 * math.pi)
        if self.time is None or self.phase is None:
            self.time, self.phase, self._loop = time, measured % 1.0, measured % 1.0
            return self.phase
        step = time - self.time
        if not step > 0:
            raise DefinitionError(f"time must grow from sample to sample; {time} came late.")
        ahead = self._loop + self.rate * step
        error = (measured - ahead + 0.5) % 1.0 - 0.5
        k = self.gain * step
        damp = math.exp(-k)  # critically damped, for any step
        self._loop = ahead + (1 - damp * damp) * error
        self.rate += (1 - damp) ** 2 * error / step
        self.time, self.phase = time, max(self.phase, self._loop)
        return self.phase


def track(
    time: Float[np.ndarray, " n"],
    angle: Float[np.ndarray, " n"],
    rate: float,
) -> Float[np.ndarray, " n"]:
    """The phase that a tracker would have found at each sample of an angle."""
    tracker = PhaseTracker((0.0, 0.0), (1.0, 1.0), rate)
    samples = zip(time.tolist(), np.cos(angle).tolist(), np.sin(angle).tolist(), strict=True)
    return np.array([tracker.update(*sample) for sample in samples], float)
