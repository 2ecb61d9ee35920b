"""The flow under the transformations of JAX: exact derivatives through events, in both modes."""

import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose

import hybridjax as hj
from hybridjax.engine.lanes import start_lanes
from hybridjax.engine.move import move
from hybridjax.engine.settings import Settings
from hybridjax.engine.target import until
from hybridjax.systems.structure import Structure

from ..conftest import no_compilation
from ..toys import Field, Toys


def tight(s):
    """Settings for states of size 1."""
    scale = np.ones((len(s.charts), s.d))
    return Settings(1e-13, 1e-13, 256, scale)


def flow(system, chart, q, u, t, end):
    """State after the flow of one lane from time t to `end`, and its result."""
    s = Structure(system)
    padded = jnp.zeros((s.d, 1))
    rows = q.shape[0]
    q = padded.at[:rows, 0].set(q)
    index = jnp.full(1, s.chart_index(chart), jnp.int32)
    lanes = start_lanes(s, t[None], index, q)
    target = until(end[None])
    inputs = u[:, None]
    moved = move(s, lanes, inputs, target, tight(s)).moved
    return moved.lanes.q[:, 0], moved.result[0]


def ball(x):
    """(y, v) of a bouncing ball; x = (y0, v0, gravity, restitution, input, duration)."""
    system = hj.models.BouncingBall(g=x[2], restitution=x[3])
    zero = jnp.zeros(())
    end = flow(system, "fall", x[:2], x[4:5], zero, x[5])
    return end[0]


def ball_exact(x):
    y0, v0, g, e, u, end = x
    g = g - u
    square = v0**2 + 2 * g * y0
    speed = jnp.sqrt(square)
    first = (v0 + speed) / g
    rest = end - first
    thrown = e * speed * rest
    height = thrown - g * rest**2 / 2
    velocity = e * speed - g * rest
    return jnp.stack([height, velocity])


X = jnp.array([1.0, 0.3, 9.81, 0.7, 0.2, 0.9])  # one bounce


def test_reverse_mode_and_second_derivatives_have_a_closed_form():
    found, first = jax.jit(
        jax.jacfwd(lambda x: (jax.jacrev(ball)(x),) * 2, has_aux=True)
    )(X)
    slope, exact = jax.jit(
        lambda x: (jax.jacfwd(ball_exact)(x), jax.hessian(ball_exact)(x))
    )(X)
    assert_allclose(first, slope, rtol=1e-11, atol=1e-12)
    tolerance = 1e-9 * np.max(np.abs(exact))
    assert_allclose(found, exact, atol=tolerance)


def test_lanes_fail_one_by_one():
    """NaN, blow-up and a good lane in one batch; no lane disturbs another."""
    system = hj.models.BouncingBall()
    s = Structure(system)
    heights = [1.0, jnp.nan, 1e-3, 2.0]
    speeds = [0.0, 0.0, 0.0, 0.0]
    q = jnp.array([heights, speeds])
    chart = jnp.zeros(4, jnp.int32)
    end = jnp.full(4, 0.6)
    u = jnp.array([[0.0, 0.0, 0.0, jnp.inf]])
    lanes = start_lanes(s, jnp.zeros(4), chart, q)
    target = until(end)
    moved = move(s, lanes, u, target, tight(s)).moved
    bad = hj.errors.Result.BAD_INPUT
    zeno = hj.errors.Result.ZENO
    codes = [hj.errors.Result.OK, bad, zeno, bad]
    assert moved.result.tolist() == codes
    x = jnp.array([1.0, 0.0, 9.81, 0.7, 0.0, 0.6])
    expected = jax.jit(ball_exact)(x)
    assert_allclose(moved.lanes.q[:, 0], expected, rtol=1e-12)


def test_new_numbers_compile_nothing():
    """Parameters, states, times and tolerances are data; only shapes and types are compiled."""

    def run(g, *state, until, time):
        hj.simulate(hj.models.BouncingBall(g=g), "fall", state, until, time=time)

    with no_compilation(after=lambda: run(9.0, 1.0, 0.0, until=1.0, time=0.0)):
        run(8.0, 1.1, 0.1, until=1.3, time=0.2)


def roots(a):
    """Chart "rise" is not defined for negative states, which chart "fall" has."""

    def rise_rates(t, q, u):
        return (jnp.sqrt(q[0]),)

    rise = Field(("z",), rise_rates)

    def fall_rates(t, q, u):
        return (-a,)

    charts = {"fall": Field(("x",), fall_rates), "rise": rise}

    def turn(t, q, u):
        return q[0] + 1.0

    def turn_reset(t, q, u):
        return -q

    return charts, (hj.Transition("turn", "fall", "rise", turn, reset=turn_reset),)


def test_gradient_of_a_mapped_flow_through_charts_that_are_not_defined_everywhere():
    """A mapped branch computes both sides: those of lanes in other charts must not be seen.
    z = (1 + (2 - t1) / 2)^2 with the event at t1 = (x + 1) / a."""

    def end(x, a):
        system = Toys(roots, [a])
        zero = jnp.zeros(())
        time = jnp.asarray(2.0)
        state = flow(system, "fall", x[None], zero[None], zero, time)[0]
        return state[0]

    def exact(x, a):
        part = (2 - (x + 1) / a) / 2
        return (1 + part) ** 2

    x = jnp.array([-0.5, 0.2])
    a = 1.3

    def loss(f):
        return lambda x, a: jnp.sum(jax.vmap(f, (0, None))(x, a) ** 2)

    slope = jax.grad(loss(end), argnums=(0, 1))
    gradient = jax.jit(slope)(x, a)
    for value, true in zip(
        gradient, jax.grad(loss(exact), argnums=(0, 1))(x, a), strict=True
    ):
        assert_allclose(value, true, rtol=1e-10)
