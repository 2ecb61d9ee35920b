"""Searches that fail name their true cause."""

import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj

from ..toys import Blowup, Field


class Balls(hj.HybridSystem):
    """Two balls on one shaken table, each with a retention of its own."""

    other: hj.Parameter = hj.parameter(0.7)

    def charts(self):
        field = lambda t, q, u: (q[1], -9.81, q[3], -9.81)  # noqa: E731
        return {"air": Field(("y0", "v0", "y1", "v1"), field)}

    def transitions(self):
        A, w = 0.15, 2 * jnp.pi

        def impact(k, retention):
            def guard(t, q, u):
                return q[2 * k] - A * jnp.sin(w * t)

            def reset(t, q, u):
                v = -retention * q[2 * k + 1] + (1 + retention) * A * w * jnp.cos(w * t)
                return jnp.asarray(q).at[2 * k + 1].set(v)

            return hj.Transition(f"impact{k}", "air", "air", guard, reset=reset)

        return impact(0, 0.7), impact(1, self.other)

    def period(self):
        return 1.0


class Friction(hj.HybridSystem):
    """An oscillator with dry friction, whose field jumps where v changes its sign."""

    def charts(self):
        def field(t, q, u):
            x, v = q
            return v, -x - 0.3 * jnp.sign(v) + jnp.sin(2 * t)

        return {"slide": Field(("x", "v"), field)}

    def period(self):
        return jnp.pi


class WrongWay(hj.HybridSystem):
    """A ball that falls through its floor, whose guard should rise."""

    def charts(self):
        return {"air": Field(("y", "v"), lambda t, q, u: (q[1], -1.0))}

    def transitions(self):
        guard = lambda t, q, u: q[0] - 0.1 * jnp.sin(2 * jnp.pi * t)  # noqa: E731
        return [hj.Transition("impact", "air", "air", guard, "rising", lambda t, q, u: q)]

    def period(self):
        return 1.0


class Damped(hj.HybridSystem):
    """A pushed mass on a spring with a dashpot that is much too strong."""

    def charts(self):
        force = lambda t, q: -1e5 * q[0] - 3e3 * q[1] + 20 * jnp.sin(2 * jnp.pi * t)  # noqa: E731
        return {"a": Field(("y", "v"), lambda t, q, u: (q[1], force(t, q)))}

    def period(self):
        return 1.0


BALLS = hj.Guess("air", (0.1, 4.7, 0.1, 4.7), 0.1)


def test_events_that_coincide():
    with pytest.raises(hj.ComputationError, match="'impact.' and 'impact.' coincide"):
        hj.find_limit_cycle(Balls(), BALLS)
    assert hj.find_limit_cycle(Balls(), BALLS, throw=False).result == hj.Result.COINCIDENCE


def test_events_that_nearly_coincide():
    """The multipliers of the second ball, in closed form (Holmes 1982), with e = 0.701."""
    cycle = hj.find_limit_cycle(Balls(0.701), BALLS)
    e, g, A, w = 0.701, 9.81, 0.15, 2 * np.pi
    # It lands where the table's speed is (1 - e) / (1 + e) g / 2.
    phase = np.arccos((1 - e) / (1 + e) * g / 2 / (A * w))
    trace = 1 + e**2 - (1 + e) ** 2 * A * w**2 * np.sin(phase) / g
    pair = np.roots([1, -trace, e**2])
    distance = np.abs(cycle.multipliers[:, None] - pair).min(axis=0)
    assert distance.max() < 1e-9


@pytest.mark.parametrize(
    "system, guess, message",
    [
        pytest.param(
            Friction(),
            (0.3, 0.0),
            r"field that jumps .* guard .*It stopped at t = ",
            marks=pytest.mark.slow,
        ),
        (WrongWay(), (0.2, 0.5), "No event happened: the guard of 'impact', which should be risin"),
        (Damped(), (0.0, 0.0), r'is stiff: a mode decays .*solver="auto".*max_steps'),
    ],
)
def test_causes(system, guess, message):
    chart = next(iter(system.charts()))
    with pytest.raises(hj.ComputationError, match=message):
        hj.find_limit_cycle(system, hj.Guess(chart, guess))


def test_a_field_that_jumps_is_told_from_one_that_blows_up():
    jump = hj.simulate(Friction(), "slide", (0.3, 0.5), 10.0, throw=False)
    assert jump.result == hj.Result.STEP_COLLAPSE
    assert hj.simulate(Blowup(), "x", (1.0,), 2.0, throw=False).result == hj.Result.BLOW_UP


def test_a_section_that_is_not_met_again_in_time():
    with pytest.raises(hj.ComputationError, match="allow more time than 1, by `max_period`"):
        hj.find_limit_cycle(
            hj.models.VanDerPol(), section=hj.Crossing("v", "falling"), max_period=1.0
        )
