"""The number of multipliers: found by rank and by criteria, refused where it is too high."""

import numpy as np
import pytest

import hybridjax as hj

from .conftest import scaled
from .test_uncertainty import (
    covered,
    noisy,
    small as small,
    variance as variance,
    with_variance,
)


@pytest.mark.parametrize("size", [1.0, 100.0])
def test_two_multipliers_are_two(size, small, variance):
    _, htf = small
    rng = np.random.default_rng(0)
    data = noisy(htf, size * variance, rng)
    found = hj.select_order(data, 4)
    assert np.all(found.deviation[:2] > 10)
    apart = np.abs(found.strength[2:] - 1)
    assert np.all(apart < 0.2)
    ratio = found.cost[2:] / found.dof[2:]
    np.testing.assert_allclose(ratio, 1.0, atol=0.2)
    blind = hj.select_order(with_variance(htf, data.H, None), 4)
    for x in (found, blind):
        orders = (x.by_rank, x.by_mdl, x.order)
        assert orders == (2, 2, 2)
    assert "by rank: 2" in repr(found)
    assert len(repr(found).splitlines()) == 7


@pytest.mark.parametrize(("few", "runs"), [(False, 50), (True, 12)])
def test_the_level_of_the_rank_test(small, variance, few, runs):
    """In 1 % of cases noise looks like one more multiplier, which fits refuse in the others; also
    with variances from few realizations, beside which noise looks larger, and has longer tails."""
    htf = small[1].select((-1, 0, 1))
    refused = 0
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        data = noisy(htf, variance[1:], rng)
        if few:
            shape = variance[1:].shape
            factors = rng.gamma(3.0, 1 / 3, shape)
            rough = variance[1:] * factors
            dof = np.full(80, 3.0)
            data = with_variance(htf, data.H, rough, dof)
        try:
            hj.fit_multipliers(data, 3)
        except hj.errors.DefinitionError as error:
            refused += "the data support 2 multipliers, not 3" in str(error)
    assert hj.select_order(data, 4).by_rank == 2
    assert covered(refused, runs, 0.98)


def test_exact_htfs_have_no_more_multipliers(small):
    _, htf = small
    with pytest.raises(
        hj.errors.DefinitionError, match="the data support 2 multipliers, not 3"
    ):
        hj.fit_multipliers(htf, 3)
    spurious = hj.fit_multipliers(htf, 3, check=False)
    assert np.isinf(spurious.standard_errors).all()
    assert "± unknown" in repr(spurious)
    assert spurious.contains(0.5).all()
    assert "support 2 multipliers, not 3" in spurious.findings[0].text
    assert (
        hj.select_order(scaled(12, (1, 1), 1, 1).htf(np.arange(1, 46) / 46)).order == 1
    )


@pytest.mark.parametrize("size", [0.0, 0.3])
def test_a_weak_multiplier_that_was_left_out_is_named(size):
    """A pair of modulus 0.7, and a multiplier of 0.4 that the input excites by `size` as much."""
    real = 0.7 * np.cos(0.9)
    imaginary = 0.7 * np.sin(0.9)
    A = np.array(
        [
            [real, imaginary, 0],
            [-imaginary, real, 0],
            [0, 0, 0.4],
        ]
    )
    named = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        # Three sections; the states change after the last one.
        draws = rng.normal(size=(3, 3))
        B = draws * [1, 1, size]
        C = rng.normal(size=(3, 2, 3))
        u = rng.normal(size=1350)
        y = np.zeros((1350, 2))
        x = np.zeros(3)
        for i in range(1350):
            n = i % 3
            y[i] = C[n] @ x
            x = x + B[n] * u[i]
            if n == 2:
                x = A @ x
        y += 0.1 * y.std(axis=0) * rng.normal(size=y.shape)
        inputs = u[:, None]
        data = hj.experiments.SectionSeries(inputs, y, n_sections=3)
        fit = hj.fit_series(data, 2)
        named += "order" in [finding.cause for finding in fit.findings]
    if size:
        assert named >= 5
    else:
        assert named <= 1  # (A test of 95 % doubts some right orders.)
