"""Answers follow the code that a notebook has now, and a function that uses the time is found."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj

from ..toys import Field


hj.enable_x64()
DRAG = 0.7
SECTIONS = hj.ClockPhase(2)
DESIGN = hj.multisine(2, periods=4).scaled(rms=0.01)
TURN = hj.Crossing("v", "falling")
drag = jax.jit(lambda speed: -DRAG * speed)  # whose trace JAX keeps


class Slowed(hj.HybridSystem):
    wind: hj.Parameter = hj.parameter(0.0)

    def period(self):
        return 1.0

    def charts(self):
        def slows(t, q, u):
            wave = jnp.cos(2 * jnp.pi * t)
            return (drag(q[0]) + wave + u[0],)

        return {"air": Field(("x",), slows)}

    def guess(self):
        return hj.Guess("air", (0.1,))


def test_a_constant_of_the_notebook_is_changed(monkeypatch):
    for value in (0.7, 1.3, 0.7):
        monkeypatch.setitem(globals(), "DRAG", value)
        cycle = hj.find_limit_cycle(Slowed())
        model = hj.linearize(cycle, SECTIONS, "x")
        for multipliers in (cycle.multipliers, model.multipliers):
            assert_allclose(multipliers, [np.exp(-value)], rtol=1e-9)
        fall = hj.simulate(Slowed(), "air", (1.0,), 1.0)
        end = fall.after[-1]
        rise = hj.simulate(Slowed(), "air", (0.0,), 1.0)
        start = rise.after[-1]
        assert_allclose(end - start, np.exp(-value), rtol=1e-7)


def test_a_constant_of_functions_of_which_a_system_is_made_is_changed(monkeypatch):
    slowed = hj.HybridSystem.from_functions(("x",), lambda t, q, u, p: (-DRAG * q[0],))
    start = hj.Guess("main", (1.0,))
    for value in (0.7, 1.3, 0.7):
        monkeypatch.setitem(globals(), "DRAG", value)
        found = hj.flow(slowed, start, 1.0).state
        assert_allclose(found, [np.exp(-value)], rtol=1e-9)
        end = hj.simulate(slowed, start, 1.0).after[-1]
        assert_allclose(end, [np.exp(-value)], rtol=1e-7)


def test_functions_that_are_made_anew_have_traces_of_their_own(monkeypatch):
    def made():
        drag = jax.jit(lambda speed: -DRAG * speed)
        drag(jnp.ones(1)[0])  # a call by the user

        class Anew(hj.HybridSystem):
            def period(self):
                return 1.0

            def charts(self):
                def air_rates(t, q, u):
                    return (drag(q[0]),)

                return {"air": Field(("x",), air_rates)}

        return Anew()

    first = made()
    second = made()
    for system, value in ((first, 0.7), (second, 1.3), (second, 0.7)):
        monkeypatch.setitem(globals(), "DRAG", value)
        cycle = hj.find_limit_cycle(system, hj.Guess("air", (0.0,)))
        assert_allclose(cycle.multipliers, [np.exp(-value)], rtol=1e-9)


@pytest.mark.parametrize(
    "use",
    [
        lambda cycle: hj.linearize(cycle, SECTIONS, "x"),
        lambda cycle: hj.run_experiments(cycle, SECTIONS, DESIGN, "x"),
        lambda cycle: hj.continuation(cycle, "wind", (0.0, 0.1)),
        lambda cycle: hj.experiments.response_function(cycle, SECTIONS, "x"),
        lambda cycle: cycle.trajectory(),
        lambda cycle: cycle.multipliers,
        lambda cycle: hj.fitting.spectral_radius(cycle),
    ],
)
def test_a_cycle_belongs_to_the_code_as_it_was(use, monkeypatch):
    cycle = hj.find_limit_cycle(Slowed())
    blown = eqx.tree_at(lambda x: x.system.wind, cycle, jnp.asarray(0.5))
    assert "find it again" in repr(blown)
    with pytest.raises(
        hj.errors.DefinitionError, match="`wind` of Slowed has changed since this limit"
    ):
        use(blown)
    monkeypatch.setitem(globals(), "DRAG", 1.3)
    with pytest.raises(
        hj.errors.DefinitionError,
        match="the field of chart 'air' of Slowed has changed since",
    ):
        use(cycle)
    assert hj.find_limit_cycle(Slowed(), cycle).is_stable  # (as a guess it will do)


def test_a_parameter_inside_of_a_cycle_is_not_differentiated():
    cycle = hj.find_limit_cycle(Slowed())

    def decay(wind):
        windy = eqx.tree_at(lambda x: x.system.wind, cycle, wind)
        ldtp = hj.linearize(windy, SECTIONS)
        return ldtp.A[0, 0, 0]

    for transform in (jax.jit, jax.grad, jax.vmap):
        with pytest.raises(hj.errors.DefinitionError, match="find it again"):
            shape = 1 if transform is jax.vmap else ()
            transform(decay)(jnp.zeros(shape))
    model = eqx.filter_jit(hj.linearize)(hj.find_limit_cycle(Slowed()), SECTIONS)
    expected = np.exp(-DRAG / 2)
    assert_allclose(model.A[:, 0, 0], expected, rtol=1e-9)


@pytest.mark.slow
def test_the_advice_to_find_a_changed_cycle_again_holds(hopper_cycle):
    changed = eqx.tree_at(lambda x: x.system.k, hopper_cycle, jnp.asarray(20.0))
    with pytest.raises(hj.errors.DefinitionError, match="with this one as the guess"):
        changed.trajectory()
    again = hj.find_limit_cycle(changed.system, changed)
    other = hj.find_limit_cycle(changed.system, hopper_cycle)
    assert_allclose(again.multipliers, other.multipliers, rtol=1e-9)


@pytest.mark.slow
def test_what_was_made_before_follows_the_code_or_is_refused(monkeypatch):
    cycle = hj.find_limit_cycle(
        Slowed(), settings=hj.orbits.Settings(solver=hj.systems.Radau())
    )
    assert len(cycle.trajectory().t) > 2  # another solver is no other code
    response = hj.experiments.response_function(cycle, SECTIONS, "x")
    chunks = hj.run_experiments(cycle, SECTIONS, DESIGN, "x", chunk=1)

    def force(t):
        return DRAG * jnp.cos(t)

    ends = []
    for drag in (0.7, 1.3):
        monkeypatch.setitem(globals(), "DRAG", drag)
        way = hj.simulate(Turns(), "on", (0.0, 0.0), 0.1, input=force)
        ends.append(way.after[-1, 1])
    expected = ends[0] * 1.3 / 0.7
    assert_allclose(ends[1], expected, rtol=1e-2)
    for use in (lambda: response(DESIGN.signals(cycles=1)), lambda: next(chunks)):
        with pytest.raises(
            hj.errors.DefinitionError,
            match="the field of chart 'air' of Slowed has changed since",
        ):
            use()


class Turns(hj.HybridSystem):
    """Van der Pol's oscillator, pushed by a pulse that 16 samples of a period miss."""

    push: hj.Parameter = hj.parameter(0.0)
    gain: hj.Parameter = hj.parameter(0.0)

    def charts(self):
        def field(t, q, u):
            distance = (t % 5.0 - 2.5) / 0.004
            pulse = jnp.exp(-(distance**2))
            gain = 1 + self.gain * pulse
            force = self.push * pulse + gain * u[0]
            damping = (1 - q[0] ** 2) * q[1]
            return q[1], damping - q[0] + force

        return {"on": Field(("x", "v"), field)}

    def guess(self):
        return hj.Guess("on", (2.0, 0.0))


@pytest.mark.parametrize(
    "search",
    [
        lambda guess: hj.find_limit_cycle(Turns(gain=0.1), section=TURN),
        lambda guess: hj.orbits.find_limit_cycles(
            [Turns(push=0.1), Turns(push=0.2)], guess=guess
        ),
        lambda guess: hj.sweep(Turns(), {"push": [0.1, 0.2]}, guess=guess),
    ],
)
def test_time_without_a_period_is_refused(search, vanderpol_cycle):
    with pytest.raises(
        hj.errors.DefinitionError, match=r"depends on t, but Turns states no period"
    ):
        search(vanderpol_cycle)


class Pushed(Slowed):
    """The input acts with another period than the clock's."""

    def charts(self):
        def air_rates(t, q, u):
            push = u[0] * jnp.cos(1.3 * t)
            return (-q[0] + push,)

        return {"air": Field(("x",), air_rates)}


def test_the_gain_of_an_input_has_the_clocks_period():
    with pytest.raises(
        hj.errors.DefinitionError,
        match=r"does not have the period 1 that Pushed.period",
    ):
        hj.find_limit_cycle(Pushed())


GAIN = 1.0
SPEED = hj.Output("speed", lambda t, q, u: GAIN * q[0], "m/s")


class Swings(hj.HybridSystem):
    """A damped pendulum with a motor, whose gain is a constant of the notebook."""

    torque: hj.Parameter = hj.parameter(0.3)

    def charts(self):
        def field(t, q, u):
            motor = self.torque * jnp.cos(2 * jnp.pi * t)
            torque = motor + u[0]
            gravity = jnp.sin(q[0])
            return q[1], -DRAG * q[1] - gravity + torque

        return {"free": Field(("x", "v"), field)}

    def period(self):
        return 1.0

    def guess(self):
        return hj.Guess("free", (0.0, 0.0))


PUSHES = hj.multisine(2, periods=4).scaled(rms=0.01)
PLACES = hj.ClockPhase(2)


def campaign(cycle):
    return hj.run_experiments(cycle, PLACES, PUSHES, "x", chunk=1)


# Objects that are made of a cycle, and a later call.
LATER = {
    "a cycle": (lambda cycle: cycle, lambda x: x.trajectory()),
    "its multipliers": (
        lambda cycle: (cycle.multipliers, cycle)[1],
        lambda x: x.multipliers,
    ),
    "its stability": (lambda cycle: (cycle.is_stable, cycle)[1], lambda x: x.is_stable),
    "its responses": (lambda cycle: cycle, lambda x: x.responses()),
    "its transfer functions": (lambda cycle: cycle, lambda x: x.htf(0.3)),
    "its sensitivity": (lambda cycle: cycle, lambda x: x.sensitivity("torque")),
    "its fluctuations": (lambda cycle: cycle, lambda x: x.fluctuations({"v": 0.1})),
    "responses": (
        lambda cycle: cycle.responses(),
        lambda x: x.amplitude(0, np.array([0.5])),
    ),
    "a sensitivity": (
        lambda cycle: cycle.sensitivity("torque"),
        lambda x: x.shape(np.array([0.5])),
    ),
    "a trajectory": (lambda cycle: cycle.trajectory(), lambda x: x("x")),
    "its events": (lambda cycle: cycle.trajectory(), lambda x: x.events),
    "placed sections": (
        lambda cycle: hj.sections.place_sections(cycle, PLACES),
        lambda x: x.observe("x"),
    ),
    "sections for a model": (
        lambda cycle: (cycle, hj.sections.place_sections(cycle, PLACES)),
        lambda x: hj.linearize(x[0], x[1], "x"),
    ),
    "a map of sections": (
        lambda cycle: hj.sections.section_map(cycle, PLACES, 0, 1),
        lambda x: x(x.fixed_point),
    ),
    "a response function": (
        lambda cycle: hj.experiments.response_function(cycle, PLACES, "x"),
        lambda x: x(PUSHES.signals(cycles=1)),
    ),
    "a campaign": (campaign, next),
    "experiments": (
        lambda cycle: cycle,
        lambda x: hj.run_experiments(x, PLACES, PUSHES, "x"),
    ),
    "a branch": (
        lambda cycle: hj.continuation(cycle, "torque", (0.29, 0.31)),
        lambda x: x[1].trajectory(),
    ),
    "multipliers of a branch": (
        lambda cycle: hj.continuation(cycle, "torque", (0.29, 0.31)),
        lambda x: x.multipliers,
    ),
    "the start of a branch": (
        lambda cycle: cycle,
        lambda x: hj.continuation(x, "torque", (0.29, 0.31)),
    ),
    "cycles": (
        lambda cycle: hj.orbits.find_limit_cycles([cycle.system] * 2, guess=cycle),
        lambda x: x.multipliers,
    ),
    "one of several cycles": (
        lambda cycle: hj.orbits.find_limit_cycles([cycle.system] * 2, guess=cycle),
        lambda x: hj.linearize(x[1], PLACES, "x"),
    ),
    "sliders": (lambda cycle: cycle, lambda x: hj.explore(x, "torque")),
    "a figure": (lambda cycle: cycle, lambda x: hj.plot.cycle(x)),
}


@pytest.fixture(scope="module")
def swinging():
    return hj.find_limit_cycle(Swings())


@pytest.mark.parametrize("name", LATER)
def test_each_later_call_names_what_has_changed(name, swinging, monkeypatch):
    make, use = LATER[name]
    made = make(swinging)
    monkeypatch.setitem(globals(), "DRAG", 0.9)
    sentence = "the field of chart 'free' of Swings has changed since"
    with pytest.raises(hj.errors.DefinitionError, match=sentence):
        use(made)


def test_outputs_and_sections_that_are_functions_are_compared(swinging, monkeypatch):
    level = hj.Crossing(lambda t, q: q[0] - 0.001 * GAIN, "rising")
    response = hj.experiments.response_function(swinging, PLACES, SPEED)
    chunks = hj.run_experiments(swinging, PLACES, PUSHES, SPEED, chunk=1)
    placed = hj.sections.place_sections(swinging, hj.ClockPhase(2, anchor=level))
    model = hj.linearize(swinging, PLACES, SPEED)
    before = model.C[0, 0, 0]
    monkeypatch.setitem(globals(), "GAIN", 2.0)
    uses = {
        "Output 'speed' has changed since this response function was made": (
            lambda: response(PUSHES.signals(cycles=1))
        ),
        "Output 'speed' has changed since these experiments were planned": (
            lambda: next(chunks)
        ),
        "ClockPhase has changed since it was placed on a cycle": (
            lambda: placed.observe("x")
        ),
    }
    for sentence, use in uses.items():
        with pytest.raises(hj.errors.DefinitionError, match=sentence):
            use()
    model_after = hj.linearize(swinging, PLACES, SPEED)
    after = model_after.C[0, 0, 0]
    assert_allclose(after, 2 * before, rtol=1e-12)
