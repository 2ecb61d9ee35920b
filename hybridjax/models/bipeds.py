"""Actuated bipeds: the three-link walker with a torso (`TorsoWalker`), and the five-link robot
RABBIT (`FiveLinkBiped`).

Both are chains of links (`chain`), whose equations of motion and impacts come from
`mechanics/mechanism.py`, under feedback that holds outputs (`accelerations_under_feedback`). Angles
are absolute, from the vertical. After an impact, the legs exchange their names. The classes cite
their sources, and tests rely on the default parameters. If a motion is wrong, look at `mechanism`
(masses and lengths) first, then at the feedback; if a step is, at `_touchdown`.
"""

import math
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core.vector_math.factorizations import solve_positive
from ..mechanics.mechanism import Mechanism
from ..systems.chart import FieldChart
from ..systems.system import Guess, HybridSystem, Output, Parameter, parameter
from ..systems.transition import Transition


Arms = Float[Array | np.ndarray, "k n"]


def tips(arms: Arms, q: Float[Array, " n"]) -> Float[Array, "2 k"]:
    """Positions of points of a chain of links relative to its foot. `arms` are their coordinates
    along each link, q the links' angles from the vertical."""
    return jnp.stack([jnp.sin(q), jnp.cos(q)]) @ arms.T


def chain(
    arms: Arms,
    masses: Float[Array, " k"],
    inertias: Float[Array, " n"] | float,
    g: Parameter,
    drawn: Mapping[str, Arms],
) -> Mechanism:
    """A chain of n links in a plane, by their angles and the place (x, y) of its foot, or by their
    angles alone, with its foot at the origin; `drawn` as lines from point to point."""
    n = arms.shape[1]

    def links(q):
        return {name: tips(line, q[:n]).T for name, line in drawn.items()}

    def places(q):
        return tips(arms, q[:n]) + (q[n:, None] if len(q) > n else 0.0)

    def kinetic(q, v):
        speeds = jax.jvp(places, (q,), (v,))[1]
        of_motion = 0.5 * jnp.sum(masses * speeds**2)
        of_rotation = 0.5 * jnp.sum(inertias * v[:n] ** 2)
        return of_motion + of_rotation

    return Mechanism(kinetic, lambda q: g * jnp.sum(masses * places(q)[1]), links)


_GROUND = np.array([(-1.0, 0.0), (1.0, 0.0)])


def accelerations_under_feedback(
    mechanism: Mechanism,
    q: Float[Array, " n"],
    v: Float[Array, " n"],
    desired: Float[Array, " n"],
    direction: Float[Array, " n"],
    torque: Float[Array, " n"],
) -> Float[Array, " n"]:
    """Accelerations `desired` + x `direction` of a chain that stands on a point, with motors
    between its links.

    Angles are absolute, so that the motors' torques have no sum: the sum of the equations of
    motion, 1'(M a + h) = 0, gives x. The motors provide the remaining components (input-output
    linearization) and do not compensate the further `torque`.
    """
    mass = mechanism.mass(q)
    inertia = jnp.sum(mass @ desired)
    residual = jnp.sum(mechanism.bias(q, v)) + inertia
    x = -residual / jnp.sum(mass @ direction)
    return desired + direction * x + solve_positive(mass, torque)


def held(error: Array, rate: Array, stiffness: Parameter) -> Array:
    """The acceleration that lets an error decay, critically damped."""
    return -(stiffness**2) * error - 2 * stiffness * rate


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
    Locomotion, 2007 (there with g = 9.8); they were not compared with the paper itself.

    J. W. Grizzle, G. Abba, F. Plestan, Asymptotically stable walking for biped robots: analysis via
    systems with impulse effects, IEEE Trans. Automatic Control 46(1), 2001.
    """

    input_units = ("N m",)
    time_unit = "s"

    m: Parameter = parameter(5.0, unit="kg", positive=True, doc="mass of a leg")
    mH: Parameter = parameter(15.0, unit="kg", positive=True, doc="mass of the hip")
    mT: Parameter = parameter(10.0, unit="kg", positive=True, doc="mass of the torso")
    r: Parameter = parameter(
        1.0, unit="m", doc="length of a leg, with its mass in the middle"
    )
    l: Parameter = parameter(0.5, unit="m", doc="from the hip to the torso's mass")  # noqa: E741
    g: Parameter = parameter(9.81, unit="m/s^2", doc="gravity")
    lean: Parameter = parameter(math.pi / 6, unit="rad", doc="angle of the torso")
    stride: Parameter = parameter(
        math.pi / 8, unit="rad", doc="angle of the leg that ends a step"
    )
    stiffness: Parameter = parameter(20.0, unit="1/s", doc="rate at which errors decay")

    def mechanism(self) -> Mechanism:
        """The walker by three angles, and for the floating base also by the position (x, y) of the
        stance foot."""
        # Each mass is so many half legs and torsos away from the stance foot.
        half_legs = np.array(
            [
                [1, 0, 0],
                [2, -1, 0],
                [2, 0, 0],
                [2, 0, 0],
            ]
        )
        torsos = np.array(
            [
                [0, 0, 0],
                [0, 0, 0],
                [0, 0, 0],
                [0, 0, 1],
            ]
        )
        arms = self.r / 2 * half_legs + self.l * torsos
        ends = np.array(
            [
                [0, 0, 0],
                [1, 0, 0],
                [1, -1, 0],
                [1, 0, 1],
            ]
        )
        ends = ends * jnp.stack([self.r, self.r, self.l])
        drawn = {
            "stance": ends[:2],
            "swing": ends[1:3],
            "torso": ends[np.array([1, 3])],
        }
        return chain(
            arms, jnp.stack([self.m, self.m, self.mH, self.mT]), 0.0, self.g, drawn
        )

    def charts(self):
        states = ("th1", "th2", "th3", "w1", "w2", "w3")
        units = ("rad",) * 3 + ("rad/s",) * 3
        return {"step": FieldChart(self._step, states, units)}

    def _step(self, t, state, u):
        q = state[:3]
        v = state[3:]
        upright = held(q[2] - self.lean, v[2], self.stiffness)
        angle = q[0] + q[1]
        rate = v[0] + v[1]
        mirrored = held(angle, rate, self.stiffness)
        desired = jnp.stack([jnp.zeros_like(upright), mirrored, upright])
        direction = jnp.array([1.0, -1.0, 0.0])
        torque = u[0] * jnp.array([0.0, -1.0, 1.0])
        a = accelerations_under_feedback(
            self.mechanism(), q, v, desired, direction, torque
        )
        return jnp.concatenate([v, a])

    def transitions(self):
        def angle(t, q, u):
            return q[0] - self.stride

        return (
            Transition("touchdown", "step", "step", angle, "rising", self._touchdown),
        )

    def _touchdown(self, t, state, u):
        origin = jnp.zeros(2)
        q = jnp.concatenate([state[:3], origin])
        v = jnp.concatenate([state[3:], origin])
        after = self.mechanism().impact(q, v, self._swing_foot).velocity
        swapped = np.array([1, 0, 2])
        return jnp.concatenate([q[swapped], after[swapped]])

    def _swing_foot(self, q):
        legs = self.r * np.array([[1.0, -1.0, 0.0]])
        foot = tips(legs, q[:3])[:, 0]
        return q[3:] + foot

    def draw(self, chart, t, q):
        angles = jnp.stack(list(q.values())[:3])
        return self.mechanism().draw(angles, _GROUND, "stance")

    def guess(self):
        start = -self.stride, self.stride, self.lean, 1.5, -1.5, 0.0
        return Guess("step", start, after="touchdown")


class FiveLinkBiped(HybridSystem):
    """Two legs with knees and a torso: ten states, four motors, and no torque at the foot.

    States: absolute angles of the links from the vertical, positive forward, and their rates, of
    the leg that stands (`shin`, `thigh`), the torso, and the leg that swings. The motors, by
    input-output linearization, hold four virtual constraints: the stance knee stays bent by `knee`,
    the torso leans by `lean`, the swing leg mirrors the stance leg, and its knee bends further by
    up to `lift` while the stance leg (the line from foot to hip) goes from -`stride` to `stride`.
    Deviations, such as those that the impact makes, decay as exp(-stiffness t). The remaining
    degree of freedom, the rotation about the foot, is driven by the lean of the torso. Input `u` is
    a further torque between torso and swing thigh. A step ends when the swing foot comes down in
    front: it sticks, the other foot lifts off, and the legs change their names. (That the ground
    only pushes, and that no foot slips, is not checked.)

    Masses, lengths, centers of mass and inertias are those of RABBIT in public simulation programs,
    among them one derived from E. R. Westervelt's and J. W. Grizzle's of 2003; they were not
    compared with the two publications below. Inertias are taken about the joints, as in these
    authors' program of 2001 (with an earlier set of numbers: 20, 6.8 and 3.2 kg; 2.22, 1.08 and
    0.93 kg m^2); programs of other authors take the same inertias about the centers of mass.
    RABBIT's motors, of 3.32e-4 kg m^2 behind gears of 50, and its friction are left out. The
    virtual constraints, with `lean`, `stride`, `knee`, `lift` and `stiffness`, are not from these
    sources.

    C. Chevallereau, G. Abba, Y. Aoustin, F. Plestan, E. R. Westervelt, C. Canudas-de-Wit, J. W.
    Grizzle, RABBIT: a testbed for advanced control theory, IEEE Control Systems Magazine 23(5),
    2003; E. R. Westervelt, J. W. Grizzle, C. Chevallereau, J. H. Choi, B. Morris, Feedback Control
    of Dynamic Bipedal Robot Locomotion, CRC Press, 2007.
    """

    input_units = ("N m",)
    time_unit = "s"

    torso_mass: Parameter = parameter(
        12.0, unit="kg", positive=True, doc="mass of the torso"
    )
    thigh_mass: Parameter = parameter(
        6.8, unit="kg", positive=True, doc="mass of a thigh"
    )
    shin_mass: Parameter = parameter(
        3.2, unit="kg", positive=True, doc="mass of a shin"
    )
    torso_inertia: Parameter = parameter(
        1.33, unit="kg m^2", doc="of the torso, about the hip"
    )
    thigh_inertia: Parameter = parameter(
        0.47, unit="kg m^2", doc="of a thigh, about the hip"
    )
    shin_inertia: Parameter = parameter(
        0.20, unit="kg m^2", doc="of a shin, about the knee"
    )
    length: Parameter = parameter(0.4, unit="m", doc="length of a thigh, and of a shin")
    torso_center: Parameter = parameter(
        0.24, unit="m", doc="from the hip to the torso's mass"
    )
    thigh_center: Parameter = parameter(
        0.11, unit="m", doc="from the hip to a thigh's mass"
    )
    shin_center: Parameter = parameter(
        0.24, unit="m", doc="from the knee to a shin's mass"
    )
    g: Parameter = parameter(9.81, unit="m/s^2", doc="gravity")
    lean: Parameter = parameter(0.2, unit="rad", doc="angle of the torso")
    stride: Parameter = parameter(
        0.2, unit="rad", doc="angle of the stance leg that ends a step"
    )
    knee: Parameter = parameter(0.2, unit="rad", doc="flexion of a knee that carries")
    lift: Parameter = parameter(
        0.4, unit="rad", doc="further flexion of the swing knee"
    )
    stiffness: Parameter = parameter(20.0, unit="1/s", doc="rate at which errors decay")

    def mechanism(self) -> Mechanism:
        """The biped by five angles, and for the floating base also by the position (x, y) of
        the stance foot."""
        order = np.array([0, 1, 2, 1, 0])
        m = jnp.stack([self.shin_mass, self.thigh_mass, self.torso_mass])[order]
        about_joint = jnp.stack(
            [self.shin_inertia, self.thigh_inertia, self.torso_inertia]
        )[order]
        center = jnp.stack([self.shin_center, self.thigh_center, self.torso_center])[
            order
        ]
        # Along whole links from the foot on, then along a part of the link itself.
        links = np.array(
            [
                [1, 0, 0, 0, 0],
                [1, 1, 0, 0, 0],
                [1, 1, 0, 0, 0],
                [1, 1, 0, 0, 0],
                [1, 1, 0, -1, 0],
            ]
        )
        below = np.diag([-1, -1, 1, -1, -1])
        arms = self.length * links + center[:, None] * below
        ends = self.length * np.vstack(
            [0 * links[0], links[:2], links[4], [1, 1, 0, -1, -1]]
        )
        along_torso = np.eye(5)[2]
        top = ends[2] + 2 * self.torso_center * along_torso
        torso = jnp.stack([ends[2], top])
        drawn = {"stance": ends[:3], "swing": ends[2:], "torso": torso}
        return chain(arms, m, about_joint - m * center**2, self.g, drawn)

    def _swing_foot(self, q):
        """Position (x, y) of the swing foot relative to the stance foot."""
        signs = np.array([[1.0, 1.0, 0.0, -1.0, -1.0]])
        legs = self.length * signs
        return tips(legs, q[:5])[:, 0]

    def outputs(self):
        """`leg`: the angle of the line from stance foot to hip, which grows all the time."""
        return (Output("leg", lambda t, q, u: (q[0] + q[1]) / 2, "rad"),)

    def charts(self):
        links = ("shin", "thigh", "torso", "swing_thigh", "swing_shin")
        states = (*links, *(f"{x}_rate" for x in links))
        units = ("rad",) * 5 + ("rad/s",) * 5
        return {"step": FieldChart(self._step, states, units)}

    def _step(self, t, state, u):
        q = state[:5]
        v = state[5:]
        desired, direction = self._constrained(q, v)
        torque = u[0] * jnp.array([0.0, 0.0, 1.0, -1.0, 0.0])
        a = accelerations_under_feedback(
            self.mechanism(), q, v, desired, direction, torque
        )
        return jnp.concatenate([v, a])

    def _constrained(self, q, v):
        """Accelerations that hold the four virtual constraints while the stance leg keeps its
        rate, and what they gain for each unit of its acceleration."""
        shin, thigh, torso, swing_thigh, swing_shin = q
        shin_rate, thigh_rate, torso_rate, swing_thigh_rate, swing_shin_rate = v
        leg = (shin + thigh) / 2
        leg_rate = (shin_rate + thigh_rate) / 2
        # The swing knee bends while the stance leg passes from -stride to stride.
        part = leg / self.stride
        bend = self.lift * (1 - part**2)
        slope = -2 * self.lift * part / self.stride
        curvature = -2 * self.lift / self.stride**2

        stance_knee = held(
            shin - thigh - self.knee, shin_rate - thigh_rate, self.stiffness
        )
        lean = held(torso - self.lean, torso_rate, self.stiffness)
        swing_leg = held(
            (swing_thigh + swing_shin) / 2 + leg,
            (swing_thigh_rate + swing_shin_rate) / 2 + leg_rate,
            self.stiffness,
        )
        swing_knee = held(
            swing_shin - swing_thigh - self.knee - bend,
            swing_shin_rate - swing_thigh_rate - slope * leg_rate,
            self.stiffness,
        )
        swing_knee = swing_knee + curvature * leg_rate**2

        desired = jnp.stack(
            [
                stance_knee / 2,
                -stance_knee / 2,
                lean,
                swing_leg - swing_knee / 2,
                swing_leg + swing_knee / 2,
            ]
        )
        unit = jnp.ones_like(slope)
        half = slope / 2
        direction = jnp.stack([unit, unit, 0 * unit, -1 - half, -1 + half])
        return desired, direction

    def transitions(self):
        def height(t, q, u):
            return self._swing_foot(q)[1]

        def ahead(t, q, u):
            return self._swing_foot(q)[0] > 0

        landing = Transition(
            "touchdown", "step", "step", height, "falling", self._touchdown, ahead
        )
        return (landing,)

    def _touchdown(self, t, state, u):
        origin = jnp.zeros(2)
        q = jnp.concatenate([state[:5], origin])
        v = jnp.concatenate([state[5:], origin])

        def foot(q):
            return q[5:] + self._swing_foot(q[:5])

        return jnp.concatenate(
            [q[4::-1], self.mechanism().impact(q, v, foot).velocity[4::-1]]
        )

    def draw(self, chart, t, q):
        angles = jnp.stack(list(q.values())[:5])
        return self.mechanism().draw(angles, _GROUND, "stance")

    def guess(self):
        s = self.stride
        k = self.knee / 2
        rate = 1.5
        bend = 2 * self.lift / self.stride
        angles = -s + k, -s - k, self.lean, s - k, s + k
        swing = rate * (1 + bend / 2)
        knee = rate * (1 - bend / 2)
        rates = rate, rate, 0.0, -swing, -knee
        return Guess("step", (*angles, *rates), after="touchdown")
