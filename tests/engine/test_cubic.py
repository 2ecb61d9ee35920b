"""First falling zero of a cubic, against polynomial roots."""

import jax
import numpy as np
from hypothesis import assume, given, settings, strategies as st
from numpy.testing import assert_allclose

from hybridjax.engine.cubic import first_crossing


number = st.floats(-4.0, 4.0).map(lambda x: round(x, 3))


compiled = jax.jit(first_crossing)


def crossing(v0, v1, d0, d1, armed=True):
    values = (np.array([x], float) for x in (v0, v1, d0, d1))
    return compiled(*values, np.array([armed]))


def truth(v0, v1, d0, d1, armed):
    """Position of the first falling zero in (0, 1] (infinity: none), and the cubic's extrema."""
    c = [d0 + d1 - 2 * (v1 - v0), 3 * (v1 - v0) - 2 * d0 - d1, d0, v0]
    roots = np.roots(np.trim_zeros(c, "f"))
    roots = np.sort(roots[np.abs(roots.imag) < 1e-9].real)
    extrema = np.roots(np.trim_zeros(np.polyder(c), "f"))
    slope = np.polyval(np.polyder(c), roots)
    # The guard must have been positive before: at once if it is armed, else after a rise.
    falls = [r for r, s in zip(roots, slope, strict=True) if 0 < r <= 1 and s < 0]
    if not armed and falls:
        rises = [
            r for r, s in zip(roots, slope, strict=True) if 0 <= r < falls[0] and s > 0
        ]
        falls = falls if rises or v0 > 0 else falls[1:]
    return (falls[0] if falls else np.inf), extrema[np.abs(extrema.imag) < 1e-9].real, c


@settings(max_examples=200)
@given(v0=number, v1=number, d0=number, d1=number)
def test_first_crossing_is_a_root(v0, v1, d0, d1):
    armed = v0 > 0
    assume(abs(v0) > 1e-2 and abs(v1) > 1e-2)
    expected, extrema, c = truth(v0, v1, d0, d1, armed)
    # Tangencies are the business of the next tests.
    assume(all(abs(np.polyval(c, e)) > 1e-3 for e in extrema if -0.1 < e < 1.1))
    found = crossing(v0, v1, d0, d1, armed)
    assert_allclose(found.position[0], expected, atol=1e-9)
    assert not found.touch[0]


def test_a_dip_within_the_step_is_found():
    # (s - 0.4)^2 - 0.01: falls through zero at 0.3, rises at 0.5.
    assert_allclose(crossing(0.15, 0.35, -0.8, 1.2).position[0], 0.3, atol=1e-12)


def test_touching_and_nearly_touching():
    assert crossing(0.16, 0.36, -0.8, 1.2).touch[0]
    near = crossing(0.16 + 1e-4, 0.36 + 1e-4, -0.8, 1.2)
    assert near.near[0]
    assert not near.touch[0]
    assert np.isinf(near.position[0])
    clear = crossing(0.16 + 0.1, 0.36 + 0.1, -0.8, 1.2)
    assert not clear.near[0]
    assert not clear.touch[0]
    assert np.isinf(clear.position[0])


def test_a_guard_that_starts_at_zero_must_leave_it_first():
    assert np.isinf(crossing(0.0, -1.0, -1.0, -1.0, armed=False).position[0])
    assert np.isinf(crossing(0.0, 1.0, 1.0, 1.0, armed=False).position[0])
    # s (0.5 - s): up, and down through zero at 0.5.
    measured = crossing(0.0, -0.5, 0.5, -1.5, armed=False).position[0]
    assert_allclose(measured, 0.5, atol=1e-12)
    # s^3 - s^2 + 0.1 s (zero to first order only) falls and rises without being positive first.
    assert np.isinf(crossing(-1e-18, -0.5, 0.0, -1.0, armed=False).position[0])
