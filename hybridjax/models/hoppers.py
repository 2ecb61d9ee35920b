"""The vertical hopper of the paper, and the same on compliant ground."""

import math
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from ..systems.chart import Chart, FieldChart
from ..systems.drawing import Drawing
from ..systems.solver import Radau
from ..systems.system import Guess, HybridSystem, Parameter, parameter
from ..systems.transition import Transition


_MASSES = ("yM", "vM", "ym", "vm"), ("m", "m/s", "m", "m/s")


class HopperStance(Chart):
    states = ("yM", "vM")
    units = ("m", "m/s")
    absent = {"ym": 0.0, "vm": 0.0}
    hopper: "VerticalHopper"

    def field(self, t, q, u):
        p = self.hopper
        yM, vM = q
        return vM, (p.leg(t, yM, 0.0) + u[0]) / p.M - p.g


class VerticalHopper(HybridSystem):
    """Two masses on a leg spring with a sinusoidal actuator; the foot is damped in the air.

    Input `u` is a force on the upper mass. With `retention` = r < 1 a touchdown multiplies the
    speed of the upper mass by r.

    S. A. Burden, S. Revzen, S. S. Sastry, Dimension reduction near periodic orbits of hybrid
    systems, CDC-ECC 2011, and HSCC 2013, whose parameters these are.
    """

    input_units: ClassVar[tuple[str, ...]] = ("N",)
    time_unit = "s"

    m: Parameter = parameter(1.0, unit="kg", doc="mass of the foot")
    M: Parameter = parameter(2.0, unit="kg", doc="mass of the body")
    k: Parameter = parameter(10.0, unit="N/m", doc="stiffness of the leg")
    b: Parameter = parameter(5.0, unit="N s/m", doc="damping of the foot in flight")
    l0: Parameter = parameter(2.0, unit="m", doc="rest length of the leg")
    a: Parameter = parameter(20.0, unit="N", doc="amplitude of the actuator")
    g: Parameter = parameter(2.0, unit="m/s^2", doc="gravity")
    omega: Parameter = parameter(2 * math.pi, unit="rad/s", doc="rate of the actuator")
    retention: Parameter = parameter(1.0, doc="speed of the body kept at touchdown")

    def leg(self, t: Array, yM: Array, ym: Array | float) -> Array:
        """Force of the leg on the body."""
        return self.k * (self.l0 - (yM - ym)) + self.a * jnp.sin(self.omega * t)

    def charts(self):
        return {"flight": self._flight(), "stance": HopperStance(self)}

    def _flight(self) -> FieldChart:
        drag = lambda ym, vm: -self.b * vm  # noqa: E731
        return FieldChart(self._moving(drag), *_MASSES)

    def _moving(self, on_foot):
        """The field of both masses, with a force on the foot by its height and speed."""

        def field(t, q, u):
            yM, vM, ym, vm = q
            leg = self.leg(t, yM, ym)
            body = (leg + u[0]) / self.M - self.g
            return vM, body, vm, (on_foot(ym, vm) - leg) / self.m - self.g

        return field

    def transitions(self):
        height = lambda t, q, u: q[2]  # noqa: E731
        landed = lambda t, q, u: (q[0], self.retention * q[1])  # noqa: E731
        force = lambda t, q, u: self.leg(t, q[0], 0.0) + self.m * self.g  # noqa: E731
        lifted = lambda t, q, u: (q[0], q[1], 0.0, 0.0)  # noqa: E731
        return (
            Transition("touchdown", "flight", "stance", height, reset=landed),
            Transition("liftoff", "stance", "flight", force, reset=lifted),
        )

    def period(self):
        return 2 * jnp.pi / self.omega

    def draw(self, chart, t, q):
        yM, ym = q["yM"], q["ym"]
        leg = Drawing.spring((0.0, ym + 0.2), (0.0, yM - 0.3))
        circles = {"body": (0.0, yM, 0.3), "foot": (0.0, ym + 0.1, 0.1)}
        return Drawing({"ground": [(-1.0, 0.0), (1.0, 0.0)], "leg": leg}, circles=circles)

    def guess(self):
        return Guess("stance", (2.0, 1.9), 0.5)


class CompliantHopper(VerticalHopper):
    """The hopper on a ground of stiffness `kg` and damping `cg`, from which the foot lifts off
    where their force vanishes. There is no impact: all four states move in both charts.

    Input `u` is a force on the upper mass.

    The hopper is `VerticalHopper`; the ground is a spring and a dashpot in parallel, and only
    pushes (on such contacts: K. H. Hunt, F. R. E. Crossley, J. Appl. Mech. 42 (1975) 440-445).
    """

    kg: Parameter = parameter(1e5, unit="N/m", doc="stiffness of the ground")
    cg: Parameter = parameter(3e3, unit="N s/m", doc="damping of the ground")

    def ground(self, ym: Array, vm: Array) -> Array:
        """Force of the ground on the foot."""
        return -self.kg * ym - self.cg * vm

    def charts(self):
        contact = FieldChart(self._moving(self.ground), *_MASSES, solver=Radau())
        return {"flight": self._flight(), "contact": contact}

    def transitions(self):
        force = lambda t, q, u: self.ground(q[2], q[3])  # noqa: E731
        return (
            Transition("touchdown", "flight", "contact", lambda t, q, u: q[2]),
            Transition("liftoff", "contact", "flight", force),
        )

    def guess(self):
        """The guess of `VerticalHopper`, with the foot where the ground carries it."""
        return Guess("contact", (2.0, 1.9, -1e-4, 0.0), 0.5)
