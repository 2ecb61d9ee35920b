r"""Harmonic transfer functions in continuous time, and the response of a cycle to lasting changes.

Under an input $e^{i w t}$, deviations from the cycle are $e^{i w t}$ times a function with the
period of the cycle. It is found from the monodromy matrix and from the forced linear flow over one
turn; the Fourier integral is a sum over the same nodes, interrupted at events (no truncated series;
N. M. Wereley, Analysis and control of linear periodically time varying systems, MIT 1991).
"""

import numpy as np
from jaxtyping import Complex, Float

from .._core.boundary.kinds import SignalNames
from .._core.compilation import at_ease
from .._core.executor import Array, namespace, on_host, scan, to_host
from ..engine import kernels
from ..errors import DefinitionError
from ..linear.frequency_response import Frequencies, Harmonics, check_harmonics
from ..linear.htf import HTF
from ..systems.check import check_output
from ..systems.structure import Outputs, Structure
from ..systems.system import Output, OutputNames
from .linear_flow import Course, LinearFlow, rule
from .return_map import ReturnMap, with_derivatives


# Largest angle by which an input, or a harmonic of the output, turns within a piece. Larger:
# polynomials on a piece lose digits. Smaller: more pieces than needed.
_TURNS = 4.0
# Distance in cycles per period from a pole on the unit circle at which a frequency lies on it.
# Smaller: responses are rounding errors. Larger: frequencies beside it are rejected.
_POLE = 1e-9
# Pieces times frequencies of one call. More: gigabytes of memory. Fewer: calls are refused that a
# machine can do.
_LARGEST = 2**21


def observed(s: Structure, flow: LinearFlow, z: Outputs) -> tuple[Array, Array, Array]:
    """Outputs at the nodes (P, K, ny), and their derivatives by states and inputs."""
    xp, (P, K, d), ny = namespace(flow.q), flow.q.shape, len(z.names)
    chart, t, q = xp.repeat(flow.chart, K), flow.t.ravel(), flow.q.reshape(P * K, d).T
    outputs = lambda a, *point: kernels.outputs(s, a, tuple(z.items), *point)  # noqa: E731
    by = with_derivatives(s, outputs, chart, t, q, ny)
    by = xp.moveaxis(by, -1, 0).reshape(P, K, ny, -1)
    return by[..., 0], by[..., 2 : 2 + d], by[..., 2 + d :]


def longest_piece(f: Float[np.ndarray, " F"], harmonics: tuple[int, ...]) -> float:
    """Length of pieces, in parts of a period, that resolves inputs and outputs: a power of 2, so
    that calls with similar frequencies share a linearization."""
    fastest = max(1.25 * np.max(np.abs(f), initial=0.0), np.max(np.abs(harmonics)), 0.1)
    longest = float(2.0 ** np.floor(np.log2(min(_TURNS / (2 * np.pi * fastest), 1.0))))
    if max(len(f), 64) / longest > _LARGEST:
        raise DefinitionError(
            f"{len(f)} frequencies up to {np.abs(f).max():.3g} per period and harmonics up to "
            f"{np.abs(harmonics).max()} need {1 / longest:.1e} pieces of the cycle: lower them."
        )
    return longest


def continuous_htf(
    course: Course,
    f: Frequencies,
    harmonics: Harmonics,
    outputs: OutputNames | None,
    inputs: SignalNames | None,
) -> HTF:
    """Harmonic transfer functions of a cycle (see `LimitCycle.htf`)."""
    s, harmonics = course.map.structure, check_harmonics(harmonics, 0)
    frequencies = np.asarray(f, float).reshape(-1)
    visited = {s.transitions[g].source for g in course.events}
    z = s.resolve_outputs(s.states_everywhere() if outputs is None else outputs)
    for x in (x for x in z.items if isinstance(x, Output)):
        list(check_output(s, x))
    for name in visited or s.names:
        z.require(s.chart_index(name))
    names, columns = s.inputs_among(inputs)
    flow = course.linear_flow(longest_piece(frequencies, harmonics))
    if on_host(flow.t):
        course = to_host(course)
    with at_ease():
        H = _transfer(course.map, flow, course.period, z, frequencies, harmonics)
    return HTF(frequencies, H[..., columns], harmonics, 0, names, z.names, "exact")


def _transfer(
    map: ReturnMap,
    flow: LinearFlow,
    period: Float[Array, ""],
    z: Outputs,
    f: Float[np.ndarray, " F"],
    harmonics: tuple[int, ...],
) -> Complex[Array, "M F ny nu"]:
    s, xp, w = map.structure, namespace(flow.q), rule().weights
    clocked, jumps, h = map.base is None, flow.jumps, flow.length
    (values, by_state, by_input), T = observed(s, flow, z), period
    (P, K, d), F, nu = flow.q.shape, len(f), flow.by_input.shape[-1]
    free, forced = flow.forward()
    # Time 0 is that of the clock, or the anchor of an autonomous cycle. Frequencies come last, so
    # that all products are those of matrices.
    t = flow.t if clocked else flow.t - flow.t[0, 0]
    rate = 2j * np.pi * f / T
    begin = xp.exp(t[:, :1] * rate)[:, None, None]  # (P, 1, 1, F)
    inside = xp.exp((h[:, None] * rule().nodes)[..., None] * rate)  # (P, K, F)
    at_end = begin * inside[:, -1:, None]
    push = forced * h[:, None, None, None, None]
    push = xp.einsum("piakb,pkbu->piauk", push, flow.by_input)  # nodes by inputs at nodes
    # From piece to piece.
    arrived = (push[:, -1].reshape(P, d * nu, K) @ inside).reshape(P, d, nu, F)
    driven = jumps.by_state @ (arrived * begin).reshape(P, d, nu * F)
    driven = driven + (jumps.by_input[..., None] * at_end).reshape(P, d, nu * F)
    through = jumps.by_state @ free[:, -1]
    advance = lambda x, piece: (piece[0] @ x + piece[1], x)  # noqa: E731
    total, _ = scan(advance, xp.zeros(driven.shape[1:], driven.dtype), (through + 0j, driven))
    # Deviations at the beginning: X(T) = exp(i w T) X(0).
    size = map.sizes
    whole = flow.monodromy(free, map.valid) * size / size[:, None]
    if on_host(whole):
        apart = np.abs(np.exp(2j * np.pi * f)[:, None] - np.linalg.eigvals(whole)).min(axis=1)
        if (apart < _POLE).any():
            where = "every whole number" if not clocked else "its multipliers of modulus 1"
            raise DefinitionError(
                f"`f` = {f[apart.argmin()]:.10g} cycles per period is a pole of the cycle, which "
                f"lie at {where}: leave it out."
            )
    turned = xp.exp(rate * T)[:, None, None] * xp.eye(d)
    total = xp.moveaxis(total.reshape(d, nu, F), -1, 0) / size[:, None]
    start = xp.moveaxis(xp.linalg.solve(turned - whole, total) * size[:, None], 0, -1)
    _, x = scan(advance, start.reshape(d, nu * F), (through + 0j, driven))
    # Fourier integrals, with exp(-i w t) of the piece and of the node apart.
    weight = (h[:, None] * w)[..., None, None]
    C = by_state * weight
    before = (x.reshape(P, d, nu, F) / begin).reshape(P, d, nu * F)
    of_push = C @ push.reshape(P, K, d, nu * K)
    shape = P, K, len(z.names), nu, F
    response = ((C @ free).reshape(P, -1, d) @ before).reshape(shape)
    response += (of_push.reshape(P, -1, K) @ inside).reshape(shape)
    back = xp.conj(inside)[:, :, None, None]
    response *= back
    # Events whose time moves: the jump of the output at the moment of the event.
    last = (free[:, -1] @ before).reshape(arrived.shape) + arrived
    delay = xp.einsum("pa,pauf->puf", jumps.delay_by_state, last) * back[:, -1, 0]
    step = values[:, -1] - xp.roll(values[:, 0], -1, axis=0)
    impulse = step[..., None, None] * (delay + jumps.delay_by_input[..., None])[:, None]
    waves = xp.exp(-2j * np.pi * np.asarray(harmonics)[:, None, None] * (t / T))
    entries = len(z.names) * nu * F
    H = waves.reshape(len(waves), P * K) @ response.reshape(P * K, entries)
    H = (H + waves[:, :, -1] @ impulse.reshape(P, entries)).reshape(len(waves), *shape[2:])
    H = H + xp.einsum("mpk,pkyu->myu", waves, by_input * weight)[..., None]
    return xp.moveaxis(H, -1, 1) / T
