"""Van der Pol's oscillator: smooth and autonomous, without any event.

B. van der Pol, On relaxation-oscillations, Phil. Mag. 2 (1926).
"""

from ...systems.chart import Chart
from ...systems.system import Guess, HybridSystem, Parameter, parameter


class Oscillation(Chart):
    states = ("x", "v")
    oscillator: "VanDerPol"

    def field(self, t, q, u):
        x, v = q
        return v, self.oscillator.mu * (1 - x**2) * v - x + u[0]


class VanDerPol(HybridSystem):
    """x'' = mu (1 - x^2) x' - x + u, with an attracting cycle for mu > 0."""

    mu: Parameter = parameter(1.0, doc="strength of the nonlinear damping")

    def charts(self):
        return {"oscillation": Oscillation(self)}

    def guess(self):
        return Guess("oscillation", (2.0, 0.0))
