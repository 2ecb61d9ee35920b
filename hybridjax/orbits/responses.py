"""Responses of a cycle to brief pushes: how much its phase and the amplitudes of its Floquet modes
change.

The phase response Z of a cycle satisfies dZ/dt = -(Df)^T Z along it, Z(t-)^T = Z(t+)^T S at events
with the saltation matrix S, and Z . f = 1. The response I of the amplitude of a mode with the
multiplier exp(kappa T) satisfies dI/dt = -(Df - kappa)^T I with the same jumps, and I . v = 1 for
the mode v (G. B. Ermentrout, D. H. Terman, Mathematical foundations of neuroscience, Springer 2010,
Ch. 8; D. Wilson, J. Moehlis, Phys. Rev. E 94, 2016).

`LimitCycle.responses` calls `responses`, which gets Z and I at the nodes of the `LinearFlow` of the
cycle (`linear_flow.py`) and returns a `Responses`. `loop` gives Z at phase 0, and `_modes` the
multipliers and modes. A *push* is a brief input or a jump of a state.
"""

import functools as ft
from collections.abc import Callable
from typing import Annotated, Any, Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Inexact

from .._core.arguments import require_among, require_index
from .._core.boundary.checked import checked_methods
from .._core.boundary.kinds import Count, Index, Numbers
from .._core.boundary.members import leading_on
from .._core.boundary.values import Reals
from .._core.compilation import at_ease, one_program
from .._core.executor import (
    Array,
    is_traced,
    namespace,
    on_host,
    stop_gradient,
    svdvals,
    to_host,
)
from .._core.meaning import require_as_made
from .._core.results import Result
from .._core.showable import Showable
from .._core.signal import unit_of
from .._core.text import fields, number
from ..engine import kernels
from ..engine.lanes import lane_at
from ..engine.move import move
from ..engine.target import toward
from ..errors import ComputationError, DefinitionError
from ..systems.structure import Structure
from ..systems.surfaces import SlidingChart
from ..systems.system import name_of
from .crossing import to_section
from .linear_flow import NODES, LinearFlow, by_name, linear_flow
from .return_map import SINGULAR, ReturnMap
from .scale import in_sizes


# Modes with multipliers below this modulus have no amplitude response. Smaller: rounding errors,
# divided by the multiplier, take the place of digits. Larger: slower modes are left out.
_LEAST = 1e-6

Unit = Literal["time", "cycles", "radians"]
Phases = Annotated[Numbers, Reals("p")]


class PhaseCurve(Showable, eqx.Module):
    """The phase response to one input over one cycle: computed from a model, or measured.

    **Fields:** `phase` (P,), in cycles; `values` (P,), in cycles per unit of time and of the input,
    with NaN between both sides of an event; `input`; `time_unit`.
    """

    phase: Float[np.ndarray, " P"]
    values: Float[np.ndarray, " P"]
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


@leading_on
class Locked(NamedTuple):
    """A state in which phases move together: `lead` of the push, in cycles, and the `rate` at which
    deviations grow, per time and strength of the push. The rate is negative if the state is
    stable."""

    lead: float
    rate: float


@checked_methods
class Coupling(Showable, eqx.Module):
    r"""Mean effect of a weak push, by its lead $\psi$ in cycles (see `Responses.coupling`).

    The rate of the phase is $f_0 + \varepsilon \Gamma(\psi)$ in cycles per time under a push of the
    strength $\varepsilon$. `coupling(lead)` returns $\Gamma$ at one or several leads $\psi$.

    **Fields:** `coefficients` (n,): those of $e^{2 \pi i n \psi}$ in $\Gamma$, n = 0, 1, ...
    """

    coefficients: Complex[Array, " n"]

    def __call__(self, lead: Phases) -> Float[Array, " p"]:
        xp = namespace(self.coefficients)
        n = np.arange(len(self.coefficients))
        angle = 2j * np.pi * xp.asarray(lead)[..., None]
        waves = xp.exp(angle * n)
        twice = np.where(n == 0, 1, 2)
        return xp.real(waves @ (self.coefficients * twice))

    __repr__ = fields

    @property
    def locking(self) -> tuple[float, float]:
        """The Arnold tongue, to first order: least and largest difference between the frequency of
        a push that entrains the cycle and the frequency of the cycle, per strength of the push."""
        values = self([x.lead for x in self._slope._zeros()] or [0.0])
        return float(values.min()), float(values.max())

    def locked(self, mutual: bool = False) -> tuple[Locked, ...]:
        """The leads at which the phases stay together, if the push has the frequency of the cycle.

        **Arguments:** `mutual`: whether the push comes from an equal cycle that is pushed in
        return. Default: False.
        """
        c = to_host(self.coefficients)
        return Coupling(np.conj(c) - c if mutual else -c)._zeros()

    @property
    def _slope(self) -> "Coupling":
        c = to_host(self.coefficients)
        rates = 2j * np.pi * np.arange(len(c))
        return Coupling(rates * c)

    def _zeros(self) -> tuple[Locked, ...]:
        """Zeros in one cycle, with their slopes."""
        from scipy import optimize  # (a third of a second)

        steps = 16 * len(self.coefficients)
        grid = (np.arange(steps + 1) - 0.5) / steps
        sign = np.sign(self(grid))

        def value(x):
            return float(self([x])[0])

        products = sign[:-1] * sign[1:]
        crossed = np.flatnonzero(products < 0)
        roots = [
            optimize.brentq(value, *grid[k : k + 2], full_output=True)[0]
            for k in crossed
        ]
        locked = []
        for x in roots:
            slope = float(self._slope([x])[0])
            locked.append(Locked(x % 1.0, slope))
        return tuple(locked)


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
        signal, pushed = self._pushed(input)
        if any(x.weight[signal] != 0 for x in self.impulses()):
            raise DefinitionError(f"'{signal}' acts at events alone: see `impulses()`.")
        flow = to_host(self.flow)
        period = float(self.period)
        phase = (flow.t - flow.t[0, 0]) / period
        # (A piece that ends in an event is separated from the next one.)
        at_end = pushed[:, -1]
        end = np.where(flow.event >= 0, np.nan, at_end)
        tail = end / period
        pairs = (phase, phase[:, -1]), (pushed / period, tail)
        phase, values = (
            np.concatenate([x, y[:, None]], axis=1).ravel() for x, y in pairs
        )
        return PhaseCurve(
            phase, values, signal, time_unit=self.structure.system.time_unit
        )

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
        flow = self.flow
        xp = namespace(self.flow.q)
        period = self.period
        signal, pushed = self._pushed(input)
        # Nodes within parts of pieces that resolve the fastest wave.
        parts = 1 + harmonics // 2
        x, weight = np.polynomial.legendre.leggauss(NODES)
        begin_of_part = np.arange(parts)[:, None]
        x = ((begin_of_part + (x + 1) / 2) / parts).ravel()
        since = flow.length[:, None] * x
        times = flow.turn[:, None] + since
        phase = (times / period).ravel()
        weight = (
            flow.length[:, None] / period * np.tile(weight / 2 / parts, parts)
        ).ravel()
        chart, Z, states = flow.at(phase, period, pushed, flow.q)
        if isinstance(push, str):
            require_among("state", [push], self.structure.state_names(), "`push`: ")
            wave = by_name(self.structure, chart, states)[push]
        else:
            wave = xp.asarray(push(phase), float)
        n = np.arange(harmonics + 1)
        exponent = -2j * np.pi * n[:, None] * phase
        waves = xp.exp(exponent)
        weight = waves * weight
        wave = weight @ wave
        response = weight @ Z
        for x in self.impulses():
            wave_there = xp.exp(-2j * np.pi * n * x.phase)
            response += wave_there * x.weight[signal] / period
        c = xp.conj(response) * wave / period
        if on_host(c):
            last_quarter = c[len(c) * 3 // 4 :]
            largest_late = np.abs(last_quarter).max()
            if largest_late > 1e-3 * np.abs(c).max():
                raise DefinitionError(
                    f"`harmonics` = {harmonics} does not resolve jumps of the push."
                )
        return Coupling(c)

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
        flow = self.flow
        s = self.structure
        xp = namespace(flow.q)
        pushed = xp.einsum("pki,pkiu->pku", covector, flow.by_input)
        covector = xp.einsum("pki,pkij->pkj", covector, self.surface)
        chart, states, inputs = flow.at(phase, self.period, covector, pushed)
        of_inputs = dict(zip(s.inputs, inputs.T, strict=True))
        named = by_name(s, chart, states) | of_inputs
        return {name: value * scale for name, value in named.items()}


def responses(cycle: Any, modes: int | None) -> Responses:
    """The responses of a cycle (see `LimitCycle.responses`)."""
    return _responses(cycle, linear_flow(cycle), modes)


@one_program
def _responses(cycle: Any, flow: LinearFlow, modes: int | None) -> Responses:
    host = on_host(flow.t)
    xp = namespace(flow.t)
    map = cycle.return_map
    period = map.expected
    clocked = map.base is None
    whole = flow.monodromy(map.valid)
    _, Z = loop(map, whole, flow.field[0, 0])
    whole = whole - flow.field[0, 0, :, None] * Z
    if modes is None and not host:
        raise DefinitionError(
            "`responses` needs the number of `modes` inside of `grad` and `jvp`."
        )
    values, right, left = _modes(whole, map.sizes, modes)
    exponents = xp.log(values + 0j) / period
    phase = None if clocked else flow.covectors(Z[:, None])[..., 0]
    # Amplitudes grow by their exponents; rounding adds responses of the phase.
    since = flow.t - flow.t[0, 0]
    to_go = period - since[..., None]
    amplitudes = xp.moveaxis(flow.covectors(left.T), -1, 0)
    rates = exponents[:, None, None, None]
    amplitudes = amplitudes * xp.exp(-rates * to_go)
    if phase is not None:
        slip = xp.einsum("rpki,pki->rpk", amplitudes, flow.field)
        amplitudes = amplitudes - slip[..., None] * phase
    if host and not np.any(np.iscomplex(exponents)):
        amplitudes, right, exponents = (
            np.real(x) for x in (amplitudes, right, exponents)
        )
    total = int(np.sum(map.valid)) - (not clocked) if host else len(values)
    off = surface(map.structure, flow)
    return Responses(
        map.structure,
        flow,
        period,
        values,
        exponents,
        right,
        total - len(values),
        cycle.event_sequence,
        phase,
        amplitudes,
        off,
    )


def asymptotic_phase(
    cycle: Any, chart: str, state: Float[np.ndarray, " n"], turns: int
) -> float:
    """The asymptotic phase of a state (see `LimitCycle.asymptotic_phase`)."""
    map = cycle.return_map
    period = float(cycle.period)
    s = map.structure
    a = map.structure.chart_index(chart)
    begin = lane_at(s, chart, state, map.anchor.t[0], "`state`")
    lanes = begin
    phase = responses(cycle, 0)._covector(None)[0, 0]
    size = map.sizes
    near = np.sqrt(map.settings.rtol)  # its square is the error of a linear phase
    surface = getattr(s.charts[a], "surface", None)
    if surface is not None and abs(float(surface(map.anchor.t[0], state))) > near:
        raise DefinitionError(
            f"`state` does not lie on the surface on which '{chart}' slides."
        )
    for _ in range(turns):
        never = np.full(1, np.inf)
        target = toward(never, -1, lanes.t + 3 * period)
        target = to_section(target, map.base, map.event)
        with at_ease():
            no_input = np.zeros((s.nu, 1))
            moved = move(s, lanes, no_input, target, map.settings).moved
        lanes = moved.lanes
        if moved.result[0] != Result.OK:
            break
        off = (lanes.q - map.anchor.q)[:, 0]
        if lanes.chart[0] == map.anchor.chart[0] and np.abs(off / size).max() < near:
            late = (lanes.t - begin.t)[0]
            return float((phase @ off - late) / period % 1.0)
    raise ComputationError(
        f"the state did not come to the cycle within {turns} crossings of its section (at t = "
        f"{lanes.t[0]:.6g}: {Result(int(moved.result[0])).message}): start nearer to a stable "
        "cycle, or allow more `cycles`."
    )


def loop(map: ReturnMap, monodromy: Float[Array, "d d"], f: Float[Array, " d"]):
    """The matrix M - I + f w^T with w . f = 1, which is regular if the multiplier 1 is simple; and
    the phase response at the beginning. In a clocked system: M - I, and zeros.

    **Raises:** `ComputationError` if the multiplier 1 is not simple.
    """
    xp = namespace(f)
    size = map.sizes
    if map.base is None:
        return monodromy - xp.eye(len(f)), xp.zeros_like(f)
    along = f / size**2
    along = along / (along @ f)
    back = f[:, None] * along
    closed = monodromy - xp.eye(len(f)) + back
    if on_host(f):
        smallest = svdvals(in_sizes(closed, size))[-1]
        if map.conserved or not smallest > SINGULAR:
            raise ComputationError(
                "the cycle has no defined phase: its multiplier 1 is double, as in a family of "
                "cycles with a conserved quantity, where pushes change the period."
            )
    return closed, xp.linalg.solve(closed.T, along)


def _modes(M: Float[Array, "d d"], size: Float[Array, " d"], count: int | None):
    """Multipliers, right and left eigenvectors of M, by decreasing modulus.

    **Raises:** `ComputationError` for multipliers that coincide.
    """
    xp = namespace(M)
    scaled = in_sizes(M, size)
    values, right = xp.linalg.eig(stop_gradient(scaled))
    lower_last = 1e-9 * (xp.imag(values) < 0)
    order = xp.argsort(-xp.abs(values) + lower_last, stable=True)
    if on_host(M):
        kept = int(np.sum(np.abs(values) > _LEAST))
        count = kept if count is None else count
        if count > kept:
            raise DefinitionError(
                f"{count} modes were asked for; {kept} have amplitudes."
            )
    modes = []
    for k in order[:count]:
        modes.append(_mode(scaled, size, values[k], right[:, k]))
    if not modes:
        return values[:0], right[:0], right[:0]
    return tuple(xp.stack(x) for x in zip(*modes, strict=True))


def _mode(M: Float[Array, "d d"], size: Float[Array, " d"], value, right):
    """An eigenvalue of M with its right and left eigenvectors, in units of the states. One Newton
    step from an approximation also gives them derivatives.

    **Raises:** `ComputationError` for an eigenvalue that coincides with another one.
    """
    xp = namespace(M)
    n = len(M)
    still = stop_gradient(M)

    def pair(M, still, x):
        shifted = still - value * np.eye(n)
        matrix = xp.concatenate([shifted, xp.conj(x)[None]])
        column = xp.append(-x, 0.0)[:, None]
        off = xp.append(M @ x - value * x, 0.0)
        step = xp.linalg.solve(xp.concatenate([matrix, column], axis=1), off)
        return x - step[:n], value - step[n]

    *_, rows = xp.linalg.svd(still.T - value * np.eye(n))  # the last is contracted most
    right, root = pair(M, still, right)
    last = xp.conj(rows[-1])
    left, _ = pair(M.T, still.T, last)
    if on_host(M):
        lengths = np.linalg.norm(left) * np.linalg.norm(right)
        apart = np.abs(left @ right) / lengths
        if not apart > SINGULAR:
            raise ComputationError(
                "two multipliers coincide, and their modes have no amplitudes of their own: "
                "ask for the phase alone by `modes=0`, or change a parameter."
            )
    largest = left[xp.argmax(xp.abs(left))]
    left = left / size
    left = (
        left * xp.conj(largest) / xp.abs(largest) / xp.sqrt(xp.sum(xp.abs(left) ** 2))
    )
    return root, right * size / (left @ (right * size)), left


def surface(s: Structure, flow: LinearFlow) -> Float[Array, "P K d d"]:
    """The effect of pushes in charts of sliding; identity in others."""
    if not any(isinstance(chart, SlidingChart) for chart in s.charts):
        return namespace(flow.q).broadcast_to(np.eye(s.d), flow.by_state.shape)
    returned = ft.partial(kernels.linear, s, _returned)
    effect = flow.evaluated(s, returned, s.d**2)
    return effect[..., 0].reshape(flow.by_state.shape)


def _returned(a: int, s: Structure, t, q, u):
    chart = s.charts[a]
    effect = jnp.eye(len(q))
    if isinstance(chart, SlidingChart):
        effect = chart.returned(t, q, s.chart_input(a, t, u))
    return jnp.pad(effect, (0, s.d - len(q))).ravel()
