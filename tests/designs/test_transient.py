"""The start of records, where it can still be seen in them."""

import numpy as np
import pytest

import hybridjax as hj
from hybridjax.designs.studies.transient import refuse_transient


N, P, S = 4, 8, 40
MULTIPLIERS = np.array([0.8, 0.3 + 0j])


def records(size, noise=0.0, *, before=5, repeats=1, seed=0):
    """Two outputs of rms one, the second with a transient, and with more in the first cycle."""
    cycle = np.repeat(np.arange(before + P * repeats), N)
    rng = np.random.default_rng(seed)
    wave = np.sqrt(2) * np.cos(2 * np.pi * np.arange(len(cycle)) / (N * P))
    y = np.stack([wave, wave + size * 0.8**cycle + 3 * size * (cycle == 0)], axis=1)
    y = y + noise * rng.normal(size=(S, *y.shape))
    u = np.zeros((S, len(cycle), 1))
    return hj.ExperimentData(u, y, n_sections=N, periods=P)


@pytest.mark.parametrize(
    "before, repeats, left",
    [
        (5, 1, 0.8**5 * (1 - 0.8**P)),
        (3, 2, 0.8**3 * (1 - 0.8**P)),
        (1, 1, 0.8 * (4 - 0.8**P)),  # The first cycle is all there is.
    ],
)
def test_what_is_left_when_the_window_begins(before, repeats, left):
    """It is refused where more is left than may be."""
    data, left = records(1e-3, before=before, repeats=repeats), 1e-3 * left
    arguments = data, repeats, MULTIPLIERS, np.zeros(2)
    refuse_transient(*arguments, 1.05 * left)
    with pytest.raises(hj.DefinitionError, match=f"after {before} cycles"):
        refuse_transient(*arguments, 0.95 * left)


def test_no_record_before_the_window():
    refuse_transient(records(1.0, before=0), 1, MULTIPLIERS, np.zeros(2), 0.0)


def test_noise_is_no_transient():
    """Unless its mean square is beyond six standard deviations of that of noise, of which the
    difference of two cycles holds twice as much."""
    noise, level = np.array([0.01, 0.01]), 2 * 0.01**2
    for seed in range(20):
        refuse_transient(records(0.0, 0.01, seed=seed), 1, MULTIPLIERS, noise, 0.0)
        size = np.sqrt(6 * level * np.sqrt(2 / (N * S))) / (0.8 * (1 - 0.8**P))
        with pytest.raises(hj.DefinitionError, match="transient is left"):
            refuse_transient(records(size, 0.01, seed=seed), 1, MULTIPLIERS, noise, 0.0)
