r"""Harmonic transfer functions in continuous time, and the response of a cycle to lasting changes.

Under an input $e^{i w t}$, deviations from the cycle are $e^{i w t}$ times a function with the
period of the cycle. It is found from the monodromy matrix and from the forced linear flow over one
turn; the Fourier integral is a sum over the same nodes, interrupted at events (no truncated series;
N. M. Wereley, Analysis and control of linear periodically time varying systems, MIT 1991).
"""

import functools as ft
from typing import Any

import numpy as np
from jaxtyping import Complex, Float

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


# Largest angle by which an input, or a harmonic of the output, turns within a piece. Larger:
# polynomials on a piece lose digits. Smaller: more pieces than needed.
_TURNS = 4.0
# Distance in cycles per period from a pole on the unit circle at which a frequency lies on it.
# Smaller: responses are rounding errors. Larger: frequencies beside it are rejected.
_POLE = 1e-9
# Chebyshev's frequencies beyond those that sines need, by the cube root of their angle. Fewer:
# responses lose digits. More: calls take longer.
_EXTRA = 12
# Pieces times frequencies of one call. More: gigabytes of memory. Fewer: calls are refused that a
# machine can do.
_LARGEST = 2**21


_kept = Memory()


def linear_outputs(
    s: Structure, flow: LinearFlow, z: Outputs
) -> tuple[Array, Array, Array]:
    """Outputs at the nodes (P, K, ny), and their derivatives by states and inputs."""
    outputs = lambda a, *point: kernels.outputs(s, a, tuple(z.items), *point)  # noqa: E731
    make = ft.partial(flow.evaluated, s, outputs, len(z.names))
    # (Other functions than states may have changed.)
    kept = on_host(flow.q) and all(isinstance(x, str) for x in z.items)
    by = _kept.recall(flow, z.names, make) if kept else make()
    return by[..., 0], by[..., 2 : 2 + s.d], by[..., 2 + s.d :]


def longest_piece(f: Float[np.ndarray, " F"], harmonics: tuple[int, ...]) -> float:
    """Length of pieces, in parts of a period, that resolves inputs and outputs: a power of the
    root of 2, so that calls with similar frequencies share a linearization."""
    fastest = max(1.25 * np.max(np.abs(f)), np.max(np.abs(harmonics)), 0.1)
    longest = float(
        2.0 ** (np.floor(2 * np.log2(min(_TURNS / (2 * np.pi * fastest), 1.0))) / 2)
    )
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
    harmonics, frequencies = (
        check_harmonics(harmonics, 0),
        np.asarray(f, float).reshape(-1),
    )
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
    """f, Chebyshev's frequencies where these are fewer than f, else f again, and the matrix from
    values there to values at f, of functions of the frequency that are sums of exp(-2 pi i f s), s
    from 0 to 1.
    """
    middle, half = (np.max(f) + np.min(f)) / 2, np.ptp(f) / 2
    n = int(np.pi * half + _EXTRA * np.cbrt(1 + np.pi * half))
    if n >= len(f) or not half:
        return f, f, np.eye(len(f))
    k, chebyshev = np.arange(n), np.polynomial.chebyshev
    x = np.cos(np.pi * (k + 0.5) / n)
    values = chebyshev.chebvander(x, n - 1).T * (2 - (k == 0))[:, None] / n
    coarse, mix = (
        middle + half * x,
        chebyshev.chebvander((f - middle) / half, n - 1) @ values,
    )
    # Their mean exponent, s = 1/2, is taken out: the others turn half as fast.
    turn = lambda x: np.exp(1j * np.pi * x)  # noqa: E731
    return f, coarse, mix * turn(coarse) * turn(-f)[:, None]


@one_program
def _transfer(
    map: ReturnMap,
    flow: LinearFlow,
    outputs: tuple[str | Output, ...],
    interpolation: tuple[Array, Array, Array],
    harmonics: tuple[int, ...],
) -> Complex[Array, "M F ny nu"]:
    s, xp, h, period = map.structure, namespace(flow.q), flow.length, map.expected
    z, (f, coarse, fine) = s.resolve_outputs(outputs), interpolation
    values, by_state, by_input = linear_outputs(s, flow, z)
    (P, K, d), nu, size, rows = (
        flow.q.shape,
        s.nu,
        map.sizes,
        len(harmonics) * len(z.names),
    )
    whole = flow.monodromy(map.valid)
    if on_host(whole):
        apart = np.abs(np.exp(2j * np.pi * f)[:, None] - np.linalg.eigvals(whole)).min(
            axis=1
        )
        if (apart < _POLE).any():
            where = "every whole number" if map.base else "its multipliers of modulus 1"
            raise DefinitionError(
                f"f = {f[apart.argmin()]:.10g} cycles per period is a pole of the cycle, which "
                f"lie at {where}: leave it out."
            )
    # Responses to inputs, and to states at phase 0, are columns.
    inside = xp.exp(
        (h[:, None] * rule().nodes / period)[..., None] * (2j * np.pi * coarse)
    )
    back, (begin, delay, end) = xp.conj(inside), flow.driven(inside)
    pushed = (by_state @ flow.pushed.reshape(P, K, d, -1)).reshape(*by_input.shape, K)
    pushed = pushed + by_input[..., None] * xp.eye(K)[:, None, None]
    # Fourier integrals of outputs by deviations where pieces begin, and by inputs within them.
    waves = xp.exp(
        -2j * np.pi * np.asarray(harmonics)[:, None, None] * flow.after(map) / period
    )
    weighted = waves * h[:, None] * rule().weights
    of_begin = xp.einsum("mpk,pkya->pmyak", weighted, by_state @ flow.forward[0])
    of_begin = of_begin.reshape(P, -1, K) @ back
    of_begin = (
        of_begin.reshape(P, rows, d, -1).transpose(3, 1, 0, 2).reshape(-1, rows, P * d)
    )
    H = of_begin @ xp.moveaxis(begin, -1, 0).reshape(-1, P * d, nu + d)
    pushed = (pushed.reshape(P, -1, K) @ inside).reshape(P, K, -1, len(coarse))
    pushed = weighted.reshape(-1, P * K) @ (pushed * back[:, :, None]).reshape(
        P * K, -1
    )
    pushed = xp.pad(pushed.reshape(rows, nu, -1), [(0, 0), (0, d), (0, 0)])
    # Events whose time moves: the jump of the output at the moment of the event.
    jump = values[:, -1] - xp.roll(values[:, 0], -1, axis=0)
    moved = (waves[:, None, :, -1] * jump.T).reshape(rows, P) @ delay.reshape(P, -1)
    H = H + xp.moveaxis(pushed + moved.reshape(pushed.shape), -1, 0)
    # The deviation at phase 0 is that one period later.
    H = xp.concatenate([H, xp.moveaxis(end, -1, 0)], axis=1).reshape(len(coarse), -1)
    H, end = xp.split((fine @ H).reshape(len(f), rows + d, -1), [rows], axis=1)
    turned = xp.eye(d) - xp.exp(-2j * np.pi * f)[:, None, None] * (
        whole * size / size[:, None]
    )
    start = solve(turned, end[..., :nu] / size[:, None]) * size[:, None]
    H = (H[..., :nu] + H[..., nu:] @ start).reshape(
        -1, len(harmonics), len(z.names), nu
    )
    return xp.moveaxis(H, 0, 1) / period
