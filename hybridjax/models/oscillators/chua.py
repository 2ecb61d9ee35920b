"""Chua's circuit: linear in three slabs of its space, autonomous.

T. Matsumoto, L. O. Chua, M. Komuro, The double scroll, IEEE Trans. Circuits and Systems 32, 1985,
in whose dimensionless form it stands. Their double scroll is at alpha = 9; at alpha = 8, before its
periods double, there is a cycle around either of two equilibria.
"""

from ...systems.chart import Chart
from ...systems.system import Guess, HybridSystem, Parameter, parameter
from ...systems.transition import Transition


class Slab(Chart):
    states = ("x", "y", "z")
    circuit: "ChuaCircuit"
    side: float

    def field(self, t, q, u):
        p = self.circuit
        x, y, z = q
        resistor = (
            p.inner * x if self.side == 0 else p.outer * (x - self.side) + p.inner * self.side
        )
        return p.alpha * (y - resistor) + u[0], x - y + z, -p.beta * y


class ChuaCircuit(HybridSystem):
    """x' = alpha (y - h(x)) + u, y' = x - y + z, z' = -beta y, with a resistor h of slope `inner`
    where |x| < 1 (chart "middle"), and `outer` beyond (charts "left" and "right").

    The field is continuous across x = 1 and x = -1; its derivative jumps. States: voltages `x` and
    `y` of both capacitors, and current `z` of the coil, without dimensions.
    """

    alpha: Parameter = parameter(8.0, doc="ratio of the capacitors")
    beta: Parameter = parameter(100 / 7, doc="of a capacitor to the coil")
    inner: Parameter = parameter(-1 / 7, doc="slope of h for small voltages")
    outer: Parameter = parameter(2 / 7, doc="the same for large ones")

    def charts(self):
        return {"left": Slab(self, -1.0), "middle": Slab(self, 0.0), "right": Slab(self, 1.0)}

    def transitions(self):
        right, left = (lambda t, q, u, x=x: q[0] - x for x in (1.0, -1.0))
        return (
            Transition("in from the right", "right", "middle", right),
            Transition("out to the right", "middle", "right", right, "rising"),
            Transition("in from the left", "left", "middle", left, "rising"),
            Transition("out to the left", "middle", "left", left),
        )

    def guess(self):
        return Guess("right", (2.1, 0.1, -3.0))
