"""The vertical hopper of the paper on a ground that yields: stiff while the foot touches it.

The hopper is that of `hopper.py`; the ground is a spring and a dashpot in parallel, and only pushes
(on such contacts: K. H. Hunt, F. R. E. Crossley, J. Appl. Mech. 42 (1975) 440-445).
"""

from jax.typing import ArrayLike
from jaxtyping import Array

from ..systems.chart import Chart
from ..systems.solver import Radau
from ..systems.system import Guess, Parameter, parameter
from ..systems.transition import Transition
from .hopper import Flight, VerticalHopper


class Contact(Chart):
    states = ("yM", "vM", "ym", "vm")
    units = ("m", "m/s", "m", "m/s")
    solver = Radau()
    hopper: "CompliantHopper"

    def field(self, t, q, u):
        p = self.hopper
        yM, vM, ym, vm = q
        leg = p.leg(t, yM, ym)
        return vM, (leg + u[0]) / p.M - p.g, vm, (p.ground(ym, vm) - leg) / p.m - p.g


class CompliantHopper(VerticalHopper):
    """The hopper on a ground of stiffness `kg` and damping `cg`, from which the foot lifts off
    where their force vanishes. There is no impact: all four states move in both charts.

    Input `u` is a force on the upper mass.
    """

    kg: Parameter = parameter(1e5, unit="N/m", doc="stiffness of the ground")
    cg: Parameter = parameter(3e3, unit="N s/m", doc="damping of the ground")

    def ground(self, ym: ArrayLike, vm: ArrayLike) -> Array:
        """Force of the ground on the foot."""
        return -self.kg * ym - self.cg * vm

    def charts(self):
        return {"flight": Flight(self), "contact": Contact(self)}

    def transitions(self):
        force = lambda t, q, u: self.ground(q[2], q[3])  # noqa: E731
        return (
            Transition("touchdown", "flight", "contact", lambda t, q, u: q[2]),
            Transition("liftoff", "contact", "flight", force),
        )

    def guess(self):
        """The hopper's, where the ground carries the foot."""
        return Guess("contact", (2.0, 1.9, -1e-4, 0.0), 0.5)
