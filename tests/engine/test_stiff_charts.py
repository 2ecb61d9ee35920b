"""A stiff chart beside one that is not, against a closed form.

A room is heated until its sensor shows 0.7, and cools until it shows 0.3. The sensor follows at
once while the room is heated, and slowly while it cools.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import hybridjax as hj
from hybridjax.engine.events import start_lanes
from hybridjax.engine.move import move
from hybridjax.engine.target import until
from hybridjax.systems.structure import Structure


class Room(hj.Chart):
    states = ("x", "z")
    heat: float
    rate: hj.Parameter

    def field(self, t, q, u):
        x, z = q
        return self.heat - x + u[0], self.rate * (x - z)


class Heated(Room):
    solver = hj.Radau()


class Thermostat(hj.HybridSystem):
    fast: hj.Parameter = hj.parameter(1e4)
    slow: hj.Parameter = hj.parameter(5.0)

    def charts(self):
        return {"on": Heated(1.0, self.fast), "off": Room(0.0, self.slow)}

    def transitions(self):
        return [
            hj.Transition("off", "on", "off", lambda t, q, u: q[1] - 0.7, "rising"),
            hj.Transition("on", "off", "on", lambda t, q, u: q[1] - 0.3, "falling"),
        ]


def stay(heat, rate, x, z, end):
    """How long it takes until z is `end`, and x then."""
    part = (x - heat) * rate / (rate - 1)  # of exp(-t) in z - heat
    sensor = lambda t: heat + part * np.exp(-t) + (z - heat - part) * np.exp(-rate * t) - end  # noqa: E731
    t = brentq(sensor, 1e-2, 10.0, xtol=1e-15, rtol=1e-15)
    return t, heat + (x - heat) * np.exp(-t)


def exact(fast=1e4, slow=5.0):
    """The period, and x where it is switched on."""
    on = 0.25
    for _ in range(8):
        heating, off = stay(1.0, fast, on, 0.3, 0.7)
        cooling, on = stay(0.0, slow, off, 0.7, 0.3)
    return heating + cooling, on


@pytest.fixture(scope="module")
def cycle():
    """(The longest time to wait for it follows from the slow modes.)"""
    guess = hj.Guess("on", (0.35, 0.3))
    return hj.find_limit_cycle(Thermostat(), guess, section=hj.AtEvent("on"))


def test_the_cycle(cycle):
    period, x = exact()
    np.testing.assert_allclose(cycle.period, period, rtol=1e-11)
    np.testing.assert_allclose(cycle.state["x"], x, rtol=1e-11)
    np.testing.assert_array_equal(cycle.multipliers, [0.0])


@pytest.mark.slow
def test_a_sweep(cycle):
    slow = np.array([4.0, 5.0, 7.0])
    found = hj.find_limit_cycles([Thermostat(slow=x) for x in slow], cycle)
    np.testing.assert_allclose(found.period, [exact(slow=x)[0] for x in slow], rtol=1e-8)


class Counted(Thermostat):
    """Says whenever the field of the stiff chart is evaluated."""

    say: object = eqx.field(static=True, default=None)

    def charts(self):
        said = self.say

        class Loud(Heated):
            def field(self, t, q, u):
                jax.debug.callback(said)
                return super().field(t, q, u)

        return {"on": Loud(1.0, self.fast), "off": Room(0.0, self.slow)}


def test_a_stiff_chart_costs_only_where_lanes_are():
    count = []
    s = Structure(Counted(say=lambda: count.append(1)))

    @jax.jit
    def run(chart):
        q, t = jnp.array([[0.6, 0.65], [0.5, 0.55]]), jnp.zeros(2)
        lanes = start_lanes(s, t, chart, q)
        settings = hj.Settings(1e-6, 1e-6, scale=np.ones((2, 2)))
        return move(s, lanes, jnp.zeros((1, 2)), until(t + 0.05), settings).result

    for chart, visited in ((1, False), (0, True)):
        np.testing.assert_array_equal(run(np.full(2, chart, np.int32)), 0)
        jax.effects_barrier()
        assert bool(count) == visited
