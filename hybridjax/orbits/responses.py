"""Responses of a cycle to brief pushes: how much its phase and the amplitudes of its Floquet modes
change.

The phase response Z of a cycle satisfies dZ/dt = -(Df)^T Z along it, Z(t-)^T = Z(t+)^T S at events
with the saltation matrix S, and Z . f = 1. The response I of the amplitude of a mode with the
multiplier exp(kappa T) satisfies dI/dt = -(Df - kappa)^T I with the same jumps, and I . v = 1 for
the mode v (G. B. Ermentrout, D. H. Terman, Mathematical foundations of neuroscience, Springer 2010,
Ch. 8; D. Wilson, J. Moehlis, Phys. Rev. E 94, 2016).

`LimitCycle.responses` calls `responses`, which gets Z and I at the nodes of the `LinearFlow` of the
cycle (P pieces of K nodes, see `linear_flow.py`) and returns a `Responses`. A *push* is a brief
input or a jump of a state; a *covector* is the response to all states. The multipliers and modes
are in `modes.py`, the effect of a periodic push in `coupling.py`, the phase of states that are not
near the cycle in `asymptotic_phase.py`. `PhaseCurve` is also the type of measured responses. The
normalizations above must stay, and so must `Responses.of_phase` in units of time: other files use
both.

If Z is wrong everywhere, look at `closing`, which gives it at phase 0; if it is wrong away from
phase 0, at `LinearFlow.covectors`. If an amplitude has the wrong scale everywhere, look at
`modes._scaled`; if it is wrong away from phase 0, at `_along_cycle`. If the effect of an input at
an event is wrong, look at `Responses.impulses`.
"""

import functools as ft
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Inexact

from .._core.arguments import require_index
from .._core.boundary.checked import checked_methods
from .._core.boundary.kinds import Count, Index
from .._core.boundary.members import leading_on
from .._core.compilation import one_program
from .._core.executor import (
    Array,
    is_traced,
    namespace,
    on_host,
    svdvals,
    to_host,
)
from .._core.meaning import require_as_made
from .._core.showable import Showable
from .._core.signal import unit_of
from .._core.text import fields, number
from ..engine import kernels
from ..errors import ComputationError, DefinitionError
from ..systems.structure import Structure
from ..systems.surfaces import SlidingChart
from ..systems.system import name_of
from .coupling import Coupling, mean_effect
from .linear_flow import LinearFlow, Phases, by_name, linear_flow
from .modes import modes_of
from .return_map import SINGULAR, ReturnMap
from .scale import in_sizes


Unit = Literal["time", "cycles", "radians"]


class PhaseCurve(Showable, eqx.Module):
    """The phase response to one input over one cycle: computed from a model, or measured.

    **Fields:** `phase` (n,), in cycles; `values` (n,), in cycles per unit of time and of the input,
    with NaN between both sides of an event; `input`; `time_unit`.
    """

    phase: Float[np.ndarray, " n"]
    values: Float[np.ndarray, " n"]
    input: str = eqx.field(static=True)
    time_unit: str = eqx.field(static=True, default="s", kw_only=True)

    __repr__ = fields

    @property
    def unit(self) -> str:
        """The unit of the values."""
        unit = unit_of(self.input)
        time = self.time_unit or "time"
        return f"cycles / ({unit} {time})" if unit else f"cycles / {time} / input"


@leading_on
class Impulse(NamedTuple):
    """The response to an input that acts at an event, through a guard or a reset: the value of the
    input at the event, times `weight`, changes the phase or the amplitude."""

    event: str
    phase: Float[Array, ""]
    weight: dict[str, Inexact[Array, ""]]
    """Change per unit of each input, by name of the input."""


# How messages call the time at which responses were computed.
_MADE = "these responses were computed"


@checked_methods
class Responses(Showable, eqx.Module):
    """Responses of a limit cycle to brief pushes, at every phase (see `LimitCycle.responses`).

    Phase 0 is the anchor of the cycle. At an event, responses are those right after it. In a chart
    of sliding (`hj.systems.filippov`), a push off the surface is followed by the return to it.

    **Fields:**

    - `period`; `multipliers` (r,) and `exponents` (r,), per unit of time, of the modes that have
        amplitudes, by decreasing modulus.
    - `modes` (r, d): the modes at phase 0. Their scale follows from the response of an amplitude to
        the states at this phase: it is a vector of length 1 (in units of the states) whose largest
        entry is real.
    - `left_out`: number of modes without an amplitude: with multipliers below 1e-6, and those that
        events or sliding remove at once.
    """

    structure: Structure
    flow: LinearFlow
    period: Float[Array, ""]
    multipliers: Complex[Array, " r"]
    exponents: Complex[Array, " r"]
    modes: Inexact[Array, "r d"]
    left_out: int = eqx.field(static=True)
    event_sequence: tuple[int, ...] = eqx.field(static=True)
    of_phase: Float[Array, "P K d"] | None
    """The phase response in time; `None` if clocked."""
    of_amplitudes: Inexact[Array, "r P K d"]
    surface: Float[Array, "P K d d"]
    """Derivative of the state after a push by the push: a part of it is lost where the state slides
    on a surface."""

    def phase(
        self, phase: Phases, unit: Unit = "time"
    ) -> dict[str, Float[Array, " p"]]:
        """Change of the phase after a brief push at some phases, by names of states and inputs.

        For a state, it is the change of phase per change of the state; for an input, per unit of
        input and time. It is NaN in charts that lack the state. In units of `"time"`, an advance of
        the cycle in its unit of time; in `"cycles"` or `"radians"`.

        **Raises:** `DefinitionError` for a cycle that is driven by a clock.
        """
        require_as_made(self.structure.system, _MADE)
        scales = {
            "time": 1.0,
            "cycles": 1 / self.period,
            "radians": 2 * np.pi / self.period,
        }
        return self._named(self._covector(None), phase, scales[unit])

    def amplitude(self, mode: Index, phase: Phases) -> dict[str, Inexact[Array, " p"]]:
        """Change of the amplitude of a mode after a brief push at some phases, by names of states
        and inputs; complex unless its multiplier is positive.

        An amplitude a moves the state by a times the mode, plus the conjugate if the multiplier is
        complex, and changes by the factor exp(exponent * t) in a time t. Real and imaginary parts
        are two real amplitudes.

        **Raises:** `DefinitionError` for a mode that does not exist.
        """
        require_as_made(self.structure.system, _MADE)
        return self._named(self._covector(mode), phase)

    def impulses(self, mode: Index | None = None) -> tuple[Impulse, ...]:
        """The responses of the phase (in time), or of the amplitude of a mode, to inputs that act
        at events."""
        require_as_made(self.structure.system, _MADE)
        xp = namespace(self.period)
        jumps = self.flow.jumps
        s = self.structure
        last_covector = self._covector(mode)[:, 0]
        after = xp.roll(last_covector, -1, axis=0)
        weight = xp.einsum("pi,piu->pu", after, jumps.by_input)
        # Pieces that end in events first: these are as many as there are events.
        place = xp.argsort(self.flow.event < 0, stable=True)
        phases = (self.flow.turn + self.flow.length) / self.period
        return tuple(
            Impulse(
                s.transitions[g].name,
                phases[k],
                dict(zip(s.inputs, weight[k], strict=True)),
            )
            for g, k in zip(self.event_sequence, place, strict=False)
        )

    def curve(self, input: str | None = None) -> PhaseCurve:
        """The phase response to an input over the cycle, of the type that measured ones have.
        Default: the first input.

        **Raises:** `DefinitionError` for an input that does not exist or acts at events, for a
        cycle that is driven by a clock, and inside of transformations of JAX.
        """
        signal, response = self._pushed(input)
        if any(x.weight[signal] != 0 for x in self.impulses()):
            where = "at events, too" if np.any(response) else "at events alone"
            raise DefinitionError(
                f"'{signal}' acts {where}: see `impulses()`, which a curve does not contain."
            )
        flow = to_host(self.flow)
        period = float(self.period)
        phase = (flow.t - flow.t[0, 0]) / period
        values = response / period
        # (NaN separates a piece that ends in an event from the next one.)
        behind = np.where(flow.event >= 0, np.nan, values[:, -1])
        phase = np.concatenate([phase, phase[:, -1:]], axis=1)
        values = np.concatenate([values, behind[:, None]], axis=1)
        time_unit = self.structure.system.time_unit
        return PhaseCurve(phase.ravel(), values.ravel(), signal, time_unit=time_unit)

    def coupling(
        self, push: Callable | str, input: str | None = None, harmonics: Count = 64
    ) -> Coupling:
        """Mean effect of a weak periodic push on the phase, by the lead of the push.

        **Arguments:**

        - `push`: a function of phases (P,) in cycles, or the name of a state of an equal cycle.
        - `input`: the input through which it acts. Default: the first.
        - `harmonics`: number of harmonics of the push and of the response. Default: 64.

        **Raises:** `DefinitionError` for names that do not exist, too few harmonics, and a cycle
        that is driven by a clock.
        """
        signal, response = self._pushed(input)
        impulses = [(x.phase, x.weight[signal]) for x in self.impulses()]
        return mean_effect(
            self.structure,
            self.flow,
            self.period,
            response,
            impulses,
            push,
            harmonics,
        )

    def __repr__(self):
        name = name_of(self.structure.system)
        if is_traced(self):
            return f"Responses({name}, traced)"
        kinds = ["no phase (driven by a clock)" if self.of_phase is None else "phase"]
        kinds += [
            f"amplitude {k}: exponent {number(x)}" for k, x in enumerate(self.exponents)
        ]
        if self.left_out:
            kinds.append(f"{self.left_out} faster modes left out")
        acting = self.flow.event[np.any(self.flow.jumps.by_input, axis=(1, 2))]
        if len(acting):
            names = dict.fromkeys(self.structure.transitions[g].name for g in acting)
            kinds.append(f"inputs act at {', '.join(names)}: see `impulses()`")
        period = number(self.period, 9, self.structure.system.time_unit)
        return f"Responses({name}: period {period})" + "".join(
            f"\n  {x}" for x in kinds
        )

    def _pushed(self, name: str | None) -> tuple[str, Float[Array, "P K"]]:
        """An input (Default: the first), and the response of the phase to it at the nodes."""
        require_as_made(self.structure.system, _MADE)
        (name, *_), columns = self.structure.inputs_among(
            name if name is None else [name]
        )
        by_input = self.flow.by_input[..., columns[0]]
        products = self._covector(None) * by_input
        return name, namespace(by_input).sum(products, axis=-1)

    def _covector(self, mode: int | None) -> Inexact[Array, "P K d"]:
        """The response of the phase (for None), or of the amplitude of a mode, to all states.

        **Raises:** `DefinitionError` for the phase of a clock, and for a mode that does not exist.
        """
        if mode is None:
            if self.of_phase is None:
                raise DefinitionError(
                    f"{name_of(self.structure.system)} has no phase response: its phase is "
                    "that of its clock; `responses.amplitude(0, phase)` is the response of its "
                    "first mode."
                )
            return self.of_phase
        require_index("mode with an amplitude", mode, len(self.exponents))
        return self.of_amplitudes[mode]

    @one_program
    def _named(
        self, covector: Inexact[Array, "P K d"], phase: Phases, scale: Array = 1.0
    ) -> dict[str, Array]:
        """A response at some phases, times `scale`, by names of states and inputs."""
        flow = self.flow
        s = self.structure
        xp = namespace(flow.q)
        to_inputs = xp.einsum("pki,pkiu->pku", covector, flow.by_input)
        to_states = xp.einsum("pki,pkij->pkj", covector, self.surface)
        chart, states, inputs = flow.at(phase, self.period, to_states, to_inputs)
        of_inputs = dict(zip(s.inputs, inputs.T, strict=True))
        named = by_name(s, chart, states) | of_inputs
        return {name: value * scale for name, value in named.items()}


def responses(cycle: Any, modes: int | None) -> Responses:
    """The responses of a cycle (see `LimitCycle.responses`)."""
    return _responses(cycle, linear_flow(cycle), modes)


@one_program
def _responses(cycle: Any, flow: LinearFlow, modes: int | None) -> Responses:
    """The responses, from the linear flow: those at phase 0 first, then those along the cycle."""
    host = on_host(flow.t)
    xp = namespace(flow.t)
    map = cycle.return_map
    period = map.expected
    clocked = map.base is None
    monodromy = flow.monodromy(map.valid)
    field = flow.field[0, 0]
    begin = closing(map, monodromy, field).phase
    if modes is None and not host:
        raise DefinitionError(
            "`responses` needs the number of `modes` inside of `grad` and `jvp`."
        )
    # (Changes of the phase are removed: the multiplier 1 becomes 0.)
    without_phase = monodromy - field[:, None] * begin
    multipliers, right, left = modes_of(without_phase, map.sizes, modes)
    exponents = xp.log(multipliers + 0j) / period
    of_phase = None if clocked else flow.covectors(begin[:, None])[..., 0]
    of_amplitudes = _along_cycle(flow, period, left, exponents, of_phase)
    if host and not np.any(np.iscomplex(exponents)):
        of_amplitudes, right, exponents = (
            np.real(x) for x in (of_amplitudes, right, exponents)
        )
    total = int(np.sum(map.valid)) - (not clocked) if host else len(multipliers)
    return Responses(
        structure=map.structure,
        flow=flow,
        period=period,
        multipliers=multipliers,
        exponents=exponents,
        modes=right,
        left_out=total - len(multipliers),
        event_sequence=cycle.event_sequence,
        of_phase=of_phase,
        of_amplitudes=of_amplitudes,
        surface=effect_of_pushes(map.structure, flow),
    )


def _along_cycle(
    flow: LinearFlow,
    period: Float[Array, ""],
    left: Inexact[Array, "r d"],
    exponents: Complex[Array, " r"],
    of_phase: Float[Array, "P K d"] | None,
) -> Inexact[Array, "r P K d"]:
    """The responses of amplitudes at all nodes, from those at phase 0 (`left`).

    Phase 0 is also the end of the turn, from which covectors are carried back. They then contain
    the decay of the mode until the end, which is divided out. A push along the field changes the
    phase alone: a part along it is a rounding error, and is taken out.
    """
    xp = namespace(flow.t)
    carried = xp.moveaxis(flow.covectors(left.T), -1, 0)
    to_go = period - (flow.t - flow.t[0, 0])[..., None]
    rates = exponents[:, None, None, None]
    amplitudes = carried * xp.exp(-rates * to_go)
    if of_phase is None:
        return amplitudes
    along_field = xp.einsum("rpki,pki->rpk", amplitudes, flow.field)
    return amplitudes - along_field[..., None] * of_phase


class Closing(NamedTuple):
    """The equation of a cycle that closes after a turn, with the monodromy matrix M, the field f at
    phase 0 and a vector w with w . f = 1."""

    matrix: Float[Array, "d d"]
    """M - I + f w^T, which is regular if the multiplier 1 is simple. With a clock, M - I."""
    phase: Float[Array, " d"]
    """The phase response at phase 0. With a clock, zeros."""


def closing(
    map: ReturnMap, monodromy: Float[Array, "d d"], f: Float[Array, " d"]
) -> Closing:
    """The equation of a cycle with this monodromy matrix.

    **Raises:** `ComputationError` if the multiplier 1 is not simple.
    """
    xp = namespace(f)
    size = map.sizes
    if map.base is None:
        return Closing(monodromy - xp.eye(len(f)), xp.zeros_like(f))
    w = f / size**2
    w = w / (w @ f)
    back = f[:, None] * w
    matrix = monodromy - xp.eye(len(f)) + back
    if on_host(f):
        smallest = svdvals(in_sizes(matrix, size))[-1]
        if map.conserved or not smallest > SINGULAR:
            raise ComputationError(
                "the cycle has no defined phase: its multiplier 1 is double, as in a family of "
                "cycles with a conserved quantity, where pushes change the period."
            )
    return Closing(matrix, xp.linalg.solve(matrix.T, w))


def effect_of_pushes(s: Structure, flow: LinearFlow) -> Float[Array, "P K d d"]:
    """Derivatives of the state after a push by the push: identities, but for charts of sliding."""
    if not any(isinstance(chart, SlidingChart) for chart in s.charts):
        return namespace(flow.q).broadcast_to(np.eye(s.d), flow.by_state.shape)
    returned = ft.partial(kernels.linear, s, _returned)
    effect = flow.evaluated(s, returned, s.d**2)
    return effect[..., 0].reshape(flow.by_state.shape)


def _returned(a: int, s: Structure, t, q, u):
    """The derivative of the state of chart a after a push by the push, padded and in one row."""
    chart = s.charts[a]
    effect = jnp.eye(len(q))
    if isinstance(chart, SlidingChart):
        effect = chart.returned(t, q, s.chart_input(a, t, u))
    return jnp.pad(effect, (0, s.d - len(q))).ravel()
