"""Passive walkers on a slope: the rimless wheel, the simplest walking model, the compass gait.

Angles are from the vertical or from the normal of the slope, as the docstring of each class says,
with the source. After an impact, the legs exchange their names (`after`, `_heelstrike`). Cycles and
multipliers are published for the default parameters, or known in closed form (`exact`), and tests
compare them. If a step is wrong, look at the guard and the reset in `transitions` first; if the
motion within a step is, at the field (`swing`, `_step`); if an animation is, at `draw`, and at the
sign of angles in `_two_legs`.
"""

import math

import jax.numpy as jnp
from jaxtyping import Array

from ..systems.chart import FieldChart
from ..systems.drawing import Drawing
from ..systems.system import Guess, HybridSystem, Parameter, parameter
from ..systems.transition import Transition


def _slope(angle: Parameter, length: Parameter | float = 1.0) -> Array:
    """The ground under a stance foot at the origin, which falls towards x > 0."""
    direction = jnp.stack([jnp.cos(angle), -jnp.sin(angle)])
    way = length * direction
    return jnp.stack([-way, way])


def _two_legs(
    slope: Parameter,
    length: Parameter | float,
    stance: Array,
    swing: Array,
) -> Drawing:
    """Legs by their angles from the vertical, positive backward."""

    def way(angle):
        return length * jnp.stack([-jnp.sin(angle), jnp.cos(angle)])

    hip = way(stance)
    foot = hip - way(swing)
    lines = {
        "ground": _slope(slope, length),
        "stance": [0 * hip, hip],
        "swing": [hip, foot],
    }
    circles = {"hip": jnp.append(hip, 0.08 * length)}
    return Drawing(
        lines,
        circles=circles,
        points={"stance foot": 0 * hip, "swing foot": foot},
        body="hip",
    )


class RimlessWheel(HybridSystem):
    """Spokes without a rim, rolling downhill: an inverted pendulum about the spoke on the ground,
    until the next spoke lands.

    States: angle `th` of that spoke from the vertical, positive downhill, and its rate `w`. Input
    `u` is a hip torque over the moment of inertia. The return map is linear in w^2, so that the
    cycle and its multiplier cos^2(2 alpha) are known in closed form (`exact`).

    T. McGeer, Passive dynamic walking, Int. J. Robotics Research 9(2), 1990; M. J. Coleman, PhD
    thesis, Cornell University, 1998.
    """

    input_units = ("1/s^2",)
    time_unit = "s"

    rate: Parameter = parameter(1.0, unit="1/s^2", doc="g / l")
    spokes: Parameter = parameter(8.0, doc="number of spokes")
    slope: Parameter = parameter(0.08, unit="rad", doc="angle of the slope")

    @property
    def alpha(self):
        """Half the angle between spokes."""
        return jnp.pi / self.spokes

    def exact(self):
        """Speed right after an impact, and the multiplier."""
        spread = jnp.sin(self.alpha) * jnp.sin(self.slope)
        square = 4 * self.rate * spread
        w = jnp.sqrt(square) / jnp.tan(2 * self.alpha)
        return w, jnp.cos(2 * self.alpha) ** 2

    def charts(self):
        def swing(t, q, u):
            gravity = self.rate * jnp.sin(q[0])
            return (q[1], gravity + u[0])

        return {"swing": FieldChart(swing, ("th", "w"), ("rad", "rad/s"))}

    def transitions(self):
        def angle(t, q, u):
            return q[0] - self.slope - self.alpha

        def after(t, q, u):
            return (
                self.slope - self.alpha,
                jnp.cos(2 * self.alpha) * q[1],
            )

        return (Transition("impact", "swing", "swing", angle, "rising", after),)

    def draw(self, chart, t, q):
        """With spokes of 1 m, of which up to 24 are drawn."""
        turned = jnp.arange(24) % self.spokes
        angles = q["th"] + 2 * self.alpha * turned
        x = jnp.sin(q["th"])
        y = jnp.cos(q["th"])
        hub = jnp.stack([x, y])
        tips = hub - jnp.stack([jnp.sin(angles), jnp.cos(angles)], axis=1)
        spokes = jnp.stack([jnp.broadcast_to(hub, tips.shape), tips], axis=1).reshape(
            -1, 2
        )
        lines = {"ground": _slope(self.slope), "spokes": spokes}
        return Drawing(lines, circles={"hub": jnp.append(hub, 0.08)}, body="hub")

    def guess(self):
        return Guess("swing", (0.0, 0.3 * jnp.sqrt(self.rate)))


class SimplestWalker(HybridSystem):
    """A heavy hip on massless legs with light feet; time in units of sqrt(l / g).

    States: angle `th` of the stance leg from the normal of the slope, angle `phi` between the legs,
    and their rates `w`, `p`. Input `u` is a hip torque, as an acceleration of phi. At heelstrike
    the legs change their names. The feet scuff past each other in the middle of a step: there the
    guard rises, and that is no event.

    M. Garcia, A. Chatterjee, A. Ruina, M. Coleman, The simplest walking model: stability,
    complexity, and scaling, J. Biomechanical Engineering 120, 1998.
    """

    slope: Parameter = parameter(0.009, unit="rad", doc="angle of the slope")

    def charts(self):
        return {
            "step": FieldChart(
                self._step, ("th", "phi", "w", "p"), ("rad", "rad", "", "")
            )
        }

    def _step(self, t, q, u):
        th, phi, w, p = q
        stance = jnp.sin(th - self.slope)
        pull = w**2 - jnp.cos(th - self.slope)
        swing = pull * jnp.sin(phi)
        return w, p, stance, stance + swing + u[0]

    def transitions(self):
        def foot(t, q, u):
            return q[1] - 2 * q[0]

        def ahead(t, q, u):
            return q[0] < 0

        return (
            Transition(
                "heelstrike", "step", "step", foot, "rising", _heelstrike, ahead
            ),
        )

    def draw(self, chart, t, q):
        """With legs of 1 m."""
        stance = q["th"] - self.slope
        return _two_legs(self.slope, 1.0, stance, stance - q["phi"])

    def guess(self):
        """The long-period gait; `short_gait` is the other one."""
        return _after_heelstrike(0.2, -0.2)

    def short_gait(self):
        """A guess of the short-period gait, which is unstable."""
        return _after_heelstrike(0.19, -0.2)


def _heelstrike(t, q, u):
    th, _, w, _ = q
    c = jnp.cos(2 * th)
    hip = c * (1 - c) * w
    return -th, -2 * th, c * w, hip


def _after_heelstrike(th, w):
    swing = (1 - jnp.cos(2 * th)) * w
    return Guess("step", (th, 2 * th, w, swing))


class CompassGait(HybridSystem):
    """A mass at the hip and one on each leg, walking down a slope.

    States: angles `n` of the swing leg and `s` of the stance leg from the vertical, and their rates
    `vn`, `vs`. Input `u` is a hip torque (+u on n, -u on s). At heelstrike the legs change their
    names. The guard is zero right after heelstrike, and then negative. It is armed only once it has
    been positive, after the feet have scuffed past each other.

    A. Goswami, B. Thuilot, B. Espiau, A study of the passive gait of a compass-like biped robot,
    Int. J. Robotics Research 17(12), 1998.
    """

    input_units = ("N m",)
    time_unit = "s"

    mH: Parameter = parameter(10.0, unit="kg", positive=True, doc="mass of the hip")
    m: Parameter = parameter(5.0, unit="kg", positive=True, doc="mass of a leg")
    a: Parameter = parameter(0.5, unit="m", doc="from the foot to the leg's mass")
    b: Parameter = parameter(0.5, unit="m", doc="from the leg's mass to the hip")
    g: Parameter = parameter(9.81, unit="m/s^2", doc="gravity")
    slope: Parameter = parameter(
        3.0 * math.pi / 180, unit="rad", doc="angle of the slope"
    )

    @property
    def l(self):  # noqa: E743
        """Length of a leg."""
        return self.a + self.b

    def charts(self):
        units = ("rad", "rad", "rad/s", "rad/s")
        return {"step": FieldChart(self._step, ("n", "s", "vn", "vs"), units)}

    def _step(self, t, q, u):
        n, s, vn, vs = q
        m = self.m
        mH = self.mH
        a = self.a
        b = self.b
        length = self.l
        coupling = m * length * b
        c = jnp.cos(s - n)
        d = coupling * jnp.sin(s - n)
        gravity = self.g * (mH * length + m * a + m * length)
        weight = m * self.g * b * jnp.sin(n)
        torque_n = -d * vs**2 - weight + u[0]
        pull = gravity * jnp.sin(s)
        torque_s = d * vn**2 + pull - u[0]
        # The inverse of [[A, B], [B, D]].
        A = m * b**2
        B = -coupling * c
        D = (mH + m) * length**2 + m * a**2
        det = A * D - B**2
        return (
            vn,
            vs,
            (D * torque_n - B * torque_s) / det,
            (A * torque_s - B * torque_n) / det,
        )

    def transitions(self):
        def foot(t, q, u):
            return q[0] + q[1] + 2 * self.slope

        def ahead(t, q, u):
            return q[1] < 0

        hit = Transition(
            "heelstrike", "step", "step", foot, reset=self._heelstrike, enabled=ahead
        )
        return (hit,)

    def _heelstrike(self, t, q, u):
        """Angular momentum about the new foot, and of the new swing leg about the hip, are kept."""
        n, s, vn, vs = q
        m = self.m
        mH = self.mH
        a = self.a
        b = self.b
        length = self.l
        c = jnp.cos(s - n)
        whole = (
            -m * a * b * vn
            + (-m * a * b + (mH * length**2 + 2 * m * a * length) * c) * vs
        )
        leg = -m * a * b * vs
        A = m * b * (b - length * c)
        swinging = m * length * (length - b * c)
        B = swinging + m * a**2 + mH * length**2
        C = m * b**2
        D = -m * b * length * c
        det = A * D - B * C
        stance = (D * whole - B * leg) / det
        swing = (A * leg - C * whole) / det
        return s, n, stance, swing

    def draw(self, chart, t, q):
        return _two_legs(self.slope, self.l, q["s"], q["n"])

    def guess(self):
        s = 0.22
        return Guess("step", (-2 * self.slope - s, s, -0.35, -1.1))
