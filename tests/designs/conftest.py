import dataclasses

import numpy as np
import pytest

import hybridjax as hj


TWO_NOISE = {"y0": 0.01, "y1": 0.02}


@pytest.fixture(scope="session")
def model():
    """Two states, slow and with little damping, with inputs and outputs in rotating directions."""
    turn = 2 * np.pi * np.arange(8) / 8
    A = 0.97 * np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    B = np.stack([np.cos(turn), np.sin(turn)], axis=1)[:, :, None]
    C = np.stack(
        [np.ones((8, 2)), np.stack([np.sin(turn), np.cos(turn)], axis=1)], axis=1
    )
    return hj.LDTP(np.broadcast_to(A, (8, 2, 2)), B, C, inputs="u", outputs=("x", "v"))


@pytest.fixture(scope="session")
def two():
    """Six sections, two inputs and two outputs."""
    return hj.testing.synthetic_ldtp()


@pytest.fixture(scope="session")
def two_usual(two):
    return hj.multisine(6, 32, band=(0, 3), inputs=two.inputs)


@pytest.fixture(scope="session")
def optimal_two(two, two_usual):
    """Plans for the two inputs, by default for multipliers of both."""
    goal = hj.designs.Multipliers(harmonics=(-1, 0, 1))
    default = {"goal": goal, "noise": TWO_NOISE, "limit": {"u0": 0.1, "u1": 0.05}}
    return lambda **options: hj.optimal_design(two, two_usual, **(default | options))


def expected_htf(model, design, noise, harmonics=None):
    """Return the exact HTFs at the lines of a design, with the variance of their estimates."""
    htf = model.htf(design.frequencies, harmonics)
    variance = (
        design.expected_variance()[:, None, :]
        * np.square(list(noise.values()))[:, None]
    )
    return dataclasses.replace(htf, variance=np.broadcast_to(variance, htf.H.shape))


def total_variance(bound):
    """Return the sum of the variances of real and imaginary parts, pairs once."""
    pairs = zip(bound.multipliers, bound.multiplier_covariances, strict=True)
    return sum(np.trace(c) for z, c in pairs if z.imag >= 0)


def random_designs(number, rms, *arguments, **options):
    """Yield multisines with random amplitudes."""
    rng = np.random.default_rng(0)
    for _ in range(number):

        def amplitude(f):
            return rng.exponential(size=f.shape)

        yield hj.multisine(*arguments, amplitude=amplitude, **options).scaled(rms)
