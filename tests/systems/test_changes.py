"""Answers follow the code that a notebook has now, and a function that uses the time is found."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj

from ..toys import Field


hj.enable_x64()
DRAG = 0.7
SECTIONS, DESIGN = hj.ClockPhase(2), hj.multisine(2, periods=4).scaled(rms=0.01)
TURN = hj.Crossing("v", "falling")
drag = jax.jit(lambda speed: -DRAG * speed)  # whose trace JAX keeps


class Slowed(hj.HybridSystem):
    wind: hj.Parameter = hj.parameter(0.0)

    def period(self):
        return 1.0

    def charts(self):
        slows = lambda t, q, u: (drag(q[0]) + jnp.cos(2 * jnp.pi * t) + u[0],)  # noqa: E731
        return {"air": Field(("x",), slows)}

    def guess(self):
        return hj.Guess("air", (0.1,))


def test_a_constant_of_the_notebook_is_changed(monkeypatch):
    for value in (0.7, 1.3, 0.7):
        monkeypatch.setitem(globals(), "DRAG", value)
        cycle = hj.find_limit_cycle(Slowed())
        model = hj.linearize(cycle, SECTIONS, "x")
        for multipliers in (cycle.multipliers, model.multipliers):
            np.testing.assert_allclose(multipliers, [np.exp(-value)], rtol=1e-9)
        end = hj.simulate(Slowed(), "air", (1.0,), 1.0).after[-1]
        start = hj.simulate(Slowed(), "air", (0.0,), 1.0).after[-1]
        np.testing.assert_allclose(end - start, np.exp(-value), rtol=1e-7)


def test_functions_that_are_made_anew_have_traces_of_their_own(monkeypatch):
    def made():
        drag = jax.jit(lambda speed: -DRAG * speed)
        drag(jnp.ones(1)[0])  # a call by the user

        class Anew(hj.HybridSystem):
            period = lambda self: 1.0  # noqa: E731
            charts = lambda self: {"air": Field(("x",), lambda t, q, u: (drag(q[0]),))}  # noqa: E731

        return Anew()

    first, second = made(), made()
    for system, value in ((first, 0.7), (second, 1.3), (second, 0.7)):
        monkeypatch.setitem(globals(), "DRAG", value)
        cycle = hj.find_limit_cycle(system, hj.Guess("air", (0.0,)))
        np.testing.assert_allclose(cycle.multipliers, [np.exp(-value)], rtol=1e-9)


@pytest.mark.parametrize(
    "use",
    [
        lambda cycle: hj.linearize(cycle, SECTIONS, "x"),
        lambda cycle: hj.run_experiments(cycle, SECTIONS, DESIGN, "x"),
        lambda cycle: hj.continuation(cycle, "wind", (0.0, 0.1)),
        lambda cycle: hj.response_function(cycle, SECTIONS, "x"),
        lambda cycle: cycle.trajectory(),
        lambda cycle: cycle.multipliers,
        lambda cycle: hj.spectral_radius(cycle),
    ],
)
def test_a_cycle_belongs_to_the_code_as_it_was(use, monkeypatch):
    cycle = hj.find_limit_cycle(Slowed())
    blown = eqx.tree_at(lambda x: x.system.wind, cycle, jnp.asarray(0.5))
    assert "find it again" in repr(blown)
    with pytest.raises(
        hj.DefinitionError, match="`wind` of Slowed has changed since this limit"
    ):
        use(blown)
    monkeypatch.setitem(globals(), "DRAG", 1.3)
    with pytest.raises(
        hj.DefinitionError, match="the field of chart 'air' of Slowed has changed since"
    ):
        use(cycle)
    assert hj.find_limit_cycle(Slowed(), cycle).stable  # (as a guess it will do)


def test_a_parameter_inside_of_a_cycle_is_not_differentiated():
    cycle = hj.find_limit_cycle(Slowed())

    def decay(wind):
        return hj.linearize(
            eqx.tree_at(lambda x: x.system.wind, cycle, wind), SECTIONS
        ).A[0, 0, 0]

    for transform in (jax.jit, jax.grad, jax.vmap):
        with pytest.raises(hj.DefinitionError, match="find it again"):
            transform(decay)(jnp.zeros(1 if transform is jax.vmap else ()))
    model = eqx.filter_jit(hj.linearize)(hj.find_limit_cycle(Slowed()), SECTIONS)
    np.testing.assert_allclose(model.A[:, 0, 0], np.exp(-DRAG / 2), rtol=1e-9)


def test_the_advice_to_find_a_changed_cycle_again_holds(hopper_cycle):
    changed = eqx.tree_at(lambda x: x.system.k, hopper_cycle, jnp.asarray(20.0))
    with pytest.raises(hj.DefinitionError, match="with this one as the guess"):
        changed.trajectory()
    again, other = (
        hj.find_limit_cycle(changed.system, x) for x in (changed, hopper_cycle)
    )
    np.testing.assert_allclose(again.multipliers, other.multipliers, rtol=1e-9)


def test_what_was_made_before_follows_the_code_or_is_refused(monkeypatch):
    cycle = hj.find_limit_cycle(Slowed(), settings=hj.Settings(solver=hj.Radau()))
    assert len(cycle.trajectory().t) > 2  # another solver is no other code
    response = hj.response_function(cycle, SECTIONS, "x")
    chunks = hj.experiments.stream_experiments(cycle, SECTIONS, DESIGN, "x", chunk=1)
    force = lambda t: DRAG * jnp.cos(t)  # noqa: E731
    ends = []
    for drag in (0.7, 1.3):
        monkeypatch.setitem(globals(), "DRAG", drag)
        ends.append(
            hj.simulate(Turns(), "on", (0.0, 0.0), 0.1, input=force).after[-1, 1]
        )
    np.testing.assert_allclose(ends[1], ends[0] * 1.3 / 0.7, rtol=1e-2)
    for use in (lambda: response(DESIGN.inputs(cycles=1)), lambda: next(chunks)):
        with pytest.raises(
            hj.DefinitionError,
            match="the field of chart 'air' of Slowed has changed since",
        ):
            use()


class Turns(hj.HybridSystem):
    """Van der Pol's oscillator, pushed by a pulse that 16 samples of a period miss."""

    push: hj.Parameter = hj.parameter(0.0)
    gain: hj.Parameter = hj.parameter(0.0)

    def charts(self):
        def field(t, q, u):
            pulse = jnp.exp(-(((t % 5.0 - 2.5) / 0.004) ** 2))
            force = self.push * pulse + (1 + self.gain * pulse) * u[0]
            return q[1], (1 - q[0] ** 2) * q[1] - q[0] + force

        return {"on": Field(("x", "v"), field)}

    def guess(self):
        return hj.Guess("on", (2.0, 0.0))


@pytest.mark.parametrize(
    "search",
    [
        lambda guess: hj.find_limit_cycle(Turns(gain=0.1), section=TURN),
        lambda guess: hj.find_limit_cycles(
            [Turns(push=0.1), Turns(push=0.2)], guess=guess
        ),
        lambda guess: hj.sweep(Turns(), {"push": [0.1, 0.2]}, guess=guess),
    ],
)
def test_time_without_a_period_is_refused(search, vanderpol_cycle):
    with pytest.raises(
        hj.DefinitionError, match=r"depends on t, but Turns states no period"
    ):
        search(vanderpol_cycle)


class Pushed(Slowed):
    """The input acts with another period than the clock's."""

    def charts(self):
        return {
            "air": Field(("x",), lambda t, q, u: (-q[0] + u[0] * jnp.cos(1.3 * t),))
        }


def test_the_gain_of_an_input_has_the_clocks_period():
    with pytest.raises(
        hj.DefinitionError, match=r"does not have the period 1 that Pushed.period"
    ):
        hj.find_limit_cycle(Pushed())
