"""`linearize`: from a limit cycle and sections to the linear periodic system between the sections
(paper Sec. III).

It returns an `LDTP` with matrices A, B, C, D at each section. `_matrices` computes them from the
Jacobians of the flow from section to section (`PlacedSections.between`) and from derivatives of the
outputs (`_output_jacobians`). There are two ways, which must agree, and `linearize` chooses:

- by a search for the sections: `_matrices_of`; `_of_family` for a cycle that JAX traces, whose
  derivatives outside of programs are `_matrices_along`;
- along the recorded itinerary of a known cycle, if there is one (see `walk.py`): `_on_walk` in a
  program, and `_of_walk` outside, which searches where sections leave the itinerary.

Delays of inputs and outputs are in `Delayed`.

If one way differs from the others, look at its function; if all matrices are wrong, at
`PlacedSections.frames`; if only C and D are, at `_output_jacobians`; if only models with a delay
are, at `Delayed.of`.
"""

from typing import Annotated, Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Numbers, SignalNames
from .._core.boundary.values import Reals
from .._core.compilation import host_first
from .._core.executor import (
    Array,
    is_inside_program,
    is_traced,
    namespace,
    stop_gradient,
)
from .._core.host_derivatives import along_program, by_columns
from .._core.progress import working
from ..engine import kernels
from ..errors import DefinitionError
from ..linear.ldtp import LDTP
from ..orbits.checks import check_outputs
from ..orbits.cycle import LimitCycle
from ..orbits.linear_flow import last_turn, of_flow
from ..orbits.return_map import with_derivatives
from ..systems.structure import Structure
from ..systems.system import Output, OutputNames
from ..systems.transition import TOGETHER
from .families import AbstractSections, BoundSections, ClockPhase, Orbit, as_family
from .place import as_placed, place_along, place_sections
from .placed import PlacedSections, SectionsLike
from .walk import Walk, walk_beside, walked


Delays = Annotated[Numbers, Reals("2", sign="nonnegative")]


@checked
@working("linearize")
def linearize(
    cycle: LimitCycle,
    sections: SectionsLike,
    outputs: OutputNames | None = None,
    inputs: SignalNames | None = None,
    delay: Delays | None = None,
) -> LDTP:
    """Linearize the flow between consecutive sections, eqs. (5) and (6).

    A[n] (d', d) and B[n] (d', nu) map deviations at section n, and the constant input until section
    n+1, to deviations at section n+1. They are exact, through all events in between, also if the
    end of the interval depends on the state. C[n] (ny, d) and D[n] (ny, nu) give the deviations of
    the outputs at section n.

    The coordinates on a section are deviations of the chart's states. On a section given by a level
    function, one state is left out: the one that the flow changes fastest across the section. (Of a
    chart with one state, none remains, and the dimension there is 0.) On a state-based section of a
    system with a clock, the deviation of the time of crossing is the first coordinate.
    `ldtp.coordinates` lists the coordinates.

    **Arguments:**

    - `cycle`: result of `hj.find_limit_cycle`.
    - `sections`: a family, the number of sections of a clock, or `PlacedSections`.
    - `outputs`: names or `Output`s. Default: all states that every chart defines.
    - `inputs`: names. Default: all.
    - `delay`: pair of delays, of the inputs and of the outputs, in the unit of time, for
      `ClockPhase` sections. The input of section n begins to act one delay later; the outputs at
      section n are those of one delay earlier. The coordinates are the states at that earlier time,
      followed by past inputs that still act. Default: none.

    **Returns:** an `LDTP` with N sections: `A` (N, d, d), `B` (N, d, nu), `C` (N, ny, d),
    `D` (N, ny, nu), `dims` (N,) and the `multipliers` (d,).

    **Raises:** `DefinitionError` for an output that is not defined in a chart where a section lies,
    or that depends on the time without the period of a clock; for an input that does not exist; for
    a `delay` with other sections than `ClockPhase`. `ComputationError` if the sections cannot be
    placed on the cycle (see `place_sections`).

    **Example:**

    ```python
    model = hj.linearize(cycle, hj.ClockPhase(8, anchor=apex), ("yM", "vM"))
    print(model.multipliers, model.A.shape)
    exact = model.htf([0.1, 0.2], harmonics=(-1, 0, 1))
    ```

    **Before:** `hj.find_limit_cycle`. **After:** `hj.optimal_design`, `hj.validate`,
    `hj.plot.multipliers`, `hj.convert.to_lti`.
    """
    if delay is not None:
        return Delayed.of(cycle, sections, outputs, inputs, delay).to_ldtp()
    cycle.require_found()
    s = cycle.structure
    traced = is_traced(cycle, sections)
    # (A family is placed later if JAX traces it or the cycle; `placed` is then still the family.)
    of_family = traced and not isinstance(sections, PlacedSections)
    placed: Any = sections if of_family else as_placed(cycle, sections)
    z = check_outputs(cycle, s.states_everywhere() if outputs is None else outputs)
    z.require(
        *(range(len(s.charts)) if traced else np.unique(placed.lanes.chart).tolist())
    )
    names, columns = s.inputs_among(inputs)
    # (See the module.)
    family = as_family(placed) if of_family else None
    walk = None if family is None else walk_beside(cycle, family)
    if family is not None and walk is not None:
        on_walk = _on_walk if is_inside_program() else _of_walk
        items = tuple(z.items)
        A, B, C, D, dims, _ = on_walk(cycle, family, items, walk)
    elif family is not None:
        turn = last_turn(cycle)
        A, B, C, D, dims = _of_family(cycle, family, tuple(z.items), turn)
    else:
        A, B, C, D, dims = _matrices_of(placed, tuple(z.items))
    if not traced:
        A, B, C, D = jax.device_get((A, B, C, D))
        d = int(np.max(np.asarray(dims)))
        A = A[:, :d, :d]
        B = B[:, :d]
        C = C[:, :, :d]
    return LDTP(
        A,
        B[..., columns],
        C,
        D[..., columns],
        dims,
        inputs=names,
        outputs=z.names,
        coordinates=None if traced else placed.coordinates(),
    )


def _matrices_of(
    placed: PlacedSections, outputs: tuple[str | Output, ...]
) -> tuple[Any, ...]:
    return *placed.flow_jacobians, *_output_jacobians(placed, outputs), placed.dims


def _matrices(
    cycle: LimitCycle,
    family: AbstractSections,
    outputs: tuple[str | Output, ...],
    _: Any,
):
    return _matrices_of(place_sections(cycle, family), outputs)


def _matrices_along(arguments: tuple, directions: tuple) -> tuple[tuple, tuple]:
    """`_matrices` on the host, and its derivatives."""
    cycle, family, outputs, turn = arguments
    by_cycle, by_family, *_ = directions
    placed, s, jacobians = place_along(cycle, family, turn, by_cycle, by_family)
    N, P, n, _ = jacobians.shape

    def by_direction(x):
        return x.reshape(N, P, *x.shape[1:])

    embed, select = placed.frames()
    after = np.roll(by_direction(select), -1, axis=0)
    A = after @ jacobians[..., :n] @ by_direction(embed)
    B = after @ jacobians[..., n:]

    def values(a, *point):
        return kernels.outputs(s, a, outputs, *point)

    lanes = placed.lanes
    u = s.pushed(np.arange(N * P) % P)
    by = with_derivatives(s, values, lanes.chart, lanes.t, lanes.q, len(outputs), u)
    by_point = np.moveaxis(by[:, 1:], -1, 0)
    C = by_direction(by_point[..., :n] @ embed)
    D = by_direction(by_point[..., n:])
    matrices, columns = kernels.parted((A, B, C, D))
    return (*matrices, placed.dims[::P]), (*columns, None)


def _on_walk(
    cycle: LimitCycle,
    family: AbstractSections,
    outputs: tuple[str | Output, ...],
    walk: Walk,
):
    """`_matrices` along the recorded itinerary of a known cycle near this one; and the result codes
    of the sections."""
    placed, jacobians = walked(cycle, family, walk)
    matrices = placed.between(jacobians)
    return *matrices, *_output_jacobians(placed, outputs), placed.dims, placed.result


def _on_walk_along(arguments: tuple, directions: tuple) -> tuple[tuple, tuple]:
    """`_on_walk` and its derivatives. If sections leave the recorded itinerary, those of
    `_matrices` on the host."""
    found, columns = along_program(_on_walk)(arguments, directions)
    codes = found[-1]
    if np.any(codes):
        cycle, family, outputs, _ = arguments
        found, columns = _matrices_along((cycle, family, outputs, None), directions)
        found, columns = (*found, np.zeros_like(codes)), (*columns, None)
    return found, columns


def _searched(
    cycle: LimitCycle,
    family: AbstractSections,
    outputs: tuple[str | Output, ...],
    _: Walk,
):
    """`_on_walk` by a search instead, where JAX hides the result codes, so that the search cannot
    be chosen later."""
    matrices = _matrices(cycle, family, outputs, None)
    return *matrices, jnp.zeros(family.n_sections, jnp.int32)


_of_family = by_columns(_matrices, _matrices_along, of_flow)
_of_walk = by_columns(_searched, _on_walk_along, of_flow)


@host_first
def _output_jacobians(
    placed: PlacedSections, outputs: tuple[str | Output, ...]
) -> tuple[Float[Array, "N ny c"], Float[Array, "N ny nu"]]:
    """C and D, padded: derivatives of the outputs with respect to (t, q, u), at u = 0."""
    s = placed.structure()
    lanes = placed.lanes
    items = tuple(outputs)

    def values(a, *point):
        return kernels.outputs(s, a, items, *point)

    by = with_derivatives(s, values, lanes.chart, lanes.t, lanes.q, len(items))
    by_point = namespace(by).moveaxis(by[:, 1:], -1, 0)
    n = 1 + s.d
    embed, _ = placed.frames()
    by_state = by_point[:, :, :n] @ embed
    return by_state, by_point[:, :, n:]


class _Departures(AbstractSections):
    """Sections at the times at which the outputs of a `ClockPhase` leave the system. With two
    `parts`, each is followed by a section at the time at which the next input begins to act."""

    label: ClassVar[str] = "isochron"
    at_anchor: ClassVar[bool] = False
    phase: ClockPhase
    delay: Float[Array, "2"]
    lag: Array
    """Number of whole sections in the sum of both delays."""
    parts: int = eqx.field(static=True)

    n_sections = property(lambda self: self.parts * self.phase.n_sections)  # type: ignore[assignment]
    anchor = property(lambda self: self.phase.anchor)  # type: ignore[assignment]

    def check(self, s: Structure) -> None:
        self.phase.check(s)

    def bind(self, s: Structure, orbit: Orbit) -> BoundSections:
        leave = self.phase.bind(s, orbit).time - self.delay[1]
        step = orbit.period
        lag = self.lag * step / self.phase.n_sections
        change = leave + self.delay.sum() - lag
        return BoundSections.at_times(
            jnp.stack([leave, change][: self.parts], axis=1).ravel()
        )

    def describe(self, i: int) -> str:
        when = ("when outputs leave", "when the next input acts")[i % self.parts]
        return f"section {i // self.parts}, {when}"


class Delayed(NamedTuple):
    """A linear system with delays. Its inputs at section n are those of `lag` sections earlier.
    Unless inputs begin to act exactly at a section, the inputs of one more section earlier are
    further inputs."""

    model: LDTP
    lag: Array
    inputs: tuple[str, ...]

    @classmethod
    def of(
        cls,
        cycle: LimitCycle,
        sections: SectionsLike,
        outputs: OutputNames | None,
        inputs: SignalNames | None,
        delay: Numbers,
    ) -> "Delayed":
        """**Raises:** `DefinitionError` for sections other than a `ClockPhase`."""
        phase = sections.family if isinstance(sections, PlacedSections) else sections
        if not isinstance(phase, ClockPhase):
            raise DefinitionError(
                f"`delay` needs sections at equal times, `ClockPhase`, not {type(phase).__name__}."
            )
        delay = jnp.asarray(delay, float)
        whole = delay.sum() * phase.n_sections / cycle.period
        lag = stop_gradient(jnp.floor(whole + TOGETHER))
        # (Two sections at the same time would be refused.)
        together = False
        if not is_traced(cycle, delay):
            together = bool(whole - lag < 2 * TOGETHER)
        family = _Departures(phase, delay, lag, 1 if together else 2)  # type: ignore[call-arg,arg-type]
        model = linearize(cycle, family, outputs, inputs)
        if together:
            return cls(model, lag, model.inputs)
        A, B, C, D, dims = model.matrices
        after_both = A[1::2] @ B[::2]
        B = jnp.concatenate([B[1::2], after_both], axis=2)
        even = D[::2]
        D = jnp.concatenate([0 * even, even], axis=2)
        names = *model.inputs, *(f"{x} before" for x in model.inputs)
        over_both = A[1::2] @ A[::2]
        C_of_both = C[::2]
        model = LDTP(over_both, B, C_of_both, D, dims[::2], names, model.outputs)
        return cls(model, lag, names[: len(names) // 2])

    def htf(
        self, f: Float[Array, " F"], harmonics: tuple[int, ...]
    ) -> Complex[Array, "M F ny nu"]:
        """Return the HTFs, also for a traced lag."""
        H = self.model.htf(f, harmonics).H
        rates = -2j * jnp.pi * f[:, None, None]
        turn = rates / self.model.n_sections
        halves = jnp.split(H, H.shape[3] // len(self.inputs), axis=3)
        return sum(jnp.exp((self.lag + k) * turn) * x for k, x in enumerate(halves))

    def to_ldtp(self) -> LDTP:
        """Return the system with past inputs as states.

        **Raises:** `DefinitionError` for a traced lag.
        """
        if is_traced(self.lag):
            raise DefinitionError(
                "the delays decide on the number of states: they cannot be traced. To fit delays, "
                "give them to `ObservedHTF`."
            )
        nu = len(self.inputs)
        wide = len(self.model.inputs)
        first = int(self.lag) * nu
        past = first + wide - nu
        if not past:
            return self.model
        unit = np.eye(past + nu)
        rows = np.tile(unit, (self.model.n_sections, 1, 1))
        (B, A), (D, C) = (
            np.split(rows[:, part], [nu], axis=2)
            for part in (slice(past), slice(first, first + wide))
        )
        return self.model @ LDTP(
            A, B, C, D, inputs=self.inputs, outputs=self.model.inputs
        )
