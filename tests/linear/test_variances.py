"""Variances of HTFs: carried along, and what they say about an interval."""

from dataclasses import replace

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


def test_a_part_by_names(htf):
    """An output by its name is an HTF, as of `select`, with all that belongs to it."""
    named = replace(htf, outputs=("y", "v"))
    one = named["v"]
    assert one.outputs == ("v",)
    assert one.inputs == named.inputs
    assert one.harmonics == named.harmonics
    for name in ("H", "variance", "noise_variance", "standard_errors"):
        assert_array_equal(getattr(one, name), getattr(named, name)[:, :, 1:])
    roundness = named.variance_dof.roundness
    assert_array_equal(one.variance_dof.roundness, roundness[:, :, 1:])
    swapped = named.select(outputs=("v", "y"))
    assert swapped.outputs == ("v", "y")
    assert_array_equal(swapped.H, named.H[:, :, ::-1])
    assert_array_equal(named.select().H, named.H)

    rng = np.random.default_rng(2)
    H = rng.normal(size=(1, len(F), 1, 2)) @ np.eye(2) * 1j
    power = rng.uniform(1, 2, size=(len(F), 2))
    two = hj.linear.HTF(F, H, 0, 4, ("a", "b"), "y", power=power)
    chosen = two.select(0, inputs="b")
    assert chosen.inputs == ("b",)
    assert_array_equal(chosen.H, two.H[..., 1:])
    assert_array_equal(chosen.power, power[:, 1:])
    for wrong, message in (
        (lambda: named["w"], "no output 'w'; outputs are y, v"),
        (lambda: two.select(inputs="u"), "no input 'u'; inputs are a, b"),
    ):
        with pytest.raises(hj.errors.DefinitionError, match=message):
            wrong()


def test_a_part_inside_of_a_transformation(htf):
    named = replace(htf, outputs=("y", "v"))

    def total(k):
        return replace(named, H=k * named.H).select(0, outputs="v").magnitude.sum()

    expected = np.abs(named["v"][0]).sum()
    assert_allclose(jax.jit(jax.grad(total))(1.0), expected, rtol=1e-12)


def test_magnitude_and_phase(htf):
    """In radians, not unwrapped, and differentiable."""
    assert_allclose(htf.magnitude * np.exp(1j * htf.phase), htf.H, rtol=1e-12)
    assert np.abs(htf.phase).max() <= np.pi
    slope = jax.grad(lambda k: (replace(htf, H=k * htf.H).magnitude).sum())(2.0)
    assert_allclose(slope, np.abs(htf.H).sum(), rtol=1e-12)
