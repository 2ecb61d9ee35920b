"""Failures that random systems brought to light, each reduced to the smallest system."""

import functools as ft

import jax
import jax.numpy as jnp
import pytest
from numpy.testing import assert_array_equal

import hybridjax as hj
from hybridjax.engine.lanes import start_lanes
from hybridjax.engine.move import move
from hybridjax.engine.settings import Settings
from hybridjax.engine.target import until
from hybridjax.systems.structure import Structure

from ..toys import Field, Toys, toy


SETTINGS = Settings(1e-10, 1e-10)


# x' = -1, with an event where x + u falls through zero: the input moves the guard.
def line_rates(t, q, u):
    return (-1.0,)


def fall_guard(t, q, u):
    return q[0] + u[0]


THRESHOLD = toy(
    {"line": Field(("x",), line_rates)},
    [hj.Transition("fall", "line", "line", fall_guard)],
)


def rounded(level):
    """An event that changes nothing: its guard is zero afterwards, but for rounding errors, which
    grow with the state and with time."""

    def guard(t, q, u):
        wave = 0.1 * jnp.sin(2 * jnp.pi * t)
        return q[0] + 1.1 * q[1] + wave - level

    def line_rates(t, q, u):
        return (-1.0, -1.0)

    charts = {"line": Field(("x", "y"), line_rates)}
    return charts, (hj.Transition("fall", "line", "line", guard),)


def test_a_guard_that_the_input_makes_negative_is_not_armed():
    run = hj.simulate(THRESHOLD, "line", (0.5,), 1.0, input=-1.0, throw=False)
    assert run.result == hj.errors.Result.OK
    assert not run.events


def two_pieces(x, first, second):
    """One second at one input, and one at another."""
    s = Structure(THRESHOLD)
    none = jnp.zeros(1, jnp.int32)
    state = jnp.full((1, 1), x)
    lanes = start_lanes(s, jnp.zeros(1), none, state)
    h = None
    for end, u in ((1.0, first), (2.0, second)):
        moved = move(
            s, lanes, jnp.full((1, 1), u), until(jnp.full(1, end)), SETTINGS, h
        ).moved
        lanes = moved.lanes
        h = moved.h
    code = int(moved.result[0])
    return hj.errors.Result(code), int(lanes.events[0])


@pytest.mark.slow
def test_a_guard_that_a_new_input_makes_positive_is_armed():
    found = two_pieces(-0.5, 0.0, 1.6)
    assert found == (hj.errors.Result.OK, 1)


@pytest.mark.parametrize("size, time", [(1e4, 0.0), (1.0, 3e3)])
@pytest.mark.slow
def test_an_event_that_leaves_its_guard_at_zero_up_to_rounding_happens_once(size, time):
    """100 systems with other levels: they differ by how their guards are rounded."""
    duration = 1 / 32
    sizes = size * jnp.linspace(0.5, 2.0, 100)
    result, events = across(sizes, time, duration)
    assert_array_equal(result, hj.errors.Result.OK)
    assert_array_equal(events, 1)


@jax.jit
@ft.partial(jax.vmap, in_axes=(0, None, None))
def across(x, time, duration):
    """A result and a number of events, with a start a third of `duration` before the guard."""
    t = jnp.full(1, time)
    q = jnp.stack([x, -x])[:, None]
    hit = duration / 3
    angle = 2 * jnp.pi * (time + hit)
    wave = jnp.sin(angle)
    level = -0.1 * x - 2.1 * hit + 0.1 * wave
    s = Structure(Toys(rounded, [level]))
    none = jnp.zeros(1, jnp.int32)
    lanes = start_lanes(s, t, none, q)
    no_input = jnp.zeros((1, 1))
    target = until(t + duration)
    moved = move(s, lanes, no_input, target, SETTINGS).moved
    return moved.result[0], moved.lanes.events[0]
