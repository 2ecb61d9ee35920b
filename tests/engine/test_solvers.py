"""Solvers other than the default, against closed forms: tableaus, steps, cycles, derivatives."""

import functools as ft

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import expm

import hybridjax as hj
from hybridjax._core.executor import to_host
from hybridjax.engine.lanes import start_lanes
from hybridjax.engine.move import move
from hybridjax.engine.runge_kutta import inverse, take_step
from hybridjax.engine.search.state import Stride
from hybridjax.engine.settings import Settings
from hybridjax.engine.target import Target
from hybridjax.orbits.crossing import ListLevels
from hybridjax.systems.solver import as_method
from hybridjax.systems.structure import Structure
from hybridjax.systems.system import integrated

from ..toys import Field, toy


STIFF = np.array([[0.0, 1.0], [-1e3, -3e3]])
FAST, SLOW = sorted(np.linalg.eigvals(STIFF))


# One mode decays in 3 s, one in 0.3 ms.
def rates(t, q, u):
    own = STIFF[1] @ q
    rate = own + force(t) + u[0]
    return (q[1], rate)


DAMPED = toy(
    {"a": Field(("y", "v"), rates)},
    period=1.0,
)


def force(t):
    return 20.0 * jnp.sin(2 * jnp.pi * t)


def exact(a=20.0):
    """The state of the cycle at t = 0."""
    w = 2j * np.pi
    denominator = w**2 + 3e3 * w + 1e3
    y = a / denominator
    v = w * y
    return np.array([y.imag, v.imag])


@pytest.mark.parametrize("stages", [3, 5, 7])
def test_radau_is_a_collocation_method(stages):
    method = as_method(hj.systems.Radau(stages))
    a = np.array(method.a)
    b = np.array(method.b)
    c = np.array(method.c)
    error = np.array(method.error)
    for k in range(1, stages + 1):
        power = c ** (k - 1)
        assert_allclose(a @ power, c**k / k, atol=1e-14)
        assert_allclose(error @ power, 0, atol=1e-13)
    for k in range(1, 2 * stages):
        moment = b @ c ** (k - 1)
        assert_allclose(moment, 1 / k, rtol=0, atol=1e-14)
    first_error = abs(error @ c**stages)
    assert first_error > 1e-5, "the estimate is not zero"


@pytest.mark.parametrize("rate", [1.0, 1e3, 1e5])
def test_no_error_of_a_stiff_step_is_hidden(rate):
    """Of a mode that follows, or is excited, by however little, and dies out within the step."""

    def field(t, q):
        distance = q - jnp.cos(t)
        return -rate * distance - jnp.sin(t)

    excited = np.array([[0.0, 1.0, 1e-4, 1e-8]])
    h = 0.4
    radau = as_method(hj.systems.Radau())
    start = 1.0 + excited
    length = jnp.array([h])
    step = take_step(radau, field, jnp.zeros(4), start, length)
    transient = excited * np.exp(-rate * h)
    expected = np.cos(h) + transient
    error = np.abs(np.asarray(step.q) - expected)
    estimate = np.asarray(step.error)
    assert np.all(error < 5 * estimate + 1e-15)


def a_rates(t, q, u):
    decay = -2e3 * q[1]
    return (1.0 + 0 * q[0], decay)


RAMP = toy({"a": Field(("x", "v"), a_rates)})


def test_a_landing_is_as_stiff_as_its_chart():
    """The last part of the way, five decay times long, is no explicit step."""
    s = Structure(integrated(RAMP, hj.systems.Radau()))
    levels = ListLevels((hj.Crossing("x", "rising", 1.0),))
    one = np.ones(1)
    none = np.zeros(1, np.int32)
    state = np.array([[0.0], [1e-3]])
    begun = start_lanes(s, np.zeros(1), none, state)
    lanes = to_host(begun)
    target = Target(
        np.array([np.inf]), none, none - 1, 2 * one, None, levels, hj.errors.Result.OK
    )
    scale = np.ones((1, 2))
    settings = Settings(1e-9, 1e-9, 64, scale)
    stride = Stride(one, 0.9975 * one, 1e7 * one)
    no_input = np.zeros((s.nu, 1))
    moved = move(s, lanes, no_input, target, settings, stride)
    states = moved.moved.lanes.q
    assert_allclose(states, [[1.0], [0.0]], atol=1e-7)


@pytest.mark.parametrize(
    "solver", [hj.systems.Radau(3), hj.systems.Radau(5), diffrax.Kvaerno3()]
)
def test_estimates_are_of_the_size_of_errors(solver):
    """Of a step whose end is known, one of its modes stiff."""
    method = as_method(solver)
    h = 0.4

    def field(t, q):
        x, y = q
        apart = y - jnp.cos(t)
        stiff_rate = -30 * apart - jnp.sin(t)
        return jnp.stack([-(x**2), stiff_rate])

    start = jnp.ones((2, 1))
    length = jnp.array([h])
    step = take_step(method, field, jnp.zeros(1), start, length)
    exact = [1 / (1 + h), np.cos(h)]
    found = np.asarray(step.q[:, 0])
    error = np.abs(found - exact).max()
    largest = np.abs(np.asarray(step.estimate)).max()
    estimate = largest**method.gain
    assert 0.5 < estimate / error < 10


def test_inverses_of_many_matrices():
    matrix = np.random.default_rng(0).normal(size=(5, 5, 3))
    matrix[0, 0] = 0.0  # pivots are needed
    inverses = jax.jit(inverse)(matrix)
    found = np.moveaxis(inverses, -1, 0)
    matrices = np.moveaxis(matrix, -1, 0)
    expected = np.linalg.inv(matrices)
    assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize(
    "solver",
    [hj.systems.Radau(3), pytest.param(diffrax.Kvaerno5(), marks=pytest.mark.slow)],
)
def test_derivatives_of_implicit_steps(solver):
    """First and second, by the implicit function theorem, against differences of long steps."""
    method = as_method(solver)
    h = jnp.array([0.1])

    def end(x):
        def field(t, q, x=x):
            wave = jnp.sin(q[1] + x)
            distance = q[0] - wave
            fast = -50.0 * distance
            slow = q[0] * q[1] + x
            return jnp.stack([fast, slow])

        still = ft.partial(field, x=jax.lax.stop_gradient(x))
        start = jnp.stack([0.3 + x, jnp.cos(x)])
        q = start[:, None]
        step = take_step(method, field, jnp.zeros(1), q, h, still=still)
        return step.q[:, 0]

    d = 1e-2
    lowest, low, middle, high, highest = jax.jit(jax.vmap(end))(
        d * jnp.arange(-2.0, 3.0)
    )
    first = jax.jit(jax.jacfwd(end))(0.0)
    curvature = jax.jacfwd(jax.jacfwd(end))
    second = jax.jit(curvature)(0.0)
    combined = lowest - 8 * low + 8 * high - highest
    by_differences = combined / (12 * d)
    assert_allclose(first, by_differences, rtol=1e-6)
    near = 16 * (low + high)
    curved = near - 30 * middle - lowest - highest
    twice = curved / (12 * d**2)
    assert_allclose(second, twice, rtol=1e-5)


@pytest.fixture(scope="module")
def damped():
    guess = hj.Guess("a", (0.01, 0.02))
    return hj.find_limit_cycle(integrated(DAMPED, hj.systems.Radau()), guess)


def test_a_stiff_cycle_with_default_settings(damped):
    state = list(damped.state.values())
    assert_allclose(state, exact(), rtol=1e-9, atol=1e-13)
    assert_allclose(damped.multipliers, [np.exp(SLOW), 0.0], rtol=1e-10)
    assert_allclose(damped.log_multipliers, [SLOW, FAST], rtol=1e-9)


def test_linearization_of_a_stiff_system(damped):
    model = hj.linearize(damped, hj.ClockPhase(4), outputs="y")
    exactly = expm(
        np.block([[STIFF, np.array([[0.0], [1.0]])], [np.zeros((1, 3))]]) / 4
    )
    A = model.A[0]
    B = model.B[0]
    scales = [damped.scale["y"], damped.scale["v"]]
    size = np.array(scales)
    ratio = size / size[:, None]
    found = A * ratio
    exact = exactly[:2, :2] * ratio
    assert_allclose(found, exact, atol=1e-9)
    expected = exactly[:2, 2] / size
    by_input = B[:, 0] / size
    assert_allclose(by_input, expected, rtol=1e-8, atol=1e-8)


def test_linearization_of_a_stiff_system_inside_of_a_program(damped):
    """There it follows the walk of the known cycle: implicit steps of the columns of inputs."""
    phases = hj.ClockPhase(3)

    @jax.jit
    def matrices():
        cycle = hj.find_limit_cycle(damped.system, damped)
        model = hj.linearize(cycle, phases, ("y",))
        A = model.A[:, :2, :2]
        B = model.B[:, :2]
        return A, B

    outside = hj.linearize(damped, phases, ("y",))
    A, B = matrices()
    assert_allclose(A, outside.A, atol=1e-9)
    assert_allclose(B, outside.B, rtol=1e-8)
