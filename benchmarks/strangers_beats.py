"""Rhythms of strangers of which events alone are seen, in plain NumPy without the package.

Each returns the times of events under a known input, and the phase response curve.
"""

from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter


class Beats(NamedTuple):
    """Trials of a rhythm under an input."""

    time: np.ndarray
    """(m,), in s."""
    force: np.ndarray
    """(S, m)"""
    events: list[np.ndarray]
    """Times of the events of each trial."""


PHASE = np.arange(100) / 100
# Steps of neurons, in ms.
_STEP = 0.05

# Highest frequencies of inputs, as parts of that of the rhythm.
INPUTS = {"slow": 0.2, "near": 1.0, "fast": 4.0}

# Curves in cycles per second and unit of the input: one that is positive, one with both signs, and
# one that jumps at the event.
CURVES = {
    "one sign": 1 - 0.8 * np.cos(2 * np.pi * PHASE),
    "two signs": 0.3 - np.sin(2 * np.pi * PHASE),
    "jumps": 0.4 + 1.2 * PHASE**2,
}


def smooth_noise(
    rng: np.random.Generator, shape: tuple[int, int], highest: float
) -> np.ndarray:
    """Return noise of variance 1 with a smooth end of its spectrum.

    **Arguments:** `highest`: its highest frequency, in cycles per sample.
    """
    spectrum = np.fft.rfft(rng.normal(size=shape), axis=1)
    frequency = np.fft.rfftfreq(shape[1])
    spectrum *= 1 / (1 + (frequency / highest) ** 16)
    noise = np.fft.irfft(spectrum, shape[1], axis=1)
    return noise / noise.std()


def phase_rhythm(
    seed: int,
    curve: np.ndarray,
    highest: float,
    events: int,
    *,
    jitter: float = 0.05,
    strength: float = 0.3,
    wander: float = 0.0,
    forgotten: float = np.inf,
) -> Beats:
    """Return a rhythm of ten cycles per second, dphi = (w + Z(phi) I) dt + s sqrt(w) dW.

    **Arguments:**

    - `curve`: Z at equal steps of the phase.
    - `highest`: highest frequency of the input, as part of w.
    - `events`: number of events of all trials, of which there are four or eight.
    - `strength`: standard deviation of the largest value of Z times the input, as part of w.
    - `wander`: standard deviation of the change of w from a cycle to the next, as part of w.
      `forgotten`: number of cycles after which it is forgotten (a random walk if infinite).
    """
    rng = np.random.default_rng(seed)
    trials = 4 if events < 1000 else 8
    w = 10.0
    rate = 500
    m = int(events / trials / w * rate) + 1
    force = smooth_noise(rng, (trials, m), highest * w / rate)
    force *= strength * w / np.abs(curve).max()
    kicks = rng.normal(size=(trials, m)) * wander * w * np.sqrt(w / rate)
    left = np.exp(-w / rate / forgotten)
    own = np.maximum(w + lfilter([1.0], [1.0, -left], kicks, axis=1), 0.2 * w)
    closes = abs(curve[-1] - curve[0]) < 0.2 * np.ptp(curve)
    nodes = np.append(PHASE, 1.0)
    table = np.append(curve, curve[0] if closes else curve[-1])
    fine = 2
    h = 1 / (rate * fine)
    phase = rng.uniform(size=trials)
    found: list[list[float]] = [[] for _ in range(trials)]
    for i in range((m - 1) * fine):
        k = i // fine
        part = (i % fine + 0.5) / fine
        u = (1 - part) * force[:, k] + part * force[:, k + 1]
        z = np.interp(phase, nodes, table)
        z = np.interp((phase + (own[:, k] + z * u) * h / 2) % 1.0, nodes, table)
        drift = (own[:, k] + z * u) * h
        move = drift + jitter * np.sqrt(w * h) * rng.normal(size=trials)
        after = np.maximum(phase + move, 0.0)
        for trial in np.flatnonzero(after >= 1):
            found[trial].append((i + (1 - phase[trial]) / move[trial]) * h)
        phase = np.where(after >= 1, after - 1, after)
    return Beats(np.arange(m) / rate, force, [np.array(x) for x in found])


class Neuron(NamedTuple):
    """Izhikevich's neuron (2003): v' = 0.04 v^2 + 5 v + 140 - w + I, w' = a (b v - w); at v = 30, v
    becomes c and w grows by d."""

    a: float
    b: float
    c: float
    d: float
    current: float

    def step(
        self, v: np.ndarray, w: np.ndarray, current: np.ndarray, h: float | np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the states after h milliseconds, by the midpoint rule."""
        half_v = v + h / 2 * (0.04 * v**2 + 5 * v + 140 - w + current)
        half_w = w + h / 2 * self.a * (self.b * v - w)
        after_v = v + h * (0.04 * half_v**2 + 5 * half_v + 140 - half_w + current)
        return after_v, w + h * self.a * (self.b * half_v - half_w)

    def spikes(
        self,
        v: np.ndarray,
        w: np.ndarray,
        current: np.ndarray,
        h: float,
        noise: np.ndarray | None = None,
    ) -> list[np.ndarray]:
        """Return times of spikes in ms.

        **Arguments:** `v`, `w` (S,): states at the start. `current` (S, n): in each step. `noise`:
        what is added to v after each step.
        """
        found: list[list[float]] = [[] for _ in v]
        for i in range(current.shape[1]):
            now = current[:, i]
            next_v, next_w = self.step(v, w, now, h)
            fires = next_v >= 30
            # After a spike, the rest of the step begins at the reset.
            part = np.where(fires, (30 - v) / np.where(fires, next_v - v, 1.0), 0.0)
            reset_w = w + part * (next_w - w) + self.d
            rest_v, rest_w = self.step(self.c + 0 * v, reset_w, now, h * (1 - part))
            v = np.where(fires, rest_v, next_v)
            w = np.where(fires, rest_w, next_w)
            if noise is not None:
                v = v + noise[:, i]
            for trial in np.flatnonzero(fires):
                found[trial].append((i + part[trial]) * h)
        return [np.array(x) for x in found]

    def after(self, w: float, h: float = _STEP / 10) -> tuple[float, float]:
        """Return w after the next spike, and the time until it, from w after a spike."""
        v, w_now = np.array([self.c]), np.array([w])
        current = np.array([self.current])
        steps = 0
        while True:
            next_v, next_w = self.step(v, w_now, current, h)
            if next_v[0] >= 30:
                part = float((30 - v[0]) / (next_v[0] - v[0]))
                at_spike = w_now[0] + part * (next_w[0] - w_now[0])
                return float(at_spike) + self.d, (steps + part) * h
            v, w_now = next_v, next_w
            steps += 1

    def settled(self, h: float = _STEP / 10) -> tuple[float, float, float]:
        """Return w after a spike, the period in ms, and the multiplier of w."""
        w = self.d
        for _ in range(60):
            w, period = self.after(w, h)
        far = 0.05
        multiplier = (self.after(w + far, h)[0] - self.after(w - far, h)[0]) / (2 * far)
        return w, period, multiplier

    def curve(self, cycles: int = 12) -> np.ndarray:
        """Return by how much a brief current advances the spike after so many, at `PHASE`, in
        cycles per second and unit of the current.

        One cycle: the effect on its own interval. Many: the shift that stays.
        """
        h = _STEP / 10
        w, period, _ = self.settled()
        n = int((cycles + 1) * period / h)
        phase = np.append(PHASE[::5], PHASE[-1])
        at = np.rint(phase * period / h).astype(int)
        kick = 0.02
        push = np.zeros((2 * len(phase), n))
        push[np.arange(len(push)), np.tile(at, 2)] = np.repeat(
            [kick, -kick], len(phase)
        )
        lanes = np.ones(len(push))
        current = np.full(push.shape, self.current)
        times = self.spikes(self.c * lanes, w * lanes, current, h, push)
        last = np.array([x[cycles - 1] for x in times])
        earlier = last[len(phase) :] - last[: len(phase)]
        return CubicSpline(phase, earlier / (2 * period) / (kick * 1e-3))(PHASE)


# Fast spiking (memory: the second multiplier is 0.085), one that adapts more, and one of a single
# state, which has no memory.
NEURONS = {
    "fast spiking": Neuron(0.1, 0.2, -65.0, 2.0, 10.0),
    "adapting": Neuron(0.02, 0.2, -65.0, 2.0, 20.0),
    "no memory": Neuron(0.0, 0.2, -65.0, 0.0, 22.0),
}


def neuron_beats(
    seed: int,
    neuron: Neuron,
    curve: np.ndarray,
    highest: float,
    events: int,
    *,
    strength: float = 0.1,
    noise: float = 0.5,
) -> Beats:
    """Return spikes of a neuron under a current.

    **Arguments:**

    - `curve`: its phase response.
    - `highest`: highest frequency of the current, as part of that of the neuron.
    - `events`: number of spikes of all trials, of which there are four or eight.
    - `strength`: standard deviation of the change of the rate under a slow current, as part of it.
    - `noise`: of v, in mV per square root of a ms.
    """
    rng = np.random.default_rng(seed)
    trials = 4 if events < 1000 else 8
    w, period, _ = neuron.settled(_STEP)
    n = int(events / trials * period / _STEP)
    force = smooth_noise(rng, (trials, n + 1), highest * _STEP / period)
    force *= strength * 1e3 / period / np.abs(curve.mean())
    kicks = noise * np.sqrt(_STEP) * rng.normal(size=(trials, n))
    current = neuron.current + (force[:, 1:] + force[:, :-1]) / 2
    lanes = np.ones(trials)
    times = neuron.spikes(neuron.c * lanes, w * lanes, current, _STEP, kicks)
    kept = slice(None, None, 4)
    return Beats(
        np.arange(n + 1)[kept] * _STEP * 1e-3, force[:, kept], [x * 1e-3 for x in times]
    )
