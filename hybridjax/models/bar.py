"""A bar on two springy legs over a shaking table: four charts, two guards in each.

The legs are linear spring-dampers without mass (R. Blickhan, The spring-mass model for running and
hopping, J. Biomech. 22, 1989). Both feet land, and both let go, within a few hundredths of a
period, and each touchdown changes the speed at which the other foot comes down.
"""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from .._core.boundary.checked import checked_methods
from ..systems.chart import Chart
from ..systems.system import Guess, HybridSystem, Parameter, parameter
from ..systems.transition import Transition


# Chart by the legs that stand on the table.
_CHARTS = {(): "air", ("hind",): "hind", ("front",): "front", ("hind", "front"): "both"}


Leg = Literal["hind", "front"]


class Standing(Chart):
    states = ("y", "v", "q", "p")
    units = ("m", "m/s", "rad", "rad/s")
    bar: "TwoLeggedBar"
    legs: tuple[str, ...] = eqx.field(static=True)

    def field(self, t, state, u):
        bar = self.bar
        _, v, _, p = state
        forces = {leg: bar.force(leg, t, state) for leg in self.legs}
        torque = sum((bar.hip(leg) * F for leg, F in forces.items()), start=0.0)
        return v, (sum(forces.values(), start=0.0) + u[0]) / bar.m - bar.g, p, torque / bar.J


@checked_methods
class TwoLeggedBar(HybridSystem):
    """A rigid bar, hopping on a hind and a front leg over a table that shakes up and down.

    States: height `y` of the center and its speed `v`, pitch `q` (a small angle by definition) and
    its rate `p`. Input `u` is a vertical force at the center. A foot that lands loses the share
    1 - rho of its speed relative to the table in an impulse; it lets go when its leg has its rest
    length again.
    """

    input_units = ("N",)
    time_unit = "s"

    m: Parameter = parameter(1.0, unit="kg", doc="mass of the bar")
    J: Parameter = parameter(0.2, unit="kg m^2", doc="moment of inertia of the bar")
    hind: Parameter = parameter(-0.5, unit="m", doc="position of the hind hip")
    front: Parameter = parameter(0.55, unit="m", doc="position of the front hip")
    k: Parameter = parameter(15.0, unit="N/m", doc="stiffness of a leg")
    b: Parameter = parameter(1.0, unit="N s/m", doc="damping of a leg")
    l0: Parameter = parameter(1.0, unit="m", doc="rest length of a leg")
    g: Parameter = parameter(10.0, unit="m/s^2", doc="gravity")
    rho: Parameter = parameter(0.8, doc="relative speed of a foot kept when it lands")
    A: Parameter = parameter(0.2, unit="m", doc="amplitude of the table")
    T: Parameter = parameter(1.0, unit="s", doc="period of the table")

    def hip(self, leg: Leg) -> Parameter:
        """Position of a leg's hip along the bar."""
        return self.hind if leg == "hind" else self.front

    def length(self, leg: Leg, t: ArrayLike, state: Float[Array, "4"]) -> Array:
        """Length of a standing leg less its rest length: the foot's height while in the air."""
        y, _, q, _ = state
        table = self.A * jnp.sin(2 * jnp.pi * t / self.T)
        return y + self.hip(leg) * q - table - self.l0

    def speed(self, leg: Leg, t: ArrayLike, state: Float[Array, "4"]) -> Array:
        """Rate of `length`."""
        _, v, _, p = state
        rate = 2 * jnp.pi / self.T
        return v + self.hip(leg) * p - self.A * rate * jnp.cos(rate * t)

    def force(self, leg: Leg, t: ArrayLike, state: Float[Array, "4"]) -> Array:
        """Force of a standing leg on the bar."""
        return -self.k * self.length(leg, t, state) - self.b * self.speed(leg, t, state)

    def charts(self):
        return {name: Standing(self, legs) for legs, name in _CHARTS.items()}

    def transitions(self):
        found = []
        for legs, name in _CHARTS.items():
            for leg in ("hind", "front"):
                lands = leg not in legs
                other = tuple(x for x in ("hind", "front") if (x in legs) != (x == leg))
                found.append(
                    Transition(
                        f"{leg} {'lands' if lands else 'lifts'} ({name})",
                        name,
                        _CHARTS[other],
                        guard=lambda t, q, u, leg=leg: self.length(leg, t, q),
                        direction="falling" if lands else "rising",
                        reset=lambda t, q, u, leg=leg, lands=lands: (
                            self._impact(leg, t, q) if lands else q
                        ),
                    )
                )
        return tuple(found)

    def _impact(self, leg, t, state):
        y, v, q, p = state
        s = self.hip(leg)
        impulse = -(1 - self.rho) * self.speed(leg, t, state) / (1 / self.m + s**2 / self.J)
        return y, v + impulse / self.m, q, p + s * impulse / self.J

    def period(self):
        return self.T

    def guess(self):
        return Guess("both", (0.4, -0.9, 0.0, 0.5))
