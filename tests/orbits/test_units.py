"""Results do not depend on the units of length and time in which a system is written."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj

from ..conftest import APEX
from ..toys import RESTING, Field, hopper_in, toy


# Units of length and time, in those of the models.
UNITS = {"micrometers and milliseconds": (1e6, 1e3), "gigameters": (1e-9, 1.0)}
units = pytest.mark.parametrize(
    "unit",
    [
        "micrometers and milliseconds",
        pytest.param("gigameters", marks=pytest.mark.slow),
    ],
)
CLOCK = hj.ClockPhase(4, anchor=APEX)
FREQUENCIES = np.arange(0.1, 4.0, 0.4)


def dimensions(length, time):
    """What a state or an output is multiplied by, by its first letter; t, and the force."""
    speed = length / time
    return {"y": length, "x": length, "v": speed, "t": time, "force": speed / time}


def hopper_cycle_in(length, time):
    state = (2.0 * length, 1.9 * length / time)
    guess = hj.Guess("stance", state, 0.5 * time)
    return hj.find_limit_cycle(hopper_in(length, time), guess)


def relaxation_in(length, time):
    """Van der Pol's oscillator with a length and a time, and two states that rest: one that is
    zero, and one that rounding errors move."""

    def field(t, q, u):
        x, v, nothing, rounding = q
        damping = (1 - (x / length) ** 2) * v / time
        force = damping - x / time**2
        rounded = (x + length) - x
        still = (rounded - length - rounding) / time
        return v, force + u[0], -nothing / time, still

    chart = Field(("x", "v", "nothing", "rounding"), field)
    system = toy({"all": chart})
    guess = hj.Guess("all", (2.0 * length, 0.0, 0.0, 0.0))
    return hj.find_limit_cycle(system, guess)


@pytest.fixture(scope="module")
def relaxation():
    return relaxation_in(1.0, 1.0)


@units
def test_cycle_linearization_and_transfer_functions_of_the_hopper(hopper_cycle, unit):
    length, time = UNITS[unit]
    sizes = dimensions(length, time)
    cycle = hopper_cycle_in(length, time)
    assert cycle.result == hj.errors.Result.OK
    assert cycle.event_sequence == hopper_cycle.event_sequence
    assert cycle.iterations == hopper_cycle.iterations
    assert cycle.residual < 1e-12
    assert_allclose(cycle.multipliers, hopper_cycle.multipliers, rtol=1e-9)
    for name, scale in hopper_cycle.scale.items():
        size = sizes[name[0]]
        assert_allclose(cycle.scale[name], scale * size, rtol=1e-9)
        expected = hopper_cycle.state.get(name, 0.0) * size
        assert_allclose(cycle.state.get(name, 0.0), expected, rtol=1e-9)

    model = hj.linearize(hopper_cycle, CLOCK, ("yM", "vM"))
    other = hj.linearize(cycle, CLOCK, ("yM", "vM"))
    assert_allclose(other.multipliers, model.multipliers, rtol=1e-9)
    expected = model.htf(FREQUENCIES, (-1, 0, 1)).H
    found = other.htf(FREQUENCIES, (-1, 0, 1)).H
    for k, name in enumerate(model.outputs):
        unit = sizes[name[0]] / sizes["force"]
        largest = np.abs(expected[:, :, k]).max()
        tolerance = 1e-9 * largest
        in_units = found[:, :, k] / unit
        assert_allclose(in_units, expected[:, :, k], atol=tolerance)


@pytest.mark.slow
@units
def test_an_oscillator_without_a_clock(relaxation, unit):
    """The plane through the guess, its time to return, and the flow out of the multipliers."""
    length, time = UNITS[unit]
    cycle = relaxation_in(length, time)
    assert cycle.result == hj.errors.Result.OK
    assert_allclose(cycle.period / time, relaxation.period, rtol=1e-9)
    leading = cycle.multipliers[:2]
    assert_allclose(leading, relaxation.multipliers[:2], rtol=1e-9)


def test_states_that_rest_stop_nothing(relaxation):
    """Their sizes are 1 where nothing moves, and where rounding errors move a state, what hides
    these. Both have the multiplier exp(-period) of their decay."""
    truth = [8.59695063603805e-4, np.exp(-6.66328685932313), np.exp(-6.66328685932313)]
    found = np.sort_complex(relaxation.multipliers)
    assert_allclose(found, np.sort_complex(truth), rtol=1e-7)
    assert relaxation.scale["nothing"] == 1.0
    assert relaxation.scale["rounding"] > 1e-7


def test_a_state_that_rounding_moves_by_time_stops_nothing():
    amplitude = 1 / (4 - 9 + 3j)
    """Beside a damped oscillator under a clock."""
    for time in (0.0, 0.3):
        guess = hj.Guess("all", (0.0, 0.0, 0.0), time)
        cycle = hj.find_limit_cycle(RESTING, guess)
        assert cycle.scale["w"] > 1e-7
        x = (amplitude * np.exp(3j * time)).real
        assert_allclose(cycle.state["x"], x, rtol=1e-9)
        decay = np.sort(np.abs(cycle.multipliers))
        rates = np.array([1.0, 0.5, 0.5])
        truth = np.exp(-rates * 2 * np.pi / 3)
        assert_allclose(decay, truth, rtol=1e-9)


@pytest.mark.parametrize("factor", [100.0, 0.5])
@pytest.mark.slow
def test_sizes_that_are_given(hopper_cycle, factor):
    """Others follow from the cycle, not from those with which the search begins."""
    settings = hopper_cycle.settings
    settings = dataclasses.replace(settings, scale=factor * settings.scale)
    guess = dataclasses.replace(hopper_cycle, settings=settings)
    cycle = hj.find_limit_cycle(hopper_cycle.system, guess, scale={"ym": 5.0})
    assert cycle.residual < 1e-12
    assert dict(cycle.scale) == pytest.approx(
        hopper_cycle.scale | {"ym": 5.0}, rel=1e-9
    )
    assert_allclose(cycle.multipliers, hopper_cycle.multipliers, rtol=1e-9)
