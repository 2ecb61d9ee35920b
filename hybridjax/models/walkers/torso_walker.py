"""The three-link walker: two straight legs and a torso, with feedback at the hips.

J. W. Grizzle, G. Abba, F. Plestan, Asymptotically stable walking for biped robots: analysis via
systems with impulse effects, IEEE Trans. Automatic Control 46(1), 2001.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._core.vector_math.factorizations import solve_positive
from ...mechanics.mechanism import Mechanism
from ...systems.chart import Chart
from ...systems.system import Guess, HybridSystem, Parameter, parameter
from ...systems.transition import Transition


def tips(arms: Float[Array, "k n"], q: Float[Array, " n"]) -> Float[Array, "2 k"]:
    """Where points of a chain of links are, relative to its foot: `arms` are the lengths that they
    have along each link, q the links' angles from the vertical."""
    return jnp.stack([jnp.sin(q), jnp.cos(q)]) @ arms.T


def chain(
    arms: Float[Array, "k n"],
    masses: Float[Array, " k"],
    inertias: Float[Array, " n"] | float,
    g: Array,
) -> Mechanism:
    """A chain of n links in a plane, by their angles and the place (x, y) of its foot, or by their
    angles alone, with its foot at the origin."""
    n = arms.shape[1]

    def places(q):
        return tips(arms, q[:n]) + (q[n:, None] if len(q) > n else 0.0)

    def kinetic(q, v):
        speeds = jax.jvp(places, (q,), (v,))[1]
        return 0.5 * jnp.sum(masses * speeds**2) + 0.5 * jnp.sum(inertias * v[:n] ** 2)

    return Mechanism(kinetic, lambda q: g * jnp.sum(masses * places(q)[1]))


def accelerations_under_feedback(
    mechanism: Mechanism,
    q: Float[Array, " n"],
    v: Float[Array, " n"],
    along: Float[Array, " n"],
    wanted: Float[Array, " n"],
    torque: Float[Array, " n"],
) -> Float[Array, " n"]:
    """Accelerations `wanted` + x `along` of a chain that stands on a point, with motors between
    its links.

    Angles are absolute, so that the motors' torques have no sum: the sum of the equations of
    motion, 1'(M a + h) = 0, gives x. The motors do the rest (input-output linearization), and know
    nothing of a further `torque`.
    """
    mass = mechanism.mass(q)
    left_over = jnp.sum(mechanism.bias(q, v)) + jnp.sum(mass @ wanted)
    passive = -left_over / jnp.sum(mass @ along)
    return wanted + along * passive + solve_positive(mass, torque)


def held(error: Array, rate: Array, stiffness: Array) -> Array:
    """The acceleration that lets an error decay, critically damped."""
    return -(stiffness**2) * error - 2 * stiffness * rate


class Step(Chart):
    states = ("th1", "th2", "th3", "w1", "w2", "w3")
    units = ("rad", "rad", "rad", "rad/s", "rad/s", "rad/s")
    walker: "TorsoWalker"

    def field(self, t, state, u):
        p, mechanism = self.walker, self.walker.mechanism()
        q, v = state[:3], state[3:]
        upright = held(q[2] - p.lean, v[2], p.stiffness)
        mirrored = held(q[0] + q[1], v[0] + v[1], p.stiffness)
        wanted = jnp.stack([jnp.zeros_like(upright), mirrored, upright])
        along, torque = jnp.array([1.0, -1.0, 0.0]), u[0] * jnp.array([0.0, -1.0, 1.0])
        a = accelerations_under_feedback(mechanism, q, v, along, wanted, torque)
        return jnp.concatenate([v, a])


class TorsoWalker(HybridSystem):
    """Two straight legs and a torso, which leans forward and thereby drives the walker.

    States: angles `th1` of the stance leg, `th2` of the swing leg and `th3` of the torso from the
    vertical, positive forward, and their rates. Motors at the hip hold the torso at the angle
    `lean`, and let the swing leg mirror the stance leg. (The paper's feedback settles in finite
    time; here errors decay as exp(-stiffness t).) Input `u` is a further torque between torso and
    swing leg. A step ends where the stance leg has come to the angle `stride`; there the swing leg
    takes over, sticks where it lands, and the legs change their names.

    Masses, lengths, `lean` and `stride` are those of the program that goes with E. R. Westervelt,
    J. W. Grizzle, C. Chevallereau, J. H. Choi, B. Morris, Feedback Control of Dynamic Bipedal Robot
    Locomotion, 2007 (there with g = 9.8); the paper itself could not be compared.
    """

    input_units = ("N m",)
    time_unit = "s"

    m: Parameter = parameter(5.0, unit="kg", doc="mass of a leg")
    mH: Parameter = parameter(15.0, unit="kg", doc="mass of the hip")
    mT: Parameter = parameter(10.0, unit="kg", doc="mass of the torso")
    r: Parameter = parameter(1.0, unit="m", doc="length of a leg, with its mass in the middle")
    l: Parameter = parameter(0.5, unit="m", doc="from the hip to the torso's mass")  # noqa: E741
    g: Parameter = parameter(9.81, unit="m/s^2", doc="gravity")
    lean: Parameter = parameter(math.pi / 6, unit="rad", doc="angle of the torso")
    stride: Parameter = parameter(math.pi / 8, unit="rad", doc="angle of the leg that ends a step")
    stiffness: Parameter = parameter(20.0, unit="1/s", doc="rate at which errors decay")

    def mechanism(self) -> Mechanism:
        """The walker by three angles, and where its feet are free, by the place (x, y) of the
        stance foot."""
        half = self.r / 2
        legs = half * np.array([[1, 0, 0], [2, -1, 0], [2, 0, 0], [2, 0, 0]])
        arms = legs + self.l * np.array([[0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 1]])
        return chain(arms, jnp.stack([self.m, self.m, self.mH, self.mT]), 0.0, self.g)

    def charts(self):
        return {"step": Step(self)}

    def transitions(self):
        return (
            Transition(
                "touchdown",
                "step",
                "step",
                guard=lambda t, q, u: q[0] - self.stride,
                direction="rising",
                reset=self._touchdown,
            ),
        )

    def _touchdown(self, t, state, u):
        q, v = (jnp.concatenate([x, jnp.zeros(2)]) for x in (state[:3], state[3:]))
        after = self.mechanism().impact(q, v, self._swing_foot).velocity
        swapped = np.array([1, 0, 2])
        return jnp.concatenate([q[swapped], after[swapped]])

    def _swing_foot(self, q):
        return q[3:] + tips(self.r * np.array([[1.0, -1.0, 0.0]]), q[:3])[:, 0]

    def guess(self):
        start = -self.stride, self.stride, self.lean, 1.5, -1.5, 0.0
        return Guess("step", start, after="touchdown")
