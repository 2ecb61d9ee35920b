"""Equations of motion from energies, against those by hand and against conservation laws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj

from ..toys import Field, toy


hj.enable_x64()
m, M, L, G = 1.3, 2.0, 0.7, 9.81


def double_pendulum():
    """Two equal masses on two equal rods, by absolute angles from straight down."""

    def place(q):
        way = jnp.stack([jnp.sin(q), -jnp.cos(q)], axis=1)
        return L * jnp.cumsum(way, axis=0)

    def kinetic(q, v):
        return 0.5 * m * jnp.sum(jax.jvp(place, (q,), (v,))[1] ** 2)

    return hj.Mechanism(kinetic, lambda q: m * G * jnp.sum(place(q)[:, 1]))


def free_ball():
    return hj.Mechanism(
        lambda q, v: 0.5 * M * jnp.sum(v**2) + v[0], lambda q: M * G * q[1]
    )


def test_a_double_pendulum_moves_as_textbooks_say():
    q = jnp.array([0.4, -0.7])
    v = jnp.array([1.1, 0.6])
    f = jnp.array([0.2, -0.1])
    pendulum = double_pendulum()
    s = jnp.sin(q[0] - q[1])
    c = jnp.cos(q[0] - q[1])
    mass = m * L**2 * jnp.array([[2, c], [c, 1]])
    bias = m * L**2 * s * jnp.array([v[1] ** 2, -(v[0] ** 2)])
    bias = bias + m * G * L * jnp.array([2, 1]) * jnp.sin(q)

    @jax.jit
    def motion(q, v, f):
        a = pendulum.acceleration(q, v, f)
        power = jax.jvp(pendulum.energy, (q, v), (v, a))[1]
        return pendulum.mass(q), pendulum.bias(q, v), a, power

    expected = mass, bias, np.linalg.solve(mass, f - bias), f @ v
    for x, y in zip(motion(q, v, f), expected, strict=True):
        assert_allclose(x, y, rtol=1e-12)


def test_a_contact_that_holds_is_a_rod():
    """A ball on a rod: the same motion in two coordinates with a contact, and in one."""

    def rod(q):
        return jnp.sum(q**2, keepdims=True) / 2

    angle, rate = 0.5, 1.2

    def place(p):
        return L * jnp.stack([jnp.sin(p[0]), -jnp.cos(p[0])])

    pendulum = free_ball().along(place)
    a = jax.jit(pendulum.acceleration)(jnp.array([angle]), jnp.array([rate]))
    assert_allclose(a, [-G / L * np.sin(angle)], rtol=1e-13)
    q = place([angle])
    v = jax.jvp(place, (jnp.array([angle]),), (jnp.array([rate]),))[1]
    found = jax.jit(
        lambda q, v: free_ball().constrained(q, v, 0.0, lambda q: rod(q)[0])
    )(q, v)
    tension = M * (G * np.cos(angle) + L * rate**2)
    assert_allclose(found.force * L, [-tension], rtol=1e-13)
    along = jnp.array([np.cos(angle), np.sin(angle)])
    assert_allclose(found.acceleration @ along / L, a[0], rtol=1e-12)


@pytest.mark.parametrize("e", [0.6, 1.0])
def test_impacts(e):
    q = jnp.array([0.4, -0.7])
    v = jnp.array([1.1, 0.6])
    pendulum = double_pendulum()

    def tip(q):
        return L * jnp.array([1.0, 1.0]) @ jnp.sin(q)[:, None]

    found = jax.jit(lambda e: pendulum.impact(q, v, tip, e))(e)
    J = jax.jacfwd(tip)(q)
    assert_allclose(J @ found.velocity, -e * (J @ v), atol=1e-14)
    gained = pendulum.mass(q) @ (found.velocity - v)
    assert_allclose(gained, J.T @ found.impulse, rtol=1e-12)
    lost = pendulum.energy(q, v) - pendulum.energy(q, found.velocity)
    assert abs(lost) < 1e-12 if e == 1 else lost > 0


def worn(t, q, u):
    """The second body wears away as the first moves, until x = 1."""

    def lost(q, v):
        return 0.5 * v[0] ** 2 + 0.5 * jnp.maximum(1 - q[0], 0.0) * v[1] ** 2

    return jnp.concatenate([q[2:], hj.Mechanism(lost).acceleration(q[:2], q[2:])])


def test_a_singular_mass_matrix_ends_the_trajectory_with_its_cause():
    system = toy({"move": Field(("x", "y", "vx", "vy"), worn)})
    found = hj.simulate(system, "move", (0.0, 0.0, 1.5, 0.0), 5.0, throw=False)
    assert found.result == hj.Result.FIELD_NOT_FINITE
    assert_allclose(found.t[-1], 2 / 3, rtol=1e-6)
    for method, force in ((free_ball().impact, ()), (free_ball().constrained, (0.0,))):
        with pytest.raises(hj.DefinitionError, match="`contact` must be independent"):
            method(jnp.ones(2), jnp.ones(2), *force, lambda q: [q[1], 2 * q[1]])
    with pytest.raises(hj.DefinitionError, match="kinetic energy must be positive"):
        hj.Mechanism(lambda q, v: -0.5 * v @ v).acceleration(jnp.zeros(2), jnp.zeros(2))
