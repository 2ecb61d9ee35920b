"""A stiff chart beside one that is not, in all that is computed from a cycle: closed forms.

A room is heated until its sensor shows 0.7, and cools until it shows 0.3. The sensor follows at
once while the room is heated, and slowly while it cools.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import brentq

import hybridjax as hj
from hybridjax.systems.chart import FieldChart


class Thermostat(hj.HybridSystem):
    fast: hj.Parameter = hj.parameter(1e4)
    slow: hj.Parameter = hj.parameter(5.0)

    def charts(self):
        def sensed(heat, rate):
            return lambda t, q, u: (heat - q[0] + u[0], rate * (q[0] - q[1]))  # noqa: E731

        heated = FieldChart(
            sensed(1.0, self.fast), ("x", "z"), solver=hj.systems.Radau()
        )
        return {"on": heated, "off": FieldChart(sensed(0.0, self.slow), ("x", "z"))}

    def transitions(self):
        def off_guard(t, q, u):
            return q[1] - 0.7

        def on_guard(t, q, u):
            return q[1] - 0.3

        return [
            hj.Transition("off", "on", "off", off_guard, "rising"),
            hj.Transition("on", "off", "on", on_guard, "falling"),
        ]


def stay(heat, rate, x, z, end):
    """How long it takes until z is `end`, and x then."""
    part = (x - heat) * rate / (rate - 1)  # of exp(-t) in z - heat

    def sensor(t):
        return heat + part * np.exp(-t) + (z - heat - part) * np.exp(-rate * t) - end  # noqa: E731

    t = brentq(sensor, 1e-2, 10.0, xtol=1e-15, rtol=1e-15)
    above = (x - heat) * np.exp(-t)
    return t, heat + above


def exact(fast=1e4, slow=5.0):
    """The period, and x where it is switched on."""
    on = 0.25
    for _ in range(8):
        heating, off = stay(1.0, fast, on, 0.3, 0.7)
        cooling, on = stay(0.0, slow, off, 0.7, 0.3)
    return heating + cooling, on


def by_differences(order):
    """Derivatives of the period by `slow`."""
    d = 0.02
    at = np.arange(-2, 3)
    values = [exact(slow=5.0 + d * k)[0] for k in at]
    of_order = {1: [1, -8, 0, 8, -1], 2: [-1, 16, -30, 16, -1]}
    weights = of_order[order]
    return np.dot(weights, values) / 12 / d**order


@pytest.fixture(scope="module")
def cycle():
    """(The longest time to wait for it follows from the slow modes.)"""
    guess = hj.Guess("on", (0.35, 0.3))
    return hj.find_limit_cycle(Thermostat(), guess, section=hj.AtEvent("on"))


@pytest.mark.slow
def test_the_cycle(cycle):
    period, x = exact()
    assert_allclose(cycle.period, period, rtol=1e-11)
    assert_allclose(cycle.state["x"], x, rtol=1e-11)
    assert_array_equal(cycle.multipliers, [0.0])


def period(cycle):
    return lambda slow: hj.find_limit_cycle(Thermostat(slow=slow), cycle).period


@pytest.mark.slow
def test_derivatives_under_all_transformations(cycle):
    slope = jax.jacfwd(period(cycle))
    values = jnp.array([5.0, 5.5])
    first = jax.jit(jax.vmap(slope))(values)
    assert_allclose(first[0], by_differences(1), rtol=1e-6)
    slope_of_period = jax.grad(period(cycle))
    backwards = jax.jit(slope_of_period)(5.5)
    assert_allclose(backwards, first[1], rtol=1e-8)
    slope = jax.jacfwd(period(cycle))
    twice = jax.jit(jax.jacfwd(slope))(5.0)
    assert_allclose(twice, by_differences(2), rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("start", ["cycle", "periodic", "steady"])
def test_experiments(cycle, start):
    events = [hj.AtEvent("on"), hj.AtEvent("off")]
    placed = hj.sections.place_sections(cycle, events)
    model = hj.linearize(cycle, placed, outputs="x")
    rng = np.random.default_rng(0)
    u = 1e-5 * rng.normal(size=(4, 16, 1))
    data = hj.run_experiments(
        cycle, placed, u, outputs="x", start=start, discard=0, accuracy=1e-12
    )
    assert (data.result == 0).all()
    x0 = np.zeros(2)
    if start != "cycle":
        x0 = model.periodic_state(u[0], 8)
    expected = model.simulate(u[0], x0)
    assert_allclose(data.y[0], expected, atol=1e-10)
    states = placed.lanes.q
    to_next = hj.sections.section_map(cycle, placed, 0, 1)
    found = to_next(states[:, 0]).q
    assert_allclose(found, states[:, 1], rtol=1e-10)
