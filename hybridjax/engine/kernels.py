"""Users' functions (fields, guards, resets, outputs) compiled one by one, for code that runs on the
host, each with its first derivatives.

The engine on the host calls `field`, `step`, `watched`, `reset` and so on with arrays of NumPy
whose last axis has the lanes (trajectories side by side). An answer has one column for the value,
then columns for the derivatives by the time, the n states and the nu inputs: (rows, 2 + n + nu, L).
`watched`, `reset`, `enabled` and `linear` also take and return arrays of JAX. With a mask `some`,
only these lanes are computed, and the other lanes hold copies of one of them.

The file has three parts: the functions that the engine calls (`field` to `levels`); behind them,
the functions of a single point (`_field` to `_levels`); and *forms*, which turn a function of a
point into a compiled function of lanes. The forms are `_expanded` (with derivatives), `_ByMethod`
(in steps), `_Tangent` (along directions, for `Tangents`) and `_BySystem` (for many systems,
`Systems`). If derivatives of all functions are wrong, look first at the forms; if those of one
function are wrong, at its function of a point.
"""

import copy
import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from .._core.compilation import kernel
from .._core.executor import from_host, is_traced, on_host
from .._core.lanes import PerLane, by_lane, shared
from ..systems.solver import Method
from ..systems.structure import Kind, Member, Structure, stacked
from ..systems.system import Output
from ..systems.transition import Scheduled
from .arrays import AnyInputs as Inputs, AnyTimes as Times, Array, States
from .runge_kutta import Step, step_along as _along, take_step
from .target import AbstractLevels


Expanded = Float[Array, "rows columns L"]
Some = Bool[Array, " L"] | None
Items = tuple[str | Output, ...]

# Number of lanes of the programs that are called for many points at once. Higher: calls for few
# points compute unused lanes. Lower: many points take more calls.
POINTS = 16
# Number of lanes of the programs for many systems or many directions. More: the last call has more
# unused lanes. Fewer: calling costs more than computing.
WIDE = 256


def field(
    s: Structure,
    a: int,
    t: Times,
    q: States,
    u: Inputs,
    some: Some = None,
    lanes: int = POINTS,
) -> Expanded:
    """The field of chart a, and its derivatives (on the host)."""
    return s.kernel(_field, _expanded, a, lanes=lanes)(t, q, u, some=some)


def step(
    s: Structure, a: int, t: Times, q: States, u: Inputs, h: Times, some: Some = None
) -> Step:
    """A step in chart a, without derivatives."""
    method = _ByMethod(_step, s.method(a))
    of_lanes = s.kernel(_field, method, a)
    return Step(*of_lanes(t, q, u, h, some=some))


def step_along(
    s: Structure,
    a: int,
    t: Times,
    q: States,
    u: Inputs,
    h: Times,
    along: States,
    some: Some,
) -> tuple[Step, States, States]:
    """A step in chart a, and the derivatives of its end and of its error estimate along a direction
    of states."""
    method = _ByMethod(_step_along, s.method(a))
    of_lanes = s.kernel(_field, method, a)
    *step, end, estimate = of_lanes(t, q, u, h, along, some=some)
    return Step(*step), end, estimate


def linear_step(
    s: Structure, a: int, t: Times, q: States, u: Inputs, h: Times
) -> Expanded:
    """The end of a step in chart a, the field there, and the derivatives of the end by time,
    states, inputs and length of the step."""
    form = _ByMethod(_linear_step, s.method(a))
    return s.kernel(_field, form, a, lanes=POINTS)(t, q, u, h)


def watched(
    s: Structure,
    a: int,
    levels: AbstractLevels | PerLane | None,
    t: Times,
    q: States,
    u: Inputs,
    index: Int[Array, " #L"],
    some: Some = None,
    lanes: int | None = None,
) -> Expanded:
    """The guards of chart a, and the level if it has one, with their derivatives."""
    static = a, s.guard_kinds(a)
    if not on_host(q):
        of_point = _columns(ft.partial(watched_at, *static))
        return s.by_lane(of_point, levels)(t, q, u, index)
    if lanes is None:
        # (Compiling a program for many points pays only if there are many points.)
        lanes = 1 if q.shape[-1] < 4 * POINTS else POINTS
    rows = s.kernel(watched_at, _expanded, *static, trees=(levels,), lanes=lanes)
    return rows(t, q, u, index.astype(np.int32), some=some)


def reset(
    s: Structure, g: Member, t: Times, q: States, u: Inputs, some: Some = None
) -> Expanded:
    """The state after transitions of one kind, and (on the host) its derivatives."""
    if on_host(q):
        run = s.kernel(_reset, _expanded, g.kind)
        return run(t, q, u, g.place, some=some)
    by_lane = s.by_lane(ft.partial(_reset, g.kind))
    return by_lane(t, q, u, g.place)[:, None]


def enabled(
    s: Structure, g: Member, t: Times, q: States, u: Inputs, lanes: int = 1
) -> Bool[Array, " L"]:
    """Test whether the predicates of transitions of one kind hold."""
    if on_host(q):
        run = s.kernel(_enabled, by_lane, g.kind, lanes=lanes)
        return run(t, q, u, g.place)
    predicate = s.by_lane(ft.partial(_enabled, g.kind))
    return predicate(t, q, u, g.place)


def due(s: Structure, g: int, t: Times, q: States, u: Inputs) -> Expanded:
    """The time from t to the nearest scheduled time of a transition, with its derivatives. (Callers
    are at such a time already, so that the value is a rounding error.)"""
    return s.kernel(_due, _expanded, g)(t, q, u)


def by_parameter_of_period(s: Structure) -> Any:
    """The derivative of the clock's period by a parameter. (The only input of `s` is added to this
    parameter.)"""
    if is_traced(s):
        by_input = jax.jacfwd(lambda u: _period(s, 0.0, 0.0, u))
        return by_input(jnp.zeros(1))[0, 0]
    t = np.zeros(1)
    no_state = np.zeros((0, 1))
    u = np.zeros((1, 1))
    rows = s.kernel(_period, _expanded)(t, no_state, u)
    return rows[0, -1, 0]


def outputs(
    s: Structure, a: int, items: Items, t: Times, q: States, u: Inputs
) -> Expanded:
    """Outputs in chart a, and their derivatives."""
    return linear(s, _outputs, a, t, q, u, items)


def linear(
    s: Structure,
    function: Callable,
    a: int,
    t: Times,
    q: States,
    u: Inputs,
    *trees: Any,
) -> Expanded:
    """A vector function (chart, structure, *trees, t, q, u) of chart a, and its derivatives."""
    if not on_host(q):
        function_of_chart = ft.partial(function, a)
        of_point = _columns(function_of_chart, 1 + len(trees))
        return s.by_lane(of_point, *trees)(t, q, u)
    lanes = POINTS if q.shape[-1] < 16 * POINTS else 4 * POINTS
    return s.kernel(function, _expanded, a, trees=trees, lanes=lanes)(t, q, u)


def levels(
    s: Structure, a: int, levels: AbstractLevels, n_sections: int, t: Times, q: States
) -> Float[Array, "N 2 L"]:
    """The levels of all sections in chart a, and their rates along the flow."""
    static = a, n_sections
    rows = s.kernel(_levels, by_lane, *static, trees=(levels,), lanes=POINTS)
    return rows(t, q)


# Functions of a point. Static arguments come first, then the structure, then other trees. (They are
# functions of the module, so that their compiled programs are found again.)


def _field(a: int, s: Structure, t, q, u, *_):
    return s.field(a, t, q, u)


def has_level(s: Structure, a: int, levels: AbstractLevels | PerLane | None) -> bool:
    """Test whether a level of the section is watched in chart a."""
    return levels is not None and shared(levels).present(s, a)


def count_watched(s: Structure, a: int, levels: AbstractLevels | PerLane | None) -> int:
    """The number of the functions of `watched_at`."""
    return len(s.guards(a)) + has_level(s, a, levels)


def watched_at(
    a: int,
    kinds: tuple[Kind, ...],
    s: Structure,
    levels: AbstractLevels | None,
    t,
    q,
    u,
    i,
):
    """The guards of chart a, given by their kinds, and the level of section i if the chart has
    one."""
    guards = s.guard_values(kinds, t, q, u)
    if levels is not None and levels.present(s, a):
        guards = [*guards, levels.level(s.under(u), a, i, t, q)]
    return stacked(guards)


def _reset(kind: Kind, s: Structure, t, q, u, place):
    return s.reset(Member(kind, place), t, q, u)


def _enabled(kind: Kind, s: Structure, t, q, u, place):
    return s.enabled(Member(kind, place), t, q, u)


def _period(s: Structure, t, q, u):
    return jnp.stack([jnp.asarray(s.under(u).system.period(), float)])


def _outputs(a: int, s: Structure, items: Items, t, q, u):
    under = s.under(u)
    inputs = u if under is s else jnp.zeros(under.nu)
    return under.resolve_outputs(items)(a, t, q, inputs)


def _due(g: int, s: Structure, t, q, u):
    guard = s.under(u).transitions[g].guard
    assert isinstance(guard, Scheduled)
    return jnp.stack([guard.nearest(t) - t])


def _levels(a: int, n_sections: int, s: Structure, levels: AbstractLevels, t, q):
    f = s.field(a, t, q, jnp.zeros(s.nu))

    def along(i):
        def level(t, q):
            return levels.level(s, a, i, t, q)

        rates = (jnp.ones_like(t), f)
        return jax.jvp(level, (t, q), rates)

    indices = jnp.arange(n_sections, dtype=np.int32)
    return jnp.stack(jax.vmap(along)(indices), axis=1)


# Forms: from a function of a point to a function of lanes.


def _expanded(function: Callable, *trees: Any) -> Callable:
    """Lanes of a vector function of (t, q, u) and its derivatives, as columns of one array."""
    return by_lane(_columns(function, len(trees)), *trees, quick=True)


def _columns(function: Callable, trees: int = 2) -> Callable:
    """A vector function of some trees and (t, q, u), and its derivatives, as columns."""

    def expand(*x):
        bound = x[:trees]
        t, q, u, *further = x[trees:]
        n = q.shape[0]
        m = 1 + q.shape[0] + u.shape[0]

        def at(t, q, u):
            return function(*bound, t, q, u, *further)

        def split(x):
            q = x[1 : 1 + n]
            u = x[1 + n :]
            return (x[0], q, u)

        def push(dx):
            return jax.jvp(at, (t, q, u), split(dx))

        columns_of = jax.vmap(push, out_axes=(None, 1))
        value, columns = columns_of(jnp.eye(m))
        return jnp.concatenate([value[:, None], columns], axis=1)

    return expand


class Tangents(Structure):
    """A structure for derivatives in P directions, in which parameters of the system and of
    `levels` change.

    Each lane has one of the P directions. States and times of a lane are complex: the real part is
    the value, and the imaginary part is its derivative along the direction, times `TINY`. Inputs
    have P more rows, which say which direction a lane has (see `pushed`). A tree of directions has
    arrays (P, ...), or `None` for a number that does not change.
    """

    def __init__(
        self, s: Structure, along: Structure, levels, by_levels, directions: int
    ):
        super().__init__(s.source)
        self.directions = directions
        self._levels = levels
        self._plain = s
        self._along = from_host((along, by_levels))
        self.nu = s.nu
        leaves = map(np.asarray, jax.tree_util.tree_leaves((along, by_levels)))
        self.moving = sum(x.reshape(directions, -1).any(axis=1) for x in leaves) > 0

    def pushed(self, direction: Int[np.ndarray, " L"]) -> Inputs:
        """Inputs for lanes with these directions: the system's own inputs, all zero, then P rows
        with a 1 in the row of the lane's direction. (A negative index gives zeros: no
        direction.)"""
        along = np.arange(self.directions)[:, None] == direction
        still = np.zeros((self.nu, len(direction)))
        return np.concatenate([still, along])

    def kernel(self, function, form, *static, trees=(), lanes=1):
        """As that of a `Structure`, for complex times and states: the imaginary part of the answer
        is the derivative along the direction of each lane, times `TINY`."""
        moving = (0, 1, 3) if isinstance(form, _ByMethod) else (0, 1)

        def make():
            def still(tree):
                return jax.tree_util.tree_map(lambda _: None, tree)

            along = [self._along[1] if x is self._levels else still(x) for x in trees]
            every = (self._plain, *trees)
            along = (self._along[0], *along)
            return kernel(
                function, _Tangent(form, moving), static, (every, along), WIDE
            )

        of_lanes = self.once((function, form, static), trees, make)

        def call(*point, some=None):
            t, q, inputs, *further = point
            tangents = [point[k].imag / TINY for k in moving]
            u, x = np.split(inputs, [self.nu])
            further = [y.real for y in further]
            both = of_lanes(t.real, q.real, u, *further, *tangents, x)
            value, change = both
            return value + 1j * TINY * change

        return call


class Systems(Structure):
    """Many systems of one class, one in each lane on the host. Arrays of parameters have the lanes
    on their last axis."""

    by_system = True

    def __init__(self, source: PerLane):
        super().__init__(source)

        def first(x):
            return np.asarray(x)[..., 0] if eqx.is_array(x) else x

        leaves = jax.tree_util.tree_leaves(eqx.filter(source.tree, eqx.is_array))
        rows = []
        for leaf in leaves:
            array = np.asarray(leaf)
            rows.append(array.reshape(-1, array.shape[-1]))
        self._numbers = np.concatenate(rows)
        single = jax.tree_util.tree_map(first, source.tree)
        self._single = Structure(from_host(single))

    def at(self, lane):
        """The systems of these lanes."""
        other = copy.copy(self)
        other._made = {}
        other._numbers = self._numbers[:, lane]
        return other

    def kernel(self, function, form, *static, trees=(), lanes=1):
        """As that of a `Structure`, where each lane has the parameters of its own system."""
        every = self._single, *trees

        def make():
            return kernel(function, _BySystem(form), static, every, WIDE)

        of_lanes = self.once((function, form, static), trees, make)
        return ft.partial(of_lanes, self._numbers)


class _BySystem(NamedTuple):
    """A form for many systems: the first argument has their parameters, one row for each system."""

    form: Callable

    def __call__(self, function: Callable, s: Structure, *trees: Any) -> Callable:
        arrays, static = eqx.partition(s, eqx.is_array)
        leaves, structure = jax.tree_util.tree_flatten(arrays)
        sizes = [x.size for x in leaves]
        ends = np.cumsum(sizes)[:-1]

        def lanes(numbers, *point):
            parts = zip(leaves, jnp.split(numbers, ends), strict=True)
            arrays = [y.reshape(*x.shape, -1).astype(x.dtype) for x, y in parts]
            numbers = jax.tree_util.tree_unflatten(structure, arrays)
            by_lane = (True,) * len(arrays)
            systems = PerLane(eqx.combine(numbers, static), by_lane)
            return self.form(function, systems, *trees)(*point)

        return lanes


# Scale of derivatives as imaginary parts, so small that products of two of them vanish beside the
# real parts.
TINY = np.sqrt(np.finfo(float).tiny)


def unpushed(s: Structure, lane: Int[np.ndarray, " L"]) -> Inputs:
    """Inputs that are zero, for lanes with these indices. For `Tangents`, they say which direction
    each lane has: lanes take turns, first the 1 + d directions of time and states, then the P of
    parameters."""
    if not isinstance(s, Tangents):
        return np.zeros((s.nu, len(lane)))
    n = 1 + s.d  # directions of the start of a move come first
    return s.pushed(lane % (n + s.directions) - n)


def parted(tree: Any) -> tuple[Any, Any]:
    """Split complex arrays (N, P, ...) (see `Tangents`) into values (N, ...) and derivatives (P, N,
    ...)."""

    values = jax.tree_util.tree_map(lambda x: x.real[:, 0], tree)
    derivatives = jax.tree_util.tree_map(
        lambda x: np.swapaxes(x.imag, 0, 1) / TINY, tree
    )
    return values, derivatives


class _Tangent(NamedTuple):
    """Another form, with its derivative along tangents of the arguments `moving` and of all
    trees."""

    form: Callable
    moving: tuple[int, ...]

    def __call__(self, function: Callable, trees: tuple, along: tuple) -> Callable:
        def moved(trees, along, *point):
            *point, x = point

            def step(y, dy):
                return y if dy is None else y + jnp.tensordot(x, dy, 1)

            return function(*jax.tree_util.tree_map(step, trees, along), *point)

        lanes = self.form(moved, trees, along)

        def both(*arguments):
            point = list(arguments[: -1 - len(self.moving)])
            tangents = arguments[len(point) :]

            def at(*moved):
                now = dict(zip(self.moving, moved[:-1], strict=True))
                return lanes(*(now.get(k, x) for k, x in enumerate(point)), moved[-1])

            start = *(point[k] for k in self.moving), jnp.zeros_like(tangents[-1])
            return jnp.stack(jax.jvp(at, start, tangents))

        return both


class _ByMethod(NamedTuple):
    """Lanes of a function of a Runge-Kutta step: of the method, the field, and (t, q, u, h)."""

    compute: Callable
    method: Method

    def __call__(self, function: Callable, *trees: Any) -> Callable:
        field = by_lane(function, *trees, quick=True)
        return ft.partial(self.compute, self.method, field)


def _step(method: Method, field: Callable, t, q, u, h, *x):
    """The fields of a `Step`, stacked on the first axis."""

    def at(t, q):
        return field(t, q, u, h, *x)

    # (With directions x, the step will be differentiated.)
    return jnp.stack(take_step(method, at, t, q, h, still=at if x else None))


def _step_along(method: Method, field: Callable, t, q, u, h, along):
    """The fields of a `Step`, and the derivatives of its end and estimate along a direction of
    states, stacked on the first axis."""

    def at(t, q):
        return field(t, q, u, h, along)

    step, *tangent = _along(method, at, t, q, h, along)
    return jnp.stack([*step, *tangent])


def _linear_step(method: Method, field: Callable, t, q, u, h, *x):
    """The end of a step, the field there, and the derivatives of the end by time, states, inputs
    and h, as columns of one array."""

    def end(t, q, u, h):
        fixed = jax.lax.stop_gradient((u, h))

        def at(t, q):
            return field(t, q, u, h, *x)

        def still(t, q):
            return field(t, q, *fixed, *x)

        step = take_step(method, at, t, q, h, still=still)
        return step.q, step.f1

    n, L = q.shape
    shapes = [x.shape[:-1] for x in (t, q, u, h)]
    split = np.cumsum([1, n, len(u)])

    def push(direction):
        parts = zip(jnp.split(direction, split), shapes, strict=True)
        tangents = [
            jnp.broadcast_to(x.reshape(*shape, 1), (*shape, L)) for x, shape in parts
        ]
        point = (t, q, u, h)
        (value, f), (tangent, _) = jax.jvp(end, point, tuple(tangents))
        return value, f, tangent

    unit = jnp.eye(split[-1] + 1)
    along = jax.vmap(push, out_axes=(None, None, 1))
    value, f, columns = along(unit)
    return jnp.concatenate([value[:, None], f[:, None], columns], axis=1)
