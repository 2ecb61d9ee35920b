"""Rhythms that respond to small pushes almost linearly, and their true multipliers.

This file stands apart from the package: it uses NumPy and SciPy alone. Each rhythm has a position
and a speed, and a force as the input. Its section is where the speed falls through zero.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import integrate, signal


Slope = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""A function (position, speed, force) that returns the acceleration."""


class Weakly(NamedTuple):
    """A rhythm: position'' = acceleration(position, speed, force)."""

    acceleration: Slope
    start: float
    """A position at which the speed falls through zero, near the cycle."""
    push: float
    """The rms of the force."""


def van_der_pol(mu: float) -> Slope:
    return lambda x, v, u: mu * (1 - x**2) * v - x + u


def rayleigh(mu: float) -> Slope:
    return lambda x, v, u: mu * (1 - v**2 / 3) * v - x + u


def stiffening(mu: float, k: float) -> Slope:
    """An oscillator of van der Pol whose rhythm is faster at larger amplitudes."""
    return lambda x, v, u: mu * (1 - x**2) * v - x - k * x**3 + u


def clock(damping: float, drive: float) -> Slope:
    """A pendulum that is driven near its lowest point, when it swings forth."""

    def acceleration(x, v, u):
        driven = drive * np.exp(-((x / 0.1) ** 2)) * (v > 0)
        return -np.sin(x) - damping * v + driven + u

    return acceleration


def hopper(damping: float, thrust: float) -> Slope:
    """A body on a leg with a cubic spring, which is stiffer while it extends."""

    def acceleration(y, v, u):
        pressed = np.maximum(1 - y, 0)
        stiffness = 20 + 200 * pressed**2 - damping * v + thrust * np.tanh(v / 0.1)
        return -1 + pressed * stiffness + u

    return acceleration


RHYTHMS = {
    "van der Pol, mu = 0.05": Weakly(van_der_pol(0.05), 2.0, 0.005),
    "van der Pol, mu = 0.1": Weakly(van_der_pol(0.1), 2.0, 0.005),
    "Rayleigh, mu = 0.07": Weakly(rayleigh(0.07), 2.0, 0.005),
    "stiffening, mu = 0.05": Weakly(stiffening(0.05, 0.1), 2.0, 0.005),
    "pendulum clock": Weakly(clock(0.05, 0.3), 0.5, 0.0015),
    "hopper, cubic spring": Weakly(hopper(3.0, 4.0), 1.5, 0.003),
}


def cycle_of(rhythm: Weakly) -> tuple[float, float, float]:
    """Return where the speed falls through zero, the period, and the multiplier, by differences."""

    def slope(t, z):
        return [z[1], float(rhythm.acceleration(z[0], z[1], 0.0))]

    def falls(t, z):
        return z[1]

    falls.direction = -1
    falls.terminal = True
    exact = {"rtol": 1e-10, "atol": 1e-12, "max_step": 0.05}

    def returned(x: float) -> tuple[float, float]:
        away = integrate.solve_ivp(slope, (0, 0.05), [x, 0.0], **exact)
        path = integrate.solve_ivp(
            slope, (0.05, 100), away.y[:, -1], events=falls, **exact
        )
        return path.y_events[0][0][0], path.t_events[0][0]

    x = rhythm.start
    for _ in range(400):
        after, period = returned(x)
        moved = abs(after - x)
        x = after
        if moved < 1e-9:
            break
    step = 1e-3 * abs(x)
    multiplier = (returned(x + step)[0] - returned(x - step)[0]) / (2 * step)
    return x, period, multiplier


class Pushed(NamedTuple):
    """Recordings of a rhythm: time (n,); force, position and speed (draws, n)."""

    time: np.ndarray
    force: np.ndarray
    position: np.ndarray
    speed: np.ndarray
    multiplier: float


def pushed(
    rhythm: Weakly, seeds: range, cycles: int = 114, noise: float = 0.0, size: float = 1
) -> Pushed:
    """Record a rhythm that is pushed by noise of up to 4 cycles per period.

    **Arguments:** `noise`: standard deviation of the measurement noise, relative to the rms of the
    speed. `size`: factor of the force.
    """
    x, period, multiplier = cycle_of(rhythm)
    samples = 126 * cycles
    step = period / 126
    low_pass = signal.butter(4, 4 / period, fs=1 / step, output="sos")
    pad = 126
    forces = []
    for seed in seeds:
        white = np.random.default_rng(seed).normal(size=samples + 2 * pad)
        force = signal.sosfiltfilt(low_pass, white)[pad : pad + samples]
        forces.append(rhythm.push * size * force / force.std())
    u = np.array(forces)
    z = np.array([np.full(len(u), x), np.zeros(len(u))])
    path = np.empty((samples, *z.shape))

    def slope(z, force):
        return np.array([z[1], rhythm.acceleration(z[0], z[1], force)])

    parts = 4
    h = step / parts
    for k in range(samples):
        path[k] = z
        change = (u[:, k + 1] - u[:, k]) / parts if k + 1 < samples else 0 * u[:, k]
        for j in range(parts):
            first = u[:, k] + j * change
            k1 = slope(z, first)
            k2 = slope(z + h / 2 * k1, first + change / 2)
            k3 = slope(z + h / 2 * k2, first + change / 2)
            k4 = slope(z + h * k3, first + change)
            z = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    rng = np.random.default_rng(seeds[0])
    path = path + noise * path[:, 1].std() * rng.normal(size=path.shape)
    return Pushed(np.arange(samples) * step, u, path[:, 0].T, path[:, 1].T, multiplier)
