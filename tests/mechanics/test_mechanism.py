"""Equations of motion from energies, against those by hand and against conservation laws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj

from ..toys import Field, toy


hj.enable_x64()
m = 1.3  # of each mass of the pendulum
M = 2.0  # of the ball
L = 0.7  # of each rod
G = 9.81


def double_pendulum():
    """Two equal masses on two equal rods, by absolute angles from straight down."""

    def positions(q):
        x = jnp.sin(q)
        y = -jnp.cos(q)
        directions = jnp.stack([x, y], axis=1)
        return L * jnp.cumsum(directions, axis=0)

    def kinetic(q, v):
        _, velocities = jax.jvp(positions, (q,), (v,))
        return 0.5 * m * jnp.sum(velocities**2)

    def potential(q):
        heights = positions(q)[:, 1]
        return m * G * jnp.sum(heights)

    return hj.systems.Mechanism(kinetic, potential)


def free_ball():
    """A ball in the plane; the term linear in v has no effect on its motion."""

    def kinetic(q, v):
        square = jnp.sum(v**2)
        return 0.5 * M * square + v[0]

    def potential(q):
        return M * G * q[1]

    return hj.systems.Mechanism(kinetic, potential)


def test_a_double_pendulum_moves_as_textbooks_say():
    q = jnp.array([0.4, -0.7])
    v = jnp.array([1.1, 0.6])
    f = jnp.array([0.2, -0.1])
    pendulum = double_pendulum()

    @jax.jit
    def motion(q, v, f):
        acceleration = pendulum.acceleration(q, v, f)
        tangents = (v, acceleration)
        _, power = jax.jvp(pendulum.energy, (q, v), tangents)
        return pendulum.mass(q), pendulum.bias(q, v), acceleration, power

    mass, bias, acceleration, power = motion(q, v, f)
    s = jnp.sin(q[0] - q[1])
    c = jnp.cos(q[0] - q[1])
    ratios = jnp.array([[2, c], [c, 1]])
    expected_mass = m * L**2 * ratios
    assert_allclose(mass, expected_mass, rtol=1e-12)
    squares = jnp.array([v[1] ** 2, -(v[0] ** 2)])
    centrifugal = m * L**2 * s * squares
    masses = jnp.array([2, 1])
    moments = m * G * L * masses
    weight = moments * jnp.sin(q)
    assert_allclose(bias, centrifugal + weight, rtol=1e-12)
    expected = np.linalg.solve(expected_mass, f - centrifugal - weight)
    assert_allclose(acceleration, expected, rtol=1e-12)
    assert_allclose(power, f @ v, rtol=1e-12)


def test_a_contact_that_holds_is_a_rod():
    """A ball on a rod: the same motion in two coordinates with a contact, and in one."""
    angle = 0.5
    rate = 1.2

    def position(angles):
        x = jnp.sin(angles[0])
        y = -jnp.cos(angles[0])
        return L * jnp.stack([x, y])

    def rod(q):
        return jnp.sum(q**2) / 2

    pendulum = free_ball().along(position)
    q = jnp.array([angle])
    v = jnp.array([rate])
    acceleration = jax.jit(pendulum.acceleration)(q, v)
    assert_allclose(acceleration, [-G / L * np.sin(angle)], rtol=1e-13)

    @jax.jit
    def held(q, v):
        return free_ball().constrained(q, v, 0.0, rod)

    q, v = jax.jvp(position, (jnp.array([angle]),), (jnp.array([rate]),))
    found = held(q, v)
    gravity = G * np.cos(angle)
    tension = M * (gravity + L * rate**2)
    assert_allclose(found.force * L, [-tension], rtol=1e-13)
    direction = [np.cos(angle), np.sin(angle)]
    tangent = jnp.array(direction)
    expected = L * acceleration[0]
    assert_allclose(found.acceleration @ tangent, expected, rtol=1e-12)


@pytest.mark.parametrize("restitution", [0.6, 1.0])
def test_impacts(restitution):
    q = jnp.array([0.4, -0.7])
    v = jnp.array([1.1, 0.6])
    pendulum = double_pendulum()

    def tip(q):
        height = jnp.sin(q[0]) + jnp.sin(q[1])
        return [L * height]

    @jax.jit
    def impact(restitution):
        return pendulum.impact(q, v, tip, restitution)

    after = impact(restitution)
    J = L * np.cos(q)[None]
    rate_before = J @ v
    assert_allclose(J @ after.velocity, -restitution * rate_before, atol=1e-14)
    momentum = pendulum.mass(q) @ (after.velocity - v)
    assert_allclose(momentum, J.T @ after.impulse, rtol=1e-12)
    after_impact = pendulum.energy(q, after.velocity)
    lost = pendulum.energy(q, v) - after_impact
    if restitution == 1:
        assert abs(lost) < 1e-12
    else:
        assert lost > 0


def worn(t, q, u):
    """The second body wears away as the first moves, until x = 1."""

    def lost(q, v):
        first = 0.5 * v[0] ** 2
        mass = jnp.maximum(1 - q[0], 0.0)
        return first + 0.5 * mass * v[1] ** 2

    return jnp.concatenate(
        [q[2:], hj.systems.Mechanism(lost).acceleration(q[:2], q[2:])]
    )


@pytest.mark.slow
def test_a_singular_mass_matrix_ends_the_trajectory_with_its_cause():
    chart = Field(("x", "y", "vx", "vy"), worn)
    system = toy({"move": chart})
    found = hj.simulate(system, "move", (0.0, 0.0, 1.5, 0.0), 5.0, throw=False)
    assert found.result == hj.errors.Result.FIELD_NOT_FINITE
    assert_allclose(found.t[-1], 2 / 3, rtol=1e-6)


def test_contacts_that_depend_on_each_other_are_refused():
    def twice(q):
        return [q[1], 2 * q[1]]

    ball = free_ball()
    q = jnp.ones(2)
    v = jnp.ones(2)
    with pytest.raises(
        hj.errors.DefinitionError, match="`contact` must be independent"
    ):
        ball.impact(q, v, twice)
    with pytest.raises(
        hj.errors.DefinitionError, match="`contact` must be independent"
    ):
        ball.constrained(q, v, 0.0, twice)


def test_a_kinetic_energy_that_is_not_positive_is_refused():
    negative = hj.systems.Mechanism(lambda q, v: -0.5 * v @ v)
    with pytest.raises(
        hj.errors.DefinitionError, match="kinetic energy must be positive"
    ):
        negative.acceleration(jnp.zeros(2), jnp.zeros(2))
