"""First falling zero of a cubic, against polynomial roots."""

import jax
import numpy as np
from hypothesis import assume, given, settings, strategies as st
from numpy.testing import assert_allclose

from hybridjax.engine.cubic import dips, first_crossing, halfway_cubic


number = st.floats(-4.0, 4.0).map(lambda x: round(x, 3))


compiled = jax.jit(first_crossing)


def crossing(v0, v1, d0, d1, armed=True):
    """The first crossing of the cubic with these values and slopes at 0 and 1."""
    values = [np.array([x], float) for x in (v0, v1, d0, d1)]
    return compiled(*values, np.array([armed]))


def cubic(v0, v1, d0, d1):
    """Its coefficients, the highest first."""
    rise = v1 - v0
    third = d0 + d1 - 2 * rise
    second = 3 * rise - 2 * d0 - d1
    return np.array([third, second, d0, v0])


def real_roots(coefficients):
    roots = np.roots(np.trim_zeros(coefficients, "f"))
    is_real = np.abs(roots.imag) < 1e-9
    return np.sort(roots[is_real].real)


def first_fall(coefficients, armed):
    """Position of the first falling zero in (0, 1] (infinity: none)."""
    derivative = np.polyder(coefficients)
    falls = []
    rises = []
    for root in real_roots(coefficients):
        slope = np.polyval(derivative, root)
        if slope < 0 and 0 < root <= 1:
            falls.append(root)
        if slope > 0 and 0 <= root:
            rises.append(root)
    if not falls:
        return np.inf
    # The guard must have been positive before: at once if it is armed, else after a rise.
    rose = any(r < falls[0] for r in rises)
    was_positive = armed or coefficients[-1] > 0 or rose
    if was_positive:
        return falls[0]
    return falls[1] if len(falls) > 1 else np.inf


@settings(max_examples=200)
@given(
    v0=number,
    v1=number,
    d0=number,
    d1=number,
)
def test_first_crossing_is_a_root(v0, v1, d0, d1):
    armed = v0 > 0
    assume(abs(v0) > 1e-2 and abs(v1) > 1e-2)
    coefficients = cubic(v0, v1, d0, d1)
    # Tangencies are the business of the next tests.
    for extremum in real_roots(np.polyder(coefficients)):
        if -0.1 < extremum < 1.1:
            assume(abs(np.polyval(coefficients, extremum)) > 1e-3)
    found = crossing(v0, v1, d0, d1, armed)
    expected = first_fall(coefficients, armed)
    assert_allclose(found.position[0], expected, atol=1e-9)
    assert not found.touch[0]


def test_a_dip_within_the_step_is_found():
    # (s - 0.4)^2 - 0.01: falls through zero at 0.3, rises at 0.5.
    found = crossing(0.15, 0.35, -0.8, 1.2)
    assert_allclose(found.position[0], 0.3, atol=1e-12)


@given(v0=number, v1=number, d0=number, d1=number)
@settings(max_examples=200, deadline=None)
def test_a_dip_is_a_negative_minimum_between_positive_ends(v0, v1, d0, d1):
    polynomial = cubic(v0, v1, d0, d1)
    lowest = np.polyval(polynomial, np.linspace(0, 1, 1001)).min()
    assume(abs(lowest) > 1e-4)
    values = [np.array([x], float) for x in (v0, v1, d0, d1)]
    expected = v0 > 0 and v1 > 0 and lowest < 0
    assert dips(*values)[0] == expected


def test_touching_and_nearly_touching():
    touching = crossing(0.16, 0.36, -0.8, 1.2)
    assert touching.touch[0]
    near = crossing(0.16 + 1e-4, 0.36 + 1e-4, -0.8, 1.2)
    assert near.near[0]
    assert not near.touch[0]
    assert np.isinf(near.position[0])
    clear = crossing(0.16 + 0.1, 0.36 + 0.1, -0.8, 1.2)
    assert not clear.near[0]
    assert not clear.touch[0]
    assert np.isinf(clear.position[0])


def test_a_guard_that_starts_at_zero_must_leave_it_first():
    falling = crossing(0.0, -1.0, -1.0, -1.0, armed=False)
    assert np.isinf(falling.position[0])
    rising = crossing(0.0, 1.0, 1.0, 1.0, armed=False)
    assert np.isinf(rising.position[0])
    # s (0.5 - s): up, and down through zero at 0.5.
    arch = crossing(0.0, -0.5, 0.5, -1.5, armed=False)
    assert_allclose(arch.position[0], 0.5, atol=1e-12)
    # s^3 - s^2 + 0.1 s (zero to first order only) falls and rises without being positive first.
    wave = crossing(-1e-18, -0.5, 0.0, -1.0, armed=False)
    assert np.isinf(wave.position[0])


def test_halfway_a_cubic_is_met_exactly():
    coefficients = np.array([0.7, -1.2, 0.4, 2.0])
    slopes = np.polyder(coefficients)
    length = 0.8
    ends = np.array([0.0, length])
    values = np.polyval(coefficients, ends)
    rates = np.polyval(slopes, ends)
    times = np.array(length)
    state, rate = halfway_cubic(*values, *rates, times)
    assert_allclose(state, np.polyval(coefficients, length / 2), rtol=1e-14)
    assert_allclose(rate, np.polyval(slopes, length / 2), rtol=1e-13)
