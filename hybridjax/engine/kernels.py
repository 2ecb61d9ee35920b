"""Users' functions for code that runs on the host, each with its first derivatives.

All take and return NumPy's arrays. A column of values stands before those of derivatives, by the
time, the n states and the inputs: (rows, 2 + n + nu, L). Where only `some` lanes are needed, the
others are copies of one of these; none may stand for all.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from .._core.lanes import by_lane
from ..systems.alike import Kind, Member
from ..systems.output import Output
from ..systems.solver import Method, Radau, as_method
from ..systems.structure import Structure, stacked
from ..systems.system import HybridSystem
from .solver import take_step
from .solver.implicit import integrated_divergence
from .solver.step import Step
from .solver.tableau import method_of
from .target import AbstractLevels


# Lanes of functions that are called for single points (in landings) as well as for all moves of a
# tape, and of one that is called for hundreds of points. Twice as many: hardly a difference.
_POINTS, _MANY_POINTS = 4, 16
# From this number of lanes on, the program for many points is worth its compilation. Twice as many:
# so are plans of experiments with twice as many sections.
_MANY_LANES = 64


def field(
    s: Structure,
    a: int,
    t: Float[np.ndarray, " #L"],
    q: Float[np.ndarray, "n L"],
    u: Float[np.ndarray, "nu #L"],
    some: Bool[np.ndarray, " L"] | None = None,
) -> Float[np.ndarray, "n c L"]:
    """The field of chart a, and its derivatives."""
    return s.kernel(_field, _expanded, a, lanes=_POINTS)(t, q, u, some=some)


def step(
    s: Structure,
    a: int,
    t: Float[np.ndarray, " #L"],
    q: Float[np.ndarray, "n L"],
    u: Float[np.ndarray, "nu #L"],
    h: Float[np.ndarray, " #L"],
    some: Bool[np.ndarray, " L"] | None = None,
) -> Step:
    """A step in chart a, without derivatives."""
    return Step(*s.kernel(_slope, _Step(method_of(s, a)), a)(t, q, u, h, some=some))


def step_along(
    s: Structure,
    a: int,
    t: Float[np.ndarray, " #L"],
    q: Float[np.ndarray, "n L"],
    u: Float[np.ndarray, "nu #L"],
    h: Float[np.ndarray, " #L"],
    along: Float[np.ndarray, "n L"],
) -> tuple[Step, Float[np.ndarray, "n L"], Float[np.ndarray, "n L"]]:
    """A step in chart a, and the derivatives of its end and of its error along a direction."""
    found = s.kernel(_slope_beside, _StepAlong(method_of(s, a)), a)(t, q, u, h, along)
    return Step(*found[:4]), found[4], found[5]


def linear_step(
    s: Structure,
    a: int,
    t: Float[np.ndarray, " L"],
    q: Float[np.ndarray, "n L"],
    u: Float[np.ndarray, "nu L"],
    h: Float[np.ndarray, " L"],
) -> Float[np.ndarray, "n c L"]:
    """The end of a step in chart a, the field there, and the derivatives of the end by time,
    states, inputs and length of the step."""
    return s.kernel(_slope, _LinearStep(method_of(s, a)), a, lanes=_POINTS)(t, q, u, h)


def divergence(
    s: Structure,
    a: int,
    t: Float[np.ndarray, " L"],
    q: Float[np.ndarray, "n L"],
    u: Float[np.ndarray, "nu #L"],
    h: Float[np.ndarray, " L"],
) -> Float[np.ndarray, " L"]:
    """The divergence of the field of chart a, integrated over steps."""
    method = method_of(s, a)
    form = _Divergence(method if method.implicit else as_method(Radau()))
    return s.kernel(_slope, form, a, lanes=_MANY_POINTS)(t, q, u, h)


def watched(
    s: Structure,
    a: int,
    levels: AbstractLevels | None,
    t: Float[np.ndarray, " #L"],
    q: Float[np.ndarray, "n L"],
    u: Float[np.ndarray, "nu #L"],
    index: Int[np.ndarray, " #L"],
    some: Bool[np.ndarray, " L"] | None = None,
) -> Float[np.ndarray, "r c L"]:
    """The guards of chart a, and the level if it has one, with their derivatives."""
    lanes = 1 if q.shape[-1] < _MANY_LANES else _MANY_POINTS
    static = a, s.guard_kinds(a)
    rows = s.kernel(_watched, _expanded, *static, trees=(levels,), lanes=lanes)
    return rows(t, q, u, index.astype(np.int32), some=some)


def reset(
    s: Structure,
    g: Member,
    t: Float[np.ndarray, " #L"],
    q: Float[np.ndarray, "n L"],
    u: Float[np.ndarray, "nu #L"],
    some: Bool[np.ndarray, " L"] | None = None,
) -> Float[np.ndarray, "m c L"]:
    """The state after transitions of one kind, and its derivatives."""
    return s.kernel(_reset, _expanded, g.kind)(t, q, u, g.place, some=some)


def enabled(
    s: Structure,
    g: Member,
    t: Float[np.ndarray, " #L"],
    q: Float[np.ndarray, "n L"],
    u: Float[np.ndarray, "nu #L"],
) -> Bool[np.ndarray, " L"]:
    """Whether the predicates of transitions of one kind hold."""
    return s.kernel(_enabled, by_lane, g.kind)(t, q, u, g.place)


def outputs(
    s: Structure,
    a: int,
    items: tuple[str | Output, ...],
    t: Float[np.ndarray, " #L"],
    q: Float[np.ndarray, "n L"],
    u: Float[np.ndarray, "nu #L"],
) -> Float[np.ndarray, "ny c L"]:
    """Outputs in chart a, and their derivatives."""
    return s.kernel(_outputs, _expanded, a, trees=(items,), lanes=_POINTS)(t, q, u)


def values(
    s: Structure,
    a: int,
    items: tuple[str | Output, ...],
    t: Float[np.ndarray, " L"],
    q: Float[np.ndarray, "n L"],
) -> Float[np.ndarray, "ny L"]:
    """Outputs in chart a without input, without derivatives."""
    return s.kernel(_values, by_lane, a, trees=(items,), lanes=_MANY_POINTS)(t, q)


def levels(
    s: Structure,
    a: int,
    levels: AbstractLevels,
    n_sections: int,
    t: Float[np.ndarray, " L"],
    q: Float[np.ndarray, "n L"],
) -> Float[np.ndarray, "N 2 L"]:
    """The levels of all sections in chart a, and their rates along the flow."""
    form = _AllSections(n_sections)
    of_all = s.kernel(_level, form, a, trees=(levels,), lanes=_MANY_POINTS)
    return of_all(t, q, np.zeros(1, np.int32))


def _field(a: int, system: HybridSystem, t, q, u):
    return Structure(system).field(a, t, q, u)


def _slope(a: int, system: HybridSystem, t, q, u, h):
    return Structure(system).field(a, t, q, u)


def _slope_beside(a: int, system: HybridSystem, t, q, u, h, along):
    return Structure(system).field(a, t, q, u)


def _watched(
    a: int, kinds: tuple[Kind, ...], system: HybridSystem, levels: AbstractLevels | None, t, q, u, i
):
    s = Structure(system)
    level = levels is not None and levels.present(s, a)
    guards = s.guard_values(kinds, t, q, u)
    return stacked(guards + ([levels.level(s, a, i, t, q)] if level else []))


def _reset(kind: Kind, system: HybridSystem, t, q, u, place):
    return Structure(system).reset(Member(kind, place), t, q, u)


def _enabled(kind: Kind, system: HybridSystem, t, q, u, place):
    return Structure(system).enabled(Member(kind, place), t, q, u)


def _outputs(a: int, system: HybridSystem, items: tuple[str | Output, ...], t, q, u):
    return Structure(system).resolve_outputs(items)(a, t, q, u)


def _values(a: int, system: HybridSystem, items: tuple[str | Output, ...], t, q):
    s = Structure(system)
    return s.resolve_outputs(items)(a, t, q, jnp.zeros(s.nu))


def _level(a: int, system: HybridSystem, levels: AbstractLevels, t, q, i):
    """A level, and the field."""
    s = Structure(system)
    return jnp.append(s.field(a, t, q, jnp.zeros(s.nu)), levels.level(s, a, i, t, q))


def _expanded(function: Callable, *trees: Any) -> Callable:
    """Lanes of a vector function of (t, q, u) and its derivatives, as columns of one array."""

    def one(*x):
        own, (t, q, u, *others) = x[: len(trees)], x[len(trees) :]
        n, m = q.shape[0], 1 + q.shape[0] + u.shape[0]
        at = lambda t, q, u: function(*own, t, q, u, *others)  # noqa: E731
        split = lambda x: (x[0], x[1 : 1 + n], x[1 + n :])  # noqa: E731
        push = lambda dx: jax.jvp(at, (t, q, u), split(dx))  # noqa: E731
        value, columns = jax.vmap(push, out_axes=(None, 1))(jnp.eye(m))
        return jnp.concatenate([value[:, None], columns], axis=1)

    return by_lane(one, *trees)


class _Step(NamedTuple):
    """Lanes of a step over h."""

    method: Method

    def __call__(self, slope: Callable, *trees: Any) -> Callable:
        field = by_lane(slope, *trees)

        def step(t, q, u, h):
            return jnp.stack(take_step(self.method, lambda t, q: field(t, q, u, h), t, q, h))

        return step


class _StepAlong(NamedTuple):
    """Lanes of a step over h, and the derivatives of its end and of its error along a direction."""

    method: Method

    def __call__(self, slope: Callable, *trees: Any) -> Callable:
        field = by_lane(slope, *trees)

        def step(t, q, u, h, along):
            own = lambda t, q: field(t, q, u, h, along)  # noqa: E731
            end = lambda q: take_step(self.method, own, t, q, h, still=own)  # noqa: E731
            value, tangent = jax.jvp(end, (q,), (along,))
            return jnp.stack([*value, tangent.q, tangent.error])

        return step


class _LinearStep(NamedTuple):
    """Lanes of the end of a step over h, of the field there, and of the derivatives of the end by
    time, states, inputs and h, as columns of one array."""

    method: Method

    def __call__(self, slope: Callable, *trees: Any) -> Callable:
        field = by_lane(slope, *trees)

        def end(t, q, u, h):
            at = jax.lax.stop_gradient((u, h))
            still = lambda t, q: field(t, q, *at)  # noqa: E731
            step = take_step(self.method, lambda t, q: field(t, q, u, h), t, q, h, still=still)
            return step.q, step.f1

        def step(t, q, u, h):
            n, L = q.shape
            shapes = [x.shape[:-1] for x in (t, q, u, h)]
            split = np.cumsum([1, n, len(u)])

            def push(direction):
                parts = jnp.split(direction, split)
                tangents = [
                    jnp.broadcast_to(x.reshape(*shape, 1), (*shape, L))
                    for x, shape in zip(parts, shapes, strict=True)
                ]
                (value, f), (tangent, _) = jax.jvp(end, (t, q, u, h), tuple(tangents))
                return value, f, tangent

            value, f, columns = jax.vmap(push, out_axes=(None, None, 1))(jnp.eye(split[-1] + 1))
            return jnp.concatenate([value[:, None], f[:, None], columns], axis=1)

        return step


class _Divergence(NamedTuple):
    """Lanes of the divergence, integrated over steps by a method."""

    method: Method

    def __call__(self, slope: Callable, *trees: Any) -> Callable:
        field = by_lane(slope, *trees)

        def integral(t, q, u, h):
            return integrated_divergence(self.method, lambda t, q: field(t, q, u, h), t, q, h)

        return integral


class _AllSections(NamedTuple):
    """Lanes of the levels of all sections, and of their rates."""

    n_sections: int

    def __call__(self, level: Callable, *trees: Any) -> Callable:
        def one(*x):
            own, (t, q, i) = x[: len(trees)], x[len(trees) :]
            f = level(*own, t, q, i)[:-1]
            along = lambda i: jax.jvp(  # noqa: E731
                lambda t, q: level(*own, t, q, i)[-1], (t, q), (jnp.ones_like(t), f)
            )
            every = jnp.arange(self.n_sections, dtype=i.dtype)
            return jnp.stack(jax.vmap(along)(every), axis=1)

        return by_lane(one, *trees)
