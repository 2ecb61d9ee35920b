"""Variances of HTFs: carried along, and what they say about an interval."""

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats

import hybridjax as hj


F = np.arange(1, 20) / 20


def an_htf(**more):
    rng = np.random.default_rng(0)
    parts = rng.normal(size=(3, len(F), 2, 1, 2))
    H = parts @ [1, 1j]
    return hj.linear.HTF(F, H, (-1, 0, 1), 4, **more)


@pytest.fixture(scope="module")
def htf():
    rng = np.random.default_rng(1)
    shape = (3, len(F), 2, 1)
    size = rng.uniform(1, 2, shape)
    dof = np.full(len(F), 4.0)
    variance_dof = hj.linear.VarianceDof(dof, size)
    return an_htf(variance=2 * size, noise_variance=size, variance_dof=variance_dof)


def test_the_radius_is_that_of_the_f_distribution(htf):
    quantile = stats.f.ppf(0.95, 2, 8)
    expected = np.sqrt(quantile * np.asarray(htf.variance))
    plain = an_htf(
        variance=htf.variance, variance_dof=hj.linear.VarianceDof(htf.variance_dof.dof)
    )
    assert_allclose(plain.confidence_radius(), expected, rtol=1e-12)
    unevenness = np.asarray(htf.variance_dof.roundness) - 1
    larger = 1 + 0.95**2 * unevenness
    level = 1 - 0.05 * larger
    quantile = stats.f.ppf(level, 2, 8)
    expected = np.sqrt(quantile * np.asarray(htf.variance))
    for radius in (
        hj.linear.HTF.confidence_radius,
        jax.jit(hj.linear.HTF.confidence_radius),
    ):
        assert_allclose(radius(htf), expected, rtol=1e-9)
    known = an_htf(variance=htf.variance).confidence_radius(0.9)
    assert_allclose(
        known,
        np.sqrt(stats.chi2.ppf(0.9, 2) / 2 * np.asarray(htf.variance)),
        rtol=1e-12,
    )


def test_variances_go_along(htf):
    one = htf.select((0, 1))
    assert_array_equal(one.variance, htf.variance[1:])
    assert_array_equal(one.noise_variance, htf.noise_variance[1:])
    assert_array_equal(one.variance_dof.dof, htf.variance_dof.dof)
    assert_array_equal(one.variance_dof.roundness, htf.variance_dof.roundness[1:])
    assert an_htf().select(0).variance is None
