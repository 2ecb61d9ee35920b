import numpy as np
import pytest

import hybridjax as hj


DECAY = 0.15
STRIDES = 200
RATE = 64
MULTIPLIER = np.exp(-2 * DECAY)


@pytest.fixture(scope="session")
def hopper_recording(hopper_cycle):
    """200 strides of the paper's hopper under a random force, without noise."""
    force = hj.testing.random_force(200, 64, 8, rms=0.02, seed=0)
    return hj.testing.simulate_recording(
        hopper_cycle, force[None], ("yM", "vM"), rate=64, steps=1
    )


@pytest.fixture(scope="session")
def angle():
    return hj.KinematicPhase(
        16, position="yM", velocity="vM", center=(1.9, 0.0), scale=(0.3, 1.9)
    )


@pytest.fixture
def wave():
    """Twenty turns of a circle, nearly, with an input that does nothing."""
    t = np.linspace(0.0, 20.0, 2001)
    noise = 1e-6 * np.random.default_rng(0).normal(size=(2, len(t)))
    x, v = np.array([np.cos(2 * np.pi * t), -np.sin(2 * np.pi * t)]) + noise
    return hj.Recording(t, {"f": np.cos(3 * t), "x": x, "v": v})


@pytest.fixture(scope="session")
def rhythm():
    """x + i v near the unit circle, in which deviations decay by exp(-0.3) in a cycle of 1 s.

    z' = (2 pi i + a (1 - |z|^2)) z + f by Runge-Kutta's method, f linear between samples. It turns
    with the clock of a drive: its angle is pulled towards 2 pi t at the same rate.
    """
    force = hj.testing.random_force(STRIDES, RATE, 8, rms=0.02, seed=0)[:, 0]
    steps = 2
    h = 1 / RATE / steps
    fine = np.interp(
        np.arange(2 * steps * len(force)) * h / 2, np.arange(len(force)) / RATE, force
    )

    def field(w, f, turn):  # w = z exp(-2 pi i t)
        pull = -1j * DECAY * 2 * np.angle(w) * w
        return DECAY * (1 - abs(w) ** 2) * w + pull + f * turn

    z = 1.0 + 0j
    out = []
    for k in range(steps * len(force)):
        t = np.exp(-2j * np.pi * h * (k + np.array([0, 0.5, 1])))
        if k % steps == 0:
            out.append(z / t[0])
        f = fine[2 * k : 2 * k + 3]
        f = np.append(f, [f[-1]] * (3 - len(f)))
        a = field(z, f[0], t[0])
        b = field(z + h / 2 * a, f[1], t[1])
        c = field(z + h / 2 * b, f[1], t[1])
        z = z + h / 6 * (a + 2 * b + 2 * c + field(z + h * c, f[2], t[2]))
    z = np.array(out)
    time = np.arange(len(force)) / RATE
    return hj.Recording(time, {"force": force, "x": z.real, "v": z.imag})
