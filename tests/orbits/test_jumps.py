"""A field that jumps, or has a pulse over which steps pass, is refused; others are not."""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

import hybridjax as hj
from hybridjax._core.meaning import current
from hybridjax.engine.unresolved import may_have_pulses, may_jump
from hybridjax.orbits.checks import check_jumps
from hybridjax.systems.structure import Structure


hj.enable_x64()
SLOW = pytest.mark.slow
RISES = hj.Crossing("x", "rising", value=0.3)


class Turning(hj.Chart):
    states = ("x", "v")
    further: Callable

    def field(self, t, q, u):
        x, v = q
        damping = (1 - x**2) * v
        force = damping - x + self.further(x)
        return v, force + u[0]


class Turns(hj.HybridSystem):
    further: Callable = eqx.field(static=True)

    def charts(self):
        return {"on": Turning(self.further)}

    def guess(self):
        return hj.Guess("on", (2.0, 0.0))


GRID = jnp.linspace(-2.5, 2.5, 12)


@pytest.fixture(scope="module")
def smooth():
    return hj.find_limit_cycle(Turns(lambda x: 0.0), section=RISES)


def is_refused(cycle, further):
    try:
        check_jumps(dataclasses.replace(cycle, system=current(Turns(further))))
    except hj.errors.DefinitionError as error:
        assert "test_jumps.py:" in str(error)
        return True
    return False


@pytest.mark.parametrize(
    "further",
    [
        lambda x: 1e-6 * jnp.mod(x, 1.0),
        lambda x: jnp.where(jnp.abs(x - 0.5) < 3e-4, 1e-2, 0.0),  # a narrow pulse
        pytest.param(
            lambda x: jax.lax.cond(
                x > 0, lambda: jnp.where(x > 0.7, 1e-6, 0.0), lambda: 0.0
            ),
            marks=SLOW,
        ),
        pytest.param(
            lambda x: 1e-6 * jnp.sin(GRID)[jnp.searchsorted(GRID, x)], marks=SLOW
        ),
        lambda x: 1e-4 * x / jnp.abs(x),
        lambda x: 1e-4 * jnp.tanh(1e11 * x),
        lambda x: 1e-3 * jnp.exp(-(((x - 0.5) / 1e-4) ** 2)),
        lambda x: 1e-3 * (1 + ((x - 0.5) / 1e-4) ** 2) ** -4,
    ],
)
@pytest.mark.slow
def test_a_jump_is_refused(smooth, further):
    assert is_refused(smooth, further)


@pytest.mark.parametrize(
    "further",
    [
        lambda x: (
            jnp.where(x > 0, 1e-3 * x, 0.0) + 1e-3 * jnp.abs(jnp.mod(x, 1.0) - 0.5)
        ),
        lambda x: 1e-6 * jnp.tanh(50 * x) + 1e-6 * x / jnp.sqrt(x**2 + 1e-4),
        pytest.param(lambda x: 1e-3 * jnp.interp(x, GRID, jnp.sin(GRID)), marks=SLOW),
    ],
)
@pytest.mark.slow
def test_a_continuous_field_is_not(smooth, further):
    assert not is_refused(smooth, further)


def test_a_mass_matrix_may_have_poles_only():
    biped = Structure(hj.models.FiveLinkBiped())
    assert may_have_pulses(biped, 0) == {"pole"}
    assert not may_jump(biped, 0)


@SLOW
def test_kinks_have_the_steps_that_they_need():
    kinked = hj.find_limit_cycle(
        Turns(lambda x: 1e-2 * jnp.interp(x, GRID, jnp.sin(GRID)))
    )
    assert kinked.result == hj.errors.Result.OK


def test_simulations_end_at_what_steps_pass_over():
    pulse = Turns(lambda x: jnp.exp(-(((x - 0.5) / 1e-4) ** 2)))

    def dip(t, q, u):
        distance = (t - 0.4321) / 1e-3
        return 1.0 - 2.0 * jnp.exp(-(distance**2))

    def dip_reset(t, q, u):
        return q

    event = hj.Transition("dip", "on", "on", dip, "falling", dip_reset)
    dips = type("Dips", (Turns,), {"transitions": lambda self: [event]})(lambda x: 0.0)
    for system in (pulse, dips):
        path = hj.simulate(system, "on", (2.0, -0.1), 6.0, throw=False)
        assert path.result == hj.errors.Result.PULSE_PASSED


def test_a_guard_without_derivative_does_not_pass_as_one_that_never_falls():
    def level(t, q, u):
        inside = jnp.maximum(0.5 - q[0], 0.0)
        return 1.5 + 0.1 * inside**0.0 - q[0]

    def stop_reset(t, q, u):
        return q

    event = hj.Transition("stop", "on", "on", level, "falling", stop_reset)
    stops = type("Stops", (Turns,), {"transitions": lambda self: [event]})(
        lambda x: 0.0
    )
    path = hj.simulate(stops, "on", (0.6, 2.0), 6.0, throw=False)
    assert path.result == hj.errors.Result.FIELD_NOT_FINITE


class Pushed(Turning):
    """The input acts in a short pulse, which its neighborhood of steps does not resolve."""

    def field(self, t, q, u):
        x, v = q
        distance = (t % 1.3 - 0.33) / 0.0055
        pulse = 0.4 * jnp.exp(-(distance**2))
        return v, -3 * x - 0.7 * v + 2 * jnp.cos(2 * jnp.pi * t / 1.3) + u[0] * (
            1 + pulse
        )


def test_a_pulse_in_the_gain_of_an_input_is_refused():
    make = {"charts": lambda self: {"on": Pushed(None)}, "period": lambda self: 1.3}
    system = type("Pushes", (Turns,), make)(None)
    with pytest.raises(
        hj.errors.DefinitionError, match="the gain from 'u' to the rate of 'v' .* pulse"
    ):
        hj.find_limit_cycle(system, hj.Guess("on", (1.0, 0.0)), settle=10.0)


class Switched(Turns):
    """A relay of a height that is zero in the first system."""

    height: hj.Parameter = hj.parameter(0.0)

    def charts(self):
        return {"on": Turning(lambda x: self.height * jnp.mod(x, 1.0))}


@SLOW
def test_a_jump_beside_a_cycle_without_one_is_refused():
    first = hj.find_limit_cycle(Switched(None), section=RISES)
    with pytest.raises(
        hj.errors.DefinitionError, match="has a pulse, a jump .*test_jumps.py"
    ):
        hj.continuation(first, "height", (0.0, 0.01))
    with pytest.raises(
        hj.errors.DefinitionError, match="has a pulse, a jump .*test_jumps.py"
    ):
        hj.orbits.find_limit_cycles(
            [Switched(None, x) for x in (0.0, 1e-3, 0.0)], guess=first
        )
