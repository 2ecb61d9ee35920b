"""Two of the paper's hoppers side by side, whose bodies a spring couples.

The hopper is that of `hopper.py`; the coupling is ours.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from ..systems.chart import Chart
from ..systems.system import Guess, Parameter, parameter
from ..systems.transition import Transition
from .hopper import VerticalHopper


_BODIES, _FEET = (("yM1", "vM1"), ("yM2", "vM2")), (("ym1", "vm1"), ("ym2", "vm2"))
_STATES = sum(_BODIES + _FEET, ())
# Chart by the feet that stand on the ground.
_CHARTS = {(): "air", (0,): "first", (1,): "second", (0, 1): "both"}


class Standing(Chart):
    pair: "HopperPair"
    down: tuple[int, ...] = eqx.field(static=True)

    @property
    def absent(self) -> dict[str, float]:
        return {name: 0.0 for i in self.down for name in _FEET[i]}

    @property
    def states(self) -> tuple[str, ...]:
        return tuple(name for name in _STATES if name not in self.absent)

    @property
    def units(self) -> tuple[str, ...]:
        return ("m", "m/s") * (len(self.states) // 2)

    def whole(self, q: Array) -> list[Array]:
        """All eight states: feet on the ground rest."""
        return [q[self.states.index(x)] if x in self.states else jnp.zeros(()) for x in _STATES]

    def part(self, whole: Sequence) -> list:
        return [x for name, x in zip(_STATES, whole, strict=True) if name in self.states]

    def field(self, t, q, u):
        p, whole = self.pair, self.whole(q)
        pull = p.coupling * (whole[2] - whole[0])
        bodies, feet = [], []
        for i, between in enumerate((pull, -pull)):
            (y, v), (ym, vm) = whole[2 * i : 2 * i + 2], whole[2 * i + 4 : 2 * i + 6]
            leg = p.leg(t - i * p.lag, y, ym)
            bodies += [v, (leg + between + u[i]) / p.M - p.g]
            feet += [vm, -(leg + p.b * vm) / p.m - p.g]
        return self.part(bodies + feet)


class HopperPair(VerticalHopper):
    """Two equal hoppers, a vertical spring between their bodies; the second actuator runs behind.

    Inputs are a force on each body. A touchdown multiplies the speed of the body above it by
    `retention`.
    """

    inputs = ("u1", "u2")
    input_units = ("N", "N")

    coupling: Parameter = parameter(1.0, unit="N/m", doc="stiffness of the spring between bodies")
    lag: Parameter = parameter(0.3, unit="s", doc="by which the second actuator runs behind")

    def charts(self):
        return {name: Standing(self, down) for down, name in _CHARTS.items()}

    def transitions(self):
        return tuple(self._step(i, down) for down in _CHARTS for i in (0, 1))

    def _step(self, i: int, down: tuple[int, ...]) -> Transition:
        """Touchdown or liftoff of hopper i, while these feet are down."""
        lifts = i in down
        after = tuple(k for k in (0, 1) if (k in down) != (k == i))
        here, there = Standing(self, down), Standing(self, after)

        def guard(t, q, u):
            whole = here.whole(q)
            force = self.leg(t - i * self.lag, whole[2 * i], 0.0) + self.m * self.g
            return force if lifts else whole[2 * i + 4]

        def reset(t, q, u):
            whole = here.whole(q)
            if not lifts:
                whole[2 * i + 1] = self.retention * whole[2 * i + 1]
            return there.part(whole)

        name = f"{'liftoff' if lifts else 'touchdown'} {i + 1} ({_CHARTS[down]})"
        return Transition(name, _CHARTS[down], _CHARTS[after], guard, reset=reset)

    def guess(self):
        """Each as if it were alone: the first is about to lift off, the other comes down."""
        return Guess("first", (2.0, 1.9, 1.6, -0.2, 0.55, -2.7), 0.5)
