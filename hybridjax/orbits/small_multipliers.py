"""The monodromy in factors that each contract little, for multipliers that are all but zero."""

import numpy as np
from jaxtyping import Float

from .._core.compilation import at_ease
from .._core.executor import to_host
from ..engine.chain import Link, divergence, links
from ..engine.move import record
from .return_map import ReturnMap


Matrix = Float[np.ndarray, "_ _"]

# Steps of the flow are multiplied as long as the weakest direction of their product keeps so much:
# twice as much makes more factors, and half loses a bit of small multipliers.
_WEAKEST = 1e-4


def fine_factors(map: ReturnMap) -> list[Matrix]:
    """Jacobians of one turn from the anchor over a few steps of the flow each, in sizes of the
    states; for an autonomous system on the states modulo the direction of the flow.

    A step of an explicit method cannot contract much, so that every multiplier keeps its digits.
    """
    map = to_host(map)
    s, moves = map.structure, []

    def flow(lanes, target, h, result):
        u = np.zeros((s.nu, 1))
        moved, tape = record(
            s, lanes, u, target, map.settings, h, result, new_input=False, tangents=True
        )
        moves.extend(links(s, lanes, target, tape))
        return moved, None

    with at_ease():
        map.travel(map.anchor.q[:, 0], flow)
    frames = [_frame(map, move) for move in moves]
    factors: list[Matrix] = []
    for k, move in enumerate(moves):
        out, into = frames[(k + 1) % len(moves)], frames[k]
        factor = out[0] @ move.jacobian @ into[1]
        merged = factor @ factors[-1] if factors else factor
        if factors and weakest(merged) > _WEAKEST:
            factors[-1] = merged
        else:
            factors.append(factor)
    return factors


def _frame(map: ReturnMap, move: Link) -> tuple[Matrix, Matrix]:
    """From (t, q), padded, at the start of a move to coordinates in sizes, and back."""
    n, clocked = map.structure.dims[move.chart], map.base is None
    size = np.append(map.expected, np.asarray(map.settings.scale)[move.chart, :n])
    basis = np.eye(1 + n)
    if not clocked:
        f = move.field[:n] / size[1:]
        basis = np.zeros((1 + n, n - 1))
        basis[1:] = np.linalg.svd(f[None])[2][1:].T
    padding = [(0, map.structure.d - n), (0, 0)]
    to, back = np.pad(basis / size[:, None], padding), np.pad(basis * size[:, None], padding)
    return to.T, back


def weakest(factor: Matrix, besides: int = 0) -> float:
    """What a factor leaves of its weakest direction, besides so many weaker ones, as a part of
    what it leaves of the strongest, or of 1 if that shrinks, too."""
    singular = np.linalg.svd(factor, compute_uv=False)
    if len(singular) <= besides:
        return np.inf
    return singular[-1 - besides] / max(singular[0], 1.0)


def log_determinant(map: ReturnMap) -> float:
    """The logarithm of the determinant of the monodromy of a cycle without events: the divergence
    of the field, integrated over one turn.

    Steps of an implicit method forget a mode that decays within them; this is how it decays.
    """
    map = to_host(map)
    s, parts = map.structure, []

    def flow(lanes, target, h, result):
        u = np.zeros((s.nu, 1))
        moved, tape = record(s, lanes, u, target, map.settings, h, result, new_input=False)
        parts.append(divergence(s, lanes, tape))
        return moved, None

    with at_ease():
        map.travel(map.anchor.q[:, 0], flow)
    return float(np.sum(parts))
