"""FitzHugh and Nagumo's model of a nerve: a relaxation oscillation, stiff where `eps` is small.

R. FitzHugh, Impulses and physiological states in theoretical models of nerve membrane, Biophys. J.
1 (1961) 445-466; J. Nagumo, S. Arimoto, S. Yoshizawa, An active pulse transmission line simulating
nerve axon, Proc. IRE 50 (1962) 2061-2070.
"""

from ...systems.chart import Chart
from ...systems.solver import Radau
from ...systems.system import Guess, HybridSystem, Parameter, parameter


class Membrane(Chart):
    states = ("v", "w")
    solver = Radau()
    nerve: "FitzHughNagumo"

    def field(self, t, q, u):
        p = self.nerve
        v, w = q
        return (v - v**3 / 3 - w + p.current + u[0]) / p.eps, v + p.a - p.b * w


class FitzHughNagumo(HybridSystem):
    """eps v' = v - v^3 / 3 - w + I + u, w' = v + a - b w: spikes at a constant current I."""

    eps: Parameter = parameter(0.01, doc="time scale of the membrane, of that of its recovery")
    current: Parameter = parameter(0.5, doc="I")
    a: Parameter = parameter(0.7)
    b: Parameter = parameter(0.8)

    def charts(self):
        return {"membrane": Membrane(self)}

    def guess(self):
        """On the slow branch, somewhat before the end of a spike."""
        return Guess("membrane", (1.5, 0.9))
