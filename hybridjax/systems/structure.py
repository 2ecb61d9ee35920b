"""`Structure`: a hybrid system by the indices of its charts and transitions, with functions in one
form.

The engine evaluates a system only through its `Structure`. Functions take (t, q, u) and return
arrays, and guards are signed so that they fall through zero at their event. Indices follow the
order in which the system lists charts and transitions. Both must stay: recorded steps and all
searches rely on them. `Varied` (`varied.py`) replaces `field`, `guard` and `reset`.

Transitions that are written once and differ only in a number are of one *kind*. For example, in
`[Transition(..., guard=Contact(self, i), ...) for i in range(n)]`, the number `i` becomes an
argument of one function, so that n contacts are traced, compiled and evaluated as one. `kinds`
finds them.

If a guard has a wrong sign, look at `Structure.guard`; if an input acts in the wrong chart, at
`chart_input`; if transitions that are alike compile one by one, at `_form` and `_is_one`; if a tick
of a clock leads to two events or to none, at `clocks`; if an output is NaN, at `Outputs._function`.
"""

import dataclasses
import functools as ft
import itertools
import operator
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Int

from .._core import jax_compat
from .._core.arguments import require_among
from .._core.call import once_in_call
from .._core.compilation import identity, kernel
from .._core.executor import Array, is_hidden, is_traced
from .._core.lanes import PerLane, by_lane, one_lane, shared
from .._core.meaning import program_digest
from .._core.memo import Memory
from .._core.signal import Signal, signals, unit_of
from ..errors import DefinitionError
from .chart import Chart
from .solver import ByChart, Method, as_method
from .system import Driven, Guess, HybridSystem, Output, name_of
from .transition import Scheduled, Transition
from .verner import VERNER76


Kind = tuple[int, ...]
"""Indices of transitions with the same charts and direction, whose functions differ at most in
the numbers that they hold."""


class Member(NamedTuple):
    """A transition, or one for each lane (trajectory), given by its kind and its index within the
    kind. The index may be traced."""

    kind: Kind
    place: Int[Array | np.ndarray, "..."]


def kinds(transitions: Sequence[Transition]) -> list[Kind]:
    """Kinds in the order of their first transitions."""
    groups: dict[Hashable, list[int]] = {}
    for g, x in enumerate(transitions):
        groups.setdefault(_form(x) or g, []).append(g)
    return [tuple(kind) for kind in groups.values()]


def member_of(alike: Sequence[Any], place: Any) -> Any:
    """Select the pytree with index `place` among pytrees that differ only in numbers."""
    leaves, structures = zip(*map(jax.tree_util.tree_flatten, alike), strict=True)

    def select(column: tuple) -> Any:
        if all(x is column[0] for x in column):
            return column[0]
        on_device = any(isinstance(x, jax.Array) for x in column)
        return jnp.asarray(jnp.stack(column) if on_device else np.stack(column))[place]

    return structures[0].unflatten(
        [select(column) for column in zip(*leaves, strict=True)]
    )


def counts_alike(program: jax_compat.Program) -> bool:
    """Test whether a program computes with integers as Python does. (JAX evaluates integer powers
    by the bits of the exponent: a negative or too large one would give another number.)"""
    for equation in program.eqns:
        types = [getattr(v.aval, "dtype", object) for v in equation.invars]
        whole = all(jnp.issubdtype(x, jnp.integer) for x in types)
        if whole and jax_compat.works_on_bits(equation):
            return False
        if not all(map(counts_alike, jax_compat.inner_programs(equation))):
            return False
    return True


def _form(x: Transition) -> Hashable:
    """A key that is equal for transitions of one kind; `None` if x can have no others of its
    kind."""
    if isinstance(x.guard, Scheduled):
        return None
    leaves, structure = jax.tree_util.tree_flatten((x.guard, x.reset, x.enabled))
    return hashable(
        (x.source, x.target, x.direction, structure, *map(_form_of_leaf, leaves))
    )


def hashable(form: Hashable) -> Hashable:
    """Return a form, or None if a part of it cannot be compared."""
    try:
        hash(form)
    except TypeError:
        return None
    return form


def _form_of_leaf(leaf: Any) -> Hashable:
    """Type and shape of a number or an array; another leaf itself."""
    if type(leaf) in (int, float):
        return type(leaf), ()
    if eqx.is_array_like(leaf) and not isinstance(leaf, bool | complex):
        return leaf.dtype, leaf.shape
    return leaf


def as_vector(value: Any) -> jax.Array:
    """Numbers returned by a user's function, as one floating-point vector."""
    if isinstance(value, tuple | list):
        if value:
            return jnp.stack([jnp.asarray(v, float) for v in value])
        return jnp.zeros(0)
    return jnp.asarray(value, float)


def quoted(names: Iterable[str]) -> str:
    """Names in quotation marks, for messages."""
    return ", ".join(map(repr, names)) or "none"


def stacked(parts: Sequence[jax.Array]) -> jax.Array:
    """Numbers and vectors, one after the other, as a vector."""
    if all(x.ndim == 0 for x in parts):
        return jnp.stack(parts)
    return jnp.concatenate([jnp.atleast_1d(x) for x in parts])


def _index(what: str, name: str, names: Sequence[str]) -> int:
    require_among(what, [name], names)
    return names.index(name)


@jax.tree_util.register_pytree_node_class
class ByName(dict):
    """Numbers by names. An error for another name lists them. A pytree, as dictionaries are.

    **Arguments:** `chart`, `time`: those of the state whose numbers these are. A simulation from
    the state begins there. (At time 0 instead, it would leave the cycle of a system with a clock.)
    """

    def __init__(self, values: Any, chart: str | None = None, time: Any = None):
        super().__init__(values)
        self._chart = chart
        self._time = time

    def tree_flatten(self):
        """The numbers. (Arithmetic with them leaves the time as it is. Only times that JAX traces,
        or those of many states, have to be a child.)"""
        values = tuple(self.values())
        if is_traced(self._time) or np.ndim(self._time):
            return (values, self._time), (tuple(self), self._chart, None)
        time = None if self._time is None else float(self._time)
        return (values, None), (tuple(self), self._chart, time)

    @classmethod
    def tree_unflatten(cls, about, children):
        names, chart, time = about
        values, traced = children
        time = time if traced is None else traced
        return cls(zip(names, values, strict=True), chart, time)

    def with_items(self, items: Mapping[str, Any]) -> "ByName":
        """Return the same with other numbers."""
        return ByName(items, self._chart, self._time)

    def __or__(self, items: Mapping[str, Any]) -> "ByName":  # type: ignore[override]
        return self.with_items({**self, **items})

    def __ror__(self, items: Mapping[str, Any]) -> "ByName":  # type: ignore[override]
        return self.with_items({**items, **self})

    def copy(self) -> "ByName":
        return self.with_items(self)

    def as_guess(self) -> Guess | None:
        """Return the state as a start, or `None` where its chart or time is not known."""
        if self._chart is None or self._time is None:
            return None
        return Guess(self._chart, tuple(self.values()), self._time)

    def __call__(self, *_: Any, **__: Any):
        raise TypeError(
            "this is the state at one time: `charts, states = trajectory.at(times)` has those at "
            "others, of `cycle.trajectory()` or of `hj.simulate`."
        )

    def __missing__(self, name: str):
        raise KeyError(f"there is no '{name}'; names are {', '.join(self)}")

    def __getattr__(self, name: str):
        if name.startswith("_"):
            # (`copy` and `pickle` ask for such names before there are numbers.)
            raise AttributeError(f"'ByName' object has no attribute {name!r}")
        if name in self:
            raise AttributeError(f"names stand in brackets here: write `['{name}']`.")
        raise AttributeError(
            f"there is no `{name}`; names are {', '.join(self)}, as in `['{next(iter(self))}']`."
        )


_kinds = Memory()
_all_clocks = Memory()
_clocks_of_programs: dict[tuple, np.ndarray] = {}


@jax.tree_util.register_pytree_node_class
class Structure:
    """Charts and transitions of a system by index.

    A `Structure` is built at the beginning of a public call, and handed on. It is a pytree whose
    only child is the system: transformations of JAX take it as an argument, and each trace gets a
    copy. Within one trace, each function of the system is traced once, however often it is used.
    """

    def __init__(self, source: "HybridSystem | PerLane"):
        self.source = source
        self._made: dict[Hashable, tuple[Any, tuple]] = {}

    def tree_flatten(self):
        return (self.source,), None

    @classmethod
    def tree_unflatten(cls, _, children):
        return cls(*children)

    @ft.cached_property
    def system(self) -> HybridSystem:
        return shared(self.source)

    def _once_in_call(self, name: str, make: Callable[[], Any]) -> Any:
        """Return an object that another structure of the same system has made in this public call,
        or make it. (In each trace of JAX it is made again, since constants belong to a trace.)"""
        system = self.system
        if is_hidden(system):
            return make()
        return once_in_call((name, id(system)), system, make)

    @ft.cached_property
    def _charts(self) -> dict[str, Chart]:
        return self._once_in_call("charts", lambda: self.system.charts())

    @ft.cached_property
    def charts(self) -> list[Chart]:
        return list(self._charts.values())

    @ft.cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(self._charts)

    @ft.cached_property
    def transitions(self) -> list[Transition]:
        return self._once_in_call(
            "transitions", lambda: list(self.system.transitions())
        )

    @ft.cached_property
    def dims(self) -> tuple[int, ...]:
        return tuple(len(c.states) for c in self.charts)

    @ft.cached_property
    def d(self) -> int:
        """Dimension of the largest chart."""
        return max(self.dims)

    @ft.cached_property
    def inputs(self) -> tuple[Signal, ...]:
        def named():
            return signals(self.system.inputs, self.system.input_units)

        return self._once_in_call("inputs", named)

    def inputs_among(
        self, names: Sequence[str] | None
    ) -> tuple[tuple[str, ...], Int[np.ndarray, " nu"]]:
        """Names of inputs (Default: all) and their indices.

        **Raises:** `DefinitionError` for a name that does not exist, and for a system without any.
        """
        names = self.inputs if names is None else names
        if not names:
            raise DefinitionError(
                f"{name_of(self.system)} has no inputs: without `inputs = ()` in its class "
                "(or call) it has one, `u`, which its functions may ignore."
            )
        columns = np.array([_index("input", name, self.inputs) for name in names], int)
        return tuple(self.inputs[k] for k in columns), columns

    @ft.cached_property
    def nu(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    def by_lane(
        self,
        function: Callable,
        *trees: Any,
        name: Hashable = None,
        by_row: bool = True,
    ) -> Callable:
        """Vectorize `function(structure, *trees, *arguments)` over the lanes on the last axis of
        `arguments`. Lanes may have parameters of their own (see `PerLane`).

        A function with a `name` is made once for the same trees, and traced once. `by_row`: as in
        `vectorized`.
        """

        def make():
            if isinstance(self.source, PerLane):

                def of_source(source, *x):
                    return function(Structure(source), *x)

                return by_lane(of_source, self.source, *trees, by_row=by_row)
            return by_lane(lambda *x: function(self, *x), *trees, by_row=by_row)

        return make() if name is None else self.once(name, trees, make)

    def kernel(
        self,
        function: Callable,
        form,
        *static: Hashable,
        trees=(),
        lanes=1,
    ) -> Callable:
        """Compile `function(*static, structure, *trees, *point)` in a form (see
        `engine/kernels.py`), for arrays of the host (see `_core/compilation.py`)."""
        name = function, form, static, lanes

        def make():
            return kernel(function, form, static, (self, *trees), lanes)

        def make_once():
            if type(self) is not Structure:  # (it has more than its source)
                return make()
            key = name, *map(id, (self.source, *trees))
            return once_in_call(key, (self.source, trees), make)

        return self.once(name, trees, make_once)

    # Whether lanes of the host have systems of their own (see `engine.kernels.Systems`).
    by_system = False

    def at(self, lane: Int[np.ndarray, " L"]) -> "Structure":
        """The structure for lanes of these indices."""
        return self

    def once(self, name: Hashable, trees: tuple, make: Callable[[], Any]) -> Any:
        """Return the object that was made under this name for these trees; call `make` only if
        there is none."""
        if name in self._made:
            made, before = self._made[name]
            if all(map(operator.is_, before, trees)):
                return made
        made = make()
        self._made[name] = made, trees
        return made

    def under(self, u: Array) -> "Structure":
        """The structure under inputs that are added to parameters (see `Varied`)."""
        return self

    def chart_index(self, name: str) -> int:
        return _index("chart", name, self.names)

    def transition_index(self, name: str) -> int:
        events = [t.name for t in self.transitions]
        if name not in events and name in self.output_names():
            raise DefinitionError(
                f"'{name}' is a signal, not an event: `hj.Crossing('{name}', 'falling')` is a "
                "section."
            )
        return _index("event", name, events)

    def method(self, a: int) -> Method:
        """The method by which chart a is integrated: that of the system, of the chart, or the
        default.

        **Raises:** `DefinitionError` for a solver that is none with an error estimate.
        """
        return self.once(("method", a), (), lambda: self._method(a))

    def _method(self, a: int) -> Method:
        system = self.system.system if isinstance(self.system, Driven) else self.system
        solver = type(system).solver if system.solver is None else system.solver
        if isinstance(solver, ByChart):
            solver = solver.get(self.names[a])
        if solver is None:
            solver = self.charts[a].solver
        return VERNER76 if solver is None else as_method(solver)

    def chart_input(self, a: int, t: ArrayLike, u: Array) -> Array:
        """g_a(û): the inputs that chart a uses."""
        if isinstance(self.system, Driven):
            drive = jnp.asarray(self.system.drive(t), float)
            u = u + jnp.broadcast_to(drive, u.shape)
        names = self.charts[a].inputs
        if names is None:
            return u
        return u[np.array([self.inputs.index(n) for n in names], int)]

    def field(self, a: int, t: Array, q: Array, u: Array) -> jax.Array:
        whole_input = self.chart_input(a, t, u)
        return as_vector(self.charts[a].field(t, q, whole_input))

    @property
    def kinds(self) -> list[Kind]:
        """The transitions, those of one kind together."""

        def make():
            groups = []
            for kind in kinds(self.transitions):
                if len(kind) == 1 or self._is_one(kind):
                    groups.append(kind)
                else:
                    groups += [(g,) for g in kind]
            return groups

        return _kinds.recall(self.source, None, make)

    def _is_one(self, kind: Kind) -> bool:
        """Test whether functions of a kind can be traced with their differing numbers as arguments,
        and still mean the same. (They cannot if Python branches on a number.)"""
        n = self.dims[self.chart_index(self.transitions[kind[0]].source)]

        def at_a_point(s, place, *point):
            x = Member(kind, place)
            return s.guard(x, *point), s.reset(x, *point), s.enabled(x, *point)

        real = jnp.result_type(float)
        place = jax.ShapeDtypeStruct((), jnp.result_type(int))
        single = Structure(one_lane(self.source))
        shapes = (), (n,), (single.nu,)
        point = [jax.ShapeDtypeStruct(shape, real) for shape in shapes]
        try:
            program, *_ = eqx.filter_make_jaxpr(at_a_point)(single, place, *point)
        except Exception:  # any error of a user's function, or of JAX in it
            return False
        return counts_alike(program.jaxpr)

    def member(self, g: int) -> Member:
        """Transition g as a member of its kind, for one lane."""
        kind = next(kind for kind in self.kinds if g in kind)
        return Member(kind, np.array([kind.index(g)], np.int32))

    def guard_kinds(self, a: int) -> tuple[Kind, ...]:
        """Kinds of the state-dependent transitions out of chart a."""

        def leaves(kind):
            return self._leaves(kind[0], a, by_clock=False)

        return self.once(("guards", a), (), lambda: tuple(filter(leaves, self.kinds)))

    def guards(self, a: int) -> list[int]:
        """Indices of the state-dependent transitions out of chart a, by kind."""
        return list(itertools.chain(*self.guard_kinds(a)))

    def schedules(self, a: int) -> list[int]:
        """Indices of the scheduled transitions out of chart a."""
        return [
            g for g in range(len(self.transitions)) if self._leaves(g, a, by_clock=True)
        ]

    @property
    def clocks(self) -> Int[np.ndarray, " G"]:
        """The clock of each transition by number, negative for those of a guard.

        Schedules with the same formulas for period and offset are one clock. Each tick of a clock
        leads to one event: in the chart that a tick enters, the transition of the same clock waits
        for the next tick. Different clocks, such as `Scheduled(T)` and `Scheduled(T, duty * T)` at
        duty 0, may tick at the same time, and each then leads to an event.
        """
        return _all_clocks.recall(self.source, None, self._clocks_of_program)

    def _clocks_of_program(self) -> Int[np.ndarray, " G"]:
        system = one_lane(self.source)
        if not program_digest(system):
            return self._clocks()
        # (Systems with the same programs have the same clocks, whatever their parameters are.)
        program = identity(system)
        if program not in _clocks_of_programs:
            _clocks_of_programs[program] = self._clocks()
        return _clocks_of_programs[program]

    def _clocks(self) -> Int[np.ndarray, " G"]:
        numbers = np.full(len(self.transitions), -1)
        formulas = []
        for g, transition in enumerate(self.transitions):
            if isinstance(transition.guard, Scheduled):
                formula = self._formula(g)
                if formula not in formulas:
                    formulas.append(formula)
                numbers[g] = formulas.index(formula)
        return numbers

    def _formula(self, g: int) -> Hashable:
        """A key of the formulas by which period and offset of a schedule follow from the parameters
        of the system."""

        def schedule(system: HybridSystem):
            guard = list(system.transitions())[g].guard
            assert isinstance(guard, Scheduled)
            return guard.period, guard.offset

        program, *_ = eqx.filter_make_jaxpr(schedule)(one_lane(self.source))
        needed, _ = jax_compat.needed_part(program.jaxpr, every_argument=True)
        constants = tuple(np.asarray(x).tobytes() for x in program.consts)
        return str(needed), constants

    def _leaves(self, g: int, a: int, by_clock: bool) -> bool:
        tr = self.transitions[g]
        return (
            tr.source == self.names[a] and isinstance(tr.guard, Scheduled) == by_clock
        )

    def transition(self, g: int | Member) -> Transition:
        """A transition by its index, or as a member of its kind (of a single lane)."""
        if not isinstance(g, Member):
            return self.transitions[g]
        alike = [self.transitions[x] for x in g.kind]
        if len(alike) == 1:
            return alike[0]
        functions = [(x.guard, x.reset, x.enabled) for x in alike]
        guard, reset, enabled = member_of(functions, g.place)
        return dataclasses.replace(alike[0], guard=guard, reset=reset, enabled=enabled)

    def guard(self, g: int | Member, t: ArrayLike, q: ArrayLike, u: Array) -> jax.Array:
        """Transition g's guard, signed so that it falls through zero at the event."""
        tr = self.transition(g)
        assert not isinstance(tr.guard, Scheduled)
        value = jnp.asarray(tr.guard(t, q, self._input_of(tr, t, u)))
        if value.dtype == bool:
            raise DefinitionError(
                f"the guard of '{tr.name}' must be `a - b`, not `a > b`."
            )
        return tr.sign * jnp.asarray(value, float)

    def guard_values(
        self,
        kinds: Sequence[Kind],
        t: Array,
        q: Array,
        u: Array,
    ) -> list[jax.Array]:
        """All guards of some kinds: a vector for each kind, or single numbers if each guard is the
        only one of its kind."""
        if all(len(kind) == 1 for kind in kinds):
            return [self.guard(g, t, q, u) for (g,) in kinds]

        def every(kind):
            return jax.vmap(lambda k: self.guard(Member(kind, k), t, q, u))

        return [every(kind)(np.arange(len(kind))) for kind in kinds]

    def reset(self, g: int | Member, t: ArrayLike, q: ArrayLike, u: Array) -> jax.Array:
        tr = self.transition(g)
        return as_vector(tr.reset(t, q, self._input_of(tr, t, u)))

    def enabled(
        self,
        g: int | Member,
        t: ArrayLike,
        q: ArrayLike,
        u: Array,
    ) -> jax.Array:
        tr = self.transition(g)
        if tr.enabled is None:
            return jnp.asarray(True)
        return jnp.asarray(tr.enabled(t, q, self._input_of(tr, t, u)), bool)

    def _input_of(self, tr: Transition, t: ArrayLike, u: Array) -> Array:
        return self.chart_input(self.chart_index(tr.source), t, u)

    def state_function(
        self, name: str, a: int
    ) -> Callable[[Any, Any, Any], Any] | None:
        """The state called `name` in chart a as a function (t, q, u), `None` if it is not there."""
        chart = self.charts[a]
        if name in chart.states:
            k = chart.states.index(name)
            return lambda t, q, u: q[k]
        if name in chart.absent:
            return lambda t, q, u: jnp.asarray(chart.absent[name], float)
        return None

    def state_names(self) -> tuple[str, ...]:
        """All state names, in order of first appearance."""
        names: dict[str, Signal] = {}
        for a in range(len(self.charts)):
            for name in self.states(a):
                if not unit_of(names.get(name, "")):
                    names[name] = name
        return tuple(names.values())

    def output_names(self) -> tuple[str, ...]:
        """The names of all states and outputs."""
        return (*self.state_names(), *(x.name for x in self.system.outputs()))

    def states_everywhere(self) -> list[str]:
        """The states that every chart defines."""
        defined = [{*chart.states, *chart.absent} for chart in self.charts]
        return [x for x in self.state_names() if all(x in names for names in defined)]

    def states(self, a: int) -> tuple[Signal, ...]:
        """The names of chart a's states, with their units."""
        return signals(self.charts[a].states, self.charts[a].units)

    def sizes(self, scale: Any) -> dict[str, np.ndarray]:
        """Sizes of the states of each chart, by its name, from `Settings.scale`."""
        rows = zip(self.names, np.asarray(scale), self.dims, strict=True)
        return {name: row[:d] for name, row, d in rows}

    def by_name(self, a: int, q: np.ndarray, time: Any = None) -> dict[str, float]:
        """A state of chart a by names, at a time."""
        values = zip(self.charts[a].states, q.tolist(), strict=False)
        return ByName(values, self.names[a], time)

    def drawing(self, a: int, t: Any, q: Any) -> Any:
        """The drawing of a state of chart a, or `None`."""
        named = {}
        for name in self.state_names():
            function = self.state_function(name, a)
            if function is not None:
                named[str(name)] = function(t, q, None)
        return self.system.draw(self.names[a], t, ByName(named))

    def resolve_outputs(
        self, outputs: Sequence[str | Output] | str | Output
    ) -> "Outputs":
        """Outputs by name or by `Output`, checked and ready to evaluate in any chart."""
        outputs = (outputs,) if isinstance(outputs, str | Output) else tuple(outputs)
        return self.once(
            (Outputs, len(outputs)), outputs, lambda: Outputs(self, outputs)
        )


def require_inputs_apart(
    what: str, inputs: Iterable[str], states_and_outputs: Iterable[str]
) -> None:
    """**Raises:** `DefinitionError` for an input that has the name of a state or of an output."""
    taken = set(map(str, states_and_outputs))
    for name in map(str, inputs):
        if name in taken:
            raise DefinitionError(
                f"{what}: '{name}' is an input and a state or an output, and results by names "
                f"could not tell them apart: give the input another name, as in `inputs = "
                f"('{name}_in',)`, or write `inputs = ()` for a system without."
            )


class Outputs:
    """Several outputs of a system as one vector function per chart."""

    def __init__(self, structure: Structure, outputs: Sequence[str | Output]):
        self.structure = structure
        defined = {o.name: o for o in structure.system.outputs()}
        items = [defined.get(x, x) if isinstance(x, str) else x for x in outputs]
        self.items: list[str | Output] = items
        require_among(
            "output", [x for x in items if isinstance(x, str)], structure.output_names()
        )
        states = {str(name): name for name in structure.state_names()}
        made = [x.name for x in items if isinstance(x, Output)]
        for name in made:
            if name in states:
                raise DefinitionError(
                    f"the output '{name}' has the name of a state: ask for the state by its name "
                    f"alone, or give the output another one."
                )
        require_inputs_apart(name_of(structure.system), structure.inputs, made)
        self.names = tuple(
            states[o] if isinstance(o, str) else Signal(o.name, o.unit)
            for o in self.items
        )
        if len(set(self.names)) < len(self.names):
            raise DefinitionError(
                f"two outputs have the same name: {quoted(self.names)}."
            )

    def __call__(self, a: int, t, q, u) -> jax.Array:
        """All outputs in chart a, shape (ny,); NaN where a chart does not define one."""
        values = []
        for item in self.items:
            function = self._function(item, a)
            value = jnp.nan if function is None else function(t, q, u)
            values.append(jnp.asarray(value, float).reshape(()))
        return jnp.stack(values) if values else jnp.zeros(0)

    def defined(self, a: int) -> bool:
        """Test whether all outputs are defined in chart a."""
        return all(self._function(item, a) is not None for item in self.items)

    def require(self, *charts: int) -> None:
        """Raise if some output is not defined in one of the charts."""
        outputs = list(zip(self.items, self.names, strict=True))
        for a, (item, name) in itertools.product(charts, outputs):
            if self._function(item, a) is None:
                raise DefinitionError(
                    f"output '{name}' is not defined in chart '{self.structure.names[a]}': give a "
                    f"value (`absent = {{'{name}': ...}}` there, or an `Output` for every chart)."
                )

    def _function(self, item: str | Output, a: int):
        if isinstance(item, str):
            return self.structure.state_function(item, a)
        function = item.in_chart(self.structure.names[a])
        if function is None:
            return None
        return lambda t, q, u: function(t, q, self.structure.chart_input(a, t, u))
