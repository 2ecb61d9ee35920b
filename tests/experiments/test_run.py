"""Batched experiments on the hopper: accuracy, isolation of failures, bad input.

All runs have batches of 40 experiments of 84 cycles, so that one program for each family of
sections is compiled.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import solve_ivp

import hybridjax as hj

from ..conftest import ISOCHRONS, KINEMATIC, OUTPUTS, no_compilation
from ..orbits import hopper_scipy
from ..toys import RESTING, Field


FAMILIES = ("isochron", pytest.param("kinematic", marks=pytest.mark.slow))
N = 32
CYCLES = 84
BATCH = dict(execution=hj.scale.Execution(batch=40))


@pytest.fixture(scope="session")
def design():
    return hj.experiments.paper_design()


@pytest.fixture(scope="module", params=FAMILIES)
def family(request, hopper_cycle, design):
    name = request.param
    fixtures = {"isochron": "placed_isochrons", "kinematic": "placed_kinematic"}
    placed = request.getfixturevalue(fixtures[name])
    ldtp = request.getfixturevalue(f"{name}_ldtp")
    data = hj.run_experiments(hopper_cycle, placed, design, OUTPUTS, **BATCH)
    return name, placed, ldtp, data


def test_the_papers_protocol_identifies_the_hopper(family, design, hopper_cycle):
    name, _, ldtp, data = family
    assert data.summary() == "80/80 ok"
    assert data.label == name
    assert data.periods == 64
    exact = ldtp.htf(design.frequencies)
    estimate = hj.estimate_htf(data)
    errors = np.asarray(estimate.harmonic_errors(exact))
    bound = {"isochron": 2.5e-4, "kinematic": 6e-4}[name]
    assert errors[estimate.harmonics.index(0)].max() < bound

    true = hopper_cycle.multipliers
    fit = hj.fit_multipliers(estimate, ldtp)
    assert fit.compare(true).max_error < 5e-5
    rational = hj.identify.fit_rational(estimate)
    of_exact = hj.identify.fit_rational(exact)
    for output in estimate.outputs:
        error = rational.compare(true, output).max_error
        bias = of_exact.compare(true, output).max_error
        assert abs(error - bias) < 0.1 * bias


def test_records_agree_with_scipy(family, design):
    name, placed, _, data = family
    begin = float(placed.lanes.t[0])
    state = np.asarray(placed.lanes.q[:, 0])
    apex = np.array([begin, *state])
    x, y = hopper_scipy.plane(apex)
    angle = np.arctan2(y, x)
    cycle = np.asarray(data.cycle_outputs)
    point = apex
    deviations = []
    for n in range(40):  # a cycle and a quarter: liftoff, touchdown, liftoff
        on_cycle = cycle[n % N]
        deviations.append(point[1:3] - on_cycle)
        turn = (n + 1) / N
        if name == "isochron":
            section = ("clock", apex[0] + turn)
        else:
            section = ("angle", angle - 2 * np.pi * turn)
        push = data.u[3, n, 0]
        point = hopper_scipy.flow(point, section, push)
    found = np.array(deviations)
    simulated = data.y[3, :40]
    error = np.abs(found - simulated)
    scale = np.ptp(cycle, axis=0)
    assert np.max(error / scale) < 1e-8


@pytest.mark.slow
def test_a_failing_experiment_leaves_the_others_intact(hopper_cycle, family, design):
    _, placed, _, data = family
    u = design.signals(CYCLES)
    u[17, 3 * N : 4 * N] = 60.0
    broken = hj.run_experiments(hopper_cycle, placed, u, OUTPUTS, discard=20, **BATCH)
    assert list(np.flatnonzero(~broken.ok)) == [17]
    assert 3 * N <= broken.failed_at[17] < 8 * N
    assert "#17: section" in broken.summary()
    assert "79/80 ok" in broken.summary()
    others = np.arange(80) != 17
    assert_allclose(broken.y[others], data.y[others], atol=1e-9)
    after = broken.failed_at[17] + 1
    known = broken.y[17, :after]
    assert np.all(np.isfinite(known))
    after_failure = broken.y[17, after:]
    assert np.all(np.isnan(after_failure))
    estimate = hj.estimate_htf(broken)
    lost = design.frequency[design.experiment == 17]
    assert_array_equal(estimate.frequencies, np.setdiff1d(design.frequencies, lost))


def test_large_inputs_that_change_the_order_of_events_are_reported(
    hopper_cycle, placed_isochrons, design
):
    u = design.signals(CYCLES) * 100
    data = hj.run_experiments(
        hopper_cycle, placed_isochrons, u, OUTPUTS, discard=20, **BATCH
    )
    assert 0 < data.ok.sum() < 80
    failed = data.result[~data.ok]
    measured = {hj.errors.Result(int(r)) for r in failed}
    assert measured == {hj.errors.Result.EVENT_ORDER}


def test_an_unstable_cycle_is_refused(hopper_cycle, placed_isochrons, design):
    unstable = dataclasses.replace(hopper_cycle, factors=1.1 * hopper_cycle.factors)
    with pytest.raises(
        hj.errors.ComputationError, match="not stable .largest multiplier 3.4"
    ):
        hj.run_experiments(unstable, placed_isochrons, design, OUTPUTS, **BATCH)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            dict(design=hj.multisine(16, frequencies=(0, 7.0))),
            "different n_sections: 16 and 32",
        ),
        (dict(design=np.zeros((2, 33, 1))), "periods x 32, 1"),
        (dict(design=np.zeros((2, 64, 1)), discard=2), "leaves none"),
        (dict(start="steady", discard=7), "needs inputs of whole windows"),
    ],
)
def test_bad_input(hopper_cycle, placed_isochrons, design, change, message):
    arguments = dict(sections=placed_isochrons, design=design, outputs=OUTPUTS) | change
    with pytest.raises(hj.errors.DefinitionError, match=message):
        hj.run_experiments(hopper_cycle, **arguments)


def test_new_values_of_parameters_do_not_compile_again(placed_isochrons, design):
    def run(k):
        def where(p):
            return (p.cycle.system.k, p.cycle.numbers["k"])

        placed = eqx.tree_at(where, placed_isochrons, (jnp.asarray(k),) * 2)
        hj.run_experiments(placed.cycle, placed, design, OUTPUTS, **BATCH)

    # (What was computed for the fixture is kept, but its programs may be forgotten.)
    with no_compilation(after=lambda: run(10.002)):
        run(10.001)


def scipy_speeds(v, inputs):
    """v of van der Pol's oscillator at the falling zeros of x, with an input from one to the
    next."""

    def x(t, q):
        return q[0]

    x.direction = -1
    speeds = []
    for u in inputs:
        speeds.append(v)

        def rates(t, q, u=u):
            damping = (1 - q[0] ** 2) * q[1]
            return q[1], damping - q[0] + u

        path = solve_ivp(
            rates, (0, 9), (0.0, v), "DOP853", events=x, rtol=1e-13, atol=1e-13
        )
        after_start = path.t_events[0] > 1
        v = path.y_events[0][after_start][0, 1]
    return speeds


@pytest.mark.slow
def test_one_section_whose_way_to_the_next_is_a_whole_turn(vanderpol_cycle):
    """No few equal steps will do: they are adapted, and the estimate still bounds the error."""
    placed = hj.sections.place_sections(vanderpol_cycle, [hj.Crossing("x", "falling")])
    rng = np.random.default_rng(0)
    u = 0.1 * rng.standard_normal((3, 6, 1))
    data = hj.run_experiments(vanderpol_cycle, placed, u, ("v",), discard=0)
    assert data.ok.all()
    assert (data.failed_at == -1).all()

    start = float(placed.lanes.q[1, 0])
    forces = u[:, :, 0]
    true = np.array([scipy_speeds(start, inputs) for inputs in forces])
    deviation = data.y[:, :, 0]
    found = deviation + data.cycle_outputs[:, 0]
    size = np.abs(true).max()
    largest = np.abs(found - true).max(axis=1)
    error = largest / size
    assert np.ptp(true) > 0.1 * size, "the inputs do something"
    assert np.all(error <= data.error)
    assert np.all(data.error < 1e-8)


def test_sections_that_are_too_far_apart_for_the_steps_allowed(
    hopper_cycle, monkeypatch
):
    monkeypatch.setattr("hybridjax.experiments.plan.PATIENCE", 3)
    settings = hj.orbits.Settings(1e-12, 1e-12, 3, hopper_cycle.settings.scale)
    cycle = dataclasses.replace(hopper_cycle, settings=settings)
    with pytest.raises(hj.errors.ComputationError, match="too few steps .*max_steps"):
        hj.run_experiments(
            cycle, hj.ClockPhase(3), np.zeros((1, 6, 1)), "yM", discard=0
        )


@pytest.mark.slow
def test_clock_sections_of_an_autonomous_system(vanderpol_cycle):
    family = hj.ClockPhase(8, anchor=hj.Crossing("v", "falling"))
    design = hj.multisine(n_sections=8, periods=4, frequencies=(0, 2.0))
    with pytest.raises(
        hj.errors.DefinitionError,
        match=r"has no clock.*multiplier of exactly 1.*Kinemat",
    ):
        hj.run_experiments(vanderpol_cycle, family, design, "x")
    # Between such sections the multiplier 1 is there, and makes whole frequencies resonant.
    model = hj.linearize(vanderpol_cycle, family, "x")
    assert abs(model.multipliers[0] - 1) < 1e-9
    with pytest.raises(
        hj.errors.DefinitionError, match="use sections that depend on the state"
    ):
        model.htf([1.0])
    model.htf([0.5])


def test_experiments_judge_errors_by_the_sizes_of_the_cycle():
    guess = hj.Guess("all", (0.0, 0.0, 0.0))
    resting = hj.find_limit_cycle(RESTING, guess, scale={"w": 1.0})
    family = hj.ClockPhase(4)
    design = hj.experiments.Design.from_lines([[0.25], [0.75]], n_sections=4, periods=4)
    data = hj.run_experiments(resting, family, design, ("x", "w"))
    assert data.summary() == "2/2 ok"
    assert np.all(data.error < 1e-8)
    model = hj.linearize(resting, family, ("x", "w"))  # the system is linear
    expected = hj.experiments.simulate_experiments(model, design).y
    assert_allclose(data.y, expected, atol=1e-9)
    scales = hj.experiments.response_function(resting, family, "x").stepping.scales
    of_states = [resting.scale[name] for name in "xv"]
    sizes = [float(resting.period), *of_states, 1.0]
    assert_array_equal(scales, np.tile(sizes, (4, 1)))


def pick(hopper):
    parameters = ("m", "M", "k", "b", "l0", "a", "g")
    return [getattr(hopper, name) for name in parameters]


def central(f, x, e=1e-4):
    steps = e * np.eye(len(x))
    return np.array([(f(x + d) - f(x - d)) / (2 * e) for d in steps])


@pytest.mark.slow
@pytest.mark.parametrize("family", (ISOCHRONS, KINEMATIC))
def test_reverse_and_forward_mode_agree_with_differences(family, lossy_cycle):
    family = dataclasses.replace(family, n_sections=4)
    response = hj.experiments.response_function(
        lossy_cycle, family, OUTPUTS, accuracy=1e-11
    )
    x = jnp.stack(pick(lossy_cycle.system))
    rng = np.random.default_rng(0)
    u = 0.1 * jnp.asarray(rng.standard_normal(12))

    def loss(x, u):
        system = eqx.tree_at(pick, lossy_cycle.system, list(x))
        found = response(u[None, :, None], system=system)
        return jnp.sum(found.y**2), found.result[0]

    value = jax.jit(loss)
    _, result = value(x, u)
    assert result == hj.errors.Result.OK
    both = jax.grad(loss, argnums=(0, 1), has_aux=True)
    reverse_mode = jax.jit(both)
    (by_x, by_u), _ = reverse_mode(x, u)
    forward_mode = jax.jit(jax.jacfwd(loss, has_aux=True))
    forward, _ = forward_mode(x, u)
    assert_allclose(forward, by_x, rtol=1e-9)

    difference = central(lambda x: value(x, u)[0], x)
    tolerance = 1e-6 * np.abs(difference).max()
    assert_allclose(by_x, difference, rtol=1e-6, atol=tolerance)
    difference = central(lambda u: value(x, u)[0], u)
    tolerance = 1e-6 * np.abs(difference).max()
    assert_allclose(by_u, difference, rtol=1e-6, atol=tolerance)


class Restarted(hj.HybridSystem):
    """x is a polynomial of degree 5 of the time since the last whole second, and falls through zero
    three times in a second. A step may be as long as a second."""

    zeros: tuple[float, ...] = (0.15, 0.3, 0.5, 0.7, 0.9)
    inputs = ("u",)

    def polynomial(self):
        return np.poly1d(self.zeros, r=True) * -100

    def start(self):
        p = self.polynomial()
        derivatives = [p.deriv(k)(0.0) for k in range(1, 6)]
        return (p(0.0), *derivatives)

    def charts(self):
        def rates(t, q, u):
            first = q[1] + u[0]
            return (first, *q[2:], 0.0)

        return {"run": Field(tuple("abcdef"), rates)}

    def transitions(self):
        (first, *others) = self.start()
        last = self.polynomial()(1.0)

        def back(t, q, u):
            return (first + 0.3 * (q[0] - last), *others)

        def fall_guard(t, q, u):
            return q[0]

        return (
            hj.Transition("fall", "run", "run", fall_guard),
            hj.Transition(
                "restart", "run", "run", hj.systems.Scheduled(1.0), reset=back
            ),
        )

    def period(self):
        return 1.0


def test_no_event_is_missed_between_sections_a_period_apart():
    guess = hj.Guess("run", Restarted().start(), 0.0)
    cycle = hj.find_limit_cycle(Restarted(), guess)
    assert cycle.event_sequence == (0, 0, 0, 1)
    rng = np.random.default_rng(0)
    u = 1e-3 * rng.normal(size=(10, 20, 1))
    section = hj.ClockPhase(1)
    data = hj.run_experiments(cycle, section, u, ("a",), discard=0)
    assert data.ok.all(), data.summary()


def test_charts_without_a_common_state_need_outputs():
    class Charge(hj.Chart):
        states = ("charge",)

        def field(self, t, q, u):
            return (1.0 + u[0],)

    class Rest(hj.Chart):
        states = ("heat",)

        def field(self, t, q, u):
            return (-q[0],)

    class Flash(hj.HybridSystem):
        def charts(self):
            return {"charge": Charge(), "rest": Rest()}

        def transitions(self):
            def full(t, q, u):
                return 1 - q[0]

            def cold(t, q, u):
                return q[0] - 0.1

            def heated(t, q, u):
                return (1.0,)

            def empty(t, q, u):
                return (0.0,)

            return [
                hj.Transition("flash", "charge", "rest", full, reset=heated),
                hj.Transition("cool", "rest", "charge", cold, reset=empty),
            ]

        def guess(self):
            return hj.Guess("charge", (0.5,))

    cycle = hj.find_limit_cycle(Flash())
    says = (
        "no state is in all charts of Flash, to be recorded by default: give `outputs`"
    )
    with pytest.raises(hj.errors.DefinitionError, match=says):
        no_input = np.zeros((1, 30, 1))
        hj.run_experiments(cycle, hj.AtEvent("cool"), no_input)
