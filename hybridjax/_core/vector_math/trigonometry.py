"""Trigonometric functions that the CPU computes for many numbers at once.

XLA on CPU turns `jnp.sin` and its relatives in float64 into one call of the C library for every
number, 8 to 22 ns each. The functions here are written in additions, multiplications, divisions and
selections, which become vector instructions: 2 to 3 ns. `rewrite.vectorized` puts them into
functions that were written with `jnp`.

- Argument reduction: x = k pi/2 + r with pi/2 cut into pieces of 33 bits (W. J. Cody, W. Waite,
  Software Manual for the Elementary Functions, 1980). Exact for |x| < 1.6e6. Beyond, the result may
  be that of a neighbor of x, at most two units in the last place away.
- Polynomials: minimax (Remez) for the relative error of each function, below 2^-57.
- Accuracy, in units in the last place: `sin`, `cos` 1.5 (|x| < 1e6), `arctan` 2, `arctan2` 3,
  `tan`, `arcsin`, `arccos` 3.3. No result of `sin` and `cos` exceeds 1, `cos(0)` is 1, and signs of
  zeros, infinities and NaN are treated as `jnp` treats them. Subnormal numbers may count as zero,
  as they do in all arithmetic of XLA on CPU.

Each has derivatives of all orders, in forward and reverse mode. Arguments are of float64.

The coefficients and the pieces of pi/2 must not be changed by hand: the accuracy above holds for
these. If `sin` or `cos` is inaccurate, look whether the argument is below 1.6e6, then at the
reduction in `_sincos`; if an inverse function is, at `_arctan2`.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp


class _Numbers(NamedTuple):
    """Constants of the functions below."""

    pi_2: tuple[float, ...]
    """pi/2 in pieces whose products with integers below 2^20 are exact, and the remainder."""
    sin: tuple[float, ...]
    """S in sin(r) = r + r^3 S(r^2) for |r| <= pi/4."""
    cos: tuple[float, ...]
    """C in cos(r) = 1 - r^2/2 + r^4 C(r^2) for |r| <= pi/4."""
    arctan: tuple[float, ...]
    """A in arctan(r) = r + r^3 A(r^2) for |r| <= tan(pi/8)."""
    pi_4_low: float
    """The difference of pi/4 from the nearest number; that of pi/2 and pi is twice and four times
    as large."""


_N = _Numbers(
    pi_2=(
        1.5707963267341256,
        6.077100506303966e-11,
        2.0222662487111665e-21,
        8.4784276603689e-32,
    ),
    sin=(
        -0.1666666666666663,
        0.008333333333322103,
        -0.00019841269829577054,
        2.7557313616915243e-06,
        -2.5050747041638134e-08,
        1.5896187163960848e-10,
    ),
    cos=(
        0.0416666666666666,
        -0.001388888888887412,
        2.4801587289479338e-05,
        -2.755731435145688e-07,
        2.0875723147665586e-09,
        -1.1359639900700292e-11,
    ),
    arctan=(
        -0.333333333333332,
        0.1999999999995404,
        -0.14285714280244025,
        0.1111111078590334,
        -0.09090897829448295,
        0.07692061508484056,
        -0.06663118879205376,
        0.05847997682515918,
        -0.05039793699138138,
        0.03807697614533479,
        -0.017920777271075074,
    ),
    pi_4_low=3.061616997868383e-17,
)
_TAN_PI_8 = math.tan(math.pi / 8)


def _polynomial(coefficients, z):
    p = coefficients[-1]
    for c in coefficients[-2::-1]:
        p = p * z + c
    return p


@jax.custom_jvp
def _sincos(x):
    """Return sin and cos of x. Polynomials give those of the rest r after k quarter turns; the
    quadrant then says which is which, and their signs."""
    n = _N
    k = jax.lax.round(x * (2 / jnp.pi), jax.lax.RoundingMethod.TO_NEAREST_EVEN)
    a = x - k * n.pi_2[0]
    b = k * n.pi_2[1]
    r = a - b
    lost = (a - r) - b  # by rounding
    third = lost - k * n.pi_2[2]
    r = (r + third) - k * n.pi_2[3]
    # Acts from |x| ~ 1e14 on only, where x does not determine r any more.
    low = jax.lax.full_like(r, -0.8)
    high = jax.lax.full_like(r, 0.8)
    r = jax.lax.clamp(low, r, high)
    z = r * r
    s = r + r * z * _polynomial(n.sin, z)
    higher = z * z * _polynomial(n.cos, z)
    c = 1 - (0.5 * z - higher)
    quadrant = k - 4 * jax.lax.floor(0.25 * k)
    odd = abs(quadrant - 2) == 1
    sin = jax.lax.select(odd, c, s)
    cos = jax.lax.select(odd, s, c)
    sin = jax.lax.select(quadrant >= 2, -sin, sin)
    cos = jax.lax.select(abs(quadrant - 1.5) < 1, -cos, cos)
    return jax.lax.select(x == 0, x, sin), cos  # the sign of zero is kept


@_sincos.defjvp
def _(xs, dxs):
    (x,) = xs
    (dx,) = dxs
    s, c = _sincos(x)
    return (s, c), (dx * c, -dx * s)


def _arctan2(y, x):
    """Return the angle of the point (x, y). It is found for the shorter side over the longer one,
    turned by pi/4 where this ratio is above tan(pi/8), then put into the octant of the point."""
    y, x = jnp.broadcast_arrays(y, x)
    n = _N
    ax = abs(x)
    ay = abs(y)
    low = jax.lax.min(ax, ay)
    high = jax.lax.max(ax, ay)
    of_equal = jnp.where(high == 0, 0.0, 1.0)
    ratio = jnp.where(low == high, of_equal, low / high)
    steep = ratio > _TAN_PI_8
    r = jax.lax.select(steep, (ratio - 1) / (ratio + 1), ratio)
    z = r * r
    angle = r + r * z * _polynomial(n.arctan, z)
    steep_angle = jnp.pi / 4 + (angle + n.pi_4_low)
    angle = jax.lax.select(steep, steep_angle, angle)
    beyond_diagonal = jnp.pi / 2 - (angle - 2 * n.pi_4_low)
    angle = jax.lax.select(ay > ax, beyond_diagonal, angle)
    left = jnp.pi - (angle - 4 * n.pi_4_low)
    angle = jax.lax.select(jnp.signbit(x), left, angle)
    return jax.lax.select(jnp.signbit(y), -angle, angle)


def _leg(x):
    """sqrt(1 - x^2)"""
    return jnp.sqrt((1 - x) * (1 + x))


def _function(name: str, function: Callable, *rules: Callable) -> Callable:
    """Return a function that is traced once: every further use costs one equation.

    **Arguments:** `rules`: one (tangent, value, *arguments) for each argument. Default: derived.
    """
    function.__name__ = name
    if rules:
        function = jax.custom_jvp(function)
        function.defjvps(*rules)
    return jax.jit(function)


sin = _function("sin", lambda x: _sincos(x)[0])
cos = _function("cos", lambda x: _sincos(x)[1])
tan = _function("tan", lambda x: jnp.divide(*_sincos(x)))
arctan2 = _function(
    "arctan2",
    _arctan2,
    lambda dy, _, y, x: dy * (x / (x**2 + y**2)),
    lambda dx, _, y, x: dx * (-y / (x**2 + y**2)),
)
arctan = _function(
    "arctan", lambda x: _arctan2(x, jnp.ones_like(x)), lambda dx, _, x: dx / (1 + x**2)
)
arcsin = _function(
    "arcsin", lambda x: _arctan2(x, _leg(x)), lambda dx, _, x: dx / _leg(x)
)
arccos = _function(
    "arccos", lambda x: _arctan2(_leg(x), x), lambda dx, _, x: -dx / _leg(x)
)
