"""Accuracy against long doubles and exact fractions, and derivatives."""

import functools as ft
import math
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal, assert_array_less

from hybridjax._core.vector_math import trigonometry


BOUNDS = {"sin": 2, "cos": 2, "tan": 4, "arctan": 2, "arcsin": 4, "arccos": 4}
NAMES = list(BOUNDS)
PI = Fraction(
    "3.14159265358979323846264338327950288419716939937510582097494459230781640628620899"
)
RNG = np.random.default_rng(0)


@ft.cache
def compiled(name):
    return jax.jit(getattr(trigonometry, name))


def ulps(value, truth):
    """Distance in units in the last place of the truth."""
    magnitude = np.abs(np.asarray(truth, float))
    unit = np.spacing(magnitude)
    found = np.asarray(value).astype(np.longdouble)
    distance = np.abs(found - truth)
    return np.asarray(distance / unit, float)


def arguments(name):
    if name in ("arcsin", "arccos"):
        anywhere = RNG.uniform(-1, 1, 20000)
        near_one = 1 - np.exp(RNG.uniform(-36, 0, 2000))
        return np.concatenate([anywhere, near_one])
    exponents = RNG.uniform(-700, math.log(1e6), 20000)
    sizes = np.exp(exponents)
    of_all_sizes = sizes * RNG.choice([-1, 1], 20000)
    small = RNG.uniform(-10, 10, 20000)
    large = RNG.uniform(-1e6, 1e6, 9000)
    multiples = np.arange(-20000, 20000, 7)
    near_multiples = multiples * (math.pi / 4)
    return np.concatenate([of_all_sizes, small, large, near_multiples])


@pytest.mark.parametrize("name", NAMES)
def test_accuracy(name):
    x = arguments(name)
    truth = getattr(np, name)(x.astype(np.longdouble))
    found = compiled(name)(x)
    largest = np.max(ulps(found, truth))
    assert largest <= BOUNDS[name]


def test_accuracy_of_arctan2():
    directions = RNG.normal(size=(2, 40000))
    exponents = RNG.uniform(-20, 20, (2, 40000))
    y, x = directions * np.exp(exponents)
    exact_y = y.astype(np.longdouble)
    exact_x = x.astype(np.longdouble)
    truth = np.arctan2(exact_y, exact_x)
    found = compiled("arctan2")(y, x)
    largest = np.max(ulps(found, truth))
    assert largest <= 3


def test_hardest_arguments():
    """Near multiples of pi/2, where sin or cos is x - k pi/2: the closest doubles, and others."""
    powers = 29 * 2 ** np.arange(7)
    spread = np.arange(1, 640000, 997)
    k = np.concatenate([powers, spread])
    x = []
    remainder = []
    for number in k:
        multiple = int(number) * PI / 2
        x.append(float(multiple))
        exact = Fraction(x[-1]) - multiple
        remainder.append(float(exact))
    x = np.array(x)
    remainder = np.array(remainder)
    assert np.min(np.abs(remainder)) < 1e-18
    # sin(k pi/2 + r) is r, cos r, -r, -cos r, and cos(k pi/2 + r) is cos r, -r, -cos r, r.
    signs = np.array([1, -1, -1, 1])
    sign = signs[k % 4]
    is_even = k % 2 == 0
    sine = compiled("sin")(x)
    cosine = compiled("cos")(x)
    small = np.where(is_even, sine, cosine)
    assert_array_less(ulps(small * sign, remainder), 2)


SPECIAL = np.array(
    [0.0, -0.0, 1.0, -1.0, np.inf, -np.inf, np.nan, 1e300, -1e300, 1e-300, 5e-324]
)


@pytest.mark.parametrize("name", NAMES)
def test_special_values(name):
    x = SPECIAL
    if name in ("sin", "cos", "tan"):
        x = SPECIAL[np.abs(SPECIAL) != 1e300]
    with np.errstate(invalid="ignore"):
        truth = getattr(np, name)(x)
    value = np.asarray(compiled(name)(x))
    assert_allclose(value, truth, rtol=1e-15, atol=1e-307)
    finite = np.isfinite(truth)
    sign = np.signbit(value)[finite]
    true_sign = np.signbit(truth)[finite]
    assert_array_equal(sign, true_sign)


def first(f):
    return jax.vmap(jax.grad(f))


def second(f):
    return jax.jacfwd(jax.jacfwd(f))


def hessian_of_squares(f):
    return jax.hessian(lambda x: (f(x) ** 2).sum())


@pytest.mark.parametrize("derivative", [first, second, hessian_of_squares])
@pytest.mark.parametrize("name", NAMES)
def test_derivatives(name, derivative):
    ours = derivative(getattr(trigonometry, name))
    plain = derivative(getattr(jnp, name))
    x = jnp.linspace(-0.9, 0.9, 8)
    both = jax.jit(lambda x: (ours(x), plain(x)))
    value, truth = both(x)
    assert_allclose(value, truth, rtol=1e-12, atol=1e-13)
