import numpy as np
import pytest

import hybridjax as hj

from ..linear.conftest import blocks_at_random, hopper as hopper


# Dimensions, outputs and inputs.
SHAPES = [((2, 3, 4, 2), 2, 1), ((3, 2, 2), 1, 2), ((2,), 1, 1)]


def scaled(seed, dims, ny, nu, modulus=0.7):
    """A random system whose largest multiplier has this modulus."""
    A, B, C, D = blocks_at_random(seed, dims, ny, nu)
    model = hj.linear.LDTP.from_blocks(A, B, C, D)
    size = np.abs(model.multipliers[0])
    return hj.linear.LDTP.from_blocks(
        [a * (modulus / size) ** (1 / len(dims)) for a in A], B, C, D
    )


@pytest.fixture(scope="session")
def small():
    """Four sections, two multipliers of modulus 0.7, states that die soon."""
    return scaled(3, (2, 3, 4, 2), 2, 1)


@pytest.fixture(scope="session")
def exact(reference):
    """The hopper's HTFs from the independent computation: 620 frequencies, all harmonics."""
    data = reference("htf_exact_isochron")
    by_harmonic = data["H"].transpose(1, 0, 2)
    H = by_harmonic[..., None]
    return hj.linear.HTF(
        data["f"], H, tuple(range(-16, 16)), 32, "u", ("yM", "vM"), "exact"
    )


@pytest.fixture(scope="session")
def multipliers():
    first = -0.248983334735609 + 0.699333251798004j
    return np.array([first, np.conj(first)])


@pytest.fixture(scope="session")
def paper_data(hopper):
    """The paper's protocol on the linear model: 84 cycles from rest, the last 64 kept."""
    return hj.experiments.simulate_experiments(hopper, hj.experiments.paper_design())


@pytest.fixture(scope="session")
def paper_estimate(paper_data):
    return hj.estimate_htf(paper_data)
