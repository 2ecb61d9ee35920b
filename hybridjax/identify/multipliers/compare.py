"""Estimated multipliers beside the true ones."""

from collections.abc import Sequence
from typing import Annotated

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from ..._core.arguments import Numbers
from ..._core.boundary.values import Complexes
from ..._core.html import card, complex_number, table
from ...errors import DefinitionError


Multipliers = Annotated[Numbers, Complexes()]
"""Supposed or true multipliers, one or several."""


class MultiplierComparison(eqx.Module):
    """Estimated Floquet multipliers, each beside the true one that it stands for.

    The pairing is the one with the smallest sum of distances; if the numbers of multipliers
    differ, those left over are not listed. Printing it shows a table.

    **Fields**, sorted by decreasing modulus of the true multiplier, where a fit has multipliers of
    its own for each output after these:

    - `true` and `estimated` (k,); `error` (k,), their distance, and `max_error`, the largest.
    - `outputs` (k,): the outputs' names; empty where all outputs have the same multipliers.
    """

    true: Complex[np.ndarray, " k"]
    estimated: Complex[np.ndarray, " k"]
    outputs: tuple[str, ...] = eqx.field(static=True, default=())

    @property
    def error(self) -> Float[np.ndarray, " k"]:
        return np.abs(self.estimated - self.true)

    @property
    def max_error(self) -> float:
        return float(np.max(self.error))

    def __repr__(self) -> str:
        width = max(map(len, self.outputs), default=-2)
        rows = [" " * (width + 2) + f"{'true':>26}  {'estimated':>26}  {'error':>8}"]
        labels = [f"{name:>{width}}  " for name in self.outputs] or [""] * len(self.true)
        for label, true, estimated, error in zip(
            labels, self.true, self.estimated, self.error, strict=True
        ):
            rows.append(f"{label}{_show(true):>26}  {_show(estimated):>26}  {error:8.1e}")
        return "\n".join(rows)

    def _repr_html_(self) -> str:
        names = self.outputs or [""] * len(self.true)
        rows = [
            (name, complex_number(true, 9), complex_number(estimated, 9), f"{error:.1e}")
            for name, true, estimated, error in zip(
                names, self.true, self.estimated, self.error, strict=True
            )
        ]
        return card("MultiplierComparison", "", table(("", "true", "estimated", "error"), rows))


def _show(value: complex) -> str:
    return f"{value.real:+.9f} {value.imag:+.9f}i"


def compare_multipliers(estimated: Numbers, true: Multipliers) -> MultiplierComparison:
    """Pair estimated with true multipliers so that the sum of distances is smallest.

    **Raises:** `DefinitionError` if either is empty.
    """
    found, known = np.asarray(estimated).ravel(), np.asarray(true).ravel()
    if found.size == 0 or known.size == 0:
        raise DefinitionError("`true` or the estimate holds no multiplier to compare.")
    here, there = _paired(np.abs(found[:, None] - known))
    order = np.lexsort((-known[there].imag, -np.abs(known[there])))
    return MultiplierComparison(
        true=known[there][order].astype(complex), estimated=found[here][order].astype(complex)
    )


def _paired(distance: Float[np.ndarray, "n m"]) -> tuple[np.ndarray, np.ndarray]:
    """Rows and their columns, as many as there can be, with the smallest sum of distances."""
    n, m = distance.shape
    if n < m:
        return _paired(distance.T)[::-1]
    nearest = distance.argmin(axis=0)
    if len(np.unique(nearest)) == m:  # no smaller sum is possible
        return nearest, np.arange(m)
    from scipy.optimize import linear_sum_assignment  # (a third of a second)

    return linear_sum_assignment(distance)


def compare_by_output(
    estimated: Sequence[Complex[np.ndarray, " _"]],
    true: Multipliers,
    outputs: Sequence[str],
    output: str | int | None = None,
) -> MultiplierComparison:
    """The same for fits with multipliers of their own for each output.

    **Arguments:** `output`: name or index of the only one to compare; None means all.

    **Raises:** `DefinitionError` for an output that is not there, or if there is no multiplier.
    """
    chosen = range(len(outputs)) if output is None else [channel_index("output", output, outputs)]
    each = [compare_multipliers(estimated[k], true) for k in chosen]
    names = [outputs[k] for k, one in zip(chosen, each, strict=True) for _ in one.true]
    return MultiplierComparison(
        np.concatenate([one.true for one in each]),
        np.concatenate([one.estimated for one in each]),
        tuple(names),
    )


def channel_index(kind: str, wanted: str | int, names: Sequence[str]) -> int:
    """The index of an input or output that is given by its name or index.

    **Raises:** `DefinitionError` if it is not there.
    """
    if isinstance(wanted, str) and wanted in names:
        return names.index(wanted)
    if not isinstance(wanted, str) and 0 <= wanted < len(names):
        return int(wanted)
    raise DefinitionError(f"there is no {kind} {wanted!r}; the {kind}s are {', '.join(names)}.")
