"""Noise of any color: process noise and measurement noise have the moments that they say."""

import numpy as np
import pytest

import hybridjax as hj


N = 8
CYCLES = 30
COUNT = 400
STD = np.linspace(0.5, 2.0, N)
ProcessNoise = hj.experiments.ProcessNoise


def require_mean(each, expected):
    """The mean over independent experiments, (S, ...), is what is expected but for four standard
    errors."""
    error = each.std(axis=0) / np.sqrt(len(each))
    mean = each.mean(axis=0)
    apart = np.abs(mean - expected)
    assert (apart < 4 * error).all()


def require_color(x, std, memory):
    """Of series (S, n, k): the variance at every section (from the first cycle on), and the
    correlation from each section to later ones, against the closed form."""
    std = np.broadcast_to(std, (N, x.shape[2]))
    cycles = x.reshape(len(x), -1, *std.shape)
    require_mean((cycles**2).mean(axis=1), std**2)
    square = x[:, 0] ** 2
    require_mean(square, std[0] ** 2)

    std_of_each = np.resize(std, x.shape[1:])
    normal = x / std_of_each
    for lag in (1, 3, N, 4 * N):
        later = normal[:, lag:]
        earlier = normal[:, :-lag]
        products = later * earlier
        expected = 0.0
        if memory:
            expected = np.exp(-lag / (N * memory))
        require_mean(products.mean(axis=1), expected)
    # Different signals have no correlation.
    first = normal[:, :, 0]
    second = normal[:, :, 1]
    products = first * second
    require_mean(products.mean(axis=1), 0.0)


@pytest.mark.parametrize("memory", [0.0, 0.2, 3.0])
@pytest.mark.parametrize("std", [0.7, STD])
def test_process_noise_has_the_color_that_it_says(std, memory):
    noise = ProcessNoise(std, seed=1, memory=memory)
    x = noise.draw((COUNT, N * CYCLES, 2), N)
    std_of_sections = np.broadcast_to(std, N)[:, None]
    require_color(x, std_of_sections, memory)


@pytest.fixture(scope="module")
def data():
    u = np.ones((COUNT, N * CYCLES, 1))
    y = np.zeros((COUNT, N * CYCLES, 2))
    return hj.experiments.ExperimentData(u, y, n_sections=N, periods=CYCLES)


@pytest.mark.parametrize("memory", [0.0, 2.0])
@pytest.mark.parametrize("std", [0.3, [0.3, 2.0], np.stack([STD, STD[::-1]], axis=1)])
def test_measurement_noise_has_the_color_that_it_says(data, std, memory):
    noisy = hj.experiments.add_noise(data, std=std, memory=memory, seed=3)
    require_color(noisy.y, std, memory)
