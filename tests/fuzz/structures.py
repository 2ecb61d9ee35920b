"""Random hybrid systems: a few structures, each with numbers that are drawn per system.

A `Plan` is what all systems of a structure share: the dimensions of the charts and who jumps
where. Its numbers are arrays, the same for all structures but for their shapes:

- field of a chart:  A q + b + B u - cube q^3 + S sin(q) + T tanh(q) + a sin(w t + p)
- guard:             n.q + q.Q q / 2 + c + m.u + a sin(w t + p), falling or rising
- enabled:           k.q + k0 > 0
- reset:             R q + r + V u, into a chart of another dimension
- schedule:          offset + k period

`Random` is such a system for hybridjax. `scipy_loop` writes the same formulas in numpy.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp

import hybridjax as hj


class Arrow(NamedTuple):
    """A transition between charts, by index."""

    source: int
    target: int
    kind: str
    """"falling", "rising" or "scheduled"."""
    gated: bool = False
    """Whether it has an `enabled` predicate."""


class Plan(NamedTuple):
    """A structure: what is compiled."""

    dims: tuple[int, ...]
    arrows: tuple[Arrow, ...]


class Start(NamedTuple):
    """The start of a trajectory in chart 0, its constant input, and the latest time it may last."""

    t: Any
    q: Any
    u: Any
    limit: Any


class Sample(NamedTuple):
    """One system: numbers of its charts and of its transitions, and where it starts."""

    charts: list[dict[str, Any]]
    arrows: list[dict[str, Any]]
    start: Start


class Piece(hj.Chart):
    """A chart with the field of this family."""

    states: tuple[str, ...] = eqx.field(static=True)
    x: dict[str, Any]

    def field(self, t, q, u):
        x = self.x
        linear = x["A"] @ q + x["b"]
        cubic = x["cube"] * q**3
        smooth = linear + x["B"] @ u - cubic
        swing = x["S"] @ jnp.sin(q)
        bounded = swing + x["T"] @ jnp.tanh(q)
        phase = x["w"] * t + x["p"]
        return smooth + bounded + x["a"] * jnp.sin(phase)


class Random(hj.HybridSystem):
    """A system of this family."""

    plan: Plan = eqx.field(static=True)
    charts_x: list[dict[str, Any]]
    arrows_x: list[dict[str, Any]]

    inputs = ("left", "right")

    def charts(self):
        charts = {}
        for a, (dim, numbers) in enumerate(
            zip(self.plan.dims, self.charts_x, strict=True)
        ):
            states = tuple(f"q{i}" for i in range(dim))
            charts[f"chart {a}"] = Piece(states, numbers)
        return charts

    def transitions(self):
        return [self._transition(g, *pair) for g, pair in enumerate(self._pairs())]

    def _pairs(self):
        return zip(self.plan.arrows, self.arrows_x, strict=True)

    def _transition(self, g, arrow: Arrow, x):
        def guard(t, q, u):
            bent = 0.5 * q @ (x["Q"] @ q)
            along = x["n"] @ q
            curved = along + bent + x["c"]
            phase = x["w"] * t + x["p"]
            wave = x["a"] * jnp.sin(phase)
            return curved + x["m"] @ u + wave

        def enabled(t, q, u):
            return x["k"] @ q + x["k0"] > 0

        def reset(t, q, u):
            kept = x["R"] @ q
            pushed = x["V"] @ u
            return kept + x["r"] + pushed

        by_clock = arrow.kind == "scheduled"
        return hj.Transition(
            f"event {g}",
            f"chart {arrow.source}",
            f"chart {arrow.target}",
            hj.systems.Scheduled(x["period"], x["offset"]) if by_clock else guard,
            "falling" if by_clock else arrow.kind,
            reset,
            enabled if arrow.gated else None,
        )
