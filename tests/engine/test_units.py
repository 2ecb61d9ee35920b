"""The flow does not depend on the units in which a system is written."""

import functools as ft

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj
from hybridjax.engine.lanes import start_lanes
from hybridjax.engine.move import Options, move
from hybridjax.engine.settings import Settings
from hybridjax.engine.target import until
from hybridjax.systems.structure import Structure

from ..toys import Field, hopper_in, toy


# Lengths and times in these units. Powers of two change no rounding: all decisions are the same.
UNITS = [(2.0**20, 1.0), (2.0**-30, 1.0), (1.0, 2.0**10), (2.0**-20, 2.0**-8)]
SIZES = np.array([[2.0, 2.0, 0.3, 4.0], [2.0, 2.0, 1.0, 1.0]])


def sizes(length, time):
    """By which the hopper's states are multiplied."""
    rate = 1 / time
    ratios = jnp.array([1.0, rate, 1.0, rate])
    return length * ratios


def begin(system, length, time):
    """A lane at the top of a hop, and one on the ground."""
    top = [2.2, 0.0, 0.3, 0.1]
    ground = [2.0, 1.9, 0.0, 0.0]
    states = np.array([top, ground])
    q = states * sizes(length, time)
    charts = jnp.array([0, 1], jnp.int32)
    return start_lanes(Structure(system), jnp.zeros(2), charts, q.T)


@ft.partial(jax.jit, static_argnums=3)
def flow(length, time, scale, tangents):
    """Steps, codes and states (in the units of 1, 1) of a second and a half."""
    system = hopper_in(length, time)
    lanes = begin(system, length, time)
    u = jnp.zeros((1, 2))
    settings = Settings(1e-10, 1e-10, 256, scale)
    end = until(jnp.full(2, 1.5 * time))
    options = Options(True, tangents=tangents)
    structure = Structure(system)
    moved, tape = move(structure, lanes, u, end, settings, options=options)
    states = moved.lanes.q.T / sizes(length, time)
    return tape.h / time, tape.code, states, moved.result


@pytest.mark.parametrize(
    "tangents", [False, pytest.param(True, marks=pytest.mark.slow)]
)
def test_the_same_steps_in_all_units(tangents):
    h, code, q, result = flow(1.0, 1.0, SIZES, tangents)
    assert_array_equal(result, hj.errors.Result.OK)
    assert jnp.max(code) >= 0, "there are events"
    for length, time in UNITS:
        scale = SIZES * sizes(length, time)
        other_h, other_code, other_q, _ = flow(length, time, scale, tangents)
        assert_array_equal(other_h, h)
        assert_array_equal(other_code, code)
        assert_array_equal(other_q, q)


# --- Single trajectories, whose usual sizes are not known -----------------------------------------


def simulate_rates(rates, start):
    """The trajectory for ten seconds of a system with one chart."""
    states = tuple(f"x{k}" for k in range(len(start)))
    system = toy({"x": Field(states, rates)})
    found = hj.simulate(system, "x", start, 10.0)
    assert len(found.t) < 150, "steps grow"
    return found


def test_an_oscillator_at_zero():
    def oscillator(t, q, u):
        return q[1], -q[0]

    found = simulate_rates(oscillator, (0.0, 0.0))
    assert_allclose(found.after[-1], [0.0, 0.0], rtol=1e-9, atol=1e-13)


def test_a_weight_at_rest_up_to_rounding():
    def spring(t, q, u):
        spring = 100.3 * (q[0] - 0.1)
        return q[1], 9.81 - spring

    rest = 0.1 + 9.81 / 100.3
    found = simulate_rates(spring, (rest, 0.0))
    assert_allclose(found.after[-1], [rest, 0.0], rtol=1e-9, atol=1e-13)


def test_a_state_at_the_level_of_rounding():
    def decay(t, q, u):
        return -q[0], 1e-17 * q[0]

    found = simulate_rates(decay, (1.0, 0.0))
    expected = [np.exp(-10), 0.0]
    assert_allclose(found.after[-1], expected, rtol=1e-9, atol=1e-13)


def test_a_chain_of_integrators_from_zero():
    def integrators(t, q, u):
        return *q[1:], jnp.cos(t)

    found = simulate_rates(integrators, (0.0, 0.0, 0.0, 0.0, 0.0))
    t = 10.0
    parabola = t**2 / 2
    bent = np.cos(t) - 1 + parabola
    slope = t - np.sin(t)
    expected = [bent, slope, 1 - np.cos(t), np.sin(t)]
    end = found.after[-1][1:]
    assert_allclose(end, expected, rtol=1e-9)
