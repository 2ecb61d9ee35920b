"""Searches that fail name their true cause."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj
from hybridjax.orbits import newton

from ..toys import Field, toy


class Balls(hj.HybridSystem):
    """Two balls on one shaken table, each with a retention of its own."""

    other: hj.Parameter = hj.parameter(0.7)
    coupling: hj.Parameter = hj.parameter(0.0)

    def charts(self):
        def field(t, q, u):
            return (q[1], -9.81, q[3], -9.81)

        return {"air": Field(("y0", "v0", "y1", "v1"), field)}

    def transitions(self):
        A = 0.15
        w = 2 * jnp.pi

        def impact(k, retention):
            def guard(t, q, u):
                table = A * jnp.sin(w * t)
                return q[2 * k] - table

            def reset(t, q, u):
                kept = -retention * q[2 * k + 1]
                table_speed = A * w * jnp.cos(w * t)
                v = kept + (1 + retention) * table_speed
                table_height = A * jnp.sin(w * t)
                height = q[2 - 2 * k] - table_height  # of the other ball
                place = 2 * k + 1
                q = jnp.asarray(q).at[place].set(v)
                change = self.coupling * height
                return q.at[2 * k + 1].add(change)

            return hj.Transition(f"impact{k}", "air", "air", guard, reset=reset)

        return impact(0, 0.7), impact(1, self.other)

    def period(self):
        return 1.0


# A ball that falls through its floor, whose guard should rise.
def above_floor(t, q, u):
    wave = jnp.sin(2 * jnp.pi * t)
    return q[0] - 0.1 * wave


def air_rates(t, q, u):
    return (q[1], -1.0)


def impact_reset(t, q, u):
    return q


WRONG_WAY = toy(
    {"air": Field(("y", "v"), air_rates)},
    [hj.Transition("impact", "air", "air", above_floor, "rising", impact_reset)],
    period=1.0,
)


# A pushed mass on a spring with a dashpot that is much too strong.
def force(t, q):
    spring = -1e5 * q[0] - 3e3 * q[1]
    table = jnp.sin(2 * jnp.pi * t)
    return spring + 20 * table


def rates(t, q, u):
    return (q[1], force(t, q))


DAMPED = toy({"a": Field(("y", "v"), rates)}, period=1.0)
BALLS = hj.Guess("air", (0.1, 4.7, 0.1, 4.7), 0.1)


@pytest.mark.parametrize("by_rough_turns", [True, False])
@pytest.mark.slow
def test_events_that_coincide_in_either_order(by_rough_turns, monkeypatch):
    """Balls that know nothing of each other: twice the multipliers of one, also if the search puts
    both impacts at the same time to the last bit."""
    if not by_rough_turns:
        no_turn = (None, 0, None)
        monkeypatch.setattr(newton, "_by_rough_turns", lambda map, x: (x, *no_turn))
    cycle = hj.find_limit_cycle(Balls(), BALLS)
    (both,) = cycle.simultaneous_events()
    assert both.commute
    assert set(both.orders) == {
        ("impact0", "impact1"),
        ("impact1", "impact0"),
    }
    z = 0.399920196836063 + 0.574511824214789j
    assert_allclose(cycle.multipliers.real, [z.real] * 4, rtol=1e-7)
    frequencies = np.abs(cycle.multipliers.imag)
    assert_allclose(frequencies, [z.imag] * 4, rtol=1e-7)


def test_events_whose_order_matters_have_a_derivative_for_each():
    """A ball that lands is pushed in proportion to the height of the other, which is zero."""
    system = Balls(coupling=0.5)
    begin = hj.find_limit_cycle(Balls(), BALLS)
    with pytest.raises(
        hj.errors.ComputationError, match="'impact.' and 'impact.' coincide"
    ):
        hj.find_limit_cycle(system, begin)
    cycle = hj.find_limit_cycle(system, begin, throw=False)
    assert cycle.result == hj.errors.Result.SIMULTANEOUS
    (both,) = cycle.simultaneous_events()
    assert not both.commute

    # The balls from half a tenth of a second before the impacts to as long after them.
    half = 0.05
    orbit = cycle.trajectory(2.0)
    is_late = orbit.t > both.time - 1e-6
    is_impact = (orbit.event >= 0) & is_late
    row = np.flatnonzero(is_impact)[0]
    y, v = orbit.before[row, :2]
    fallen = 9.81 * half**2 / 2
    height = y - v * half - fallen
    ball = [height, v + 9.81 * half]
    start = np.array([*ball, *ball])
    fall = np.kron(np.eye(2), [[1.0, half], [0.0, 1.0]])

    def ends(q):
        path = hj.simulate(system, "air", q, 2 * half, time=both.time - half)
        return path.after[-1]

    for order, derivative in zip(both.orders, both.derivatives, strict=True):
        first = int(order[0][-1])
        step = np.zeros(4)
        step[2 * first] = -1e-6  # this ball is lower, and lands first
        change = ends(start + step) - ends(start)
        expected = fall @ derivative @ fall @ step
        assert_allclose(change / 1e-6, expected / 1e-6, atol=1e-4)


@pytest.mark.parametrize(
    "system, guess, message, steps",
    [
        (
            WRONG_WAY,
            (0.2, 0.5),
            "'impact', which should be rising, began past zero, at",
            100,
        ),
        (
            DAMPED,
            (0.0, 0.0),
            r'it from 100 .*\. The system is stiff: a mode .*solver="auto"',
            100,
        ),
        pytest.param(
            hj.models.VerticalHopper(k=1e7),
            (2.0, 1.9),
            r"256 \(reached.* of 1\).* `settle=60`",
            256,
            marks=pytest.mark.slow,
        ),
    ],
)
def test_causes(system, guess, message, steps):
    *_, chart = system.charts()
    with pytest.raises(hj.errors.ComputationError, match=message):
        hj.find_limit_cycle(
            system, hj.Guess(chart, guess), settings=hj.orbits.Settings(max_steps=steps)
        )
