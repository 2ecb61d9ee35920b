"""A DC-DC buck converter under voltage-mode control with pulse-width modulation.

E. Fossas, G. Olivar, Study of chaos in the buck converter, IEEE Trans. Circuits and Systems I 43,
1996, whose parameters these are.
"""

import equinox as eqx
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from ...systems.chart import Chart
from ...systems.system import Guess, HybridSystem, Parameter, parameter
from ...systems.transition import Scheduled, Transition


class Circuit(Chart):
    states = ("v", "i", "ramp")
    units = ("V", "A", "V")
    buck: "BuckConverter"
    closed: bool = eqx.field(static=True)

    def field(self, t, q, u):
        p = self.buck
        v, i, _ = q
        supply = p.Vin if self.closed else 0.0
        return (i - v / p.R) / p.C, (supply - v) / p.L, (p.upper - p.lower) / p.T


class BuckConverter(HybridSystem):
    """A switch, a coil and a capacitor, and a comparator that closes the switch.

    States: voltage `v` at the load, current `i` of the coil (it never rests: continuous
    conduction), and the voltage `ramp` with which the amplified error is compared. The ramp starts
    anew once a period; that is a scheduled event. Input `u` is added to the reference voltage.
    """

    input_units = ("V",)
    time_unit = "s"

    R: Parameter = parameter(22.0, unit="ohm", doc="load")
    C: Parameter = parameter(47e-6, unit="F", doc="capacitor")
    L: Parameter = parameter(20e-3, unit="H", doc="coil")
    Vin: Parameter = parameter(20.0, unit="V", doc="supply")
    Vref: Parameter = parameter(11.3, unit="V", doc="reference")
    gain: Parameter = parameter(8.4, doc="gain of the error amplifier")
    lower: Parameter = parameter(3.8, unit="V", doc="start of the ramp")
    upper: Parameter = parameter(8.2, unit="V", doc="end of the ramp")
    T: Parameter = parameter(400e-6, unit="s", doc="period of the ramp")

    def control(self, t: ArrayLike, q: Float[Array, "3"], u: Float[Array, "1"]) -> Array:
        """Amplified error less the ramp: the switch is closed where this is negative."""
        return self.gain * (q[0] - self.Vref - u[0]) - q[2]

    def charts(self):
        return {"open": Circuit(self, False), "closed": Circuit(self, True)}

    def transitions(self):
        tick = Scheduled(self.T)
        anew = lambda t, q, u: (q[0], q[1], self.lower)  # noqa: E731
        return (
            Transition("switch on", "open", "closed", self.control),
            Transition("switch off", "closed", "open", self.control, direction="rising"),
            Transition("ramp ends", "closed", "open", tick, reset=anew),
            Transition("ramp ends (open)", "open", "open", tick, reset=anew),
        )

    def period(self):
        return self.T

    def guess(self):
        return Guess("open", (12.0, 0.6, self.lower))
