"""The saltation formula against the closed form of a bouncing ball on a floor that moves."""

import numpy as np

import hybridjax as hj
from hybridjax.engine.saltation import jump
from hybridjax.systems.structure import Structure


G = 9.81
RESTITUTION = 0.7


class Flight(hj.Chart):
    states = ("y", "v")

    def field(self, t, q, u):
        return q[1], -G


class Ball(hj.HybridSystem):
    """A ball that bounces on a floor at the height u, and is kicked by a clock."""

    inputs = ("floor",)

    def charts(self):
        return {"flight": Flight()}

    def transitions(self):
        return [
            hj.Transition(
                "bounce",
                "flight",
                "flight",
                lambda t, q, u: q[0] - u[0],
                direction="falling",
                reset=lambda t, q, u: (q[0], -RESTITUTION * q[1]),
            ),
            hj.Transition(
                "kick",
                "flight",
                "flight",
                hj.systems.Scheduled(1.0),
                reset=lambda t, q, u: (q[0], q[1] + 2.0 * q[0]),
            ),
        ]


def jump_of(name, v):
    s = Structure(Ball())
    states = np.array([[0.0, v]])
    g = s.transition_index(name)
    no_input = np.zeros((1, 1))
    return jump(s, g, np.zeros(1), states, no_input)


def test_a_bounce_is_that_of_the_closed_form():
    """A ball that is higher by x arrives later by -x / v, and has fallen for longer."""
    v = -3.0
    e = RESTITUTION
    bounce = jump_of("bounce", v)
    expected_delay = [[-1 / v, 0.0]]
    np.testing.assert_allclose(bounce.delay_by_state, expected_delay)
    by_height = -(1 + e) * G / v
    expected = [[[-e, 0.0], [by_height, -e]]]
    np.testing.assert_allclose(bounce.saltation, expected)
    # A floor that is higher by x is met earlier by -x / v, and lifts the ball.
    np.testing.assert_allclose(bounce.delay_by_input, [[1 / v]])
    expected_input = [[[1 + e], [-by_height]]]
    np.testing.assert_allclose(bounce.input_saltation, expected_input)


def test_no_state_delays_a_clock():
    kick = jump_of("kick", 1.5)
    np.testing.assert_array_equal(kick.delay_by_state, [[0.0, 0.0]])
    expected = [[[1.0, 0.0], [2.0, 1.0]]]
    np.testing.assert_array_equal(kick.saltation, expected)


def test_a_guard_that_does_not_move_has_no_delay():
    assert np.isnan(jump_of("bounce", 0.0).delay_by_level).all()
