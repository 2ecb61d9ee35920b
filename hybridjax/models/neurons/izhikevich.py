"""Izhikevich's neuron, driven by a periodic current.

E. M. Izhikevich, Simple model of spiking neurons, IEEE Trans. Neural Networks 14, 2003, whose
parameters for regular spiking these are.
"""

import jax.numpy as jnp

from ...systems.chart import Chart
from ...systems.system import Guess, HybridSystem, Parameter, parameter
from ...systems.transition import Transition


class Membrane(Chart):
    states = ("v", "w")
    units = ("mV", "mV/ms")
    neuron: "IzhikevichNeuron"

    def field(self, t, q, u):
        p = self.neuron
        v, w = q
        current = p.current + p.amplitude * jnp.cos(2 * jnp.pi * t / p.T) + u[0]
        return 0.04 * v**2 + 5 * v + 140 - w + current, p.a * (p.b * v - w)


class IzhikevichNeuron(HybridSystem):
    """v' = 0.04 v^2 + 5 v + 140 - w + I(t) + u, w' = a (b v - w), reset to v = c, w + d at v = 30.

    States: potential `v` of the membrane, and its recovery `w` (u in the paper). The current I(t) =
    current + amplitude cos(2 pi t / T) calls for one spike a period.
    """

    input_units = ("mV/ms",)
    time_unit = "ms"

    a: Parameter = parameter(0.02, unit="1/ms", doc="rate of the recovery")
    b: Parameter = parameter(0.2, unit="1/ms", doc="how recovery follows the potential")
    c: Parameter = parameter(-65.0, unit="mV", doc="potential after a spike")
    d: Parameter = parameter(8.0, unit="mV/ms", doc="step of the recovery at a spike")
    peak: Parameter = parameter(30.0, unit="mV", doc="potential of a spike")
    current: Parameter = parameter(10.0, unit="mV/ms", doc="mean of I(t)")
    amplitude: Parameter = parameter(4.0, unit="mV/ms", doc="amplitude of I(t)")
    T: Parameter = parameter(40.0, unit="ms", doc="period of I(t)")

    def charts(self):
        return {"membrane": Membrane(self)}

    def transitions(self):
        below = lambda t, q, u: self.peak - q[0]  # noqa: E731
        reset = lambda t, q, u: (self.c, q[1] + self.d)  # noqa: E731
        return (Transition("spike", "membrane", "membrane", below, reset=reset),)

    def period(self):
        return self.T

    def guess(self):
        return Guess("membrane", (-74.0, -4.6), 0.5 * self.T)
