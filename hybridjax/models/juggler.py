"""A ball on a vibrating paddle.

P. J. Holmes, The dynamics of repeated impacts with a sinusoidally vibrating table, J. Sound and
Vibration 84, 1982.
"""

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array

from ..systems.chart import Chart
from ..systems.system import Guess, HybridSystem, Parameter, parameter
from ..systems.transition import Transition


class Fall(Chart):
    states = ("y", "v")
    units = ("m", "m/s")
    juggler: "PaddleJuggler"

    def field(self, t, q, u):
        return q[1], -self.juggler.g


class PaddleJuggler(HybridSystem):
    """A ball that bounces on a paddle in sinusoidal motion, once a period.

    Input `u` is added to the speed of the paddle at the impact. Between impacts the ball falls
    freely, so that everything is known in closed form (`exact`).
    """

    input_units = ("m/s",)
    time_unit = "s"

    A: Parameter = parameter(0.15, unit="m", doc="amplitude of the paddle")
    T: Parameter = parameter(1.0, unit="s", doc="period of the paddle")
    g: Parameter = parameter(9.81, unit="m/s^2", doc="gravity")
    restitution: Parameter = parameter(0.7, doc="relative speed kept at an impact")

    @property
    def rate(self):
        return 2 * jnp.pi / self.T

    def paddle(self, t: ArrayLike) -> tuple[Array, Array]:
        """Height and speed of the paddle."""
        phase = self.rate * t
        return self.A * jnp.sin(phase), self.A * self.rate * jnp.cos(phase)

    def exact(self):
        """Time of the impact, height and speed of the ball right after it, and the multipliers."""
        a, v = self.restitution, self.g * self.T / 2
        speed = (1 - a) * v / (1 + a)
        t = jnp.arccos(speed / (self.A * self.rate)) / self.rate
        y, _ = self.paddle(t)
        acceleration = -(self.rate**2) * y
        trace = 1 + a**2 + (1 + a) ** 2 * acceleration / self.g
        root = jnp.sqrt(trace**2 / 4 - a**2 + 0j)
        return t, y, v, jnp.stack([trace / 2 + root, trace / 2 - root])

    def charts(self):
        return {"fall": Fall(self)}

    def transitions(self):
        def bounce(t, q, u):
            a, (_, speed) = self.restitution, self.paddle(t)
            return q[0], -a * q[1] + (1 + a) * (speed + u[0])

        above = lambda t, q, u: q[0] - self.paddle(t)[0]  # noqa: E731
        return (Transition("impact", "fall", "fall", guard=above, reset=bounce),)

    def period(self):
        return self.T

    def guess(self):
        # From the top of the flight on: half a period after an impact.
        return Guess("fall", (1.3, 0.0), 0.56)
