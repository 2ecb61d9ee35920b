"""Small systems with known answers, shared by the tests."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import hybridjax as hj
from hybridjax.orbits.limit_cycles import LimitCycles


class Field(hj.Chart):
    """A chart from a function (t, q, u) -> rates."""

    states: tuple[str, ...] = eqx.field(static=True)
    function: Callable = eqx.field(static=True)

    def field(self, t, q, u):
        return self.function(t, q, u)


class Ceiling(hj.HybridSystem):
    """A ball thrown up under gravity 1 against a ceiling at `height`."""

    height: Float[Array, ""] = hj.parameter(1.0)

    def charts(self):
        return {"air": Field(("y", "v"), lambda t, q, u: (q[1], -1.0))}

    def transitions(self):
        def guard(t, q, u):
            return q[0] - self.height

        def reset(t, q, u):
            return q[0], -q[1]

        return (hj.Transition("hit", "air", "air", guard, "rising", reset),)


class Blowup(hj.HybridSystem):
    """x' = x^2, which reaches infinity at t = 1 / x(0)."""

    def charts(self):
        return {"x": Field(("x",), lambda t, q, u: q**2)}


class Switched(hj.HybridSystem):
    """x' = -x + u while on and x' = -x while off; on at k, off at k + duty, for all whole k."""

    duty: Float[Array, ""] = hj.parameter(0.3)

    def charts(self):
        return {
            "on": Field(("x",), lambda t, q, u: (1.0 + u[0] - q[0],)),
            "off": Field(("x",), lambda t, q, u: (-q[0],)),
        }

    def transitions(self):
        return (
            hj.Transition("switch on", "off", "on", hj.Scheduled(1.0)),
            hj.Transition("switch off", "on", "off", hj.Scheduled(1.0, self.duty)),
        )

    def period(self):
        return 1.0

    def guess(self):
        return hj.Guess("off", (0.1,), 0.5)

    def exact(self):
        """x at the time of switching on, on the cycle."""
        rest = jnp.exp(-(1 - self.duty))
        return (rest - jnp.exp(-1.0)) / (1 - jnp.exp(-1.0))


class Turning(hj.HybridSystem):
    """A point on the unit circle that turns at rate 1, and marks where it passes.

    `low` and `high` are marked where x falls through them; `low` only in the upper half plane
    (y > 0), and `gate` only when it is enabled. The mark counts events in the state `n`.
    """

    low: Float[Array, ""] = hj.parameter(-0.5)
    high: Float[Array, ""] = hj.parameter(0.5)
    gate: Float[Array, ""] = hj.parameter(1.0)

    def charts(self):
        return {"turn": Field(("x", "y", "n"), lambda t, q, u: (-q[1], q[0], 0.0))}

    def transitions(self):
        def count(t, q, u):
            return q[0], q[1], q[2] + 1

        return (
            hj.Transition("low", "turn", "turn", lambda t, q, u: q[0] - self.low, reset=count),
            hj.Transition("high", "turn", "turn", lambda t, q, u: q[0] - self.high, reset=count),
            hj.Transition(
                "gated",
                "turn",
                "turn",
                lambda t, q, u: q[1],
                reset=count,
                enabled=lambda t, q, u: q[2] < self.gate,
            ),
        )


class Close(hj.HybridSystem):
    """A point on the unit circle and two guards on x that fall a `gap` apart.

    The second one is so far from a cubic that its crossing is first estimated wrongly.
    """

    gap: Float[Array, ""] = hj.parameter(0.0)
    k: Float[Array, ""] = hj.parameter(20.0)

    def charts(self):
        return {"turn": Field(("x", "y"), lambda t, q, u: (-q[1], q[0]))}

    def transitions(self):
        def plain(t, q, u):
            return q[0] - 0.5

        def curved(t, q, u):
            return jnp.exp(self.k * (q[0] - 0.5 - self.gap)) - 1

        return (
            hj.Transition("plain", "turn", "turn", plain),
            hj.Transition("curved", "turn", "turn", curved),
        )


class Dip(hj.HybridSystem):
    """y = (t - 1)^2 - depth as a state: below zero for 2 sqrt(depth), then back."""

    depth: Float[Array, ""] = hj.parameter(1e-6)

    def charts(self):
        return {"dip": Field(("y", "n"), lambda t, q, u: (2 * (t - 1.0), 0.0))}

    def transitions(self):
        def mark(t, q, u):
            return q[0], q[1] + 1.0

        return (hj.Transition("dip", "dip", "dip", lambda t, q, u: q[0] - 0.0, reset=mark),)

    def start(self):
        return 1.0 - float(self.depth), 0.0


def many(cycle, n):
    """Return so many times the same cycle, without a program that finds them."""
    arrays, rest = eqx.partition(cycle, eqx.is_array)
    arrays = jax.tree_util.tree_map(lambda x: np.broadcast_to(x, (n, *x.shape)), arrays)
    c, codes = eqx.combine(arrays, rest), np.tile(cycle.event_sequence, (n, 1))
    return LimitCycles(
        c.system, c.base, c.period, c.anchor, c.legs, c.factors, c.residual, c.iterations,
        c.result, codes, cycle.settings, c.conserved, c.multiplicity,
    )  # fmt: skip
