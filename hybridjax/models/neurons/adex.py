"""The adaptive exponential integrate-and-fire neuron, driven by a periodic current.

R. Brette, W. Gerstner, Adaptive exponential integrate-and-fire model as an effective description of
neuronal activity, J. Neurophysiology 94, 2005, whose parameters these are, but for `peak`.
"""

import jax.numpy as jnp

from ...systems.chart import Chart
from ...systems.system import Guess, HybridSystem, Parameter, parameter
from ...systems.transition import Transition


class Membrane(Chart):
    states = ("v", "w")
    units = ("mV", "pA")
    neuron: "AdExNeuron"

    def field(self, t, q, u):
        p = self.neuron
        v, w = q
        current = p.current + p.amplitude * jnp.cos(2 * jnp.pi * t / p.T) + u[0]
        spike = p.slope * jnp.exp((v - p.threshold) / p.slope)
        leak = p.gL * (p.EL - v + spike)
        return (leak - w + current) / p.C, (p.a * (v - p.EL) - w) / p.tau


class AdExNeuron(HybridSystem):
    """C v' = gL (EL - v + slope exp((v - threshold) / slope)) - w + I(t) + u and
    tau w' = a (v - EL) - w, reset to v = EL, w + b at v = peak.

    States: potential `v` of the membrane, and adaptation current `w`. The current I(t) = current +
    amplitude cos(2 pi t / T) calls for one spike a period. Once the exponential has taken over, v
    would be infinite after C / gL exp(-(v - threshold) / slope): 3.5e-4 ms from `peak` on. (The
    paper's peak of 20 mV comes so late in it that double precision does not tell its time.)
    """

    input_units = ("pA",)
    time_unit = "ms"

    C: Parameter = parameter(281.0, unit="pF", doc="capacitance")
    gL: Parameter = parameter(30.0, unit="nS", doc="leak")
    EL: Parameter = parameter(-70.6, unit="mV", doc="potential of the leak, and after a spike")
    threshold: Parameter = parameter(-50.4, unit="mV")
    slope: Parameter = parameter(2.0, unit="mV", doc="how sharply a spike sets in")
    tau: Parameter = parameter(144.0, unit="ms", doc="time constant of the adaptation")
    a: Parameter = parameter(4.0, unit="nS", doc="adaptation below the threshold")
    b: Parameter = parameter(80.5, unit="pA", doc="step of the adaptation at a spike")
    peak: Parameter = parameter(-30.0, unit="mV", doc="potential of a spike")
    current: Parameter = parameter(1000.0, unit="pA", doc="mean of I(t)")
    amplitude: Parameter = parameter(200.0, unit="pA", doc="amplitude of I(t)")
    T: Parameter = parameter(40.0, unit="ms", doc="period of I(t)")

    def charts(self):
        return {"membrane": Membrane(self)}

    def transitions(self):
        below = lambda t, q, u: self.peak - q[0]  # noqa: E731
        reset = lambda t, q, u: (self.EL, q[1] + self.b)  # noqa: E731
        return (Transition("spike", "membrane", "membrane", below, reset=reset),)

    def period(self):
        return self.T

    def guess(self):
        return Guess("membrane", (-53.0, 350.0), 0.5 * self.T)
