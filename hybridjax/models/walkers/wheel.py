"""The rimless wheel: a spoked wheel without a rim that rolls down a slope.

T. McGeer, Passive dynamic walking, Int. J. Robotics Research 9(2), 1990; M. J. Coleman, PhD
thesis, Cornell University, 1998.
"""

import jax.numpy as jnp

from ...systems.chart import Chart
from ...systems.system import Guess, HybridSystem, Parameter, parameter
from ...systems.transition import Transition


class Swing(Chart):
    states = ("th", "w")
    units = ("rad", "rad/s")
    wheel: "RimlessWheel"

    def field(self, t, q, u):
        th, w = q
        return w, self.wheel.rate * jnp.sin(th) + u[0]


class RimlessWheel(HybridSystem):
    """An inverted pendulum about the spoke that stands, from one spoke to the next.

    States: angle `th` of that spoke from the vertical, positive downhill, and its rate `w`. Input
    `u` is a hip torque over the moment of inertia. The return map is linear in w^2, so that the
    cycle and its multiplier cos^2(2 alpha) are known in closed form (`exact`).
    """

    input_units = ("1/s^2",)
    time_unit = "s"

    rate: Parameter = parameter(1.0, unit="1/s^2", doc="g / l")
    spokes: Parameter = parameter(8.0, doc="number of spokes")
    slope: Parameter = parameter(0.08, unit="rad", doc="angle of the slope")

    @property
    def alpha(self):
        """Half the angle between spokes."""
        return jnp.pi / self.spokes

    def exact(self):
        """Speed right after an impact, and the multiplier."""
        spread = jnp.sin(self.alpha) * jnp.sin(self.slope)
        w = jnp.sqrt(4 * self.rate * spread) / jnp.tan(2 * self.alpha)
        return w, jnp.cos(2 * self.alpha) ** 2

    def charts(self):
        return {"swing": Swing(self)}

    def transitions(self):
        return (
            Transition(
                "impact",
                "swing",
                "swing",
                guard=lambda t, q, u: q[0] - self.slope - self.alpha,
                direction="rising",
                reset=lambda t, q, u: (
                    self.slope - self.alpha,
                    jnp.cos(2 * self.alpha) * q[1],
                ),
            ),
        )

    def guess(self):
        return Guess("swing", (0.0, 0.3 * jnp.sqrt(self.rate)))
