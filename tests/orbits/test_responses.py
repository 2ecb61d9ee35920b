"""Responses of cycles to pushes, to lasting changes and to sines, against closed forms, finite
differences of flows and an identity."""

# ruff: noqa: E731
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj
from hybridjax.orbits.linear_flow import linear_flow
from hybridjax.systems.chart import FieldChart

from ..toys import toy


PHASES = np.array([0.0, 0.13, 0.31, 0.52, 0.77, 0.98])


class StuartLandau(hj.HybridSystem):
    mu: hj.Parameter = hj.parameter(0.1)
    eta: hj.Parameter = hj.parameter(1.0)
    alpha: hj.Parameter = hj.parameter(-0.4)

    def charts(self):
        return {"plane": FieldChart(self.field, ("x", "y"))}

    def field(self, t, q, u):
        square = q[0] ** 2 + q[1] ** 2
        z = self.growth(square)
        turned = z[0] * q[0] - z[1] * q[1]
        x = turned + u[0]
        y = z[1] * q[0] + z[0] * q[1]
        return x, y

    def growth(self, r2):
        return self.mu - r2, self.eta - self.alpha * r2


class Neuron(hj.HybridSystem):
    """v' = I - leak v + square v^2 + u; at v = 1 - grip u, v is reset to low + grip u."""

    current: hj.Parameter = hj.parameter(1.2)
    leak: hj.Parameter = hj.parameter(1.0)
    square: hj.Parameter = hj.parameter(0.0)
    low: hj.Parameter = hj.parameter(0.0)
    grip: hj.Parameter = hj.parameter(0.0)

    def charts(self):
        return {"membrane": FieldChart(self.field, ("v",))}

    def field(self, t, q, u):
        leak = self.leak * q[0]
        square = self.square * q[0] ** 2
        return (self.current - leak + square + u[0],)

    def transitions(self):
        def guard(t, q, u):
            return 1 - self.grip * u[0] - q[0]

        def reset(t, q, u):
            return (self.low + self.grip * u[0],)

        return [hj.Transition("spike", "membrane", "membrane", guard, reset=reset)]

    def guess(self):
        return hj.Guess("membrane", jnp.atleast_1d(self.low), after="spike")


class PushedAtSpikes(Neuron):
    """The same with an input that acts at spikes alone."""

    def field(self, t, q, u):
        return super().field(t, q, 0 * u)


class Driven(hj.HybridSystem):
    """A clocked cycle whose states are proportional to the force, and differ in size."""

    force: hj.Parameter = hj.parameter(1.0)

    def charts(self):
        return {"plane": FieldChart(self.field, ("x", "y"))}

    def field(self, t, q, u):
        wave = jnp.cos(2 * jnp.pi * t)
        fast = 1e12 * q[0] - q[1]
        return self.force * wave - q[0], fast

    def period(self):
        return 1.0


class Square(hj.HybridSystem):
    """z' = (a + i omega) z in a square with hard walls."""

    a: hj.Parameter = hj.parameter(0.2)
    omega: hj.Parameter = hj.parameter(1.0)

    WALLS = (("right", 0, 1), ("top", 1, 1), ("left", 0, -1), ("bottom", 1, -1))

    def rates(self, q):
        grown = self.a * q[0]
        x = grown - self.omega * q[1]
        grown = self.a * q[1]
        y = self.omega * q[0] + grown
        return x, y

    def charts(self):
        def inside_rates(t, q, u):
            return self.rates(q)

        charts = {"inside": FieldChart(inside_rates, ("x", "y"))}
        for name, axis, _ in self.WALLS:

            def along(t, q, u, k=axis):
                return [r * (i != k) for i, r in enumerate(self.rates(q))]

            charts[name] = FieldChart(along, ("x", "y"))
        return charts

    def transitions(self):
        for name, k, side in self.WALLS:

            def inner(t, q, u, k=k, side=side):
                return 1 - side * q[k]

            yield hj.Transition(f"to {name}", "inside", name, inner)

            def pressed(t, q, u, k=k, side=side):
                return side * self.rates(q)[k]

            yield hj.Transition(f"off {name}", name, "inside", pressed)

    def guess(self):
        return hj.Guess("inside", (1.0, 0.2), after="off right")


class Juggler(hj.models.PaddleJuggler):
    """A force acts on the ball."""

    def charts(self):
        def fall_rates(t, q, u):
            return (q[1], u[0] - self.g)

        return {"fall": FieldChart(fall_rates, ("y", "v"))}


@pytest.mark.core
def test_a_stuart_landau_oscillator_responds_as_its_closed_form():
    system = StuartLandau()
    section = hj.Crossing("y", "rising")
    guess = hj.Guess("plane", (0.33, 0.0))
    responses = hj.find_limit_cycle(system, guess, section=section).responses()
    angle = 2 * np.pi * PHASES
    phase = responses.phase(PHASES, "radians")
    wave = np.sin(angle) - 0.4 * np.cos(angle)
    exact = -wave / np.sqrt(0.1)
    assert_allclose(phase["u"], exact, rtol=0, atol=1e-12)
    assert_allclose(phase["x"], exact, rtol=0, atol=1e-12)
    amplitude = responses.amplitude(0, PHASES)
    assert_allclose(amplitude["x"], np.cos(angle), rtol=0, atol=1e-12)
    assert_allclose(amplitude["y"], np.sin(angle), rtol=0, atol=1e-12)
    assert_allclose(responses.exponents, [-0.2], rtol=0, atol=1e-12)
    assert "exponent -0.2" in str(responses)
    fast = hj.find_limit_cycle(StuartLandau(mu=1.0), guess, section=section).responses()
    amplitude = fast.amplitude(
        0, PHASES
    )  # without a part along the flow, which would grow
    assert_allclose(amplitude["x"], np.cos(angle), rtol=0, atol=1e-10)
    # Isochrons are logarithmic spirals: phase = angle + alpha log(r / sqrt(mu)).
    cycle = hj.find_limit_cycle(system, guess, section=section)
    phase = cycle.asymptotic_phase("plane", (0.3, 0.15))
    distance = np.hypot(0.3, 0.15) / np.sqrt(0.1)
    shear = 0.4 * np.log(distance)
    exact = np.arctan2(0.15, 0.3) + shear
    assert_allclose(phase, exact / (2 * np.pi), rtol=1e-9)


def test_responses_and_sensitivities_do_not_depend_on_the_units_of_states():
    """Stuart and Landau's oscillator with y in another unit, and a clocked oscillator."""
    size = 1e12

    class Scaled(StuartLandau):
        def field(self, t, q, u):
            scaled = (q[0], q[1] / size)
            x, y = super().field(t, scaled, u)
            return x, y * size

    section = hj.Crossing("y", "rising")
    guess = hj.Guess("plane", (0.33, 0.0))
    cycle = hj.find_limit_cycle(Scaled(), guess, section=section)
    exact = -(np.sin(2 * np.pi * PHASES) - 0.4 * np.cos(2 * np.pi * PHASES)) / np.sqrt(
        0.1
    )
    phase = cycle.responses().phase(PHASES, "radians")
    assert_allclose(phase["x"], exact, rtol=0, atol=1e-12)
    slower = cycle.sensitivity("mu").period
    expected = -2 * np.pi * 0.4 / 1.04**2
    assert_allclose(slower, expected, rtol=1e-11)
    driven = hj.find_limit_cycle(Driven(), hj.Guess("plane", (0.1, 1e11)))
    shape = driven.sensitivity("force").shape([0.0])
    state = driven.state
    relative = [shape[x][0] / state[x] for x in "xy"]
    assert_allclose(relative, 1.0, rtol=1e-11)


def test_an_amplitude_of_a_negative_multiplier_has_its_closed_form():
    """x' = cos(2 pi t) - 0.3 x, and x changes its sign at each tick."""

    def field(t, q, u):
        wave = jnp.cos(2 * jnp.pi * t)
        return (wave - 0.3 * q[0] + u[0],)

    tick = hj.systems.Scheduled(1.0, 0.5)

    def tick_reset(t, q, u):
        return (-q[0],)

    turned = hj.Transition("tick", "line", "line", tick, reset=tick_reset)
    chart = FieldChart(field, ("x",))
    system = toy({"line": chart}, [turned], period=1.0)
    cycle = hj.find_limit_cycle(system, hj.Guess("line", (0.1,)))
    responses = cycle.responses()
    expected = [-0.3 + 1j * np.pi]
    assert_allclose(responses.exponents, expected, rtol=1e-12)
    before_tick = np.where(PHASES < 0.5, PHASES, PHASES - 1)
    turn = np.exp(1j * np.pi * before_tick)
    of_tick = responses.amplitude(0, [0.0])["x"]
    exact = turn * of_tick
    assert_allclose(responses.amplitude(0, PHASES)["x"], exact, rtol=1e-11)


@pytest.mark.slow
def test_the_closed_form_of_a_response_has_its_derivative():
    section = hj.Crossing("y", "rising")
    guess = hj.Guess("plane", (0.33, 0.0))
    near = hj.find_limit_cycle(StuartLandau(), guess, section=section)

    def response(mu):
        cycle = hj.find_limit_cycle(StuartLandau(mu=mu), near)
        phases = jnp.asarray(PHASES)
        return cycle.responses(modes=0).phase(phases, "radians")["x"]

    angle = 2 * np.pi * PHASES
    wave = np.sin(angle) - 0.4 * np.cos(angle)
    exact = wave / (2 * 0.1**1.5)
    tangent = jax.jvp(response, (0.1,), (1.0,))[1]  # (in reverse mode: the slow test)
    assert_allclose(tangent, exact, rtol=0, atol=1e-9)


def test_weakly_pushed_and_coupled_oscillators_lock_as_their_closed_forms():
    section = hj.Crossing("y", "rising")
    guess = hj.Guess("plane", (0.33, 0.0))
    responses = hj.find_limit_cycle(StuartLandau(), guess, section=section).responses()
    pushed = responses.coupling(lambda phase: np.cos(2 * np.pi * phase))
    size = 1 / (4 * np.pi * np.sqrt(0.1))
    angle = 2 * np.pi * PHASES
    wave = np.sin(angle) + 0.4 * np.cos(angle)
    expected = size * wave
    assert_allclose(pushed(PHASES), expected, rtol=1e-11)
    both = np.array([-1, 1])
    expected = both * size * np.sqrt(1.16)
    assert_allclose(pushed.locking, expected, rtol=1e-12)
    rates = [x.rate for x in pushed.locked()]
    expected = 2 * np.pi * size * np.sqrt(1.16)
    assert_allclose(np.abs(rates), expected, rtol=1e-11)
    together, apart = responses.coupling("x").locked(mutual=True)
    phases = [*together, *apart]
    assert_allclose(phases, [0, -1, 0.5, 1], rtol=0, atol=1e-12)
    leads = [
        x.lead for x in type(pushed)(np.array([0.0, np.exp(0.5002j * np.pi)])).locked()
    ]
    assert_allclose(leads, [0.9999, 0.4999], rtol=1e-9)
    with pytest.raises(
        hj.errors.DefinitionError, match="`harmonics` = 64 does not resolve jumps"
    ):
        hj.find_limit_cycle(Neuron(grip=0.3)).responses().coupling("v")


@pytest.mark.core
def test_integrate_and_fire_neurons_respond_as_their_closed_forms():
    leaky = hj.find_limit_cycle(Neuron(grip=0.3)).responses()
    period = np.log(1.2 / 0.2)
    assert_allclose(leaky.period, period, rtol=1e-12)
    exact = np.exp(PHASES * period) / 1.2
    assert_allclose(leaky.phase(PHASES)["v"], exact, rtol=1e-12)
    # The guard comes 0.3 / v' = 1.5 earlier, and the reset starts 0.3 / 1.2 ahead.
    (impulse,) = leaky.impulses()
    assert_allclose(impulse.weight["u"], 1.5 + 0.25, rtol=1e-12)
    assert "inputs act at spike" in str(leaky)
    with pytest.raises(hj.errors.DefinitionError, match="acts at events, too: see"):
        leaky.curve("u")
    held = hj.find_limit_cycle(PushedAtSpikes(grip=0.3)).responses()
    with pytest.raises(hj.errors.DefinitionError, match="acts at events alone: see"):
        held.curve("u")
    # v' = I + v^2: v = tan(t + arctan v0) for I = 1.
    system = Neuron(
        current=1.0,
        leak=0.0,
        square=1.0,
        low=-2.0,
    )
    cycle = hj.find_limit_cycle(system)
    begin = np.arctan(-2.0)
    quadratic = cycle.responses()
    period = np.arctan(1.0) - begin
    exact = np.cos(begin + PHASES * period) ** 2
    assert_allclose(quadratic.phase(PHASES)["u"], exact, rtol=1e-12)
    curve = quadratic.curve()
    angle = begin + curve.phase * period
    exact = np.cos(angle) ** 2 / period
    kept = np.isfinite(curve.values)
    assert_allclose(curve.values[kept], exact[kept], rtol=1e-12)
    assert 0 < np.sum(~kept) <= 2
    assert curve.input == "u"
    change = cycle.sensitivity("low")  # T = arctan(1) - arctan(low)
    assert_allclose(change.period, -1 / 5, rtol=1e-11)
    assert_allclose(change.durations, [-1 / 5], rtol=1e-11)
    by_speed = change.shape([0.0])["v"]
    assert_allclose(by_speed, [1.0], rtol=1e-11)


@pytest.mark.slow
@pytest.mark.core
def test_a_cycle_that_slides_on_four_walls_has_the_published_period_and_its_derivative():
    cycle = hj.find_limit_cycle(Square())
    assert_allclose(cycle.period, 6.766182958186238, rtol=1e-11)
    a = cycle.sensitivity("a")
    omega = cycle.sensitivity("omega")
    assert_allclose(a.period - omega.period, 10.784262213426, rtol=1e-9)
    assert_allclose(np.sum(a.durations), a.period, rtol=1e-9)
    # By symmetry each quarter takes its part.
    by_side = np.reshape(a.durations, (4, 2))
    measured = by_side.sum(1)
    assert_allclose(measured, a.period / 4, rtol=1e-9)
    # A cycle that begins where sliding ends can be followed.
    squares = [Square(a=x) for x in (0.19, 0.21)]
    periods = [hj.find_limit_cycle(square, cycle).period for square in squares]
    slope = np.diff(periods)[0] / 0.02
    assert_allclose(slope, a.period, rtol=1e-3)


# All of `hj.models` without a clock, except a family of cycles (SLIPRunner).
AUTONOMOUS = """
    BeltOscillator ChuaCircuit CompassGait FitzHughNagumo FiveLinkBiped HopfOscillator RimlessWheel
    SimplestWalker TorsoWalker VanDerPol
""".split()


@pytest.mark.slow
@pytest.mark.parametrize("name", AUTONOMOUS)
def test_phase_responses_are_differences_of_asymptotic_phases(name):
    """Of flows from states that are pushed in a random direction, to both sides."""
    cycle = hj.find_limit_cycle(getattr(hj.models, name)())
    s = cycle.structure
    period = float(cycle.period)
    flow = linear_flow(cycle)
    phases = np.array([0.15, 0.4, 0.77])
    response = cycle.responses(modes=0).phase(phases, "cycles")
    charts, states = flow.at(phases, period, flow.q)
    rng = np.random.default_rng(0)
    exact = []
    difference = []
    for k, a in enumerate(charts):
        names = s.charts[a].states
        q = states[k, : s.dims[a]]
        scales = [cycle.scale[x] for x in names]
        push = 1e-4 * rng.normal(size=len(q)) * scales
        push *= [response[x][k] != 0 for x in names]  # sliding undoes the others

        def central(h):
            to = [cycle.asymptotic_phase(s.names[a], q + x * push) for x in (h, -h)]  # noqa: B023
            half_turn_on = to[0] - to[1] + 0.5
            apart = half_turn_on % 1.0 - 0.5
            return apart / (2 * h)

        fourth_order = (4 * central(0.5) - central(1.0)) / 3
        difference.append(fourth_order)
        exact.append(sum(response[x][k] * p for x, p in zip(names, push, strict=True)))
    all_responses = np.concatenate([*response.values()])
    size = max(np.abs(all_responses)) * 1e-4
    assert_allclose(difference, exact, rtol=1e-6, atol=1e-6 * size)


@pytest.mark.slow
def test_pushes_off_a_surface_on_which_the_cycle_slides_are_lost():
    cycle = hj.find_limit_cycle(hj.models.BeltOscillator())
    flow = cycle.trajectory()
    is_sliding = flow.chart == cycle.structure.chart_index("sticks")
    inside = is_sliding & (flow.event < 0)
    sticks = flow.t[inside] - flow.t[0]
    phases = sticks[:-1] / float(cycle.period)
    phase = cycle.responses().phase(phases)
    assert np.all(phase["v"] == 0)
    assert np.all(np.abs(phase["x"]) > 1)
    assert "2 faster modes left out" not in str(cycle.responses())


def test_mathieus_equation_has_the_published_continuous_htf():
    cycle = hj.find_limit_cycle(hj.models.Mathieu())
    htf = cycle.htf(0.25, (-1, 0, 1), "x")
    published = [
        -0.435292031202 - 0.119838440991j,
        1.085149865188 - 0.060008477233j,
        0.333649918824 + 0.129840711721j,
    ]
    computed = htf.H[:, 0, 0, 0]
    assert_allclose(computed, published, rtol=0, atol=1e-11)
    assert "continuous time" in str(htf)
    assert htf[1].shape == (1, 1, 1)
    ldtp = hj.linearize(cycle, hj.ClockPhase(64), "x")
    held = ldtp.htf(0.25, (-1, 0, 1)).H
    x = 2j * np.pi * 0.25 / 64  # less aliases, the factor of the hold
    decay = np.exp(-x)
    found = held * x / (1 - decay)
    assert_allclose(found, htf.H, rtol=1e-7)
    with pytest.raises(hj.errors.DefinitionError, match="takes HTFs between sections"):
        htf.predict(np.ones((32, 1)))


def test_htfs_at_many_frequencies_come_from_fewer():
    cycle = hj.find_limit_cycle(hj.models.BuckConverter())
    f = np.linspace(0.013, 9.987, 620)
    some = [0, 7, 311, 619]
    many = cycle.htf(f, (-1, 0, 1)).H
    response = cycle.htf(f[some], (-1, 0, 1))
    few = response.H
    tolerance = 1e-12 * np.abs(few).max()
    assert_allclose(many[:, some], few, rtol=0, atol=tolerance)


def test_harmonic_state_spaces_converge_to_the_exact_htf():
    cycle = hj.find_limit_cycle(hj.models.Mathieu())
    space = hj.convert.to_harmonic_state_space(cycle, outputs="x", tolerance=1e-12)
    H = space.transfer(0.25, float(cycle.period))[
        0, space.order - 1 : space.order + 2, 0, 0
    ]
    htf = cycle.htf(0.25, (-1, 0, 1), "x")
    exact = htf.H[:, 0, 0, 0]
    assert_allclose(H, exact, rtol=1e-11)
    assert space.error < 1e-12
    assert space.order == 8
    assert hj.convert.to_harmonic_state_space(cycle, 1).error > 1e-3
    with pytest.raises(
        hj.errors.DefinitionError, match="has events at which deviations jump"
    ):
        hj.convert.to_harmonic_state_space(hj.find_limit_cycle(Neuron()))


def test_the_continuous_htf_of_a_speed_that_jumps_is_that_of_the_derivative_of_the_height():
    """With the impulses of the speed at impacts whose time moves."""
    guess = hj.Guess("fall", (0.2, 4.5), time=0.1)
    cycle = hj.find_limit_cycle(Juggler(), guess)
    f = np.array([0.3, 1.7])
    m = np.arange(-3, 4)
    H = cycle.htf(f, m, ("y", "v")).H
    outputs = H[..., 0]
    y, v = np.moveaxis(outputs, -1, 0)
    rates = 2j * np.pi * (f + m[:, None])
    assert_allclose(v, rates * y, rtol=1e-9)


@pytest.mark.slow
def test_the_curve_of_a_simulated_neuron_lies_in_the_band_of_its_estimate(tmp_path):
    rng = np.random.default_rng(0)
    system = Neuron(
        current=1.0,
        leak=0.0,
        square=1.0,
        low=-2.0,
    )
    f, angle = rng.uniform(0.1, 0.9, (2, 12))

    def current(t):
        phase = 2 * jnp.pi * (f * t + angle)
        return 0.05 * jnp.sum(jnp.cos(phase), keepdims=True)

    way = hj.simulate(system, "membrane", (-2.0,), 600.0, input=current)
    t = np.arange(0, 600, 0.02)
    spikes = np.array([x.time for x in way.events]) + 0.01 * rng.normal(
        size=len(way.events)
    )
    recording = hj.Recording(
        t, {"u": jax.vmap(current)(t)[:, 0]}, events={"spike": spikes}
    )
    measured = hj.recordings.phase_response(recording, hj.AtEvent("spike"), input="u")
    curve = hj.find_limit_cycle(system).responses().curve()
    (low, high) = measured.interval(curve.phase)
    values = curve.values
    is_inside = (low <= values) & (values <= high)
    assert np.mean(is_inside[np.isfinite(values)]) > 0.9
    hj.plot.phase_response(measured, model=curve).save(tmp_path / "both")


def _shifted(cycle, name, step):
    value = getattr(cycle.system, name) + step
    system = eqx.tree_at(lambda x: getattr(x, name), cycle.system, value)
    return hj.find_limit_cycle(system, cycle)


@pytest.mark.parametrize(
    "system, name",
    [
        pytest.param(hj.models.VerticalHopper(), "omega", marks=pytest.mark.slow),
        (hj.models.BuckConverter(), "Vin"),
    ],
    ids=["a clock that changes", "an event by the clock"],
)
@pytest.mark.slow
def test_sensitivities_are_differences_of_cycles(system, name):
    cycle = hj.find_limit_cycle(system)
    change = cycle.sensitivity(name)
    step = 1e-3 * float(getattr(system, name))

    def numbers(step):
        other = _shifted(cycle, name, step)
        events = [x.time for x in other.trajectory().events]
        _, states = linear_flow(other).at(
            PHASES[1:], other.period, linear_flow(other).q
        )
        return np.concatenate(
            [
                [float(other.period)],
                np.array(events) - float(other.anchor.t[0]),
                states[:, 0],
            ]
        )

    def central(h):
        return (numbers(h) - numbers(-h)) / (2 * h)

    half_step = central(step / 2)
    difference = (4 * half_step - central(step)) / 3
    name = cycle.structure.charts[0].states[0]
    period = float(cycle.period)
    part = float(cycle.anchor.t[0]) / period
    begin = part * change.period
    exact = [
        [change.period],
        np.array(change.times) - begin,
        change.shape(PHASES[1:])[name],
    ]
    assert_allclose(np.concatenate(exact), difference, rtol=1e-6, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(
    "system, name, output",
    [
        (Neuron(grip=0.3), "current", "v"),
        (hj.models.VerticalHopper(), "k", "yM"),
        (hj.models.BuckConverter(), "Vin", "v"),
        (hj.models.TwoLeggedBar(), "m", "y"),
    ],
    ids=["a phase", "two charts", "a schedule", "four charts"],
)
def test_results_have_derivatives_in_forward_and_reverse_mode(system, name, output):
    guess = hj.find_limit_cycle(system)
    begin = jnp.asarray(getattr(system, name), float)

    def result(value):
        cycle = hj.find_limit_cycle(
            eqx.tree_at(lambda x: getattr(x, name), system, value), guess
        )
        responses = cycle.responses(modes=2 * guess.clocked)
        at = jnp.array([0.3])
        if guess.clocked:
            push = responses.amplitude(0, at)
        else:
            push = responses.phase(at)
        H = cycle.htf(0.3, 1, output).H
        htf = H[0, 0, 0, 0]
        noise = cycle.fluctuations({output: 0.1})
        if guess.clocked:
            noisy = noise.covariance(at)[0, 0, 0]
        else:
            noisy = noise.diffusion
        change = cycle.sensitivity(name)
        if guess.clocked:
            shape = change.shape(at)[output][0]
        else:
            shape = change.period
        section = 0 if guess.clocked else None
        impulse = responses.impulses(section)[0].weight["u"]
        later = change.durations[0]
        pushed = push[output][0]
        values = [pushed, htf, noisy, shape, impulse, later]
        return jnp.abs(jnp.stack(values))

    _, forward = jax.jvp(result, (begin,), (jnp.ones(()),))

    def central(h):
        later = result(begin + h)
        change = later - result(begin - h)
        return change / (2 * h)

    h = 1e-3 * begin
    of_half_step = central(h / 2)
    difference = (4 * of_half_step - central(h)) / 3
    assert_allclose(forward, difference, rtol=1e-7, atol=1e-12)
    assert_allclose(jax.jacrev(result)(begin), forward, rtol=1e-9)


@pytest.mark.slow
def test_bad_questions_are_refused_in_one_sentence():
    hopper = hj.find_limit_cycle(hj.models.VerticalHopper())
    wheel = hj.find_limit_cycle(Neuron())
    with pytest.raises(
        hj.errors.DefinitionError, match="has no phase response: its phase is that"
    ):
        hopper.responses().phase([0.1])
    with pytest.raises(
        hj.errors.DefinitionError, match="has no phase response: its phase is that"
    ):
        hopper.asymptotic_phase("flight", [0.0] * hopper.structure.dims[0])
    with pytest.raises(
        hj.errors.DefinitionError, match="for the 1 states v of chart 'membrane'"
    ):
        wheel.asymptotic_phase("membrane", (0.3, 0.5))
    with pytest.raises(
        hj.errors.DefinitionError, match="no mode with an amplitude 2: there are 2"
    ):
        hopper.responses().amplitude(2, [0.1])
    with pytest.raises(
        hj.errors.DefinitionError, match="3 modes were asked for; 2 have amplitudes"
    ):
        hopper.responses(modes=3)
    with pytest.raises(
        hj.errors.DefinitionError, match="pole of the cycle, which lie at every whole"
    ):
        wheel.htf([0.3, 2.0])
    with pytest.raises(hj.errors.DefinitionError, match="there is no input 'force'"):
        wheel.htf(0.3, inputs="force")
    with pytest.raises(
        hj.errors.DefinitionError, match=r"need 2.4e\+10 pieces of the cycle: lower"
    ):
        wheel.htf(1e10)
    with pytest.raises(
        hj.errors.DefinitionError, match="there is no parameter 'speed'"
    ):
        wheel.sensitivity("speed")
    with pytest.raises(hj.errors.DefinitionError, match="there is no input 'force'"):
        wheel.responses().curve("force")
    with pytest.raises(hj.errors.DefinitionError, match="call (it|them) outside"):
        eqx.filter_jit(lambda cycle: cycle.htf(0.3))(wheel)
    apex = hj.Crossing("vy", "falling")
    family = dict(section=apex, conserved={"energy": 1784.8})
    runner = hj.find_limit_cycle(hj.models.SLIPRunner(), **family)
    with pytest.raises(
        hj.errors.ComputationError, match="has no defined phase: its multiplier 1 is"
    ):
        runner.responses()
