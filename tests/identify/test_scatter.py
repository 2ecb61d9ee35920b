"""Multipliers with errors: efficient, and with regions that hold what they promise."""

import dataclasses

import numpy as np
import pytest
from scipy import stats

import hybridjax as hj

from ..periodic.conftest import blocks_at_random


def noisy(htf, variance, rng, correlation=0.0):
    """HTFs with circular errors; a share of them is common to all harmonics and outputs."""
    parts = [rng.normal(size=htf.H.shape) + 1j * rng.normal(size=htf.H.shape) for _ in range(2)]
    own, common = parts[0], parts[1][:1, :, :1]
    error = np.sqrt(1 - correlation) * own + np.sqrt(correlation) * common
    return with_variance(htf, np.asarray(htf.H) + np.sqrt(variance / 2) * error, variance)


def with_variance(htf, H, variance, freedom=None):
    return hj.HTF(
        htf.f, H, htf.harmonics, htf.sections, htf.inputs, htf.outputs,
        variance=variance, freedom=freedom,
    )  # fmt: skip


@pytest.fixture(scope="module")
def small():
    """Four sections, two multipliers, a state that dies within a period; and its HTFs."""
    model = hj.LDTP.from_blocks(*blocks_at_random(3, (2, 3, 4, 2), 2, 1, gain=0.98))
    return model, model.htf(np.linspace(0.01, 1.99, 80))


@pytest.fixture(scope="module")
def variance(small):
    """Not the same at all frequencies, harmonics and outputs."""
    _, htf = small
    rng = np.random.default_rng(9)
    levels = [10 ** rng.uniform(-1, 1, n) for n in (4, 80, 2, 1)]
    levels[0][3] = levels[0][1]  # H_-1 and H_1
    return 1e-4 * np.prod(np.ix_(*levels)[0:1], axis=0) * levels[1][:, None, None] * levels[2][
        :, None
    ]


def covered(hits, runs, level=0.95):
    """Consistent with the level by a two-sided binomial test of level 0.1 %."""
    return stats.binomtest(hits, runs, level).pvalue > 1e-3


@pytest.mark.parametrize("correlation, errors", [(0, "variance"), (0, None), (0.7, None)])
def test_regions_cover_and_errors_reach_the_bound(correlation, errors, small, variance):
    model, htf = small
    true = model.multipliers()
    bound = hj.multiplier_bound(model, with_variance(htf, htf.H, variance))
    hits, square, said = 0, 0.0, 0.0
    for seed in range(150):
        fit = hj.fit_multipliers(
            noisy(htf, variance, np.random.default_rng(seed), correlation), 2, errors=errors
        )
        hits += fit.contains(true).all()
        square += fit.compare(true).error[0] ** 2 / 150
        said += fit.standard_errors[0] ** 2 / 150
    print(hits, square**.5, said**.5, bound)
