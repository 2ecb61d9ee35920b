"""Flapping of a rotor blade in forward flight: linear, with periodic coefficients.

D. A. Peters, K. H. Hohenemser, Application of the Floquet transition matrix to problems of lifting
rotor stability, J. American Helicopter Society 16(2), 1971 (without reversed flow).
"""

import jax.numpy as jnp

from ...systems.chart import Chart
from ...systems.system import Guess, HybridSystem, Parameter, parameter


class Blade(Chart):
    states = ("b", "vb")
    units = ("rad", "")
    rotor: "RotorFlap"

    def field(self, t, q, u):
        p = self.rotor
        b, vb = q
        damping = p.lock / 8 * (1 + 4 / 3 * p.mu * jnp.sin(t))
        stiffness = p.p**2 + p.lock / 8 * (4 / 3 * p.mu * jnp.cos(t) + p.mu**2 * jnp.sin(2 * t))
        return vb, u[0] - damping * vb - stiffness * b


class RotorFlap(HybridSystem):
    """The flapping angle `b` of a rigid blade; time in radians of its rotation.

    Input `u` is a flapping moment over the moment of inertia, such as pitch makes.
    """

    lock: Parameter = parameter(12.0, doc="Lock number, aerodynamic over inertial forces")
    p: Parameter = parameter(1.0, doc="natural frequency over the rotor's")
    mu: Parameter = parameter(0.3, doc="advance ratio")

    def charts(self):
        return {"blade": Blade(self)}

    def period(self):
        return jnp.asarray(2 * jnp.pi)

    def guess(self):
        return Guess("blade", (0.0, 0.0))
