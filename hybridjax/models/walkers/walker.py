"""The simplest walking model: two legs and point feet on a slope.

M. Garcia, A. Chatterjee, A. Ruina, M. Coleman, The simplest walking model: stability, complexity,
and scaling, J. Biomechanical Engineering 120, 1998.
"""

import jax.numpy as jnp

from ...systems.chart import Chart
from ...systems.system import Guess, HybridSystem, Parameter, parameter
from ...systems.transition import Transition


class Step(Chart):
    states = ("th", "phi", "w", "p")
    units = ("rad", "rad", "", "")
    walker: "SimplestWalker"

    def field(self, t, q, u):
        th, phi, w, p = q
        stance = jnp.sin(th - self.walker.slope)
        swing = (w**2 - jnp.cos(th - self.walker.slope)) * jnp.sin(phi)
        return w, p, stance, stance + swing + u[0]


class SimplestWalker(HybridSystem):
    """A heavy hip on massless legs with light feet; time in units of sqrt(l / g).

    States: angle `th` of the stance leg from the normal of the slope, angle `phi` between the legs,
    and their rates `w`, `p`. Input `u` is a hip torque, as an acceleration of phi. At heelstrike
    the legs change their names. The feet scuff past each other in the middle of a step: there the
    guard rises, and that is no event.
    """

    slope: Parameter = parameter(0.009, unit="rad", doc="angle of the slope")

    def charts(self):
        return {"step": Step(self)}

    def transitions(self):
        return (
            Transition(
                "heelstrike",
                "step",
                "step",
                guard=lambda t, q, u: q[1] - 2 * q[0],
                direction="rising",
                reset=_heelstrike,
                enabled=lambda t, q, u: q[0] < 0,
            ),
        )

    def guess(self):
        """The long-period gait; `short_gait` is the other one."""
        return _after_heelstrike(0.2, -0.2)

    def short_gait(self):
        """A guess of the short-period gait, which is unstable."""
        return _after_heelstrike(0.19, -0.2)


def _heelstrike(t, q, u):
    th, _, w, _ = q
    c = jnp.cos(2 * th)
    return -th, -2 * th, c * w, c * (1 - c) * w


def _after_heelstrike(th, w):
    return Guess("step", (th, 2 * th, w, (1 - jnp.cos(2 * th)) * w))
