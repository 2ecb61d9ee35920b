"""Runners on springy legs: a bar on two legs (`TwoLeggedBar`), a quadruped that trots
(`TrottingQuadruped`), and a point mass (`SLIPRunner`).

The charts of the bar are named by the legs that stand; `length`, `speed` and `force` of a leg are
its whole mechanics. The quadruped is a bar with other parameters and a `reflex`; both of its feet
land at the same time, so that events coincide. Examples and tests rely on the default parameters.
If a touchdown is wrong, look at `_step` and `_impact`, or at `landed` of the point mass; if a
motion is, at `length` and `speed`, then at the sums in `_support`, or at `_stance`.
"""

import itertools
import math
from typing import Literal

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from .._core.boundary.checked import checked_methods
from ..systems.chart import FieldChart
from ..systems.drawing import Drawing
from ..systems.system import Guess, HybridSystem, Output, Parameter, parameter
from ..systems.transition import Transition


Leg = Literal["hind", "front"]
Legs = tuple[Leg, ...]
_LEGS: Legs = ("hind", "front")
# Charts by the legs that stand on the table.
_CHARTS: dict[Legs, str] = {
    (): "air",
    ("hind",): "hind",
    ("front",): "front",
    _LEGS: "both",
}


@checked_methods
class TwoLeggedBar(HybridSystem):
    """A rigid bar, hopping on a hind and a front leg over a table that shakes up and down.

    States: height `y` of the center and its speed `v`, pitch `q` (a small angle by definition) and
    its rate `p`. Input `u` is a vertical force at the center. A foot that lands loses the share
    1 - rho of its speed relative to the table in an impulse; it lets go when its leg has its rest
    length again.

    The legs are linear spring-dampers without mass (R. Blickhan, The spring-mass model for running
    and hopping, J. Biomech. 22, 1989). Both feet land, and both let go, within a few hundredths of
    a period, and each touchdown changes the speed at which the other foot comes down.
    """

    input_units = ("N",)
    time_unit = "s"

    m: Parameter = parameter(1.0, unit="kg", positive=True, doc="mass of the bar")
    J: Parameter = parameter(
        0.2, unit="kg m^2", positive=True, doc="moment of inertia of the bar"
    )
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
        wave = jnp.sin(2 * jnp.pi * t / self.T)
        table = self.A * wave
        return y + self.hip(leg) * q - table - self.l0

    def speed(self, leg: Leg, t: ArrayLike, state: Float[Array, "4"]) -> Array:
        """Rate of `length`."""
        _, v, _, p = state
        rate = 2 * jnp.pi / self.T
        offset = self.hip(leg) * p
        return v + offset - self.A * rate * jnp.cos(rate * t)

    def force(self, leg: Leg, t: ArrayLike, state: Float[Array, "4"]) -> Array:
        """Force of a standing leg on the bar."""
        spring = self.k * self.length(leg, t, state)
        return -spring - self.b * self.speed(leg, t, state)

    def charts(self):
        return {name: self._support(legs) for legs, name in _CHARTS.items()}

    def _support(self, legs: Legs) -> FieldChart:
        def field(t, state, u):
            _, v, _, p = state
            forces: dict[Leg, Array] = {leg: self.force(leg, t, state) for leg in legs}
            torque = sum((self.hip(leg) * F for leg, F in forces.items()), start=0.0)
            total = sum(forces.values(), start=self.reflex(legs)) + u[0]
            return v, total / self.m - self.g, p, torque / self.J

        return FieldChart(field, ("y", "v", "q", "p"), ("m", "m/s", "rad", "rad/s"))

    def reflex(self, legs: Legs) -> Parameter:
        """A force that is added while these legs stand."""
        return 0.0

    def transitions(self):
        steps = itertools.product(_CHARTS, _LEGS)
        return tuple(self._step(leg, legs) for legs, leg in steps)

    def _step(self, leg: Leg, legs: Legs) -> Transition:
        """Touchdown or liftoff of a leg, while these legs stand."""
        lands = leg not in legs
        source = _CHARTS[legs]
        after: Legs = tuple(x for x in _LEGS if (x in legs) != (x == leg))
        name = f"{leg} {'lands' if lands else 'lifts'} ({source})"

        def length(t, q, u):
            return self.length(leg, t, q)

        if not lands:
            return Transition(name, source, _CHARTS[after], length, "rising")

        def impact(t, q, u):
            return self._impact(leg, t, q)

        return Transition(name, source, _CHARTS[after], length, "falling", impact)

    def _impact(self, leg, t, state):
        y, v, q, p = state
        s = self.hip(leg)
        impulse = (
            -(1 - self.rho) * self.speed(leg, t, state) / (1 / self.m + s**2 / self.J)
        )
        after = v + impulse / self.m
        return y, after, q, p + s * impulse / self.J

    def period(self):
        return self.T

    def draw(self, chart, t, q):
        """The table, the bar, and legs that have their rest length in the air."""
        wave = jnp.sin(2 * jnp.pi * t / self.T)
        table = self.A * wave
        hips = []
        for leg in _LEGS:
            hip = self.hip(leg)
            hips.append((hip, q["y"] + hip * q["q"]))
        lines: dict = {"ground": [(-1.0, table), (1.0, table)], "bar": hips}
        for leg, (x, y) in zip(_LEGS, hips, strict=True):
            lines[leg] = Drawing.spring(
                (x, jnp.maximum(table, y - self.l0)), (x, y), 0.05
            )
        return Drawing(lines, circles={"center": (0.0, q["y"], 0.08)})

    def guess(self):
        return Guess("both", (0.4, -0.9, 0.0, 0.5))


class TrottingQuadruped(TwoLeggedBar):
    """A trotting bar on four legs: both legs of a diagonal pair land at the same time.

    In the side view both pairs are the same, so that one hop is a cycle, and two hops are a stride.
    Actuators lengthen the legs of the pair that lands next by A sin(2 pi t / T). States and input
    as those of `TwoLeggedBar`; nothing is lost at touchdown (rho = 1), but legs damp. While both
    feet of a pair stand, a reflex adds `thrust` to the force of the legs. Without it, the order in
    which the feet land has no effect of first order, and the cycle has multipliers; with it, each
    order has a derivative of its own (`cycle.simultaneous_events()`), and `find_limit_cycle`
    raises an error that reports this.

    The body on springy legs is that of `TwoLeggedBar`. Events that coincide on its cycle make the
    flow piecewise differentiable: S. A. Burden, S. S. Sastry, D. E. Koditschek, S. Revzen,
    Event-selected vector field discontinuities yield piecewise-differentiable flows, SIAM J.
    Applied Dynamical Systems 15, 2016.
    """

    hind: Parameter = parameter(-0.5, unit="m", doc="position of the hind hip")
    front: Parameter = parameter(0.5, unit="m", doc="position of the front hip")
    rho: Parameter = parameter(1.0, doc="relative speed of a foot kept when it lands")
    thrust: Parameter = parameter(
        0.0, unit="N", doc="force of the reflex, of both legs"
    )

    def reflex(self, legs: Legs) -> Parameter:
        return self.thrust if len(legs) == 2 else 0.0

    def guess(self):
        return Guess("both", (0.4, -0.9, 0.0, 0.0))


class SLIPRunner(HybridSystem):
    """A point mass on a massless spring, which touches down at a fixed angle of attack.

    States: height `y` and speeds `vx`, `vy`; in stance also `x`, the position of the
    mass relative to the foot. (In flight this position has no effect and is left out,
    so that a step is a cycle.) Input `u` is added to the angle of attack. Energy is
    conserved (output `energy`). One multiplier is therefore exactly 1, and there is a
    family of cycles, with one cycle for each energy. `find_limit_cycle(runner,
    conserved={"energy": 1784.8}, ...)` finds the cycle of a given energy.

    R. Blickhan, The spring-mass model for running and hopping, J. Biomechanics 22, 1989; H. Geyer,
    A. Seyfarth, R. Blickhan, Spring-mass running: simple approximate solution and application to
    gait stability, J. Theoretical Biology 232, 2005.
    """

    input_units = ("rad",)
    time_unit = "s"

    m: Parameter = parameter(80.0, unit="kg", positive=True, doc="mass")
    k: Parameter = parameter(20000.0, unit="N/m", doc="stiffness of the leg")
    l0: Parameter = parameter(1.0, unit="m", doc="rest length of the leg")
    g: Parameter = parameter(9.81, unit="m/s^2", doc="gravity")
    angle: Parameter = parameter(math.radians(68.0), unit="rad", doc="angle of attack")

    def energy(
        self,
        t: ArrayLike,
        q: Float[Array, " n"],
        u: Float[Array, " l"],
    ) -> Array:
        """Energy of the mass, and in stance of the spring."""
        *x, y, vx, vy = q
        spring = 0.0
        if x:
            compression = self.l0 - jnp.hypot(x[0], y)
            spring = 0.5 * self.k * compression**2
        kinetic = (vx**2 + vy**2) / 2
        return self.m * (self.g * y + kinetic) + spring

    def outputs(self):
        return (Output("energy", self.energy, "J"),)

    def charts(self):
        def flight(t, q, u):
            return (q[2], 0.0 * q[1], -self.g)

        return {
            "flight": FieldChart(flight, ("y", "vx", "vy"), ("m", "m/s", "m/s")),
            "stance": FieldChart(
                self._stance, ("x", "y", "vx", "vy"), ("m", "m", "m/s", "m/s")
            ),
        }

    def _stance(self, t, q, u):
        x, y, vx, vy = q
        r = jnp.hypot(x, y)
        push = self.k / self.m * (self.l0 - r) / r
        return vx, vy, push * x, push * y - self.g

    def transitions(self):
        def height(t, q, u):
            drop = self.l0 * jnp.sin(self.angle + u[0])
            return q[0] - drop

        def landed(t, q, u):
            foot = -self.l0 * jnp.cos(self.angle + u[0])
            return (foot, *q)

        def down(t, q, u):
            return q[2] < 0

        def stretch(t, q, u):
            return jnp.hypot(q[0], q[1]) - self.l0

        def lifted(t, q, u):
            return q[1:]

        return (
            Transition(
                "touchdown", "flight", "stance", height, reset=landed, enabled=down
            ),
            Transition("liftoff", "stance", "flight", stretch, "rising", lifted),
        )

    def draw(self, chart, t, q):
        """In flight, the leg has the angle at which it will touch down."""
        y = q["y"]
        flies = chart == "flight"
        x = -self.l0 * jnp.cos(self.angle) if flies else q["x"]
        foot = y - self.l0 * jnp.sin(self.angle) if flies else 0.0
        speed = (q["vx"], 0.0) if flies else (0.0, 0.0)
        lines = {
            "ground": [(-1.0, 0.0), (1.0, 0.0)],
            "leg": Drawing.spring((0.0, foot), (x, y)),
        }
        return Drawing(
            lines, circles={"mass": (x, y, 0.15)}, body="mass", velocity=speed
        )

    def guess(self):
        return Guess("flight", (0.95, 5.07, 0.0))
