"""Estimated multipliers beside the true ones."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Array, Complex, Float
from scipy.optimize import linear_sum_assignment

from ...errors import DefinitionError


Multipliers = np.ndarray | Array | Sequence[complex | float]


class MultiplierComparison(eqx.Module):
    """Estimated Floquet multipliers, each beside the true one that it stands for.

    The pairing is the one with the smallest sum of distances; if the numbers of multipliers
    differ, those left over are not listed. Printing it shows a table.

    **Fields**, sorted by decreasing modulus of the true multiplier: `true`, `estimated` and
    `error`, the distance `|estimated - true|`. `max_error`: the largest.
    """

    true: Complex[np.ndarray, " d"]
    estimated: Complex[np.ndarray, " d"]

    @property
    def error(self) -> Float[np.ndarray, " d"]:
        return np.abs(self.estimated - self.true)

    @property
    def max_error(self) -> float:
        return float(np.max(self.error))

    def __repr__(self) -> str:
        rows = [f"{'true':>26}  {'estimated':>26}  {'error':>8}"]
        for true, estimated, error in zip(self.true, self.estimated, self.error, strict=True):
            rows.append(f"{_show(true):>26}  {_show(estimated):>26}  {error:8.1e}")
        return "\n".join(rows)


def _show(value: complex) -> str:
    return f"{value.real:+.9f} {value.imag:+.9f}i"


def compare_multipliers(estimated: Multipliers, true: Multipliers) -> MultiplierComparison:
    """Pair estimated with true multipliers so that the sum of distances is smallest.

    **Raises:** `DefinitionError` if either is empty.
    """
    estimated, true = np.asarray(estimated).ravel(), np.asarray(true).ravel()
    if estimated.size == 0 or true.size == 0:
        raise DefinitionError("there is no multiplier to compare.")
    here, there = linear_sum_assignment(np.abs(estimated[:, None] - true))
    order = np.lexsort((-true[there].imag, -np.abs(true[there])))
    return MultiplierComparison(
        true=true[there][order].astype(complex), estimated=estimated[here][order].astype(complex)
    )
