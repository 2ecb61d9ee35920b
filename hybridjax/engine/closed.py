"""A system of which only the programs of its functions are left.

What JAX traces of a closed system can depend on these programs only, and on words and numbers that
can be looked at. So it is known by a digest of them (`_core/compilation/fingerprint.py`), also in
another process, where a user's classes and functions could not be told apart.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._core.compilation.fingerprint import Program
from ..systems.chart import Chart
from ..systems.kinds import Kind, Member
from ..systems.output import Output
from ..systems.solver import Method
from ..systems.structure import Structure
from ..systems.system import HybridSystem
from ..systems.transition import Scheduled, Transition
from .target import AbstractLevels


class _Event(NamedTuple):
    """What is left of a transition: the programs of its kind, and its place there. No guard: it is
    scheduled."""

    name: str
    source: str
    target: str
    place: int
    guard: Program | None
    reset: Program
    enabled: Program | None


class _Chart(NamedTuple):
    name: str
    states: tuple[str, ...]
    solver: Method | None
    field: Program


class _Output(NamedTuple):
    name: str
    functions: tuple[tuple[str, Program], ...]
    """Charts that have it, each with a function."""


class _Closed(NamedTuple):
    """What is left of a system."""

    inputs: tuple[str, ...]
    charts: tuple[_Chart, ...]
    events: tuple[_Event, ...]
    outputs: tuple[_Output, ...]


class ClosedSystem(HybridSystem):
    """A system made of programs, with the numbers of one that was written by a user."""

    numbers: list[Array]
    schedules: list[Scheduled | None]
    closed: _Closed = eqx.field(static=True)

    @property
    def inputs(self) -> tuple[str, ...]:
        return self.closed.inputs

    def charts(self):
        return {x.name: _ClosedChart(self.numbers, x) for x in self.closed.charts}

    def transitions(self):
        return [
            Transition(
                x.name,
                x.source,
                x.target,
                self._of_kind(x.guard, x) if schedule is None else schedule,
                reset=self._of_kind(x.reset, x),
                enabled=None if x.enabled is None else self._of_kind(x.enabled, x),
            )
            for x, schedule in zip(self.closed.events, self.schedules, strict=True)
        ]

    def outputs(self):
        return [
            Output(x.name, {chart: self._function(program) for chart, program in x.functions})
            for x in self.closed.outputs
        ]

    def _function(self, program: Program):
        return lambda t, q, u: program(self.numbers, t, q, u)

    def _of_kind(self, program: Program | None, event: _Event) -> "_ClosedFunction":
        assert program is not None
        return _ClosedFunction(self.numbers, event.place, program)


class _ClosedFunction(eqx.Module):
    """A function of a transition, which differs from those of its kind by a place only."""

    numbers: list[Array]
    place: int
    program: Program = eqx.field(static=True)

    def __call__(self, t, q, u):
        return self.program(self.numbers, jnp.asarray(self.place, int), t, q, u)


class _ClosedChart(Chart):
    numbers: list[Array]
    closed: _Chart = eqx.field(static=True)

    @property
    def states(self) -> tuple[str, ...]:
        return self.closed.states

    @property
    def solver(self) -> Method | None:
        return self.closed.solver

    def field(self, t, q, u):
        return self.closed.field(self.numbers, t, q, u)


class ClosedLevels(AbstractLevels):
    """Level functions of a closed system's sections."""

    programs: tuple[Program | None, ...] = eqx.field(static=True)
    """For each chart; none where no section can be crossed."""

    def present(self, s, a):
        return self.programs[a] is not None

    def level(self, s, a, i, t, q):
        program = self.programs[a]
        assert program is not None
        return program(s.system.numbers, jnp.asarray(i, int), t, q)


def close(
    system: HybridSystem, outputs: tuple[str | Output, ...], levels: AbstractLevels | None
) -> tuple[ClosedSystem, ClosedLevels | None]:
    """`system` and `levels` as programs; the system can be asked for `outputs` by their names.

    **Raises:** `IndescribableError` if something has no digest.
    """
    arrays, rest = eqx.partition((system, outputs, levels), eqx.is_array)
    numbers, structure = jax.tree_util.tree_flatten(arrays)
    s, real = Structure(system), jnp.result_type(float)
    array = jax.ShapeDtypeStruct

    def program(function: Callable, *arguments: jax.ShapeDtypeStruct) -> Program:
        def run(numbers, *arguments):
            system, outputs, levels = eqx.combine(structure.unflatten(numbers), rest)
            return function(Structure(system), outputs, levels, *arguments)

        return Program(run, numbers, *arguments)

    def at(a: int) -> tuple[jax.ShapeDtypeStruct, ...]:
        return array((), real), array((s.dims[a],), real), array((s.nu,), real)

    def chart(a: int) -> _Chart:
        field = program(lambda s, z, levels, *x: s.field(a, *x), *at(a))
        return _Chart(s.names[a], tuple(map(str, s.charts[a].states)), s.method(a), field)

    def of_kind(kind: Kind) -> dict[int, _Event]:
        one = s.transitions[kind[0]]
        by_clock = isinstance(one.guard, Scheduled)
        point = array((), jnp.result_type(int)), *at(s.chart_index(one.source))
        guard = lambda s, z, levels, k, *x: s.guard(Member(kind, k), *x)  # noqa: E731
        reset = lambda s, z, levels, k, *x: s.reset(Member(kind, k), *x)  # noqa: E731
        enabled = lambda s, z, levels, k, *x: s.enabled(Member(kind, k), *x)  # noqa: E731
        programs = (
            None if by_clock else program(guard, *point),
            program(reset, *point),
            None if one.enabled is None else program(enabled, *point),
        )
        members = [(g, s.transitions[g]) for g in kind]
        return {
            g: _Event(x.name, x.source, x.target, place, *programs)
            for place, (g, x) in enumerate(members)
        }

    def output(k: int, name: str) -> _Output:
        one = lambda a: lambda s, z, levels, *x: s.resolve_outputs(z[k])(a, *x)[0]  # noqa: E731
        there = [a for a in charts if s.resolve_outputs(outputs[k]).defined(a)]
        return _Output(str(name), tuple((s.names[a], program(one(a), *at(a))) for a in there))

    def level(a: int) -> Program | None:
        if levels is None or not levels.present(s, a):
            return None
        function = lambda s, z, levels, i, t, q: levels.level(s, a, i, t, q)  # noqa: E731
        return program(function, array((), jnp.result_type(int)), *at(a)[:2])

    charts = range(len(s.charts))
    events = {g: event for kind in s.kinds for g, event in of_kind(kind).items()}
    closed = _Closed(
        tuple(map(str, s.inputs)),
        tuple(map(chart, charts)),
        tuple(events[g] for g in sorted(events)),
        tuple(output(k, x) for k, x in enumerate(s.resolve_outputs(outputs).names)),
    )
    schedules = [x.guard if isinstance(x.guard, Scheduled) else None for x in s.transitions]
    of_sections = None if levels is None else ClosedLevels(tuple(map(level, charts)))
    return ClosedSystem(numbers, schedules, closed), of_sections
