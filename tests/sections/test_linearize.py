"""A, B, C, D between sections: against stored references, and against scipy's differences."""

import dataclasses
import math

import equinox as eqx
import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj

from ..conftest import APEX, ISOCHRONS, KINEMATIC, OUTPUTS
from ..orbits import hopper_scipy


LAMBDA = -0.248983334735609 + 0.699333251798004j
LOSSY = -0.317897006349938 + 0.694628822735891j


def padded(x):
    return np.nan_to_num(np.asarray(x))


def test_isochrons_agree_with_the_reference(reference, placed_isochrons, isochron_ldtp):
    data = reference("ldtp_isochron")
    clock = np.asarray(placed_isochrons.lanes.t) % 1
    assert_allclose(clock, data["clock"] % 1, atol=1e-10)
    assert_allclose(placed_isochrons.lanes.q.T, padded(data["q"]), atol=1e-10)
    assert_array_equal(isochron_ldtp.dims, data["dim"])
    assert_allclose(isochron_ldtp.A, padded(data["A"]), atol=1e-8)
    expected = padded(data["B"])
    assert_allclose(isochron_ldtp.B[..., 0], expected, atol=1e-8)
    assert_allclose(isochron_ldtp.C, padded(data["C"]), atol=1e-12)
    assert_array_equal(isochron_ldtp.D, np.zeros((32, 2, 1)))
    markov = isochron_ldtp.impulse_response(97)[..., 0]
    assert_allclose(markov, data["markov"], atol=1e-8)


def test_all_lines_of_the_transfer_function(reference, isochron_ldtp):
    data = reference("htf_exact_isochron")
    response = isochron_ldtp.htf(data["f"])
    values = np.asarray(response.H)[..., 0]
    H = values.transpose(1, 0, 2)
    modulus = np.abs(data["H"][:, 16])
    largest = modulus.max(axis=0)
    apart = np.abs(H - data["H"])
    error = apart.max(axis=(0, 1))
    assert np.all(error <= 1e-8 * largest)


@pytest.mark.parametrize("family", ["isochron_ldtp", "kinematic_ldtp"])
def test_multipliers_are_the_same_from_every_section(family, hopper_cycle, request):
    ldtp = request.getfixturevalue(family)
    truth = np.array([LAMBDA, np.conj(LAMBDA)])
    assert_allclose(hopper_cycle.multipliers, truth, atol=1e-9)
    assert_allclose(ldtp.multipliers, truth, atol=1e-9)
    for i in range(32):
        monodromy = np.asarray(ldtp.monodromy(i))
        found = sorted(np.linalg.eigvals(monodromy), key=abs)
        measured = sorted(found[-2:], key=np.imag)
        assert_allclose(measured, truth[::-1], atol=1e-9)
        assert ldtp.rank(i) == 2


def test_resets_that_depend_on_time():
    """The velocity of the paddle at the impact is told by the time of the impact."""
    cycle = hj.find_limit_cycle(hj.models.PaddleJuggler())
    time, *state, exact = cycle.system.exact()
    (impact,) = cycle.trajectory().events
    assert_allclose(
        [impact.time % 1, *impact.after.values()], [time, *state], atol=1e-9
    )
    assert_allclose(*np.sort_complex([cycle.multipliers, exact]), atol=1e-9)
    found = hj.linearize(cycle, hj.ClockPhase(8)).multipliers
    assert_allclose(np.sort_complex(found), np.sort_complex(exact), atol=1e-9)


def angles(apex, count):
    """Kinematic sections of the scipy hopper, the first of them through its apex."""
    position, velocity = hopper_scipy.plane(apex)
    first = np.arctan2(velocity, position)
    return [("angle", first - 2 * np.pi * i / count) for i in range(count)]


def cycle_points(sections, start, retention=1.0):
    """The scipy hopper's cycle on each of the sections."""
    points = [hopper_scipy.flow(start, sections[0], retention=retention)]
    for section in sections[1:]:
        points.append(hopper_scipy.flow(points[-1], section, retention=retention))
    return points


def check_against_differences(ldtp, sections, points, retention, subset):
    """Matrices against differences of scipy's flow from section to section."""
    N = len(sections)
    tolerance_A = 1e-7 * np.max(np.abs(ldtp.A))
    tolerance_B = 1e-7 * np.max(np.abs(ldtp.B))
    time_is_known = ldtp.coordinates[0][0] != "t"
    for i in subset:
        here = sections[i]
        there = sections[(i + 1) % N]
        if i == N - 1 and time_is_known:
            there = ("clock", there[1] + 1.0)
        before = ldtp.coordinates[i]
        after = ldtp.coordinates[(i + 1) % N]
        J = hopper_scipy.jacobian(points[i], here, there, before, after, retention)
        A = np.asarray(ldtp.A)[i, : len(after), : len(before)]
        B = np.asarray(ldtp.B)[i, : len(after), 0]
        by_state = J[:, :-1]
        assert_allclose(A, by_state, rtol=0, atol=tolerance_A, err_msg=f"A[{i}]")
        by_input = J[:, -1]
        assert_allclose(B, by_input, rtol=0, atol=tolerance_B, err_msg=f"B[{i}]")


def test_kinematic_sections_agree_with_scipy(
    reference, kinematic_ldtp, placed_kinematic
):
    sections = angles((0.0, 2.2, 0.0), 32)  # at the apex vM = 0, so the angle is 0
    start = (0.5, *reference("limit_cycle")["state_clock_half"])
    points = cycle_points(sections, start)
    times = np.asarray(placed_kinematic.lanes.t)
    states = np.asarray(placed_kinematic.lanes.q)
    for i, (time, *state) in enumerate(points):
        assert_allclose(times[i], time, rtol=0, atol=1e-10)
        reached = states[: len(state), i]
        assert_allclose(reached, state, rtol=0, atol=1e-10)
    check_against_differences(kinematic_ldtp, sections, points, 1.0, range(32))


def lossy_sections(kind, count):
    start = (0.5, 1.87978886663710, 1.75832736962547)
    apex = hopper_scipy.flow(start, ("angle", 0.0), retention=0.8)
    if kind == "isochron":
        sections = [("clock", apex[0] + i / count) for i in range(count)]
    else:
        sections = angles(apex, count)
    return sections, cycle_points(sections, start, retention=0.8)


@pytest.mark.parametrize("kind", ["isochron", "kinematic"])
def test_a_touchdown_that_loses_speed_agrees_with_scipy(kind, lossy_cycle):
    # With 32 kinematic sections the jump at touchdown would throw the cycle back over one.
    N = 32 if kind == "isochron" else 8
    family = (
        ISOCHRONS
        if kind == "isochron"
        else dataclasses.replace(KINEMATIC, n_sections=N)
    )
    ldtp = hj.linearize(lossy_cycle, family, OUTPUTS)
    assert_allclose(ldtp.multipliers, [LOSSY, np.conj(LOSSY)], atol=1e-9)
    sections, points = lossy_sections(kind, N)
    dims = [len(p) for p in points]
    changes = [i for i in range(N) if dims[i] != dims[(i + 1) % N]]
    assert len(changes) == 2  # the intervals that contain touchdown and liftoff
    check_against_differences(ldtp, sections, points, 0.8, [*changes, 0, 2])


def test_a_jump_that_goes_back_over_a_section_is_reported(lossy_cycle):
    with pytest.raises(
        hj.errors.ComputationError,
        match=r"section 19 .* is crossed .* t = 1.34 in stance\. Choose",
    ):
        hj.linearize(lossy_cycle, KINEMATIC, OUTPUTS)


def test_a_cycle_that_is_rest():
    """Where the state stands still, only its derivatives say how short steps must be."""
    cycle = hj.find_limit_cycle(hj.models.Mathieu(delta=1.0, epsilon=0.4))
    found = hj.linearize(cycle, hj.ClockPhase(4)).multipliers
    expected = np.sort(cycle.multipliers)
    assert_allclose(np.sort(found), expected, rtol=1e-10)


@pytest.mark.parametrize(
    "late_input, late_output", [(7, 16), (40, 9), (0, 16), (10, 15), (0, 0)]
)
def test_delays_agree_with_finer_sections(hopper_cycle, late_input, late_output):
    """100 sections, whose inputs change at every 25th: delays of so many of them."""
    finer = 25
    N = 4 * finer
    fine = hj.linearize(hopper_cycle, hj.ClockPhase(N, anchor=APEX), OUTPUTS)
    interval = float(hopper_cycle.period) / N
    delay = (late_input * interval, late_output * interval)
    sections = hj.ClockPhase(4, anchor=APEX)
    model = hj.linearize(hopper_cycle, sections, OUTPUTS, delay=delay)

    rng = np.random.default_rng(0)
    u = rng.normal(size=(24, 1))
    rest = np.zeros((N + late_input, 1))  # a period before the input begins
    held = np.repeat(u, finer, axis=0)
    inputs = np.concatenate([rest, held])
    y = np.asarray(fine.simulate(inputs))
    expected = y[N - late_output :: finer][: len(u)]
    tolerance = 1e-11 * np.abs(expected).max()
    assert_allclose(model.simulate(u), expected, atol=tolerance)
    assert_allclose(model.multipliers, hopper_cycle.multipliers, atol=1e-9)
    # The inputs on their way are states.
    kept = math.ceil((late_input + late_output) / finer)
    assert max(model.dims) == max(fine.dims) + kept


def test_delays_at_sections_of_the_state_are_refused(hopper_cycle):
    with pytest.raises(
        hj.errors.DefinitionError, match="needs sections at equal times"
    ):
        hj.linearize(hopper_cycle, KINEMATIC, OUTPUTS, delay=(0.1, 0.0))


class _Leaky(hj.Chart):
    states = ("v",)

    def field(self, t, q, u):
        return (1.2 - q[0] + u[0],)


class _Neuron(hj.HybridSystem):
    """Integrate and fire: on a section, its only state is known, and nothing is left to deviate."""

    def charts(self):
        return {"below": _Leaky()}

    def transitions(self):
        def threshold(t, q, u):
            return 1 - q[0]

        def after(t, q, u):
            return (0.0,)

        return [hj.Transition("spike", "below", "below", guard=threshold, reset=after)]


HALF = hj.Crossing("v", "rising", 0.5)


MOST = hj.Crossing("v", "rising", 0.8)


@pytest.mark.slow
@pytest.mark.parametrize(
    "sections, dims",
    [([HALF, hj.AtEvent("spike")], [0, 1]), ([HALF, MOST], [0, 0]), (HALF, [0])],
)
def test_sections_of_a_chart_with_one_state_have_the_dimension_zero(sections, dims):
    guess = hj.Guess("below", (0.5,))
    cycle = hj.find_limit_cycle(_Neuron(), guess)
    # The voltage of a section does not change, the current does.
    current = hj.Output("current", lambda t, q, u: 3 * q[0] + 2 * u[0])
    model = hj.linearize(cycle, sections, outputs=current)
    assert_array_equal(model.dims, dims)
    assert [len(names) for names in model.coordinates] == dims
    assert len(model.multipliers) == 0

    H = model.htf((0.1, 0.2, 0.4))
    for m in H.harmonics:
        gain = 2 if m == 0 else 0
        assert_allclose(H[m][:, 0, 0], gain)
    ones = np.ones((4, 1))
    assert_allclose(model.simulate(ones), 2 * ones)
    closed = model.feedback(np.zeros((1, 1)))
    assert_allclose(closed.simulate(ones), 2 * ones)

    whole_design = hj.multisine(len(dims), 8, inputs="u")
    design = whole_design.scaled(0.01)
    data = hj.run_experiments(cycle, sections, design, current, start="periodic")
    assert_allclose(data.y, 2 * data.u, rtol=1e-9)


@pytest.mark.slow
def test_a_section_map_waits_for_late_arrivals():
    """A ball 3 m/s faster than on the cycle flies for two periods: alone and inside of programs."""
    cycle = hj.find_limit_cycle(hj.models.PaddleJuggler())
    paddle = hj.sections.section_map(cycle, [hj.AtEvent("impact")], 0, 0)
    fixed = np.asarray(paddle.fixed_point)
    state = fixed + np.array([0.0, 3.0])
    placed = hj.sections.place_sections(cycle, [hj.AtEvent("impact")])
    begin = float(placed.lanes.t[0])
    path = hj.simulate(cycle.system, "fall", state, 3.0, time=begin)
    alone = paddle(state)
    inside = eqx.filter_jit(paddle)(state)
    twice = np.stack([state, state])
    both = jax.vmap(paddle)(twice)
    duration = float(alone.t) - begin
    assert duration > 1.5 * float(cycle.period)
    for t in (alone.t, inside.t, both.t[1]):
        assert_allclose(t, path.events[0].time, rtol=1e-9)


@pytest.mark.slow
def test_second_derivatives_of_a_period():
    cycle = hj.find_limit_cycle(hj.models.VanDerPol())

    def period(mu):
        return hj.find_limit_cycle(hj.models.VanDerPol(mu=mu), cycle).period

    h = 1e-3
    middle = 2 * period(1.0)
    change = period(1 + h) - middle + period(1 - h)
    second = change / h**2
    exact = jax.jacrev(jax.jacfwd(period))(1.0)
    assert_allclose(exact, second, rtol=1e-5)
    with pytest.raises(hj.errors.DefinitionError, match="jacrev.*jacfwd"):
        jax.hessian(period)(1.0)
