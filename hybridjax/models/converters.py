"""DC-DC converters with a switch that a controller closes and opens.

Each class has two charts, "open" and "closed", named by the switch, whose equations are in
`_circuit`; a clock (`Scheduled`) and a guard switch between them. The classes cite their sources.
Tests rely on the default parameters. Each chart must have a transition for the tick of the clock,
also where the switch stays as it is, so that no tick is missed.

If a voltage or current is wrong between two events, look at `_circuit`; if the switch acts at a
wrong time, at the guards in `transitions`; if no cycle is found, at `guess`.
"""

from jax.typing import ArrayLike
from jaxtyping import Array, Float

from ..systems.chart import FieldChart
from ..systems.system import Guess, HybridSystem, Parameter, parameter
from ..systems.transition import Scheduled, Transition


class BuckConverter(HybridSystem):
    """A switch, a coil and a capacitor, and a comparator that closes the switch.

    States: voltage `v` at the load, current `i` of the coil (which never vanishes: continuous
    conduction), and the voltage `ramp` with which the amplified error is compared. A scheduled
    event resets the ramp once a period. Input `u` is added to the reference voltage.

    Parameters: E. Fossas, G. Olivar, Study of chaos in the buck converter, IEEE Trans.
    Circuits and Systems I 43, 1996.
    """

    input_units = ("V",)
    time_unit = "s"

    R: Parameter = parameter(22.0, unit="ohm", positive=True, doc="load")
    C: Parameter = parameter(47e-6, unit="F", positive=True, doc="capacitor")
    L: Parameter = parameter(20e-3, unit="H", positive=True, doc="coil")
    Vin: Parameter = parameter(20.0, unit="V", doc="supply")
    Vref: Parameter = parameter(11.3, unit="V", doc="reference")
    gain: Parameter = parameter(8.4, doc="gain of the error amplifier")
    lower: Parameter = parameter(3.8, unit="V", doc="start of the ramp")
    upper: Parameter = parameter(8.2, unit="V", doc="end of the ramp")
    T: Parameter = parameter(400e-6, unit="s", doc="period of the ramp")

    def control(
        self,
        t: ArrayLike,
        q: Float[Array, "3"],
        u: Float[Array, "1"],
    ) -> Array:
        """Amplified error less the ramp: the switch is closed where this is negative."""
        error = q[0] - self.Vref - u[0]
        return self.gain * error - q[2]

    def charts(self):
        return {"open": self._circuit(0.0), "closed": self._circuit(self.Vin)}

    def _circuit(self, supply: Parameter) -> FieldChart:
        def field(t, q, u):
            v, i, _ = q
            ramp = (self.upper - self.lower) / self.T
            voltage_rate = (i - v / self.R) / self.C
            current_rate = (supply - v) / self.L
            return voltage_rate, current_rate, ramp

        return FieldChart(field, ("v", "i", "ramp"), ("V", "A", "V"))

    def transitions(self):
        tick = Scheduled(self.T)

        def anew(t, q, u):
            return (q[0], q[1], self.lower)

        return (
            Transition("switch on", "open", "closed", self.control),
            Transition(
                "switch off", "closed", "open", self.control, direction="rising"
            ),
            Transition("ramp ends", "closed", "open", tick, reset=anew),
            Transition("ramp ends (open)", "open", "open", tick, reset=anew),
        )

    def period(self):
        return self.T

    def guess(self):
        return Guess("open", (12.0, 0.6, self.lower))


class CukConverter(HybridSystem):
    """A clock closes the switch, and the sum of both coils' currents opens it at a reference.

    States: current `i1` of the coil at the supply, voltage `v1` of the capacitor that transfers the
    energy, current `i2` of the coil at the load, and the load's voltage `v2` (of opposite sign to
    the supply, here counted as positive). While the switch is open, the diode conducts all the time
    (continuous conduction). Input `u` is added to the reference current.

    S. Ćuk, R. D. Middlebrook, A new optimum topology switching dc-to-dc converter, IEEE
    Power Electronics Specialists Conference, 1977. C. K. Tse, W. C. Y. Chan, Chaos from
    a current-programmed Ćuk converter, Int. J. Circuit Theory and Applications 23,
    1995, study this control where the cycle is no longer stable. The parameters have
    typical values, which are from neither source.
    """

    input_units = ("A",)
    time_unit = "s"

    E: Parameter = parameter(15.0, unit="V", doc="supply")
    L1: Parameter = parameter(2e-3, unit="H", positive=True, doc="coil at the supply")
    L2: Parameter = parameter(2e-3, unit="H", positive=True, doc="coil at the load")
    C1: Parameter = parameter(
        20e-6, unit="F", positive=True, doc="capacitor between the coils"
    )
    C2: Parameter = parameter(
        20e-6, unit="F", positive=True, doc="capacitor at the load"
    )
    R: Parameter = parameter(10.0, unit="ohm", positive=True, doc="load")
    Iref: Parameter = parameter(2.0, unit="A", doc="reference for i1 + i2")
    T: Parameter = parameter(100e-6, unit="s", doc="period of the clock")

    def charts(self):
        return {"open": self._circuit(False), "closed": self._circuit(True)}

    def _circuit(self, closed: bool) -> FieldChart:
        def field(t, q, u):
            i1, v1, i2, v2 = q
            # The capacitor between the coils stands in the loop of one or the other.
            first, charge, second = (0.0, -i2, v1) if closed else (v1, i1, 0.0)
            rates = (
                (self.E - first) / self.L1,
                charge / self.C1,
                (second - v2) / self.L2,
            )
            return *rates, (i2 - v2 / self.R) / self.C2

        return FieldChart(field, ("i1", "v1", "i2", "v2"), ("A", "V", "A", "V"))

    def transitions(self):
        tick = Scheduled(self.T)

        def left(t, q, u):
            return self.Iref + u[0] - q[0] - q[2]

        return (
            Transition("switch off", "closed", "open", left),
            Transition("switch on", "open", "closed", tick),
            Transition("stays on", "closed", "closed", tick),
        )

    def period(self):
        return self.T

    def guess(self):
        return Guess("open", (0.55, 25.0, 0.85, 10.0), 0.9 * self.T)
