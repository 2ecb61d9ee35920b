"""Users' functions for code that runs on the host, each with its first derivatives.

All take and return NumPy's arrays. A column of values stands before those of derivatives, by the
time, the n states and the inputs: (rows, 2 + n + nu, L). Where only `some` lanes are needed, the
others are copies of one of these; none may stand for all.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from ..systems.output import Output
from ..systems.solver import Radau, as_method
from ..systems.structure import Structure
from ..systems.system import HybridSystem
from .solver import take_step
from .solver.implicit import integrated_divergence
from .solver.step import Step
from .solver.tableau import method_of
from .target import AbstractLevels


# Lanes of functions that are called for single points (in landings) as well as for all moves of a
# tape, and of one that is called for hundreds of points. Twice as many: hardly a difference.
_POINTS, _MANY_POINTS = 4, 16


def field(
    s: Structure,
    a: int,
    t: Float[np.ndarray, " #L"],
    q: Float[np.ndarray, "n L"],
    u: Float[np.ndarray, "nu #L"],
    some: Bool[np.ndarray, " L"] | None = None,
) -> Float[np.ndarray, "n c L"]:
    """The field of chart a, and its derivatives."""
    return s.kernel(_field, a, lanes=_POINTS)(t, q, u, some=some)


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
    return Step(*s.kernel(_step, a)(t, q, u, h, some=some))


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
    found = s.kernel(_step_along, a)(t, q, u, h, along)
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
    return s.kernel(_linear_step, a, lanes=_POINTS)(t, q, u, h)


def divergence(
    s: Structure,
    a: int,
    t: Float[np.ndarray, " L"],
    q: Float[np.ndarray, "n L"],
    u: Float[np.ndarray, "nu #L"],
    h: Float[np.ndarray, " L"],
) -> Float[np.ndarray, " L"]:
    """The divergence of the field of chart a, integrated over steps."""
    return s.kernel(_divergence, a, lanes=_MANY_POINTS)(t, q, u, h)


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
    return s.kernel(_watched, a, trees=(levels,))(t, q, u, index.astype(np.int32), some=some)


def reset(
    s: Structure,
    g: int,
    t: Float[np.ndarray, " #L"],
    q: Float[np.ndarray, "n L"],
    u: Float[np.ndarray, "nu #L"],
    some: Bool[np.ndarray, " L"] | None = None,
) -> Float[np.ndarray, "m c L"]:
    """The state after transition g, and its derivatives."""
    return s.kernel(_reset, g)(t, q, u, some=some)


def enabled(
    s: Structure,
    g: int,
    t: Float[np.ndarray, " #L"],
    q: Float[np.ndarray, "n L"],
    u: Float[np.ndarray, "nu #L"],
) -> Bool[np.ndarray, " L"]:
    """Whether the predicate of transition g holds."""
    return s.kernel(_enabled, g)(t, q, u)


def outputs(
    s: Structure,
    a: int,
    items: tuple[str | Output, ...],
    t: Float[np.ndarray, " #L"],
    q: Float[np.ndarray, "n L"],
    u: Float[np.ndarray, "nu #L"],
) -> Float[np.ndarray, "ny c L"]:
    """Outputs in chart a, and their derivatives."""
    return s.kernel(_outputs, a, trees=(items,), lanes=_POINTS)(t, q, u)


def values(
    s: Structure,
    a: int,
    items: tuple[str | Output, ...],
    t: Float[np.ndarray, " L"],
    q: Float[np.ndarray, "n L"],
) -> Float[np.ndarray, "ny L"]:
    """Outputs in chart a without input, without derivatives."""
    return s.kernel(_values, a, trees=(items,), lanes=_MANY_POINTS)(t, q)


def levels(
    s: Structure,
    a: int,
    levels: AbstractLevels,
    n_sections: int,
    t: Float[np.ndarray, " L"],
    q: Float[np.ndarray, "n L"],
) -> Float[np.ndarray, "N 2 L"]:
    """The levels of all sections in chart a, and their rates along the flow."""
    return s.kernel(_levels, a, n_sections, trees=(levels,), lanes=_MANY_POINTS)(t, q)


def _field(a: int, system: HybridSystem, t, q, u):
    one = lambda s, t, q, u: _expand(lambda t, q, u: s.field(a, t, q, u), t, q, u)  # noqa: E731
    return Structure(system).by_lane(one)(t, q, u)


def _step(a: int, system: HybridSystem, t, q, u, h):
    return jnp.stack(take_step(*_method_and_field(a, system, u), t, q, h))


def _step_along(a: int, system: HybridSystem, t, q, u, h, along):
    method, field = _method_and_field(a, system, u)
    step = lambda q: take_step(method, field, t, q, h, still=field)  # noqa: E731
    value, tangent = jax.jvp(step, (q,), (along,))
    return jnp.stack([*value, tangent.q, tangent.error])


def _linear_step(a: int, system: HybridSystem, t, q, u, h):
    def end(t, q, u, h):
        method, field = _method_and_field(a, system, u)
        still = _method_and_field(a, system, jax.lax.stop_gradient(u))[1]
        step = take_step(method, field, t, q, h, still=still)
        return step.q, step.f1

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


def _divergence(a: int, system: HybridSystem, t, q, u, h):
    method, field = _method_and_field(a, system, u)
    method = method if method.implicit else as_method(Radau())
    return integrated_divergence(method, field, t, q, h)


def _method_and_field(a: int, system: HybridSystem, u):
    s = Structure(system)
    field = s.by_lane(lambda s, t, q, u: s.field(a, t, q, u))
    return method_of(s, a), lambda t, q: field(t, q, u)


def _watched(a: int, system: HybridSystem, levels: AbstractLevels | None, t, q, u, index):
    def one(s, levels, t, q, u, i):
        def rows(t, q, u):
            level = levels is not None and levels.present(s, a)
            guards = [s.guard(g, t, q, u) for g in s.guards(a)]
            return jnp.stack(guards + ([levels.level(s, a, i, t, q)] if level else []))

        return _expand(rows, t, q, u)

    return Structure(system).by_lane(one, levels)(t, q, u, index)


def _reset(g: int, system: HybridSystem, t, q, u):
    one = lambda s, t, q, u: _expand(lambda t, q, u: s.reset(g, t, q, u), t, q, u)  # noqa: E731
    return Structure(system).by_lane(one)(t, q, u)


def _enabled(g: int, system: HybridSystem, t, q, u):
    return Structure(system).by_lane(lambda s, t, q, u: s.enabled(g, t, q, u))(t, q, u)


def _outputs(a: int, system: HybridSystem, items: tuple[str | Output, ...], t, q, u):
    def one(s, items, t, q, u):
        z = s.resolve_outputs(items)
        return _expand(lambda t, q, u: z(a, t, q, u), t, q, u)

    return Structure(system).by_lane(one, items)(t, q, u)


def _values(a: int, system: HybridSystem, items: tuple[str | Output, ...], t, q):
    one = lambda s, items, t, q: s.resolve_outputs(items)(a, t, q, jnp.zeros(s.nu))  # noqa: E731
    return Structure(system).by_lane(one, items)(t, q)


def _levels(a: int, n_sections: int, system: HybridSystem, levels: AbstractLevels, t, q):
    def one(s, levels, t, q):
        f = s.field(a, t, q, jnp.zeros(s.nu))
        along = lambda i: jax.jvp(  # noqa: E731
            lambda t, q: levels.level(s, a, i, t, q), (t, q), (jnp.ones_like(t), f)
        )
        return jnp.stack(jax.vmap(along)(jnp.arange(n_sections)), axis=1)

    return Structure(system).by_lane(one, levels)(t, q)


def _expand(function, t, q, u):
    """A vector function of (t, q, u) and its derivatives, as columns of one array."""
    n, m = q.shape[0], 1 + q.shape[0] + u.shape[0]
    split = lambda x: (x[0], x[1 : 1 + n], x[1 + n :])  # noqa: E731
    push = lambda dx: jax.jvp(function, (t, q, u), split(dx))  # noqa: E731
    value, columns = jax.vmap(push, out_axes=(None, 1))(jnp.eye(m))
    return jnp.concatenate([value[:, None], columns], axis=1)
