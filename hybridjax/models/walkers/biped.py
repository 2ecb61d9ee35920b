"""A biped of five links: the robot RABBIT, walking by virtual constraints.

C. Chevallereau, G. Abba, Y. Aoustin, F. Plestan, E. R. Westervelt, C. Canudas-de-Wit, J. W.
Grizzle, RABBIT: a testbed for advanced control theory, IEEE Control Systems Magazine 23(5), 2003;
E. R. Westervelt, J. W. Grizzle, C. Chevallereau, J. H. Choi, B. Morris, Feedback Control of
Dynamic Bipedal Robot Locomotion, CRC Press, 2007.
"""

import jax.numpy as jnp
import numpy as np

from ...mechanics.mechanism import Mechanism
from ...systems.chart import Chart
from ...systems.output import Output
from ...systems.system import Guess, HybridSystem, Parameter, parameter
from ...systems.transition import Transition
from .torso_walker import accelerations_under_feedback, chain, held, tips


class Step(Chart):
    states = (
        "shin", "thigh", "torso", "swing_thigh", "swing_shin",
        "shin_rate", "thigh_rate", "torso_rate", "swing_thigh_rate", "swing_shin_rate",
    )  # fmt: skip
    units = ("rad",) * 5 + ("rad/s",) * 5
    biped: "FiveLinkBiped"

    def field(self, t, state, u):
        p, mechanism = self.biped, self.biped.mechanism()
        q, v = state[:5], state[5:]
        leg, leg_rate = (q[0] + q[1]) / 2, (v[0] + v[1]) / 2
        # The swing knee bends while the stance leg passes from -stride to stride.
        bend, slope = p.lift * (1 - (leg / p.stride) ** 2), -2 * p.lift * leg / p.stride**2
        knee = held(q[0] - q[1] - p.knee, v[0] - v[1], p.stiffness)
        torso = held(q[2] - p.lean, v[2], p.stiffness)
        mirrored = held((q[3] + q[4]) / 2 + leg, (v[3] + v[4]) / 2 + leg_rate, p.stiffness)
        swing_knee = (
            held(q[4] - q[3] - p.knee - bend, v[4] - v[3] - slope * leg_rate, p.stiffness)
            - 2 * p.lift * (leg_rate / p.stride) ** 2
        )
        wanted = [knee / 2, -knee / 2, torso, mirrored - swing_knee / 2, mirrored + swing_knee / 2]
        one = jnp.ones_like(slope)
        along = jnp.stack([one, one, 0 * one, -1 - slope / 2, -1 + slope / 2])
        torque = u[0] * jnp.array([0.0, 0.0, 1.0, -1.0, 0.0])
        a = accelerations_under_feedback(mechanism, q, v, along, jnp.stack(wanted), torque)
        return jnp.concatenate([v, a])


class FiveLinkBiped(HybridSystem):
    """Two legs with knees and a torso: ten states, four motors, and no torque at the foot.

    States: absolute angles of the links from the vertical, positive forward, and their rates, of
    the leg that stands (`shin`, `thigh`), the torso, and the leg that swings. The motors, by
    input-output linearization, hold four virtual constraints: the knee that carries stays bent by
    `knee`, the torso leans by `lean`, the swing leg mirrors the stance leg, and its knee bends
    further by up to `lift` while the stance leg (the line from foot to hip) goes from -`stride` to
    `stride`. Deviations, such as those that the impact makes, decay as exp(-stiffness t). What is
    left, the rotation about the foot, is driven by the torso's lean. Input `u` is a further torque
    between torso and swing thigh. A step ends when the swing foot comes down in front: it sticks,
    the other foot lifts off, and the legs change their names. (That the ground only pushes, and
    that no foot slips, is not checked.)

    Where the numbers are from: masses, lengths, centers of mass and inertias are those that public
    simulation programs give for RABBIT, among them one derived from E. R. Westervelt's and J. W.
    Grizzle's of 2003; the two publications themselves could not be compared. Inertias are taken
    about the joints, as in these authors' program of 2001 (which has an earlier set: 20, 6.8 and
    3.2 kg; 2.22, 1.08 and 0.93 kg m^2); programs of others take the same numbers about the centers
    of mass. RABBIT's motors, of 3.32e-4 kg m^2 behind gears of 50, and its friction are left out.
    The virtual constraints, `lean`, `stride`, `knee`, `lift` and `stiffness` are none of theirs.
    """

    input_units = ("N m",)
    time_unit = "s"

    torso_mass: Parameter = parameter(12.0, unit="kg", doc="mass of the torso")
    thigh_mass: Parameter = parameter(6.8, unit="kg", doc="mass of a thigh")
    shin_mass: Parameter = parameter(3.2, unit="kg", doc="mass of a shin")
    torso_inertia: Parameter = parameter(1.33, unit="kg m^2", doc="of the torso, about the hip")
    thigh_inertia: Parameter = parameter(0.47, unit="kg m^2", doc="of a thigh, about the hip")
    shin_inertia: Parameter = parameter(0.20, unit="kg m^2", doc="of a shin, about the knee")
    length: Parameter = parameter(0.4, unit="m", doc="length of a thigh, and of a shin")
    torso_center: Parameter = parameter(0.24, unit="m", doc="from the hip to the torso's mass")
    thigh_center: Parameter = parameter(0.11, unit="m", doc="from the hip to a thigh's mass")
    shin_center: Parameter = parameter(0.24, unit="m", doc="from the knee to a shin's mass")
    g: Parameter = parameter(9.81, unit="m/s^2", doc="gravity")
    lean: Parameter = parameter(0.2, unit="rad", doc="angle of the torso")
    stride: Parameter = parameter(0.2, unit="rad", doc="angle of the stance leg that ends a step")
    knee: Parameter = parameter(0.2, unit="rad", doc="flexion of a knee that carries")
    lift: Parameter = parameter(0.4, unit="rad", doc="further flexion of the swing knee")
    stiffness: Parameter = parameter(20.0, unit="1/s", doc="rate at which errors decay")

    def mechanism(self) -> Mechanism:
        """The biped by five angles, and where its feet are free, by the place (x, y) of the stance
        foot."""
        order = np.array([0, 1, 2, 1, 0])
        m = jnp.stack([self.shin_mass, self.thigh_mass, self.torso_mass])[order]
        about_joint = jnp.stack([self.shin_inertia, self.thigh_inertia, self.torso_inertia])[order]
        center = jnp.stack([self.shin_center, self.thigh_center, self.torso_center])[order]
        # From the foot along whole links, and then along part of the own one.
        links = np.array(
            [[1, 0, 0, 0, 0], [1, 1, 0, 0, 0], [1, 1, 0, 0, 0], [1, 1, 0, 0, 0], [1, 1, 0, -1, 0]]
        )
        arms = self.length * links + center[:, None] * np.diag([-1, -1, 1, -1, -1])
        return chain(arms, m, about_joint - m * center**2, self.g)

    def _swing_foot(self, q):
        """Its place relative to the stance foot, (x, y)."""
        return tips(self.length * np.array([[1.0, 1.0, 0.0, -1.0, -1.0]]), q[:5])[:, 0]

    def outputs(self):
        """`leg`: the angle of the line from stance foot to hip, which grows all the time."""
        return (Output("leg", lambda t, q, u: (q[0] + q[1]) / 2, "rad"),)

    def charts(self):
        return {"step": Step(self)}

    def transitions(self):
        return (
            Transition(
                "touchdown",
                "step",
                "step",
                guard=lambda t, q, u: self._swing_foot(q)[1],
                reset=self._touchdown,
                enabled=lambda t, q, u: self._swing_foot(q)[0] > 0,
            ),
        )

    def _touchdown(self, t, state, u):
        q, v = (jnp.concatenate([x, jnp.zeros(2)]) for x in (state[:5], state[5:]))
        foot = lambda q: q[5:] + self._swing_foot(q[:5])  # noqa: E731
        after = self.mechanism().impact(q, v, foot).velocity
        return jnp.concatenate([q[4::-1], after[4::-1]])

    def guess(self):
        s, k = self.stride, self.knee / 2
        rate, bend = 1.5, 2 * self.lift / self.stride
        return Guess(
            "step",
            (
                *(-s + k, -s - k, self.lean, s - k, s + k),
                *(rate, rate, 0.0, -rate * (1 + bend / 2), -rate * (1 - bend / 2)),
            ),
            after="touchdown",
        )
