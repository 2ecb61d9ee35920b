"""The damped Mathieu equation.

A. H. Nayfeh, D. T. Mook, Nonlinear oscillations, Wiley 1979, Ch. 5.
"""

import jax.numpy as jnp

from ...systems.chart import Chart
from ...systems.system import Guess, HybridSystem, Parameter, parameter


class Line(Chart):
    states = ("x", "v")
    mathieu: "Mathieu"

    def field(self, t, q, u):
        p = self.mathieu
        x, v = q
        return v, u[0] - 2 * p.damping * v - (p.delta + p.epsilon * jnp.cos(t)) * x


class Mathieu(HybridSystem):
    """x'' + 2 c x' + (delta + epsilon cos t) x = u, with the period 2 pi; its cycle is rest.

    At delta = 0.25, epsilon = 0.1 both multipliers are negative: no real N-th root of the monodromy
    exists, and the argument of a multiplier does not say how often the state went round.
    """

    delta: Parameter = parameter(1.0, doc="stiffness")
    epsilon: Parameter = parameter(0.4, doc="amplitude of the stiffness's oscillation")
    damping: Parameter = parameter(0.1, doc="c")

    def charts(self):
        return {"line": Line(self)}

    def period(self):
        return jnp.asarray(2 * jnp.pi)

    def guess(self):
        return Guess("line", (0.0, 0.0))
