"""Multipliers that are all but zero, against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj

from ..toys import Field, toy


def decaying(rates):
    """A forced linear system whose modes, mixed with each other, decay at these rates."""
    modes = np.array(
        [
            [1.0, 0.4, 0.2],
            [-0.3, 1.0, 0.5],
            [0.1, -0.6, 1.0],
        ]
    )
    decay = np.diag(-np.array(rates))
    inverse = np.linalg.inv(modes)
    A = jnp.asarray(modes @ decay @ inverse)
    force = jnp.array([1.0, 2.0, 3.0])

    def field(t, q, u):
        wave = jnp.cos(2 * jnp.pi * t)
        return A @ q + force * wave

    return toy({"a": Field(("x", "y", "z"), field)}, period=1.0)


@pytest.mark.slow
def test_a_small_multiplier_of_an_autonomous_cycle():
    """exp(-2 mu T) from steps between which the direction of the flow turns."""
    cycle = hj.find_limit_cycle(hj.models.HopfOscillator(mu=40.0))
    assert cycle.log_multipliers == pytest.approx([-80.0], rel=1e-11)

    def return_map(mu):
        cycle_there = hj.find_limit_cycle(hj.models.HopfOscillator(mu=mu), cycle)
        ldtp = hj.linearize(cycle_there, hj.Crossing("x", "rising"))
        return ldtp.A[0, 0, 0]

    multiplier, by_mu = jax.jvp(return_map, (40.0,), (1.0,))
    values = [jnp.log(return_map(40.0)), jnp.log(multiplier), by_mu / multiplier]
    assert_allclose(values, [-80.0, -80.0, -2.0], rtol=1e-9)


def test_multipliers_beside_a_reset_to_zero_do_not_depend_on_units():
    """x' = cos - x / 2 and y' = x - y, with y = 0 after each tick."""
    small = 1e-9
    large = 1e9

    def field(t, q, u):
        x, y = q
        wave = small * jnp.cos(2 * jnp.pi * t)
        fast = x / small * large - y
        return wave - x / 2, fast

    def reset(t, q, u):
        return (q[0], 0.0)

    schedule = hj.systems.Scheduled(1.0, 0.5)
    tick = hj.Transition("tick", "a", "a", schedule, reset=reset)
    chart = Field(("x", "y"), field)
    system = toy({"a": chart}, [tick], period=1.0)
    guess = hj.Guess("a", (small, large))
    cycle = hj.find_limit_cycle(system, guess)
    assert_allclose(cycle.multipliers, [np.exp(-0.5)], rtol=1e-12)


@pytest.mark.slow
def test_modes_that_decay_fast_beside_one_that_does_not():
    """The smallest multiplier is 3e-109."""
    rates = (0.5, 45.0, 250.0)
    truth = np.exp(-np.array(rates))
    guess = hj.Guess("a", (0.1, 0.2, 0.3))
    cycle = hj.find_limit_cycle(decaying(rates), guess)
    assert_allclose(cycle.multipliers, truth, rtol=1e-10, atol=0)
    found = hj.linearize(cycle, hj.ClockPhase(40)).multipliers
    assert_allclose(found, truth, rtol=1e-8, atol=0)
