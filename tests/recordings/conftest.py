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
    force = hj.experiments.random_input(200, 64, 8, rms=0.02, seed=0)
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
    rng = np.random.default_rng(0)
    x_noise, v_noise = 1e-6 * rng.normal(size=(2, len(t)))
    cosine = np.cos(2 * np.pi * t)
    x = cosine + x_noise
    sine = np.sin(2 * np.pi * t)
    v = -sine + v_noise
    signals = {"f": np.cos(3 * t), "x": x, "v": v}
    return hj.Recording(t, signals)


@pytest.fixture(scope="session")
def rhythm():
    """x + i v near the unit circle, in which deviations decay by exp(-0.3) in a cycle of 1 s.

    z' = (2 pi i + a (1 - |z|^2)) z + f by Runge-Kutta's method, f linear between samples. It turns
    with the clock of a drive: its angle is pulled towards 2 pi t at the same rate.
    """
    inputs = hj.experiments.random_input(STRIDES, RATE, 8, rms=0.02, seed=0)
    force = inputs[:, 0]
    steps = 2  # from one sample to the next
    h = 1 / RATE / steps
    sampled = np.arange(len(force)) / RATE
    steps_in_half = np.arange(2 * steps * len(force) + 1)
    halves = steps_in_half * h / 2
    fine = np.interp(halves, sampled, force)

    def field(w, f, turn):
        """Of w = z exp(-2 pi i t), with turn = exp(-2 pi i t)."""
        turned = 2 * np.angle(w) * w
        pull = -1j * DECAY * turned
        distance = 1 - abs(w) ** 2
        growth = DECAY * distance * w
        return growth + pull + f * turn

    w = 1.0 + 0j
    samples = []
    for k in range(steps * len(force)):
        of_step = halves[2 * k : 2 * k + 3]
        phases = -2j * np.pi * of_step
        begin, middle, end = np.exp(phases)
        f_begin, f_middle, f_end = fine[2 * k : 2 * k + 3]
        if k % steps == 0:
            samples.append(w / begin)
        a = field(w, f_begin, begin)
        b = field(w + h / 2 * a, f_middle, middle)
        c = field(w + h / 2 * b, f_middle, middle)
        d = field(w + h * c, f_end, end)
        slopes = a + 2 * b + 2 * c + d
        w = w + h / 6 * slopes
    z = np.array(samples)
    signals = {"force": force, "x": z.real, "v": z.imag}
    return hj.Recording(sampled, signals)
