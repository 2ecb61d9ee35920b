"""Section maps, cycles and linearizations under compositions of jit, vmap, jvp and vjp.

The truth is a closed form.
"""

import functools as ft

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

import hybridjax as hj
from hybridjax._core.compilation import compiler_options
from hybridjax.engine.settings import Settings


# Compiled in a third of the time, to slower programs.
QUICK = compiler_options()
compiled = ft.partial(jax.jit, compiler_options=QUICK)
TIGHT = Settings(rtol=1e-13, atol=1e-13)


def fresh(P, system):
    """The section map of another system, between the same sections."""
    return eqx.tree_at(lambda P: P.placed.cycle.system, P, system)


# --- A system with a closed form ------------------------------------------------------------------


class Fall(hj.Chart):
    states = ("x", "y")
    relay: "Relay"

    def field(self, t, q, u):
        return u[0] - self.relay.a * (q[0] + 1), q[0] - self.relay.b * q[1]


class Rise(hj.Chart):
    """Its field is not defined for negative z; in chart "fall", x is negative before the event."""

    states = ("z", "y")
    relay: "Relay"

    def field(self, t, q, u):
        return jnp.sqrt(q[0]), u[0] - self.relay.b * q[1]


class Relay(hj.HybridSystem):
    a: Float[Array, ""] = hj.parameter(1.3)
    b: Float[Array, ""] = hj.parameter(0.4)
    c: Float[Array, ""] = hj.parameter(-0.5)

    def charts(self):
        return {"fall": Fall(self), "rise": Rise(self)}

    def transitions(self):
        def turn(t, q, u):
            return q[0] - self.c + 0.1 * q[1]

        def turned(t, q, u):
            return 0.3 + 0.2 * q[1] ** 2, q[1] - 0.3 * q[0]

        def landed(t, q, u):
            return q[0] + 0.1 * q[1], 0.9 * q[1]

        return (
            hj.Transition("turn", "fall", "rise", turn, "falling", turned),
            hj.Transition("land", "rise", "fall", lambda t, q, u: q[0] - 1, "rising", landed),
        )

    def guess(self):
        return hj.Guess("fall", (1.0, 0.3))


def exact(v):
    """From (x, y) through the event "turn" to z = 0.7, under an input from a time on: state and
    time there. The solutions are exponentials and a parabola; the event's time is a root."""
    x, y, u, t, a, b, c = v
    rest = u / a - 1
    C = (x - rest) / (b - a)

    def fall(t):
        fast, slow = jnp.exp(-a * t), jnp.exp(-b * t)
        return rest + (x - rest) * fast, rest / b + C * fast + (y - rest / b - C) * slow

    def guard(t):
        x, y = fall(t)
        return x - c + 0.1 * y

    t1 = jnp.asarray(0.6)
    for _ in range(12):  # more than enough for three derivatives, too
        value, rate = jax.jvp(guard, (t1,), (jnp.ones(()),))
        t1 = t1 - value / rate
    x, y = fall(t1)
    z, y = 0.3 + 0.2 * y**2, y - 0.3 * x
    t2 = 2 * (jnp.sqrt(0.7) - jnp.sqrt(z))
    return jnp.stack([jnp.asarray(0.7), u / b + (y - u / b) * jnp.exp(-b * t2), t + t1 + t2])


@pytest.fixture(scope="module")
def relay_map():
    """From a level in chart "fall", through an event, to a level in chart "rise"."""
    cycle = hj.find_limit_cycle(Relay(), section=hj.AtEvent("land"), settings=TIGHT)
    sections = [
        hj.Crossing("x", "falling", 0.2),
        hj.AtEvent("turn"),
        hj.Crossing("z", "rising", 0.7),
    ]
    return hj.section_map(cycle, sections, 0, 2)


def relay(P, v):
    """State and time at arrival; v = (state, input, time, a, b, c)."""
    arrival = fresh(P, Relay(a=v[4], b=v[5], c=v[6]))(v[:2], v[2], v[3])
    return jnp.append(arrival.q, arrival.t)


V = jnp.array([0.22, 0.35, 0.02, 2.4, 1.3, 0.4, -0.5])
W = V + jnp.array([0.01, -0.02, 0.01, 0.1, 0.05, -0.02, 0.03])
BOTH = jnp.stack([V, W])


def assert_equal_derivatives(found, exact, rtol):
    exact = np.asarray(exact)
    np.testing.assert_allclose(found, exact, atol=rtol * np.abs(exact).max())


@pytest.mark.slow
def test_section_map_in_closed_form(relay_map):
    """vmap of forward over reverse mode: values, first and second derivatives at two points."""

    def all_orders(v):
        def first(v):
            J, value = jax.jacrev(lambda v: (relay(relay_map, v),) * 2, has_aux=True)(v)
            return J, (J, value)

        return jax.jacfwd(first, has_aux=True)(v)

    H, (J, value) = compiled(jax.vmap(all_orders))(BOTH)
    np.testing.assert_allclose(value, jax.vmap(exact)(BOTH), rtol=1e-12)
    assert_equal_derivatives(J, jax.vmap(jax.jacfwd(exact))(BOTH), 1e-11)
    assert_equal_derivatives(H, jax.vmap(jax.hessian(exact))(BOTH), 1e-9)


@pytest.mark.slow
def test_third_derivatives_in_closed_form(relay_map):
    """Two corrections onto the event are right to third order."""
    direction = W - V

    def along(f):
        line = lambda s: f(V + s * direction)  # noqa: E731
        return jax.jacfwd(jax.jacfwd(jax.jacfwd(line)))

    found = compiled(along(lambda v: relay(relay_map, v)))(0.0)
    assert_equal_derivatives(found, along(exact)(0.0), 1e-8)


@pytest.mark.slow
def test_a_map_that_does_not_arrive(relay_map):
    """Without transformations it raises; with them, values and derivatives are NaN."""
    lost = jnp.array([-3.0, 0.3])
    with pytest.raises(hj.ComputationError, match="not reached from section 0"):
        relay_map(lost)
    (_, result), tangents = compiled(
        lambda q: jax.jvp(lambda q: (relay_map(q).q, relay_map(q).result), (q,), (q,))
    )(lost)
    assert result != hj.Result.OK
    assert np.isnan(tangents[0]).all()
