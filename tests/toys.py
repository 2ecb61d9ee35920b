"""Small systems with known answers, shared by the tests."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import hybridjax as hj
from hybridjax.orbits.limit_cycles import LimitCycles
from hybridjax.systems.chart import FieldChart


def Field(states, function):
    """A chart from a function (t, q, u) -> rates."""
    return FieldChart(function, states)


def toy(charts, transitions=(), period=None, outputs=(), **names):
    """Return a system without parameters, whose methods return these.

    `toy({"fall": Field(("y",), rates)}, [impact], period=1.0)` is short for what users write:

    ```python
    class Fall(hj.Chart):
        states = ("y",)

        def field(self, t, q, u):
            return rates(t, q, u)


    class Toy(hj.HybridSystem):
        def charts(self):
            return {"fall": Fall()}

        def transitions(self):
            return [impact]

        def period(self):
            return 1.0
    ```
    """
    parts = {
        "charts": charts,
        "transitions": transitions,
        "period": period,
        "outputs": outputs,
    }
    methods = {name: lambda self, x=x: x for name, x in parts.items()}
    return type("Toy", (hj.HybridSystem,), methods | names)()


def resting(t, q, u):
    """A driven oscillator, and beside it a state that only rounding errors move from zero."""
    (x, v, w) = q
    c = jnp.cos(3 * t)
    v_rate = c - 4 * x - v + u[0]
    w_rate = (1 + 0.1 * c) * 3 - 3 - 0.3 * c - w
    return v, v_rate, w_rate


RESTING = toy({"all": Field(("x", "v", "w"), resting)}, period=2 * np.pi / 3)


def hopper_in(length, time):
    """Return the hopper with lengths and times multiplied."""
    h = hj.models.VerticalHopper()
    force = length / time**2
    return hj.models.VerticalHopper(
        l0=h.l0 * length,
        a=h.a * force,
        g=h.g * force,
        k=h.k / time**2,
        b=h.b / time,
        omega=h.omega / time,
    )


class Toys(hj.HybridSystem):
    """Systems of which `make` returns the charts, transitions and perhaps period, with numbers."""

    make: Callable = eqx.field(static=True)
    numbers: Float[Array, " n"] = eqx.field(converter=lambda x: jnp.array(x, float))

    def charts(self):
        return self.make(*self.numbers)[0]

    def transitions(self):
        return self.make(*self.numbers)[1]

    def period(self):
        made = self.make(*self.numbers)
        return made[2] if len(made) > 2 else None


class Switched(hj.HybridSystem):
    """x' = -x + u while on and x' = -x while off; on at k, off at k + duty, for all whole k."""

    duty: Float[Array, ""] = hj.parameter(0.3)

    def charts(self):
        def rates(t, q, u):
            return (1.0 + u[0] - q[0],)

        def off_rates(t, q, u):
            return (-q[0],)

        return {
            "on": Field(("x",), rates),
            "off": Field(("x",), off_rates),
        }

    def transitions(self):
        return (
            hj.Transition("switch on", "off", "on", hj.systems.Scheduled(1.0)),
            hj.Transition(
                "switch off", "on", "off", hj.systems.Scheduled(1.0, self.duty)
            ),
        )

    def period(self):
        return 1.0

    def guess(self):
        return hj.Guess("off", (0.1,), 0.5)

    def exact(self):
        """x at the time of switching on, on the cycle."""
        rest = jnp.exp(-(1 - self.duty))
        left = jnp.exp(-1.0)
        return (rest - left) / (1 - left)


def many(cycle, n):
    """Return so many times the same cycle, without a program that finds them."""
    arrays, rest = eqx.partition(cycle, eqx.is_array)
    arrays = jax.tree_util.tree_map(lambda x: np.broadcast_to(x, (n, *x.shape)), arrays)
    c = eqx.combine(arrays, rest)
    codes = np.tile(cycle.event_sequence, (n, 1))
    return LimitCycles(
        c.system,
        cycle.base,
        c.period,
        c.anchor,
        c.pieces,
        c.factors,
        c.residual,
        c.iterations,
        c.result,
        codes,
        cycle.settings,
        c.conserved,
        c.multiplicity,
        c.numbers,
    )
