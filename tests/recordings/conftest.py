import numpy as np
import pytest

import hybridjax as hj


@pytest.fixture(scope="session")
def hopper_recording(hopper_cycle):
    """200 strides of the paper's hopper under a random force, without noise."""
    force = hj.random_force(200, 64, 8, rms=0.02, seed=0)
    return hj.simulate_recording(hopper_cycle, force[None], ("yM", "vM"), rate=64, steps=1)


@pytest.fixture(scope="session")
def angle():
    return hj.AnglePhase("yM", "vM", center=(1.9, 0.0), scale=(0.3, 1.9))


@pytest.fixture
def wave():
    """Twenty turns of a circle with an input that does nothing."""
    t = np.linspace(0.0, 20.0, 2001)
    signals = {"f": np.cos(3 * t), "x": np.cos(2 * np.pi * t), "v": -np.sin(2 * np.pi * t)}
    return hj.Recording(t, signals)
