import dataclasses

import numpy as np
import pytest

import hybridjax as hj


TWO_NOISE = {"y0": 0.01, "y1": 0.02}


@pytest.fixture(scope="session")
def model():
    """Two states, slow and with little damping, with inputs and outputs in rotating directions."""
    c = np.cos(0.3)
    s = np.sin(0.3)
    rotation = np.array([[c, -s], [s, c]])
    A = np.broadcast_to(0.97 * rotation, (8, 2, 2))
    angle = 2 * np.pi * np.arange(8) / 8
    along = np.cos(angle)
    across = np.sin(angle)
    push = np.stack([along, across], axis=1)
    x = np.ones((8, 2))
    sine = np.sin(angle)
    v = np.stack([sine, np.cos(angle)], axis=1)
    C = np.stack([x, v], axis=1)
    B = push[:, :, None]
    return hj.linear.LDTP(A, B, C, inputs="u", outputs=("x", "v"))


@pytest.fixture(scope="session")
def two():
    """Six sections, two inputs and two outputs."""
    return hj.testing.synthetic_ldtp()


@pytest.fixture(scope="session")
def two_usual(two):
    return hj.multisine(6, 32, frequencies=(0, 3), inputs=two.inputs)


@pytest.fixture(scope="session")
def optimal_two(two, two_usual):
    """Plans for the two inputs, by default for multipliers of both."""
    goal = hj.designs.MultiplierGoal(harmonics=(-1, 0, 1))
    default = {"goal": goal, "noise": TWO_NOISE, "limit": {"u0": 0.1, "u1": 0.05}}
    return lambda **options: hj.optimal_design(two, two_usual, **(default | options))


def expected_htf(model, design, noise, harmonics=None):
    """Return the exact HTFs at the lines of a design, with the variance of their estimates."""
    htf = model.htf(design.frequencies, harmonics)
    of_unit_noise = design.expected_variance()[:, None, :]
    squares = np.square(list(noise.values()))
    of_outputs = squares[:, None]
    variance = np.broadcast_to(of_unit_noise * of_outputs, htf.H.shape)
    return dataclasses.replace(htf, variance=variance)


def total_variance(bound):
    """Return the sum of the variances of real and imaginary parts, pairs once."""
    total = 0.0
    for z, covariance in zip(
        bound.multipliers, bound.multiplier_covariances, strict=True
    ):
        if z.imag >= 0:
            total += np.trace(covariance)
    return total


def random_designs(number, rms, *arguments, **options):
    """Yield multisines with random amplitudes."""
    rng = np.random.default_rng(0)
    for _ in range(number):

        def amplitude(f):
            return rng.exponential(size=f.shape)

        yield hj.multisine(*arguments, amplitude=amplitude, **options).scaled(rms)
