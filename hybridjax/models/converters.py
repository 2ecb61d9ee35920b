"""A DC-DC converter with a switch that a controller closes and opens."""

import math

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from ..systems.chart import FieldChart
from ..systems.drawing import Drawing
from ..systems.system import Guess, HybridSystem, Parameter, parameter
from ..systems.transition import Scheduled, Transition


# Symbols of a circuit, of length 1, in the complex plane.
_COIL = np.array([k / 48 + 0.1j * math.sin(math.pi * (k % 12) / 12) for k in range(49)])
_DIODE = np.array([0, 35, 35 + 15j, 65, 35 - 15j, 35, 65, 65 + 15j, 65 - 15j, 65, 100]) / 100


def _plates(charge: ArrayLike) -> tuple[Array, Array]:
    """Both halves of a capacitor, the gap of which shows the charge, from 0 to 1."""
    half = jnp.array([0, 0.45, 0.45 - 0.25j, 0.45 + 0.25j])
    half -= 0.1 * jnp.clip(charge, 0, 1) * np.array([0, 1, 1, 1])
    return half, 1 - half


class BuckConverter(HybridSystem):
    """A switch, a coil and a capacitor, and a comparator that closes the switch.

    States: voltage `v` at the load, current `i` of the coil (which never vanishes: continuous
    conduction), and the voltage `ramp` with which the amplified error is compared. A scheduled
    event resets the ramp once a period. Input `u` is added to the reference voltage.

    E. Fossas, G. Olivar, Study of chaos in the buck converter, IEEE Trans. Circuits and Systems I
    43, 1996, whose parameters these are.
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
        return {"open": self._circuit(0.0), "closed": self._circuit(self.Vin)}

    def _circuit(self, supply: Parameter) -> FieldChart:
        def field(t, q, u):
            v, i, _ = q
            ramp = (self.upper - self.lower) / self.T
            return (i - v / self.R) / self.C, (supply - v) / self.L, ramp

        return FieldChart(field, ("v", "i", "ramp"), ("V", "A", "V"))

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

    def draw(self, chart, t, q):
        """The circuit: supply, switch (or diode), coil, capacitor, load."""
        above, below = _plates(q["v"] / self.Vin)
        lines = {
            "switch": np.array([1j, 0.2 + 1j, 0.9 + 1j if chart == "closed" else 0.7 + 1.4j]),
            "coil": np.append(0.9 + 1j, 1 + 1j + _COIL),
            "diode": 1 + 1j * _DIODE,
            "upper plate": 2 + 1j - 1j * above,
            "lower plate": 2 + 1j - 1j * below,
        }
        drawn = {name: jnp.stack([jnp.real(z), jnp.imag(z)], -1) for name, z in lines.items()}
        load = [(2.0, 1.0), *Drawing.spring((3.0, 1.0), (3.0, 0.0)), (0.0, 0.0)]
        return Drawing(drawn | {"load": load}, points={"plus": (0.0, 1.0), "minus": (0.0, 0.0)})

    def guess(self):
        return Guess("open", (12.0, 0.6, self.lower))
