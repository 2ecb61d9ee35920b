"""The structured fit: exact on exact data, robust on measured data, bad input."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose

import hybridjax as hj

from ..linear.conftest import blocks_at_random
from .conftest import SHAPES


@pytest.mark.parametrize("harmonics", [0, (-1, 0, 1), 1, (1, 2), (-16, -2, 2)])
def test_the_hopper_is_found_exactly(harmonics, exact, multipliers):
    fit = hj.fit_multipliers(exact.select(harmonics), 2)
    assert fit.compare(multipliers).max_error < 2e-9
    assert fit.residual.max() < 1e-9


def test_the_paper_protocol(paper_estimate, multipliers):
    five = paper_estimate.select((-2, -1, 0, 1, 2))
    narrow = hj.fit_multipliers(five, 2)
    assert narrow.compare(multipliers).max_error < 2e-5


@settings(max_examples=12)
@given(st.sampled_from(SHAPES), st.integers(0, 99))
def test_random_systems(shape, seed):
    """The state beyond the rank dies within one period, as dimensions fall to 2 or less."""
    dims, ny, nu = shape
    blocks = blocks_at_random(seed, dims, ny, nu, gain=0.95)
    model = hj.linear.LDTP.from_blocks(*blocks)
    N = len(dims)
    last = N / 2 - 0.01
    f = np.linspace(0.01, last, 12 * N)
    htf = model.htf(f)
    fit = hj.fit_multipliers(htf, model)
    true = model.multipliers
    exact = np.poly(true).real[1:]
    assert_allclose(fit.coefficients, exact, atol=1e-8)
    error = fit.htf(htf.frequencies).error(htf)
    assert error.max() < 1e-8
    lags = 3 * N + 1
    assert fit.numerators.shape == (N, lags, ny, nu)
