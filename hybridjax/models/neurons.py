"""Neurons that spike: adaptive exponential, Izhikevich, and FitzHugh-Nagumo.

The first two are `DrivenNeuron`s: a periodic current, times in ms, and a reset at the `peak`. The
third has no reset and no units. Each class has its equations and its source in the docstring; tests
rely on the default parameters. If a spike comes at a wrong time, look at `_membrane`, and at the
guard in `transitions`; if the state after it is wrong, at `after_spike`.
"""

import abc

import jax.numpy as jnp
from equinox import AbstractVar

from ..systems.chart import FieldChart
from ..systems.solver import Radau
from ..systems.system import Guess, HybridSystem, Parameter, parameter
from ..systems.transition import Transition


class DrivenNeuron(HybridSystem):
    """A neuron with the potential v and the recovery w, in a periodic current I(t) = current +
    amplitude cos(2 pi t / T)."""

    time_unit = "ms"

    peak: AbstractVar[Parameter]
    current: AbstractVar[Parameter]
    amplitude: AbstractVar[Parameter]
    T: AbstractVar[Parameter]

    def total_current(self, t, u):
        wave = jnp.cos(2 * jnp.pi * t / self.T)
        drive = self.amplitude * wave
        return self.current + drive + u[0]

    @abc.abstractmethod
    def after_spike(self, t, q, u):
        """The state after a spike."""

    def transitions(self):
        def below(t, q, u):
            return self.peak - q[0]

        return (
            Transition("spike", "membrane", "membrane", below, reset=self.after_spike),
        )

    def period(self):
        return self.T


class AdExNeuron(DrivenNeuron):
    """C v' = gL (EL - v + slope exp((v - threshold) / slope)) - w + I(t) + u and
    tau w' = a (v - EL) - w, reset to v = EL, w + b at v = peak.

    States: potential `v` of the membrane, and adaptation current `w`. The current I(t) = current +
    amplitude cos(2 pi t / T) causes one spike in each period. When the exponential term dominates,
    v becomes infinite within a time of C / gL exp(-(v - threshold) / slope), which is 3.5e-4 ms at
    `peak`. (At the paper's peak of 20 mV, this time is too short for double precision.)

    Equations, and all parameters except `peak`: R. Brette, W. Gerstner, Adaptive
    exponential integrate-and-fire model as an effective description of neuronal
    activity, J. Neurophysiology 94, 2005.
    """

    input_units = ("pA",)

    C: Parameter = parameter(281.0, unit="pF", positive=True, doc="capacitance")
    gL: Parameter = parameter(30.0, unit="nS", doc="leak")
    EL: Parameter = parameter(
        -70.6, unit="mV", doc="potential of the leak, and after a spike"
    )
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
        return {"membrane": FieldChart(self._membrane, ("v", "w"), ("mV", "pA"))}

    def _membrane(self, t, q, u):
        v, w = q
        spike = self.slope * jnp.exp((v - self.threshold) / self.slope)
        membrane = self.gL * (self.EL - v + spike)
        total = membrane - w + self.total_current(t, u)
        recovery = (self.a * (v - self.EL) - w) / self.tau
        return total / self.C, recovery

    def after_spike(self, t, q, u):
        return self.EL, q[1] + self.b

    def guess(self):
        return Guess("membrane", (-53.0, 350.0), 0.5 * self.T)


class IzhikevichNeuron(DrivenNeuron):
    """v' = 0.04 v^2 + 5 v + 140 - w + I(t) + u, w' = a (b v - w), reset to v = c, w + d at v = 30.

    States: potential `v` of the membrane, and its recovery `w` (u in the paper). The current I(t) =
    current + amplitude cos(2 pi t / T) causes one spike in each period.

    Equations, and parameters for regular spiking: E. M. Izhikevich, Simple model of spiking
    neurons, IEEE Trans. Neural Networks 14, 2003.
    """

    input_units = ("mV/ms",)

    a: Parameter = parameter(0.02, unit="1/ms", doc="rate of the recovery")
    b: Parameter = parameter(0.2, unit="1/ms", doc="how recovery follows the potential")
    c: Parameter = parameter(-65.0, unit="mV", doc="potential after a spike")
    d: Parameter = parameter(8.0, unit="mV/ms", doc="step of the recovery at a spike")
    peak: Parameter = parameter(30.0, unit="mV", doc="potential of a spike")
    current: Parameter = parameter(10.0, unit="mV/ms", doc="mean of I(t)")
    amplitude: Parameter = parameter(4.0, unit="mV/ms", doc="amplitude of I(t)")
    T: Parameter = parameter(40.0, unit="ms", doc="period of I(t)")

    def charts(self):
        return {"membrane": FieldChart(self._membrane, ("v", "w"), ("mV", "mV/ms"))}

    def _membrane(self, t, q, u):
        v, w = q
        own = 0.04 * v**2 + 5 * v + 140
        rate = own - w + self.total_current(t, u)
        return rate, self.a * (self.b * v - w)

    def after_spike(self, t, q, u):
        return self.c, q[1] + self.d

    def guess(self):
        return Guess("membrane", (-74.0, -4.6), 0.5 * self.T)


class FitzHughNagumo(HybridSystem):
    """eps v' = v - v^3 / 3 - w + I + u, w' = v + a - b w: spikes at a constant current I.

    R. FitzHugh, Impulses and physiological states in theoretical models of nerve membrane, Biophys.
    J. 1 (1961) 445-466; J. Nagumo, S. Arimoto, S. Yoshizawa, An active pulse transmission line
    simulating nerve axon, Proc. IRE 50 (1962) 2061-2070.
    """

    eps: Parameter = parameter(
        0.01, doc="time scale of the membrane, of that of its recovery"
    )
    current: Parameter = parameter(0.5, doc="I")
    a: Parameter = parameter(0.7)
    b: Parameter = parameter(0.8)

    def charts(self):
        return {"membrane": FieldChart(self._membrane, ("v", "w"), solver=Radau())}

    def _membrane(self, t, q, u):
        v, w = q
        rise = v - v**3 / 3 - w
        fast = (rise + self.current + u[0]) / self.eps
        return fast, v + self.a - self.b * w

    def guess(self):
        """A state on the slow branch, before the end of a spike."""
        return Guess("membrane", (1.5, 0.9))
