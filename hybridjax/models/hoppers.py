"""The vertical hopper of the paper, the same on compliant ground, and a coupled pair of them.

`VerticalHopper` has the equations, which the other two reuse. A foot that rests on rigid ground has
no states in its chart. Each class cites its source; examples, tests and benchmarks rely on the
default parameters. If a motion is wrong, look at `leg` (the force between both masses), then at the
field of the chart: `_moving`, `pushed` in `charts`, or `_standing` of the pair. If an event is
wrong, look at its guard in `transitions` (`_step` of the pair).
"""

import itertools
import math
from collections.abc import Sequence
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from ..systems.chart import FieldChart
from ..systems.drawing import Drawing
from ..systems.solver import Radau
from ..systems.system import Guess, HybridSystem, Parameter, parameter
from ..systems.transition import Transition


_MASSES = ("yM", "vM", "ym", "vm"), ("m", "m/s", "m", "m/s")


def _hopper(i: int, yM: Array, ym: Array) -> tuple[dict, dict]:
    """Lines and circles of hopper i. (Its foot has a radius of 0.1 m.)"""
    x = 1.5 * i
    number = f" {i + 1}" if i else ""
    leg = Drawing.spring((x, ym + 0.2), (x, yM - 0.3))
    body = (x, yM, 0.3)
    foot = (x, ym + 0.1, 0.1)
    return {"leg" + number: leg}, {"body" + number: body, "foot" + number: foot}


class VerticalHopper(HybridSystem):
    """Two masses on a leg spring with a sinusoidal actuator; the foot is damped in the air.

    Input `u` is a force on the upper mass. With `retention` = r < 1 a touchdown multiplies the
    speed of the upper mass by r.

    S. A. Burden, S. Revzen, S. S. Sastry, Dimension reduction near periodic orbits of
    hybrid systems, CDC-ECC 2011, and HSCC 2013. The parameters are from the second
    source.
    """

    input_units: ClassVar[tuple[str, ...]] = ("N",)
    time_unit = "s"

    m: Parameter = parameter(1.0, unit="kg", positive=True, doc="mass of the foot")
    M: Parameter = parameter(2.0, unit="kg", positive=True, doc="mass of the body")
    k: Parameter = parameter(10.0, unit="N/m", doc="stiffness of the leg")
    b: Parameter = parameter(5.0, unit="N s/m", doc="damping of the foot in flight")
    l0: Parameter = parameter(2.0, unit="m", doc="rest length of the leg")
    a: Parameter = parameter(20.0, unit="N", doc="amplitude of the actuator")
    g: Parameter = parameter(2.0, unit="m/s^2", doc="gravity")
    omega: Parameter = parameter(2 * math.pi, unit="rad/s", doc="rate of the actuator")
    retention: Parameter = parameter(1.0, doc="speed of the body kept at touchdown")

    def leg(self, t: Array, yM: Array, ym: Array | float) -> Array:
        """Force of the leg on the body."""
        spring = self.k * (self.l0 - (yM - ym))
        return spring + self.a * jnp.sin(self.omega * t)

    def charts(self):
        def pushed(t, q, u):
            return (
                q[1],
                (self.leg(t, q[0], 0.0) + u[0]) / self.M - self.g,
            )

        names, units = _MASSES
        stance = FieldChart(
            pushed, names[:2], units[:2], absent=dict.fromkeys(names[2:], 0.0)
        )
        return {"flight": self._flight(), "stance": stance}

    def _flight(self) -> FieldChart:
        return FieldChart(self._moving(lambda ym, vm: -self.b * vm), *_MASSES)

    def _moving(self, on_foot):
        """The field of both masses, with a force on the foot by its height and speed."""

        def field(t, q, u):
            yM, vM, ym, vm = q
            leg = self.leg(t, yM, ym)
            body = (leg + u[0]) / self.M - self.g
            foot = (on_foot(ym, vm) - leg) / self.m - self.g
            return vM, body, vm, foot

        return field

    def transitions(self):
        def height(t, q, u):
            return q[2]

        def landed(t, q, u):
            return (q[0], self.retention * q[1])

        def force(t, q, u):
            return self.leg(t, q[0], 0.0) + self.m * self.g

        def lifted(t, q, u):
            return (q[0], q[1], 0.0, 0.0)

        return (
            Transition("touchdown", "flight", "stance", height, reset=landed),
            Transition("liftoff", "stance", "flight", force, reset=lifted),
        )

    def period(self):
        return 2 * jnp.pi / self.omega

    def draw(self, chart, t, q):
        lines, circles = _hopper(0, q["yM"], q["ym"])
        return Drawing({"ground": [(-1.0, 0.0), (1.0, 0.0)], **lines}, circles=circles)

    def guess(self):
        return Guess("stance", (2.0, 1.9), 0.5)


class CompliantHopper(VerticalHopper):
    """The hopper on a ground of stiffness `kg` and damping `cg`, from which the foot lifts off
    where their force vanishes. There is no impact: all four states move in both charts.

    Input `u` is a force on the upper mass.

    The hopper is `VerticalHopper`; the ground is a spring and a dashpot in parallel, and only
    pushes (on such contacts: K. H. Hunt, F. R. E. Crossley, J. Appl. Mech. 42 (1975) 440-445).
    """

    kg: Parameter = parameter(1e5, unit="N/m", doc="stiffness of the ground")
    cg: Parameter = parameter(3e3, unit="N s/m", doc="damping of the ground")

    def ground(self, ym: Array, vm: Array) -> Array:
        """Force of the ground on the foot."""
        return -self.kg * ym - self.cg * vm

    def charts(self):
        contact = FieldChart(self._moving(self.ground), *_MASSES, solver=Radau())
        return {"flight": self._flight(), "contact": contact}

    def transitions(self):
        def force(t, q, u):
            return self.ground(q[2], q[3])

        return (
            Transition("touchdown", "flight", "contact", lambda t, q, u: q[2]),
            Transition("liftoff", "contact", "flight", force),
        )

    def guess(self):
        """The guess of `VerticalHopper`, with the foot where the ground carries it."""
        return Guess("contact", (2.0, 1.9, -1e-4, 0.0), 0.5)


_FEET = ("ym1", "vm1"), ("ym2", "vm2")
_STATES = ("yM1", "vM1", "yM2", "vM2", *_FEET[0], *_FEET[1])
# Chart by the feet that stand on the ground.
_PAIR_CHARTS = {(): "air", (0,): "first", (1,): "second", (0, 1): "both"}


def _absent(down: tuple[int, ...]) -> dict[str, float]:
    """States of the feet that stand."""
    names = itertools.chain(*(_FEET[i] for i in down))
    return dict.fromkeys(names, 0.0)


def _part(down: tuple[int, ...], whole: Sequence) -> list:
    """Those of all eight states that a chart has."""
    return [
        x for name, x in zip(_STATES, whole, strict=True) if name not in _absent(down)
    ]


def _whole(down: tuple[int, ...], q: Array) -> list[Array]:
    """All eight states, of those of a chart: feet on the ground rest."""
    moving = iter(q)
    return [jnp.zeros(()) if x in _absent(down) else next(moving) for x in _STATES]


class HopperPair(VerticalHopper):
    """Two equal hoppers whose bodies are joined by a spring; the second actuator lags behind.

    Inputs are a force on each body. A touchdown multiplies the speed of the body above it by
    `retention`.

    The hoppers are `VerticalHopper`; the coupling is not from the literature.
    """

    inputs = ("u1", "u2")
    input_units = ("N", "N")

    coupling: Parameter = parameter(
        1.0, unit="N/m", doc="stiffness of the spring between bodies"
    )
    lag: Parameter = parameter(
        0.3, unit="s", doc="by which the second actuator runs behind"
    )

    def charts(self):
        return {name: self._standing(down) for down, name in _PAIR_CHARTS.items()}

    def _standing(self, down: tuple[int, ...]) -> FieldChart:
        def field(t, q, u):
            whole = _whole(down, q)
            pull = self.coupling * (whole[2] - whole[0])
            bodies = []
            feet = []
            for i, between in enumerate((pull, -pull)):
                y, v = whole[2 * i : 2 * i + 2]
                first = 2 * i + 4
                ym, vm = whole[first : 2 * i + 6]
                leg = self.leg(t - i * self.lag, y, ym)
                body = (leg + between + u[i]) / self.M - self.g
                bodies += [v, body]
                foot = -(leg + self.b * vm) / self.m - self.g
                feet += [vm, foot]
            return _part(down, bodies + feet)

        states = tuple(_part(down, _STATES))
        units = ("m", "m/s") * (len(states) // 2)
        return FieldChart(field, states, units, absent=_absent(down))

    def transitions(self):
        steps = itertools.product(_PAIR_CHARTS, (0, 1))
        return tuple(self._step(i, down) for down, i in steps)

    def _step(self, i: int, down: tuple[int, ...]) -> Transition:
        """Touchdown or liftoff of hopper i, while these feet are down."""
        lifts = i in down
        after = tuple(k for k in (0, 1) if (k in down) != (k == i))

        def guard(t, q, u):
            whole = _whole(down, q)
            late = t - i * self.lag
            weight = self.m * self.g
            force = self.leg(late, whole[2 * i], 0.0) + weight
            return force if lifts else whole[2 * i + 4]

        def reset(t, q, u):
            whole = _whole(down, q)
            if not lifts:
                v = 2 * i + 1
                whole[v] = self.retention * whole[v]
            return _part(after, whole)

        what = "liftoff" if lifts else "touchdown"
        name = f"{what} {i + 1} ({_PAIR_CHARTS[down]})"
        return Transition(
            name, _PAIR_CHARTS[down], _PAIR_CHARTS[after], guard, reset=reset
        )

    def draw(self, chart, t, q):
        first, circles = _hopper(0, q["yM1"], q["ym1"])
        second, more_circles = _hopper(1, q["yM2"], q["ym2"])
        lines = {"ground": [(-1.0, 0.0), (2.5, 0.0)], **first, **second}
        left = (0.3, q["yM1"])
        right = (1.2, q["yM2"])
        lines["coupling"] = Drawing.spring(left, right)
        return Drawing(lines, circles={**circles, **more_circles})

    def guess(self):
        """The states of two uncoupled hoppers: the first is about to lift off, the second is
        falling."""
        return Guess("first", (2.0, 1.9, 1.6, -0.2, 0.55, -2.7), 0.5)
