"""The spring-loaded inverted pendulum that runs.

R. Blickhan, The spring-mass model for running and hopping, J. Biomechanics 22, 1989; H. Geyer, A.
Seyfarth, R. Blickhan, Spring-mass running: simple approximate solution and application to gait
stability, J. Theoretical Biology 232, 2005.
"""

import math

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from ..systems.chart import Chart
from ..systems.output import Output
from ..systems.system import Guess, HybridSystem, Parameter, parameter
from ..systems.transition import Transition


class Flight(Chart):
    states = ("y", "vx", "vy")
    units = ("m", "m/s", "m/s")
    runner: "SLIPRunner"

    def field(self, t, q, u):
        return q[2], 0.0 * q[1], -self.runner.g


class Stance(Chart):
    states = ("x", "y", "vx", "vy")
    units = ("m", "m", "m/s", "m/s")
    runner: "SLIPRunner"

    def field(self, t, q, u):
        p = self.runner
        x, y, vx, vy = q
        r = jnp.hypot(x, y)
        push = p.k / p.m * (p.l0 - r) / r
        return vx, vy, push * x, push * y - p.g


class SLIPRunner(HybridSystem):
    """A point mass on a massless spring, which touches down at a fixed angle of attack.

    States: height `y` and speeds `vx`, `vy`; in stance also `x`, the place of the mass relative to
    the foot. (In flight the place does not matter and is left out, so that a step is a cycle.)
    Input `u` is added to the angle of attack. Energy is conserved (output `energy`): one multiplier
    is exactly 1, and cycles come in families, one for each energy:
    `find_limit_cycle(runner, conserved={"energy": 1784.8}, ...)`.
    """

    input_units = ("rad",)
    time_unit = "s"

    m: Parameter = parameter(80.0, unit="kg", doc="mass")
    k: Parameter = parameter(20000.0, unit="N/m", doc="stiffness of the leg")
    l0: Parameter = parameter(1.0, unit="m", doc="rest length of the leg")
    g: Parameter = parameter(9.81, unit="m/s^2", doc="gravity")
    angle: Parameter = parameter(math.radians(68.0), unit="rad", doc="angle of attack")

    def energy(self, t: ArrayLike, q: Float[Array, " n"], u: Float[Array, " l"]) -> Array:
        """Energy of the mass, and in stance of the spring."""
        *x, y, vx, vy = q
        spring = 0.5 * self.k * (self.l0 - jnp.hypot(x[0], y)) ** 2 if x else 0.0
        return self.m * (self.g * y + (vx**2 + vy**2) / 2) + spring

    def outputs(self):
        return (Output("energy", self.energy, "J"),)

    def charts(self):
        return {"flight": Flight(self), "stance": Stance(self)}

    def transitions(self):
        attack = lambda u: self.angle + u[0]  # noqa: E731
        return (
            Transition(
                "touchdown",
                "flight",
                "stance",
                guard=lambda t, q, u: q[0] - self.l0 * jnp.sin(attack(u)),
                reset=lambda t, q, u: (-self.l0 * jnp.cos(attack(u)), *q),
                enabled=lambda t, q, u: q[2] < 0,
            ),
            Transition(
                "liftoff",
                "stance",
                "flight",
                guard=lambda t, q, u: jnp.hypot(q[0], q[1]) - self.l0,
                direction="rising",
                reset=lambda t, q, u: q[1:],
            ),
        )

    def guess(self):
        return Guess("flight", (0.95, 5.07, 0.0))
