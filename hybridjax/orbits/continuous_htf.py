r"""Harmonic transfer functions in continuous time, and the response of a cycle to lasting changes.

Under an input $e^{i w t}$, deviations from the cycle are $e^{i w t}$ times a function with the
period of the cycle. This function follows from the monodromy matrix and from the forced linear flow
over one period (`LinearFlow.driven`). Its Fourier integrals are sums over the nodes of the linear
flow, interrupted at events, so that no series is truncated (N. M. Wereley, Analysis and control of
linear periodically time varying systems, MIT 1991).

`LimitCycle.htf` calls `continuous_htf`; `_transfer` does the work. A *piece* is a part of the cycle
between events, with `NODES` nodes. Frequencies are in cycles per period, and phases are those of
the clock, or count from the anchor without one (`LinearFlow.after`): this convention is that of
`HTF`, and must stay.

If a response is wrong at all frequencies, look at `LinearFlow.driven`; if it is wrong at high ones
alone, at `longest_piece`; if it is wrong between computed frequencies, at `_interpolation`; if
outputs are wrong, at `linear_outputs`.
"""

import functools as ft
from typing import Any

import numpy as np
from jaxtyping import Complex, Float, Inexact

from .._core.boundary.kinds import SignalNames
from .._core.compilation import at_ease, one_program
from .._core.executor import Array, namespace, on_host, solve
from .._core.memo import Memory
from ..engine import kernels
from ..errors import DefinitionError
from ..linear.frequency_response import Frequencies, Harmonics, check_harmonics
from ..linear.htf import HTF
from ..systems.check import check_output
from ..systems.structure import Outputs, Structure
from ..systems.system import Output, OutputNames
from .linear_flow import LinearFlow, linear_flow, rule
from .return_map import ReturnMap
from .scale import in_sizes


# Largest change of the phase angle of an input, or of a harmonic of the output, within a piece, in
# radians. Larger: polynomials on a piece lose digits. Smaller: more pieces than needed.
_TURNS = 4.0
# A frequency counts as a pole if it is closer to a pole than this, in cycles per period. Smaller:
# responses are rounding errors. Larger: frequencies near a pole are rejected.
_POLE = 1e-9
# Number of Chebyshev frequencies, in addition to the largest angle, in units of the cube root of
# this angle. Fewer: responses lose digits. More: calls take longer.
_EXTRA = 12
# Largest number of pieces times frequencies in one call. More: gigabytes of memory. Fewer: calls
# that a machine could do are refused.
_LARGEST = 2**21


_kept = Memory()


def linear_outputs(
    s: Structure, flow: LinearFlow, z: Outputs
) -> tuple[Array, Array, Array]:
    """Outputs at the nodes (P, K, ny), and their derivatives by states and inputs."""

    def outputs(a, *point):
        return kernels.outputs(s, a, tuple(z.items), *point)

    make = ft.partial(flow.evaluated, s, outputs, len(z.names))
    # (Other functions than states may have changed.)
    are_states = all(isinstance(x, str) for x in z.items)
    if on_host(flow.q) and are_states:
        expanded = _kept.recall(flow, z.names, make)
    else:
        expanded = make()
    value = expanded[..., 0]
    by_state = expanded[..., 2 : 2 + s.d]
    by_input = expanded[..., 2 + s.d :]
    return value, by_state, by_input


def longest_piece(f: Float[np.ndarray, " F"], harmonics: tuple[int, ...]) -> float:
    """Length of pieces, as a part of the period, that resolves inputs and outputs. It is a power of
    the square root of 2, so that calls with similar frequencies share a linearization."""
    of_inputs = 1.25 * np.max(np.abs(f))
    of_outputs = np.max(np.abs(harmonics))
    fastest = max(of_inputs, of_outputs, 0.1)
    resolved = min(_TURNS / (2 * np.pi * fastest), 1.0)
    halvings = np.floor(2 * np.log2(resolved)) / 2
    longest = float(2.0**halvings)
    if max(len(f), 64) / longest > _LARGEST:
        raise DefinitionError(
            f"{len(f)} frequencies up to {np.abs(f).max():.3g} per period and harmonics up to "
            f"{np.abs(harmonics).max()} need {1 / longest:.1e} pieces of the cycle: lower them."
        )
    return longest


def asked(
    s: Structure,
    events: tuple[int, ...],
    outputs: OutputNames | None,
    inputs: SignalNames | None,
):
    """Outputs that exist all along a cycle with these events, and the names and indices of
    inputs."""
    z = s.resolve_outputs(s.states_everywhere() if outputs is None else outputs)
    for x in (x for x in z.items if isinstance(x, Output)):
        list(check_output(s, x))
    z.require(*map(s.chart_index, {s.transitions[g].source for g in events} or s.names))
    return z, *s.inputs_among(inputs)


def continuous_htf(
    cycle: Any,
    f: Frequencies,
    harmonics: Harmonics,
    outputs: OutputNames | None,
    inputs: SignalNames | None,
) -> HTF:
    """Harmonic transfer functions of a cycle (see `LimitCycle.htf`)."""
    harmonics = check_harmonics(harmonics, 0)
    frequencies = np.asarray(f, float).reshape(-1)
    if not len(frequencies):
        raise DefinitionError("`frequencies` holds no frequency: give one or more.")
    map = cycle.return_map
    z, names, columns = asked(map.structure, cycle.event_sequence, outputs, inputs)
    flow = linear_flow(cycle, longest_piece(frequencies, harmonics))
    with at_ease():
        H = _transfer(map, flow, tuple(z.items), _interpolation(frequencies), harmonics)
    return HTF(frequencies, H[..., columns], harmonics, 0, names, z.names, "exact")


def _interpolation(
    f: Float[np.ndarray, " F"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frequencies at which the response is computed, and the matrix from values at these to values
    at f. They are Chebyshev's frequencies if these are fewer than f, otherwise f itself. The
    interpolation is for functions of the frequency that are sums of exp(-2 pi i f s), s from 0 to
    1.
    """
    middle = (np.max(f) + np.min(f)) / 2
    half = np.ptp(f) / 2
    turns = np.pi * half
    n = int(turns + _EXTRA * np.cbrt(1 + turns))
    if n >= len(f) or not half:
        return f, f, np.eye(len(f))
    k = np.arange(n)
    x = np.cos(np.pi * (k + 0.5) / n)
    coarse = middle + half * x
    chebvander = np.polynomial.chebyshev.chebvander
    twice = np.where(k == 0, 1, 2)[:, None]
    coefficients = chebvander(x, n - 1).T * twice / n
    at_f = chebvander((f - middle) / half, n - 1)
    mix = at_f @ coefficients

    def turn(x):
        return np.exp(1j * np.pi * x)

    # The factor with the mean exponent, s = 1/2, is taken out, so that the rest oscillates half as
    # fast.
    from_coarse = mix * turn(coarse)
    return f, coarse, from_coarse * turn(-f)[:, None]


@one_program
def _transfer(
    map: ReturnMap,
    flow: LinearFlow,
    outputs: tuple[str | Output, ...],
    interpolation: tuple[Array, Array, Array],
    harmonics: tuple[int, ...],
) -> Complex[Array, "M F ny nu"]:
    """The HTFs of M harmonics at F frequencies. First come the integrals of outputs that inputs and
    states at phase 0 cause; then the states at phase 0 are chosen so that the response is periodic.

    **Arguments:** `interpolation`: see `_interpolation`.
    """
    s = map.structure
    xp = namespace(flow.q)
    z = s.resolve_outputs(outputs)
    f, coarse, fine = interpolation
    d = flow.q.shape[2]
    nu = s.nu
    rows = len(harmonics) * len(z.names)
    whole = flow.monodromy(map.valid)
    if on_host(whole):
        _require_no_pole(map, f, whole)

    # The input exp(i w t) at the nodes of each piece, relative to the piece's beginning. Columns
    # are responses to inputs, then to states at phase 0.
    phase = flow.length[:, None] * rule().nodes / map.expected
    rates = 2j * np.pi * coarse
    inside = xp.exp(phase[..., None] * rates)
    begin, delay, end = flow.driven(inside)
    H = _integrals(map, flow, z, harmonics, inside, begin, delay)

    of_end = xp.moveaxis(end, -1, 0)
    H = xp.concatenate([H, of_end], axis=1)
    at_f = fine @ H.reshape(len(coarse), -1)
    at_f = at_f.reshape(len(f), rows + d, -1)
    H, end = xp.split(at_f, [rows], axis=1)

    # In the periodic response, the deviation at phase 0 is the same one period later.
    size = map.sizes
    column = size[:, None]
    scaled = in_sizes(whole, size)
    back_a_period = xp.exp(-2j * np.pi * f)[:, None, None]
    turned = xp.eye(d) - back_a_period * scaled
    right = end[..., :nu] / column
    start = solve(turned, right) * column
    by_input = H[..., :nu]
    by_start = H[..., nu:]
    H = by_input + by_start @ start
    H = H.reshape(-1, len(harmonics), len(z.names), nu)
    return xp.moveaxis(H, 0, 1) / map.expected


def _require_no_pole(
    map: ReturnMap,
    f: Float[np.ndarray, " F"],
    monodromy: Float[np.ndarray, "d d"],
) -> None:
    """**Raises:** `DefinitionError` for a frequency at which the HTF is infinite."""
    phasors = np.exp(2j * np.pi * f)
    multipliers = np.linalg.eigvals(monodromy)
    apart = np.abs(phasors[:, None] - multipliers).min(axis=1)
    if (apart < _POLE).any():
        where = "every whole number" if map.base else "its multipliers of modulus 1"
        raise DefinitionError(
            f"f = {f[apart.argmin()]:.10g} cycles per period is a pole of the cycle, which "
            f"lie at {where}: leave it out."
        )


def _integrals(
    map: ReturnMap,
    flow: LinearFlow,
    z: Outputs,
    harmonics: tuple[int, ...],
    inside: Inexact[Array, "P K f"],
    begin: Inexact[Array, "P d c f"],
    delay: Inexact[Array, "P c f"],
) -> Complex[Array, "f rows c"]:
    """Fourier integrals of outputs over a turn, by harmonic and output, for inputs that are waves,
    and for the state at phase 0: c = nu + d columns.

    **Arguments:** `inside`: waves within pieces; `begin`, `delay`: see `LinearFlow.driven`.
    """
    xp = namespace(flow.q)
    P, K, d = flow.q.shape
    nu = map.structure.nu
    rows = len(harmonics) * len(z.names)
    values, by_state, by_input = linear_outputs(map.structure, flow, z)
    orders = np.asarray(harmonics)[:, None, None]
    rates = -2j * np.pi * orders
    waves = xp.exp(rates * flow.after(map) / map.expected)
    weighted = waves * flow.length[:, None] * rule().weights
    back = xp.conj(inside)

    # Outputs by the deviations at the beginnings of pieces.
    by_begin, _ = flow.forward
    free = xp.einsum("mpk,pkya->pmyak", weighted, by_state @ by_begin)
    free = free.reshape(P, -1, K) @ back
    free = free.reshape(P, rows, d, -1).transpose(3, 1, 0, 2)
    free = free.reshape(-1, rows, P * d)
    by_line = xp.moveaxis(begin, -1, 0)
    begins = by_line.reshape(-1, P * d, nu + d)
    of_begin = free @ begins

    # Outputs by the inputs within pieces.
    pushed = by_state @ flow.pushed.reshape(P, K, d, -1)
    pushed = pushed.reshape(*by_input.shape, K)
    unit = xp.eye(K)[:, None, None]
    at_once = by_input[..., None] * unit
    pushed = (pushed + at_once).reshape(P, -1, K) @ inside
    pushed = pushed.reshape(P, K, -1, inside.shape[2])
    turned_back = pushed * back[:, :, None]
    pushed = turned_back.reshape(P * K, -1)
    forced = weighted.reshape(-1, P * K) @ pushed
    forced = forced.reshape(rows, nu, -1)
    forced = xp.pad(forced, [(0, 0), (0, d), (0, 0)])

    # Events whose time moves: the jump of the output at the moment of the event.
    after_event = xp.roll(values[:, 0], -1, axis=0)
    jump = values[:, -1] - after_event
    at_ends = waves[:, None, :, -1]
    jumps = (at_ends * jump.T).reshape(rows, P)
    moved = jumps @ delay.reshape(P, -1)
    of_inputs = forced + moved.reshape(forced.shape)
    return of_begin + xp.moveaxis(of_inputs, -1, 0)
