"""A neuron that spikes."""

from ..systems.chart import FieldChart
from ..systems.solver import Radau
from ..systems.system import Guess, HybridSystem, Parameter, parameter


class FitzHughNagumo(HybridSystem):
    """eps v' = v - v^3 / 3 - w + I + u, w' = v + a - b w: spikes at a constant current I.

    R. FitzHugh, Impulses and physiological states in theoretical models of nerve membrane, Biophys.
    J. 1 (1961) 445-466; J. Nagumo, S. Arimoto, S. Yoshizawa, An active pulse transmission line
    simulating nerve axon, Proc. IRE 50 (1962) 2061-2070.
    """

    eps: Parameter = parameter(0.01, doc="time scale of the membrane, of that of its recovery")
    current: Parameter = parameter(0.5, doc="I")
    a: Parameter = parameter(0.7)
    b: Parameter = parameter(0.8)

    def charts(self):
        return {"membrane": FieldChart(self._membrane, ("v", "w"), solver=Radau())}

    def _membrane(self, t, q, u):
        v, w = q
        fast = (v - v**3 / 3 - w + self.current + u[0]) / self.eps
        return fast, v + self.a - self.b * w

    def guess(self):
        """A state on the slow branch, before the end of a spike."""
        return Guess("membrane", (1.5, 0.9))
