"""Duffing's oscillator, driven by a cosine.

G. Duffing, Erzwungene Schwingungen bei veränderlicher Eigenfrequenz, Vieweg 1918; A. H. Nayfeh, D.
T. Mook, Nonlinear oscillations, Wiley 1979, Sec. 4.1.
"""

import jax.numpy as jnp

from ...systems.chart import Chart
from ...systems.system import Guess, HybridSystem, Parameter, parameter


class Line(Chart):
    states = ("x", "v")
    units = ("m", "m/s")
    duffing: "Duffing"

    def field(self, t, q, u):
        p = self.duffing
        x, v = q
        force = p.amplitude * jnp.cos(p.rate * t) + u[0]
        return v, force - p.damping * v - p.alpha * x - p.beta * x**3


class Duffing(HybridSystem):
    """x'' + delta x' + alpha x + beta x^3 = gamma cos(omega t) + u, smooth and clocked.

    With a hardening spring (beta > 0) the resonance leans over to higher frequencies: between two
    folds there are three responses to one `rate`, the middle one unstable.
    """

    input_units = ("m/s^2",)
    time_unit = "s"

    alpha: Parameter = parameter(1.0, unit="1/s^2", doc="linear stiffness")
    beta: Parameter = parameter(0.05, unit="1/(m^2 s^2)", doc="cubic stiffness")
    damping: Parameter = parameter(0.1, unit="1/s", doc="delta")
    amplitude: Parameter = parameter(0.5, unit="m/s^2", doc="gamma, of the force")
    rate: Parameter = parameter(0.5, unit="rad/s", doc="omega, of the force")

    def charts(self):
        return {"line": Line(self)}

    def period(self):
        return 2 * jnp.pi / self.rate

    def guess(self):
        """The response of the linear oscillator, far from resonance."""
        return Guess("line", (self.amplitude / (self.alpha - self.rate**2), 0.0))
