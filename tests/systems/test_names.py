"""States, inputs and outputs share one space of names."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj


ANGULAR = 1.3
PUSH = 0.2


class Plane(hj.Chart):
    """A radial oscillator, whose second state has any name; the input pushes the first."""

    states = ("x", "u")

    def field(self, t, q, u):
        x, y = q
        growth = 1 - x**2 - y**2
        turn = ANGULAR * y
        x_rate = growth * x - turn + u[0]
        y_rate = growth * y + ANGULAR * x
        return x_rate, y_rate


class Oscillator(hj.HybridSystem):
    def charts(self):
        return {"plane": Plane()}


class Named(Oscillator):
    inputs = ("force",)


class Clashing(Oscillator):
    inputs = ("u",)


class Shadowed(hj.HybridSystem):
    """An output that is called as the default input is."""

    def charts(self):
        return {"plane": Renamed()}

    def outputs(self):
        return [hj.Output("u", lambda t, q, u: q[0] + q[1])]


class Renamed(Plane):
    states = ("x", "y")


START = hj.Guess("plane", (1.0, 0.0))
FORWARD = hj.Crossing("x", "rising")


def _cycle(system):
    return hj.find_limit_cycle(system, START, section=FORWARD)


def test_the_default_input_yields_to_a_state_of_its_name():
    cycle = _cycle(Oscillator())
    named = _cycle(Named())
    assert Oscillator().inputs == cycle.system.inputs == ("input",)
    phase = np.array([0.1, 0.4, 0.8])
    responses = cycle.responses().phase(phase)
    expected = named.responses().phase(phase)
    assert list(responses) == ["x", "u", "input"]
    # At the angle a of the unit circle, the angle changes by -sin(a) dx + cos(a) du.
    angle = 2 * np.pi * phase - np.pi / 2
    assert_allclose(responses["u"], np.cos(angle) / ANGULAR, atol=1e-9)
    expected_input = -np.sin(angle) / ANGULAR
    assert_allclose(responses["input"], expected_input, atol=1e-9)
    assert_allclose(responses["u"], expected["u"], rtol=1e-12)
    # White noise of the state and of the input are two things, with equal effects here.
    diffusion = PUSH**2 / 2 / ANGULAR**2
    for name in ("u", "input"):
        noisy = cycle.fluctuations(white={name: PUSH})
        assert_allclose(noisy.diffusion, diffusion, rtol=1e-9)
    model = hj.linearize(cycle, hj.KinematicPhase(4, "x", "u"), outputs=("u",))
    assert model.inputs == ("input",)
    assert model.outputs == ("u",)
    pushed = hj.simulate(Oscillator(), "plane", (1.0, 0.0), 1.0, input=jnp.cos)
    expected = hj.simulate(Named(), "plane", (1.0, 0.0), 1.0, input=jnp.cos)
    assert_array_equal(pushed.after, expected.after)


def test_the_default_input_yields_to_an_output_of_its_name():
    cycle = _cycle(Shadowed())
    model = hj.linearize(cycle, hj.KinematicPhase(4, "x", "y"), outputs=("u",))
    assert model.inputs == ("input",)
    assert model.outputs == ("u",)


def test_an_input_with_the_name_of_a_state_or_an_output_is_refused():
    class Output(Shadowed):
        inputs = ("u",)

    class Absent(hj.HybridSystem):
        inputs = ("m",)

        def charts(self):
            class Lacking(Renamed):
                absent = {"m": 0.0}  # noqa: RUF012

            return {"plane": Lacking()}

    for system in (Clashing(), Output(), Absent()):
        with pytest.raises(
            hj.errors.DefinitionError, match="give the input another name"
        ):
            _cycle(system)
        with pytest.raises(
            hj.errors.DefinitionError, match="give the input another name"
        ):
            hj.simulate(system, "plane", (1.0, 0.0), 1.0)


def test_an_output_of_a_call_with_the_name_of_a_state_or_an_input_is_refused():
    cycle = _cycle(Named())
    phase = hj.KinematicPhase(4, "x", "u")

    def twice(t, q, u):
        return 2 * q[0]

    with pytest.raises(hj.errors.DefinitionError, match="'x' has the name of a state"):
        hj.linearize(cycle, phase, outputs=(hj.Output("x", twice),))
    with pytest.raises(
        hj.errors.DefinitionError, match="'force' is an input and a state or"
    ):
        hj.linearize(cycle, phase, outputs=(hj.Output("force", twice),))


def test_charts_may_ask_for_the_inputs_of_their_system():
    class Asked(Oscillator):
        def charts(self):
            assert len(self.inputs) == 1
            return {"plane": Plane()}

    assert Asked().inputs == ("input",)
    assert hj.HybridSystem.inputs == Asked.inputs == ("u",)
