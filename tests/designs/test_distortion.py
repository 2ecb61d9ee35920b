"""Distortion as a limit: what is predicted, against closed forms and the nonlinear hopper."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj
from hybridjax.designs.candidates import Candidates
from hybridjax.designs.limits import products
from hybridjax.sections.second_order import second_order

from ..conftest import APEX, OUTPUTS
from ..toys import Field, toy


Limits = hj.designs.Limits
Distortion = hj.designs.Distortion
# (Eight sections: shapes are the same in all tests of the hopper, so that each is compiled once.)
KINEMATIC = hj.KinematicPhase(8, "yM", "vM", (1.9, 0.0), (0.3, 1.9), anchor=APEX)
LEVEL = {"yM": 6e-6, "vM": 1.2e-5}
NOISE = {"yM": 6e-6, "vM": 1.2e-5}
EXPERIMENTS = hj.multisine(8, periods=8, frequencies=(0.0, 1.0))
GOAL = hj.designs.MultiplierGoal(harmonics=(-1, 0, 1))


class Quadratic(hj.HybridSystem):
    """x[p+1] = 0.6 x[p] + u + b x[p]^2 once a period, at t = p, and constant in between."""

    b: hj.Parameter = hj.parameter(0.7)

    def charts(self):
        def rest_rates(t, q, u):
            return (0.0 * q[0],)

        return {"rest": Field(("x",), rest_rates)}

    def transitions(self):
        def reset(t, q, u):
            square = self.b * q[0] ** 2
            return (0.6 * q[0] + u[0] + square,)

        return (
            hj.Transition(
                "tick", "rest", "rest", hj.systems.Scheduled(1.0), reset=reset
            ),
        )

    def outputs(self):
        return (hj.Output("z", lambda t, q, u: q[0] + u[0] ** 2),)

    def period(self):
        return 1.0


def two_charts():
    """Charts with one and with two states, two inputs, and an output that depends on both."""

    def up(t, q, u):
        product = 0.3 * q[0] * u[1]
        x = 0.6 * q[0] + u[0] + product
        square = 0.5 * q[0] ** 2
        y = square + u[1]
        return x, y

    def down(t, q, u):
        linear = 0.5 * q[0] - q[1]
        product = 0.2 * u[0] * u[1]
        return (linear + product + 0.4 * q[1] ** 2,)

    def shown(t, q, u):
        by_input = q[0] * u[0]
        square = 2 * u[1] ** 2
        return q[0] + u[1] + by_input + square + 0.5 * u[0] * u[1]

    def one_rates(t, q, u):
        return (0.0 * q[0],)

    def two_rates(t, q, u):
        return (0.0 * q[0], 0.0 * q[1])

    charts = {
        "one": Field(("x",), one_rates),
        "two": Field(("x", "v"), two_rates),
    }
    transitions = (
        hj.Transition("up", "one", "two", hj.systems.Scheduled(1.0), reset=up),
        hj.Transition("down", "two", "one", hj.systems.Scheduled(1.0, 0.5), reset=down),
    )
    return toy(
        charts, transitions, 1.0, (hj.Output("z", shown),), inputs=("push", "pull")
    )


SHORT = hj.multisine(4, periods=8, inputs=("push", "pull")).scaled(1e-3)


def about(system):
    guess = hj.Guess("rest", (0.0,), time=0.5)
    cycle = hj.find_limit_cycle(system, guess, scale={"x": 1.0})
    sections = hj.ClockPhase(4)
    return cycle, sections, hj.linearize(cycle, sections, "x")


@pytest.fixture(scope="module")
def quadratic():
    return about(Quadratic())


@pytest.fixture(scope="module")
def two():
    guess = hj.Guess("one", (0.0,), time=0.75)
    cycle = hj.find_limit_cycle(two_charts(), guess)
    sections = hj.ClockPhase(4)
    return cycle, sections, hj.linearize(cycle, sections, ("x", "z"))


def even_part(cycle, sections, u, outputs):
    """(y(u) + y(-u)) / 2 of the nonlinear system, as it deviates from the cycle."""
    both = np.concatenate([u, -u])
    data = hj.run_experiments(
        cycle, sections, both, outputs, start="steady", accuracy=1e-11
    )
    up, down = np.split(data.y, 2)
    return (up + down) / 2


@pytest.mark.slow
def test_the_even_part_of_the_hopper(hopper_cycle):
    """The error is of fourth order."""
    sections = KINEMATIC
    quadratic = second_order(hopper_cycle, sections, OUTPUTS, ("u",))
    left = []
    for rms in (0.02, 0.04):
        u = EXPERIMENTS.scaled(rms=rms).signals()
        even = even_part(hopper_cycle, sections, u, OUTPUTS)
        wrong = even - quadratic.second_order(u)
        wrong_power = np.mean(wrong**2)
        even_power = np.mean(even**2)
        left.append(np.sqrt(wrong_power / even_power))
    assert left[0] < 1e-3
    ratio = left[1] / left[0]
    assert ratio == pytest.approx(4, rel=0.1)


@pytest.mark.slow
def test_without_a_clock(vanderpol_cycle):
    """Sections on which no time is kept, and the direction of the flow means nothing."""
    sections = hj.KinematicPhase(4, "x", "v", anchor=hj.Crossing("v", "falling"))
    quadratic = second_order(vanderpol_cycle, sections, ("x", "v"), ("u",))
    design = hj.multisine(4, periods=4, frequencies=(0.0, 2.0))
    u = design.scaled(rms=1e-3).signals()
    even = even_part(vanderpol_cycle, sections, u, ("x", "v"))
    expected = quadratic.second_order(u)
    error = np.abs(even - expected).max()
    assert error < 1e-4 * np.abs(even).max()


@pytest.mark.slow
@pytest.mark.parametrize("inputs", [("pull", "push"), ("pull",)])
def test_two_inputs(two, inputs):
    """Inputs in any order; charts with one and two states; outputs that depend on the inputs."""
    cycle, sections, _ = two
    quadratic = second_order(cycle, sections, ("x", "z"), inputs)
    everything = SHORT.signals()
    columns = [SHORT.inputs.index(name) for name in inputs]
    u = everything[:, :, columns]
    of_system = np.zeros_like(everything)
    for k, name in enumerate(inputs):
        column = ("push", "pull").index(name)
        of_system[:, :, column] = u[:, :, k]
    even = even_part(cycle, sections, of_system, ("x", "z"))
    tolerance = 1e-5 * np.abs(even).max()
    assert_allclose(quadratic.second_order(u), even, rtol=0, atol=tolerance)


def require_mean_square(outputs, count, expected, precision):
    """The mean square over draws is what is expected, but for 3.5 standard errors."""
    in_time = np.mean(outputs**2, axis=1)
    each = in_time.reshape(count, -1, 2).mean(axis=1)
    standard_error = np.std(each, axis=0) / np.sqrt(count)
    mean = np.mean(each, axis=0)
    error = np.abs(mean - expected)
    assert (error < 3.5 * standard_error).all()
    assert (standard_error < precision * expected).all()


def products_of(two):
    cycle, sections, model = two
    cosines = Candidates.of(SHORT)
    limit = Distortion(cycle, sections, {"x": 1.0, "z": 1.0})
    return cosines, products(limit, cosines, model.inputs, cosines.power_of(SHORT))


def test_the_expected_size_with_two_inputs(two):
    """Over draws of the phases."""
    count = 400
    _, form = products_of(two)
    drawn = SHORT.realizations(count)
    outputs = form.quadratic.second_order(drawn.signals())
    require_mean_square(outputs, count, form.rms(SHORT) ** 2, 0.02)


def test_the_expected_size_of_gaussian_inputs(two):
    """Over draws of phases and amplitudes."""
    count = 400
    cosines, form = products_of(two)
    drawn = SHORT.realizations(count)
    rng = np.random.default_rng(0)
    size = np.sqrt(rng.exponential(size=len(drawn.line)))
    drawn = dataclasses.replace(drawn, amplitude=drawn.amplitude * size)
    outputs = form.quadratic.second_order(drawn.signals())
    matrix = form.quadratic.products(cosines.f, cosines.channel).gaussian()
    expected = [matrix @ power @ power for power in cosines.powers_in(SHORT)]
    require_mean_square(outputs, count, np.mean(expected, axis=0), 0.05)


@pytest.mark.parametrize("f", [0.125, 0.375])
def test_one_cosine_in_closed_form(quadratic, f):
    """x2[p+1] = 0.6 x2[p] + 0.7 x1[p]^2, of which the mean and twice the frequency are seen; z has
    the square of the input, too."""
    cycle, sections, _ = quadratic
    amplitude = 0.01
    design = hj.experiments.Design.from_lines(
        [[f]], amplitude, 0.4, n_sections=4, periods=8, inputs="u"
    )
    cosines = Candidates.of(design)
    limit = Distortion(cycle, sections, {"x": 1.0, "z": 1.0})
    found = products(limit, cosines, ("u",), cosines.power_of(design))

    z = np.exp(2j * np.pi * f)
    x1 = amplitude / np.abs(z - 0.6)
    mean = 0.7 * x1**2 / 2 / 0.4
    distance = np.abs(z**2 - 0.6)
    twice = 0.7 * x1**2 / 2 / distance
    rms_of_x = np.sqrt(mean**2 + twice**2 / 2)
    rms = found.rms(design)
    assert rms[0] == pytest.approx(rms_of_x, rel=1e-9)
    with_phases = found.rms(design, phases=True)
    assert_allclose(with_phases, found.rms(design), rtol=1e-9)
    u = design.signals()
    x, z = found.quadratic.second_order(u)[0].T
    square = u[0, :, 0] ** 2
    assert_allclose(z, x + square, atol=1e-15)


@pytest.mark.slow
def test_designs_within_a_distortion(hopper_cycle):
    """The limit holds for the experiments that are made, and those of equal amplitudes."""
    sections = hj.ClockPhase(8, anchor=APEX)
    model = hj.linearize(hopper_cycle, sections, OUTPUTS)
    usual = hj.multisine(8, periods=32)
    limit = Limits(distortion=Distortion(hopper_cycle, sections, LEVEL))
    plan = hj.optimal_design(model, usual, limit=limit, noise=NOISE)

    def shares(rms):
        """The distortion of each output as a share of its limit."""
        return {name: rms[f"distortion of {name}"] / LEVEL[name] for name in LEVEL}

    found = shares(plan.rms).items()
    at_limit = [name for name, share in found if share > 0.99]
    assert len(at_limit) > 0
    assert plan.limited == tuple(at_limit)
    largest = max(shares(plan.rms).values())
    assert largest == pytest.approx(1)
    largest_usual = max(shares(plan.usual_rms).values())
    assert largest_usual == pytest.approx(1)
    assert plan.saved > 1.2
    assert 1 <= plan.certificate < 1.1
    names = " and ".join(plan.limited)
    assert f"With the {names} limited, one cycle" in plan.advice
    assert "of distortion: an upper bound" in repr(plan)

    # Twice what is allowed: twice the power, half of the strides.
    twice = {name: 2 * level for name, level in LEVEL.items()}
    limit = Limits(distortion=Distortion(hopper_cycle, sections, twice))
    more = hj.optimal_design(model, usual, limit=limit, noise=NOISE)
    assert more.criterion == pytest.approx(plan.criterion / 2, rel=0.02)

    # What one draw of the phases does, as the nonlinear hopper does by the test above.
    quadratic = second_order(hopper_cycle, sections, OUTPUTS, ("u",))
    outputs = quadratic.second_order(plan.design.signals())
    squares = np.mean(outputs**2, axis=(0, 1))
    rms = np.sqrt(squares)
    expected = [plan.rms[f"distortion of {name}"] for name in OUTPUTS]
    assert_allclose(rms, expected, rtol=0.1)


def test_beside_other_limits(quadratic):
    """Peaks, with the distortion of the phases that these get; several models."""
    cycle, sections, model = quadratic
    usual = hj.multisine(4, periods=16).scaled(0.01)
    distortion = Distortion(cycle, sections, {"x": 1e-3})
    options = dict(noise={"x": 1e-4}, goal=GOAL)
    limit = Limits(peak={"u": 0.05}, distortion=distortion)
    peaked = hj.optimal_design(model, usual, limit=limit, **options)
    peak = np.abs(peaked.design.signals()).max()
    assert peak <= 0.05 * (1 + 1e-9)
    assert peaked.rms["distortion of x"] <= 1e-3 * (1 + 1e-9)
    assert peaked.certificate >= 1
    both = hj.optimal_design(
        [model, model],
        usual,
        limit=Limits(rms={"u": 0.01}, distortion=distortion),
        robust="worst",
        **options,
    )
    assert both.limited == ("u",)
    assert both.rms["distortion of x"] < 1e-3
    assert both.rms["u"] <= 0.01 * (1 + 1e-9)
    assert both.certificate >= 1


def test_without_distortion(quadratic):
    """Nothing limits a linear system's."""
    cycle, sections, model = about(Quadratic(b=0.0))
    usual = hj.multisine(4, periods=16).scaled(0.01)
    linear = Distortion(cycle, sections, {"x": 1e-3})
    options = dict(noise={"x": 1e-4}, goal=GOAL)
    with pytest.raises(
        hj.errors.DefinitionError, match="moves no signal of `limit`: limit the input"
    ):
        hj.optimal_design(model, usual, limit=Limits(distortion=linear), **options)
    both = Limits(rms={"u": 0.01}, distortion=linear)
    plan = hj.optimal_design(model, usual, limit=both, **options)
    alone = hj.optimal_design(model, usual, limit={"u": 0.01}, **options)
    assert plan.rms["distortion of x"] == 0
    assert plan.criterion == pytest.approx(alone.criterion, rel=1e-3)


def test_bad_distortions(quadratic):
    cycle, sections, model = quadratic
    doubled = 2 * model.B
    twice = hj.linear.LDTP(model.A, doubled, model.C, outputs="x")
    for family, message in (
        (hj.ClockPhase(8), "different n_sections: 8 and 4"),
        (sections, "differ in H_0 .to x, by 50%"),
    ):
        limit = Limits(distortion=Distortion(cycle, family, {"x": 1.0}))
        with pytest.raises(hj.errors.DefinitionError, match=message):
            hj.optimal_design(twice, hj.multisine(4, periods=16), limit=limit)
