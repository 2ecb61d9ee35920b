"""The normal form of a Hopf bifurcation.

J. Guckenheimer, P. Holmes, Nonlinear oscillations, dynamical systems, and bifurcations of vector
fields, Springer 1983, Sec. 3.4.
"""

import jax.numpy as jnp

from ...systems.chart import Chart
from ...systems.system import Guess, HybridSystem, Parameter, parameter


class Plane(Chart):
    states = ("x", "y")
    oscillator: "HopfOscillator"

    def field(self, t, q, u):
        p = self.oscillator
        x, y = q
        growth, rate = p.mu - x**2 - y**2, 2 * jnp.pi / p.T
        return growth * x - rate * y + u[0], rate * x + growth * y


class HopfOscillator(HybridSystem):
    """A smooth oscillator with a circular cycle of radius sqrt(mu) and multiplier exp(-2 mu T).

    Input `u` is added to the rate of x.
    """

    time_unit = "s"

    mu: Parameter = parameter(0.1, unit="1/s", doc="growth rate at the origin")
    T: Parameter = parameter(1.0, unit="s", doc="period")

    def charts(self):
        return {"plane": Plane(self)}

    def guess(self):
        return Guess("plane", (1.1 * jnp.sqrt(self.mu), 0.0))
