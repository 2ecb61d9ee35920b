"""The clock-driven vertical hopper of the paper (Fig. 2), and a variant that loses speed.

S. A. Burden, S. Revzen, S. S. Sastry, Dimension reduction near periodic orbits of hybrid systems,
CDC-ECC 2011, and HSCC 2013, whose parameters these are.
"""

import math

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array

from ..systems.chart import Chart
from ..systems.system import Guess, HybridSystem, Parameter, parameter
from ..systems.transition import Transition


class Flight(Chart):
    states = ("yM", "vM", "ym", "vm")
    units = ("m", "m/s", "m", "m/s")
    hopper: "VerticalHopper"

    def field(self, t, q, u):
        p = self.hopper
        yM, vM, ym, vm = q
        leg = p.leg(t, yM, ym)
        return vM, (leg + u[0]) / p.M - p.g, vm, -(leg + p.b * vm) / p.m - p.g


class Stance(Chart):
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
    """

    input_units = ("N",)
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

    def leg(self, t: ArrayLike, yM: ArrayLike, ym: ArrayLike) -> Array:
        """Force of the leg on the body."""
        return self.k * (self.l0 - (yM - ym)) + self.a * jnp.sin(self.omega * t)

    def charts(self):
        return {"flight": Flight(self), "stance": Stance(self)}

    def transitions(self):
        return (
            Transition(
                "touchdown",
                "flight",
                "stance",
                guard=lambda t, q, u: q[2],
                reset=lambda t, q, u: (q[0], self.retention * q[1]),
            ),
            Transition(
                "liftoff",
                "stance",
                "flight",
                guard=lambda t, q, u: self.leg(t, q[0], 0.0) + self.m * self.g,
                reset=lambda t, q, u: (q[0], q[1], 0.0, 0.0),
            ),
        )

    def period(self):
        return 2 * jnp.pi / self.omega

    def guess(self):
        return Guess("stance", (2.0, 1.9), 0.5)
