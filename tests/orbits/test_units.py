"""Results do not depend on the units of length and time in which a system is written."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj

from ..conftest import APEX
from ..toys import Field


# Units of length and time, in those of the models.
UNITS = {"micrometers and milliseconds": (1e6, 1e3), "gigameters": (1e-9, 1.0)}
units = pytest.mark.parametrize(
    "unit", ["micrometers and milliseconds", pytest.param("gigameters", marks=pytest.mark.slow)]
)
CLOCK = hj.ClockPhase(4, anchor=APEX)
FREQUENCIES = np.arange(0.1, 4.0, 0.4)


def dimensions(length, time):
    """What a state or an output is multiplied by, by its first letter; t, and the force."""
    speed = length / time
    return {"y": length, "x": length, "v": speed, "t": time, "force": speed / time}


def scaled_hopper(length, time, **changes):
    hopper = hj.models.VerticalHopper(**changes)
    force = length / time**2
    p = {
        "k": hopper.k / time**2, "b": hopper.b / time, "l0": hopper.l0 * length,
        "a": hopper.a * force, "g": hopper.g * force, "omega": hopper.omega / time,
    }  # fmt: skip
    return hj.models.VerticalHopper(m=hopper.m, M=hopper.M, retention=hopper.retention, **p)


def hopper_cycle_in(length, time):
    guess = hj.Guess("stance", (2.0 * length, 1.9 * length / time), 0.5 * time)
    return hj.find_limit_cycle(scaled_hopper(length, time), guess)


class Relaxation(hj.HybridSystem):
    """Van der Pol's oscillator with a length and a time, and two states that rest: one that is
    zero, and one that rounding errors move."""

    length: jax.Array = hj.parameter(1.0)
    time: jax.Array = hj.parameter(1.0)
    mu: jax.Array = hj.parameter(1.0)

    def charts(self):
        return {"all": Motion(self)}

    def guess(self):
        return hj.Guess("all", (2.0 * self.length, 0.0, 0.0, 0.0))


class Motion(hj.Chart):
    states = ("x", "v", "nothing", "rounding")
    system: Relaxation

    def field(self, t, q, u):
        x, v, nothing, rounding = q
        length, time, mu = self.system.length, self.system.time, self.system.mu
        force = mu * (1 - (x / length) ** 2) * v / time - x / time**2
        rest = (((x + length) - x) - length - rounding) / time
        return v, force + u[0], -nothing / time, rest


def relaxation_in(length, time):
    return hj.find_limit_cycle(Relaxation(length=length, time=time))


@pytest.fixture(scope="module")
def relaxation():
    return relaxation_in(1.0, 1.0)


@units
def test_cycle_linearization_and_transfer_functions_of_the_hopper(hopper_cycle, unit):
    length, time = UNITS[unit]
    sizes = dimensions(length, time)
    cycle = hopper_cycle_in(length, time)
    assert (cycle.result, cycle.event_sequence) == (hj.Result.OK, hopper_cycle.event_sequence)
    assert cycle.iterations == hopper_cycle.iterations and cycle.residual < 1e-12
    np.testing.assert_allclose(cycle.multipliers, hopper_cycle.multipliers, rtol=1e-9)
    for name, size in hopper_cycle.scale.items():
        np.testing.assert_allclose(cycle.scale[name], size * sizes[name[0]], rtol=1e-9)
        size = hopper_cycle.state.get(name, 0.0) * sizes[name[0]]
        np.testing.assert_allclose(cycle.state.get(name, 0.0), size, rtol=1e-9)
    model, other = (hj.linearize(x, CLOCK, ("yM", "vM")) for x in (hopper_cycle, cycle))
    np.testing.assert_allclose(other.multipliers, model.multipliers, rtol=1e-9)
    H, theirs = (x.htf(FREQUENCIES, (-1, 0, 1)).H for x in (model, other))
    for k, name in enumerate(model.outputs):
        mine, back = H[:, :, k], sizes["force"] / sizes[name[0]]
        np.testing.assert_allclose(theirs[:, :, k] * back, mine, atol=1e-9 * np.abs(mine).max())


@pytest.mark.slow
@units
def test_an_oscillator_without_a_clock(relaxation, unit):
    """The plane through the guess, its time to return, and the flow out of the multipliers."""
    length, time = UNITS[unit]
    cycle = relaxation_in(length, time)
    assert cycle.result == hj.Result.OK
    np.testing.assert_allclose(cycle.period / time, relaxation.period, rtol=1e-9)
    np.testing.assert_allclose(cycle.multipliers[:2], relaxation.multipliers[:2], rtol=1e-9)


def test_states_that_rest_stop_nothing(relaxation):
    """Their sizes are 1 where nothing moves, and where rounding errors move a state, what hides
    these. Both have the multiplier exp(-period) of their decay."""
    truth = [8.59695063603805e-4, np.exp(-6.66328685932313), np.exp(-6.66328685932313)]
    found = np.sort_complex(relaxation.multipliers)
    np.testing.assert_allclose(found, np.sort_complex(truth), rtol=1e-7)
    assert relaxation.scale["nothing"] == 1.0 and relaxation.scale["rounding"] > 1e-7


class Shaken(hj.HybridSystem):
    """A damped oscillator under a clock, beside a state that only rounding moves, by time."""

    def charts(self):
        def field(t, q, u):
            beat = jnp.cos(3 * t)
            rounding = (1 + 0.1 * beat) * 3 - 3 - 0.3 * beat
            return q[1], -q[0] - 0.2 * q[1] + beat, rounding - q[2]

        return {"all": Field(("x", "v", "w"), field)}

    def period(self):
        return 2 * np.pi / 3


def test_a_state_that_rounding_moves_by_time_stops_nothing():
    amplitude = 1 / (1 - 9 + 0.6j)
    for time in (0.0, 0.3):
        cycle = hj.find_limit_cycle(Shaken(), hj.Guess("all", (0.0, 0.0, 0.0), time))
        assert cycle.scale["w"] > 1e-7
        x = (amplitude * np.exp(3j * time)).real
        np.testing.assert_allclose(cycle.state["x"], x, rtol=1e-9)
        decay = np.sort(np.abs(cycle.multipliers))
        truth = np.exp(-np.array([1.0, 0.1, 0.1]) * 2 * np.pi / 3)
        np.testing.assert_allclose(decay, truth, rtol=1e-9)


def test_sizes_that_are_given(hopper_cycle):
    cycle = hj.find_limit_cycle(hopper_cycle.system, hopper_cycle, scale={"ym": 5.0})
    assert cycle.scale["ym"] == 5.0
    np.testing.assert_allclose(cycle.scale["yM"], hopper_cycle.scale["yM"], rtol=1e-9)
    np.testing.assert_allclose(cycle.multipliers, hopper_cycle.multipliers, rtol=1e-9)
