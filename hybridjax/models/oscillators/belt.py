"""A block on a belt, which sticks and slips.

R. I. Leine, D. H. van Campen, A. de Kraker, L. van den Steen, Stick-slip vibrations induced by
alternate friction models, Nonlinear Dynamics 16, 1998.
"""

import jax.numpy as jnp

from ...systems.chart import Chart
from ...systems.sliding import Sliding, sliding
from ...systems.system import Guess, HybridSystem, Parameter, parameter


class Slips(Chart):
    states = ("x", "v")
    units = ("m", "m/s")
    block: "BeltOscillator"
    side: float

    def field(self, t, q, u):
        p = self.block
        friction = p.friction / (1 + p.decay * self.side * (q[1] - p.belt))
        return q[1], (u[0] - p.k * q[0] - self.side * friction) / p.m


class BeltOscillator(HybridSystem):
    """A block on a spring, carried along by a belt until the spring tears it off.

    States: extension `x` of the spring and speed `v`. Dry friction decreases with the speed
    relative to the belt. On the belt (chart "sticks") both sides push towards the same speed
    (`hj.sliding`). Every start that comes to stick leaves the belt at x = friction / k: all
    multipliers are zero. Input `u` is a force.
    """

    input_units = ("N",)
    time_unit = "s"

    m: Parameter = parameter(1.0, unit="kg", doc="mass")
    k: Parameter = parameter(1.0, unit="N/m", doc="stiffness")
    belt: Parameter = parameter(0.2, unit="m/s", doc="speed of the belt")
    friction: Parameter = parameter(1.0, unit="N", doc="friction of a block that begins to slip")
    decay: Parameter = parameter(3.0, unit="s/m", doc="how fast friction decreases with the speed")

    def charts(self):
        return self._parts().charts

    def transitions(self):
        return self._parts().transitions

    def _parts(self) -> Sliding:
        sides = {"ahead": Slips(self, 1.0), "behind": Slips(self, -1.0)}
        return sliding(sides, lambda t, q: q[1] - self.belt, "sticks")

    def guess(self):
        return Guess("sticks", jnp.stack([0.5 * self.friction / self.k, self.belt]))
