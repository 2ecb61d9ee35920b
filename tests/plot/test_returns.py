"""The return map of one coordinate, where its formula is known."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj


class Hold(hj.Chart):
    states = ("x",)

    def field(self, t, q, u):
        return (0.0 * q[0],)


class Logistic(hj.HybridSystem):
    """A state that is kept, and once a period replaced by r x (1 - x)."""

    r: hj.Parameter = hj.parameter(2.8)

    def charts(self):
        return {"main": Hold()}

    def transitions(self):
        tick = hj.systems.Scheduled(1.0, offset=0.5)
        jump = hj.Transition("jump", "main", "main", tick, reset=self.after)
        return [jump]

    def after(self, t, q, u):
        rest = 1 - q[0]
        return (self.r * q[0] * rest,)

    def period(self):
        return 1.0

    def guess(self):
        return hj.Guess("main", (0.6,))


def lines_of(plot):
    return {line.get_label(): line.get_data() for line in plot.ax.get_lines()}


def test_the_logistic_map_and_its_cobweb():
    r = 2.8
    cycle = hj.find_limit_cycle(Logistic(r=r))
    plot = hj.plot.return_map(cycle, range=(0.3, 0.95), start=0.4, iterates=6)
    lines = lines_of(plot)
    x, after = lines["return map"]
    ends = (x[0], x[-1])
    assert ends == (0.3, 0.95)
    assert_allclose(after, r * x * (1 - x), atol=1e-12)
    assert "slope -0.8: multiplier" in lines  # 2 - r
    near, tangent = lines["slope -0.8: multiplier"]
    slope = np.diff(tangent) / np.diff(near)
    assert_allclose(slope, 2 - r, rtol=1e-9)
    iterates = [0.4]
    for _ in range(6):
        last = iterates[-1]
        iterates.append(r * last * (1 - last))
    corners_x, corners_y = lines["from 0.4"]
    expected_x = np.repeat(iterates, 2)[:-1]
    assert_allclose(corners_x, expected_x, atol=1e-12)
    twice = np.repeat(iterates[1:], 2)
    assert_allclose(corners_y[1:], twice, atol=1e-12)
    (fixed,), _ = lines["cycle"]
    assert_allclose(fixed, 1 - 1 / r, atol=1e-12)
    bare = lines_of(hj.plot.return_map(cycle, cobweb=False))
    assert not any(label.startswith("from") for label in bare)


def test_a_cobweb_ends_where_it_leaves_the_range():
    cycle = hj.find_limit_cycle(Logistic(r=3.9))
    plot = hj.plot.return_map(cycle, range=(0.6, 0.85), start=0.75, iterates=50)
    x, _ = lines_of(plot)["from 0.75"]
    assert len(x) < 20
    assert np.all((x >= 0.6) & (x <= 0.85))


def test_the_slope_in_several_dimensions_is_the_multiplier():
    """Two states that decay at their own rates: along each eigenvector the map is a line."""
    system = hj.HybridSystem.from_functions(
        ("x", "y"),
        lambda t, q, u, p: (1.0 - 0.2 * q[0], q[0] - 0.5 * q[1]),
        period=1.0,
    )
    guess = hj.Guess("main", (1.0, 1.0))
    cycle = hj.find_limit_cycle(system, guess)
    for coordinate in (None, "x", "y"):
        lines = lines_of(hj.plot.return_map(cycle, coordinate, cobweb=False))
        x, after = lines["return map"]
        slope = np.diff(after) / np.diff(x)
        assert_allclose(slope, np.exp(-0.2), rtol=1e-4)
        assert f"slope {np.exp(-0.2):.4g}: multiplier" in lines


@pytest.mark.slow
def test_states_that_do_not_return_are_gaps():
    """x' = x^3 - x reaches infinity before t = 1 from above 1.0754, as its solution says."""
    system = hj.HybridSystem.from_functions(
        ("x",), lambda t, q, u, p: (q[0] ** 3 - q[0],), period=1.0
    )
    cycle = hj.find_limit_cycle(system, hj.Guess("main", (0.1,)))
    plot = hj.plot.return_map(cycle, range=(-1.5, 1.5), start=0.9)
    x, after = lines_of(plot)["return map"]
    lost = 1 / np.sqrt(1 - np.exp(-2))
    returns = np.abs(x) < lost
    assert_array_equal(np.isfinite(after), returns)
    kept = x[np.abs(x) < lost]
    square = kept**2
    left = (1 - square) * np.exp(2)
    exact = kept / np.sqrt(square + left)
    inner = after[np.abs(x) < lost]
    assert_allclose(inner, exact, atol=1e-9)


@pytest.mark.slow
def test_wrong_coordinates_ranges_and_cycles_are_refused():
    cycle = hj.find_limit_cycle(Logistic())
    for options, message in (
        ({"coordinate": "y"}, "must be a state on the section, x, not 'y'"),
        ({"range": (0.1, 0.2)}, "must contain the cycle, x = 0.642857"),
    ):
        with pytest.raises(hj.errors.DefinitionError, match=message):
            hj.plot.return_map(cycle, **options)
    hopper = hj.find_limit_cycle(hj.models.VerticalHopper())
    with pytest.raises(hj.errors.DefinitionError, match="no real multiplier"):
        hj.plot.return_map(hopper)
