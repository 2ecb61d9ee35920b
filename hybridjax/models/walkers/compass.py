"""The compass-gait walker: a passive biped with two straight legs of some mass.

A. Goswami, B. Thuilot, B. Espiau, A study of the passive gait of a compass-like biped robot, Int.
J. Robotics Research 17(12), 1998.
"""

import math

import jax.numpy as jnp

from ...systems.chart import Chart
from ...systems.system import Guess, HybridSystem, Parameter, parameter
from ...systems.transition import Transition


class Step(Chart):
    states = ("n", "s", "vn", "vs")
    units = ("rad", "rad", "rad/s", "rad/s")
    walker: "CompassGait"

    def field(self, t, q, u):
        p = self.walker
        n, s, vn, vs = q
        coupling = p.m * p.l * p.b
        c, d = jnp.cos(s - n), coupling * jnp.sin(s - n)
        gravity = p.g * (p.mH * p.l + p.m * p.a + p.m * p.l)
        torque_n = -d * vs**2 - p.m * p.g * p.b * jnp.sin(n) + u[0]
        torque_s = d * vn**2 + gravity * jnp.sin(s) - u[0]
        # The inverse of [[A, B], [B, D]].
        A, B, D = p.m * p.b**2, -coupling * c, (p.mH + p.m) * p.l**2 + p.m * p.a**2
        det = A * D - B**2
        return vn, vs, (D * torque_n - B * torque_s) / det, (A * torque_s - B * torque_n) / det


class CompassGait(HybridSystem):
    """A mass at the hip and one on each leg, walking down a slope.

    States: angles `n` of the swing leg and `s` of the stance leg from the vertical, and their rates
    `vn`, `vs`. Input `u` is a hip torque (+u on n, -u on s). At heelstrike the legs change their
    names. The guard is zero right after that and moves down, away from its event: only when it has
    been positive, past the scuff, may it fire.
    """

    input_units = ("N m",)
    time_unit = "s"

    mH: Parameter = parameter(10.0, unit="kg", doc="mass of the hip")
    m: Parameter = parameter(5.0, unit="kg", doc="mass of a leg")
    a: Parameter = parameter(0.5, unit="m", doc="from the foot to the leg's mass")
    b: Parameter = parameter(0.5, unit="m", doc="from the leg's mass to the hip")
    g: Parameter = parameter(9.81, unit="m/s^2", doc="gravity")
    slope: Parameter = parameter(3.0 * math.pi / 180, unit="rad", doc="angle of the slope")

    @property
    def l(self):  # noqa: E743
        """Length of a leg."""
        return self.a + self.b

    def charts(self):
        return {"step": Step(self)}

    def transitions(self):
        return (
            Transition(
                "heelstrike",
                "step",
                "step",
                guard=lambda t, q, u: q[0] + q[1] + 2 * self.slope,
                reset=self._heelstrike,
                enabled=lambda t, q, u: q[1] < 0,
            ),
        )

    def _heelstrike(self, t, q, u):
        """Angular momentum about the new foot, and of the new swing leg about the hip, are kept."""
        n, s, vn, vs = q
        m, mH, a, b, length = self.m, self.mH, self.a, self.b, self.l
        c = jnp.cos(s - n)
        whole = -m * a * b * vn + (-m * a * b + (mH * length**2 + 2 * m * a * length) * c) * vs
        leg = -m * a * b * vs
        A, B = m * b * (b - length * c), m * length * (length - b * c) + m * a**2 + mH * length**2
        C, D = m * b**2, -m * b * length * c
        det = A * D - B * C
        return s, n, (D * whole - B * leg) / det, (A * leg - C * whole) / det

    def guess(self):
        s = 0.22
        return Guess("step", (-2 * self.slope - s, s, -0.35, -1.1))
