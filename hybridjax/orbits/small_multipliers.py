"""Multipliers that are all but zero: the monodromy in factors that each contract little, and the
product of all multipliers by Liouville's formula."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from .._core.compilation import at_ease
from .._core.executor import to_host
from ..engine.move import Options, move
from ..engine.replay import Link, divergence, links
from .return_map import ReturnMap


Matrix = Float[np.ndarray, "_ _"]

# A piece of a turn is computed in factors of its own steps if its weakest direction keeps less than
# this, and these are multiplied as long as their product keeps as much. Larger: more factors, for
# more cycles. Smaller: small multipliers lose digits.
WEAKEST = 1e-5


def fine_factors(map: ReturnMap) -> list[Matrix]:
    """Jacobians of one turn from the anchor over a few steps of the flow each, in sizes of the
    states; for an autonomous system on the states modulo the direction of the flow.

    A step of an explicit method cannot contract much, so that every multiplier keeps its digits.
    """
    map = to_host(map)
    moves = [move for piece in _pieces(map, links, tangents=True) for move in piece]
    frames = [_frame(map, link) for link in moves]
    factors: list[Matrix] = []
    for k, link in enumerate(moves):
        out, into = frames[(k + 1) % len(moves)], frames[k]
        factor = out[0] @ link.jacobian @ into[1]
        merged = factor @ factors[-1] if factors else factor
        if factors and weakest(merged) > WEAKEST:
            factors[-1] = merged
        else:
            factors.append(factor)
    return factors


def log_determinant(map: ReturnMap) -> float:
    """The logarithm of the determinant of the monodromy of a cycle without events: the divergence
    of the field, integrated over one turn.

    Steps of an implicit method lose a mode that decays within them; this gives its decay.
    """
    return float(
        np.sum(_pieces(to_host(map), lambda s, lanes, _, tape: divergence(s, lanes, tape)))
    )


def _pieces(map: ReturnMap, measure: Callable, tangents: bool = False) -> list:
    """`measure(structure, lanes, target, tape)` of each piece of one turn."""
    s, parts = map.structure, []

    def flow(lanes, target, h, result):
        u = np.zeros((s.nu, 1))
        options = Options(tape=True, new_input=False, tangents=tangents)
        moved, tape = move(s, lanes, u, target, map.settings, h, result, options)
        parts.append(measure(s, lanes, target, tape))
        return moved, None

    with at_ease():
        map.travel(map.anchor.q[:, 0], flow)
    return parts


def _frame(map: ReturnMap, move: Link) -> tuple[Matrix, Matrix]:
    """Matrices from (t, q), padded, at the start of a move to coordinates in sizes, and back."""
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


def weakest(factor: Matrix, weaker: int = 0) -> float:
    """The gain of a factor in its weakest direction but for so many `weaker` ones, relative to the
    gain in its strongest, or to 1 if that is smaller."""
    singular = np.linalg.svd(factor, compute_uv=False)
    if len(singular) <= weaker:
        return np.inf
    return singular[-1 - weaker] / max(singular[0], 1.0)
