"""A planar quadruped that trots on the spot: two feet land, and two let go, at the same time.

The body on springy legs is that of `bar.py`. Events that coincide on its cycle make the flow
piecewise differentiable: S. A. Burden, S. S. Sastry, D. E. Koditschek, S. Revzen, Event-selected
vector field discontinuities yield piecewise-differentiable flows, SIAM J. Applied Dynamical Systems
15, 2016.
"""

from ..systems.system import Guess, Parameter, parameter
from .bar import Standing, TwoLeggedBar


class Support(Standing):
    bar: "TrottingQuadruped"

    def field(self, t, state, u):
        both = len(self.legs) == 2
        return super().field(t, state, u + self.bar.thrust if both else u)


class TrottingQuadruped(TwoLeggedBar):
    """A bar on four legs, of which a diagonal pair lands at once, and then the other.

    Seen from the side both pairs are the same, so that a hop is a cycle, and two of them a stride.
    Legs of the pair in turn lengthen and shorten by A sin(2 pi t / T). States and input as those of
    `TwoLeggedBar`; nothing is lost at touchdown (rho = 1), but legs damp. While both feet of a pair
    stand, a reflex adds `thrust` to the force of the legs. Without it, the order in which the feet
    land has no effect of first order, and the cycle has multipliers; with it, each order has a
    derivative of its own (`hj.orbits.coincidences`), and `find_limit_cycle` says so.
    """

    hind: Parameter = parameter(-0.5, unit="m", doc="position of the hind hip")
    front: Parameter = parameter(0.5, unit="m", doc="position of the front hip")
    rho: Parameter = parameter(1.0, doc="relative speed of a foot kept when it lands")
    thrust: Parameter = parameter(0.0, unit="N", doc="force of the reflex, of both legs")

    def charts(self):
        return {name: Support(self, chart.legs) for name, chart in super().charts().items()}

    def guess(self):
        return Guess("both", (0.4, -0.9, 0.0, 0.0))
