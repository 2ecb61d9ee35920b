"""The paper's parametric fit: its known bias, global optimum, bad input."""

import numpy as np
import scipy.optimize

import hybridjax as hj


def test_the_bias_on_exact_data(exact, multipliers):
    fit = hj.identify.fit_rational(exact)
    errors = [fit.compare(multipliers, name).max_error for name in fit.outputs]
    np.testing.assert_allclose(errors, (2.6e-3, 1.07e-2), atol=0.05e-3)
    assert np.all(fit.result == hj.errors.Result.OK)
    assert fit.outputs == ("yM", "vM")
    np.testing.assert_array_equal(fit.multipliers, fit.poles**32)


def rational(f, numerator, denominator, sections):
    angles = -2j * np.pi * np.asarray(f)
    w = np.exp(angles / sections)
    top = w * np.polynomial.polynomial.polyval(w, numerator)
    bottom = np.polynomial.polynomial.polyval(w, denominator)
    return top / bottom


def real_parts(values):
    """Real and imaginary parts, as solvers for real numbers take them."""
    return np.concatenate([values.real, values.imag])


def test_no_start_finds_a_better_fit(exact):
    """Against scipy's solver over all coefficients, from 20 random pairs of poles."""
    fit = hj.identify.fit_rational(exact, output="vM")
    f = np.asarray(exact.frequencies)
    h = np.asarray(exact[0])[:, 1, 0]

    def residual(x):
        denominator = [1, *x[:2]]
        fitted = rational(f, x[2:], denominator, 32)
        relative = (h - fitted) / np.linalg.norm(h)
        return real_parts(relative)

    def start(radius, angle):
        """The best numerator for a pair of poles."""
        middle = -2 * radius * np.cos(angle)
        a = [middle, radius**2]
        denominator = [1, *a]
        first = rational(f, [1], denominator, 32)
        second = rational(f, [0, 1], denominator, 32)
        columns = [real_parts(first), real_parts(second)]
        b = np.linalg.lstsq(np.stack(columns, axis=1), real_parts(h))[0]
        return [*a, *b]

    own = [*fit.denominator[0, 1:], *fit.numerator[0]]
    own_cost = np.linalg.norm(residual(own))
    np.testing.assert_allclose(own_cost, fit.residual[0], rtol=1e-9)
    rng = np.random.default_rng(0)
    radii = rng.uniform(0.5, 1.0, 20)
    angles = rng.uniform(0, 2, 20)
    for radius, angle in zip(radii, angles, strict=True):
        begin = start(radius, angle)
        found = scipy.optimize.least_squares(
            residual, begin, x_scale="jac", max_nfev=50
        )
        found_cost = np.linalg.norm(found.fun)
        assert found_cost > own_cost * (1 - 1e-6)


def test_a_rational_function_is_found_exactly():
    """Three poles, two zeros; HTF, poles, zeros and gain of what was put in."""
    f = np.linspace(0.1, 2.4, 40)
    numerator = np.array([2.0, -1.0, 0.3])
    poles = np.array([0.9 + 0.3j, 0.9 - 0.3j, -0.5])
    denominator = np.poly(poles).real
    h = rational(f, numerator, denominator, 5)
    H = h[None, :, None, None]
    htf = hj.linear.HTF(f, H, 0, 5)
    fit = hj.identify.fit_rational(htf, poles=3, zeros=2)
    np.testing.assert_allclose(fit.poles[0], poles, atol=1e-7)
    np.testing.assert_allclose(fit.numerator[0], numerator, atol=1e-6)
    zeros = np.sort_complex(fit.zeros[0])
    true_zeros = np.roots(numerator)[::-1]
    np.testing.assert_allclose(zeros, true_zeros, atol=1e-6)
    found = fit.htf(f).H[0, :, 0, 0]
    np.testing.assert_allclose(found, h, atol=1e-6)
    assert fit.residual[0] < 1e-7

    # More poles than there are: the fit stays good and the true ones are among them.
    more = hj.identify.fit_rational(htf, poles=4, zeros=3)
    shift = more.poles[0] - poles[:, None]
    distances = np.abs(shift)
    assert np.all(distances.min(axis=1) < 1e-4)
