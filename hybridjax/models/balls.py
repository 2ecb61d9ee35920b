"""Balls that bounce: on fixed ground, on a vibrating paddle, and in a row on a shaken table.

A single ball falls freely, so that its cycle on the paddle is known in closed form
(`PaddleJuggler.exact`), which tests compare. On fixed ground, a restitution below 1 gives
infinitely many impacts in finite time. Guards are heights above the ground and must stay so, as
they fall through zero at an impact. Tests rely on the default parameters.

If an impact is wrong, look at the reset in `transitions`, or in `ChainContact.impact`; if a flight
is, at the field in `charts` (`BouncingChain._flight`); if no cycle is found, at `guess`.
"""

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array

from .._core.boundary.kinds import Count
from ..systems.chart import FieldChart
from ..systems.drawing import Drawing
from ..systems.system import Guess, HybridSystem, Parameter, parameter
from ..systems.transition import Transition


class BouncingBall(HybridSystem):
    """A ball under gravity that keeps the share `restitution` of its speed at each bounce.

    Input `u` is an acceleration. With a restitution below 1 the bounces accumulate in finite time
    (Zeno), and the ball has no cycle but rest.
    """

    input_units = ("m/s^2",)
    time_unit = "s"

    g: Parameter = parameter(9.81, unit="m/s^2", doc="gravity")
    restitution: Parameter = parameter(0.7, doc="speed kept at a bounce")

    def charts(self):
        def fall(t, q, u):
            return (q[1], u[0] - self.g)

        return {"fall": FieldChart(fall, ("y", "v"), ("m", "m/s"))}

    def transitions(self):
        def bounced(t, q, u):
            return (0.0, -self.restitution * q[1])

        return (
            Transition("bounce", "fall", "fall", lambda t, q, u: q[0], reset=bounced),
        )


class PaddleJuggler(HybridSystem):
    """A ball that bounces on a paddle in sinusoidal motion, once a period.

    Input `u` is added to the speed of the paddle at the impact. Between impacts the ball falls
    freely, so that everything is known in closed form (`exact`).

    P. J. Holmes, The dynamics of repeated impacts with a sinusoidally vibrating table, J. Sound and
    Vibration 84, 1982.
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
        height = self.A * jnp.sin(phase)
        speed = self.A * self.rate * jnp.cos(phase)
        return height, speed

    def exact(self):
        """Time of the impact, height and speed of the ball right after it, and the multipliers."""
        a = self.restitution
        v = self.g * self.T / 2
        speed = (1 - a) * v / (1 + a)
        t = jnp.arccos(speed / (self.A * self.rate)) / self.rate
        y, _ = self.paddle(t)
        acceleration = -(self.rate**2) * y
        by_paddle = (1 + a) ** 2 * acceleration / self.g
        trace = 1 + a**2 + by_paddle
        root = jnp.sqrt(trace**2 / 4 - a**2 + 0j)
        multipliers = jnp.stack([trace / 2 + root, trace / 2 - root])
        return t, y, v, multipliers

    def charts(self):
        return {
            "fall": FieldChart(
                lambda t, q, u: (q[1], -self.g), ("y", "v"), ("m", "m/s")
            )
        }

    def transitions(self):
        def bounce(t, q, u):
            a = self.restitution
            _, speed = self.paddle(t)
            by_paddle = (1 + a) * (speed + u[0])
            return q[0], -a * q[1] + by_paddle

        def above(t, q, u):
            return q[0] - self.paddle(t)[0]

        return (Transition("impact", "fall", "fall", guard=above, reset=bounce),)

    def period(self):
        return self.T

    def draw(self, chart, t, q):
        height, _ = self.paddle(t)
        lines = {"paddle": [(-0.3, height), (0.3, height)]}
        return Drawing(lines, circles={"ball": (0.0, q["y"] + 0.1, 0.1)})

    def guess(self):
        # From the top of the flight on: half a period after an impact.
        return Guess("fall", (1.3, 0.0), 0.56)


class ChainContact(eqx.Module):
    """Mass `i`, counted from 0, and the table below it."""

    chain: "BouncingChain"
    i: int

    def table(self, t: ArrayLike) -> tuple[Array, Array]:
        """Its height and speed."""
        chain = self.chain
        rate = 2 * jnp.pi / chain.T
        phase = rate * t - 2 * jnp.pi * self.i / chain.n
        height = chain.A * jnp.sin(phase)
        speed = chain.A * rate * jnp.cos(phase)
        return height, speed

    def gap(self, t, q, u):
        return q[self.i] - self.table(t)[0]

    def impact(self, t, q, u):
        e = self.chain.restitution
        n = self.chain.n
        _, speed = self.table(t)
        speed_after = (1 + e) * speed - e * q[n + self.i]
        return q.at[n + self.i].set(speed_after)


class BouncingChain(HybridSystem):
    """`n` equal masses in a row above a table, each joined to its neighbors by a spring and a
    dashpot. Along the table a wave travels that is as long as the row: every mass bounces once a
    period, one after the other.

    States: heights `y1` to `yn` and speeds `v1` to `vn`. Input `u` is a force on the first mass.
    Impacts keep the share `restitution` of the speed relative to the table.

    Each mass alone is the ball of `PaddleJuggler` (P. J. Holmes, J. Sound and Vibration 84, 1982).
    The system has 2n states and n events, for any n.
    """

    input_units = ("N",)
    time_unit = "s"

    n: Count = eqx.field(
        static=True, default=2, metadata={"unit": "", "doc": "number of masses"}
    )
    m: Parameter = parameter(1.0, unit="kg", positive=True, doc="mass of each")
    k: Parameter = parameter(0.3, unit="N/m", doc="stiffness between neighbors")
    c: Parameter = parameter(0.05, unit="N s/m", doc="damping between neighbors")
    g: Parameter = parameter(9.81, unit="m/s^2", doc="gravity")
    restitution: Parameter = parameter(0.5, doc="relative speed kept at an impact")
    A: Parameter = parameter(0.3, unit="m", doc="amplitude of the table")
    T: Parameter = parameter(1.0, unit="s", doc="period of the table")

    def charts(self):
        states = tuple(f"{x}{i}" for x in "yv" for i in range(1, self.n + 1))
        return {
            "flight": FieldChart(
                self._flight, states, ("m",) * self.n + ("m/s",) * self.n
            )
        }

    def _flight(self, t, q, u):
        y = q[: self.n]
        v = q[self.n :]
        spring = self.k * jnp.diff(y)
        damper = self.c * jnp.diff(v)
        stretch = spring + damper
        between = jnp.diff(jnp.pad(stretch, 1))
        force = between.at[0].add(u[0])
        return jnp.concatenate([v, force / self.m - self.g])

    def transitions(self):
        contacts = [ChainContact(self, i) for i in range(self.n)]
        return [
            Transition(f"impact {x.i + 1}", "flight", "flight", x.gap, reset=x.impact)
            for x in contacts
        ]

    def period(self):
        return self.T

    def guess(self):
        """The cycle of masses that are not coupled (see `PaddleJuggler.exact`)."""
        first, lift, v, _ = PaddleJuggler(
            self.A, self.T, self.g, self.restitution
        ).exact()
        delays = jnp.arange(self.n) * self.T / self.n
        past = -(first + delays) % self.T
        y = lift + v * past - self.g * past**2 / 2
        return Guess("flight", jnp.concatenate([y, v - self.g * past]))
