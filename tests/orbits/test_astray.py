"""Searches that end on another cycle than the one that is asked for, and go on."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import hybridjax as hj


class Swing(hj.Chart):
    states = ("x", "v")

    def field(self, t, q, u):
        x, v = q
        stiffness = 0.25 + 0.2 * jnp.cos(t)
        force = stiffness * x
        return v, -0.05 * v - force - x**3


class Pumped(hj.HybridSystem):
    """A swing whose rest is unstable by a flip: it swings with twice the period of the pump."""

    def period(self):
        return 2 * np.pi

    def charts(self):
        return {"plane": Swing()}


@pytest.mark.slow
def test_a_search_for_two_periods_leaves_the_rest_to_which_newtons_method_leads():
    system = Pumped()
    guess = hj.Guess("plane", (0.15, 0.05))
    cycle = hj.find_limit_cycle(system, guess, multiplicity=2)

    def rates(t, q):
        x, v = q
        stiffness = 0.25 + 0.2 * np.cos(t)
        force = stiffness * x
        return v, -0.05 * v - force - x**3

    end = solve_ivp(rates, (0, 400 * np.pi), (0.15, 0.05), rtol=1e-9, atol=1e-12)
    found = np.abs(cycle.anchor.q[:, 0])
    expected = np.abs(end.y[:, -1])
    assert_allclose(found, expected, rtol=1e-6)


class Held(hj.Chart):
    states = ("x", "u")

    def field(self, t, q, u):
        return q[0] + q[1], 0.0 * q[1]


class EventTriggered(hj.HybridSystem):
    """An unstable plant, whose input is held until the state reaches a level."""

    def charts(self):
        return {"hold": Held()}

    def transitions(self):
        def high(t, q, u):
            return 1 - q[0]

        def low(t, q, u):
            return q[0] + 1

        def push_down(t, q, u):
            return q[0], -1.5

        def push_up(t, q, u):
            return q[0], 1.5

        return [
            hj.Transition("high", "hold", "hold", high, reset=push_down),
            hj.Transition("low", "hold", "hold", low, reset=push_up),
        ]


@pytest.mark.slow
def test_a_cycle_that_was_found_as_four_turns_is_found_as_one():
    """From -1 to 1 it takes the time in which x + 1.5 grows from 0.5 to 2.5."""
    guess = hj.Guess("hold", (5e-7, -1.5e-6))
    cycle = hj.find_limit_cycle(EventTriggered(), guess)
    assert_allclose(cycle.period, 2 * np.log(5), rtol=1e-10)


class Membrane(hj.Chart):
    states = ("v", "u")

    def field(self, t, q, u):
        v, w = q
        own = 0.04 * v**2 + 5 * v
        rise = own + 150 - w
        recovery = 0.02 * (0.2 * v - w)
        return rise, recovery


class Chattering(hj.HybridSystem):
    """Bursts of five spikes (Izhikevich, IEEE Transactions on Neural Networks 14, 2003)."""

    def charts(self):
        return {"membrane": Membrane()}

    def transitions(self):
        def peak(t, q, u):
            return 30 - q[0]

        def after(t, q, u):
            return -50.0, q[1] + 2

        return [hj.Transition("spike", "membrane", "membrane", peak, reset=after)]


@pytest.mark.slow
def test_a_burst_that_meets_the_plane_through_its_guess_twice_is_found():
    guess = hj.Guess("membrane", (-55.0, 0.0))
    cycle = hj.find_limit_cycle(Chattering(), guess)
    path = hj.simulate(Chattering(), "membrane", (-55.0, 0.0), 600.0)
    spikes = np.array([event.time for event in path.events])
    assert len(cycle.event_sequence) == 5
    five_bursts = spikes[-1] - spikes[-6]
    assert_allclose(cycle.period, five_bursts, rtol=1e-7)


@pytest.mark.slow
def test_a_search_waits_for_a_slow_manifold_to_end():
    """The fast mode of x = 6 decays 36 times as fast as x moves."""
    system = hj.models.VanDerPol(mu=6.0)
    guess = hj.Guess("oscillation", (6.0, 0.3))
    far = hj.find_limit_cycle(system, guess)
    assert_allclose(far.period, hj.find_limit_cycle(system).period, rtol=1e-10)
