"""Rows of arrays, one for each watched function, over lanes.

A few rows are selected one by one in programs: unlike a gather, XLA computes selections together
with their users. Of many rows that would be a large program. The host always goes by index.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Int

from ..executor import Array, namespace, on_host


# Up to so many rows are selected one by one. Twice as many: programs of eight contacts compile for
# longer, and run a little faster.
_FEW = 8


def take_rows(x: Array, rows: Sequence[int]) -> Array:
    """Some rows of x (W, L)."""
    if list(rows) == list(range(len(x))):
        return x
    if on_host(x) or len(rows) > _FEW:
        return x[np.array(rows)]
    return namespace(x).stack([x[row] for row in rows])


def put_rows(x: Array, rows: Sequence[int], here: Bool[Array, " L"], new: Array) -> Array:
    """x (W, L) with these rows replaced by those of `new` for the lanes `here`."""
    xp = namespace(x)
    if list(rows) == list(range(len(x))):
        return xp.where(here, new, x)
    place = np.full(len(x), -1)
    place[np.array(rows, int)] = np.arange(len(rows))
    if on_host(x) or len(x) > _FEW:
        return xp.where(here & (place >= 0)[:, None], new[place], x)
    return xp.stack([x[r] if k < 0 else xp.where(here, new[k], x[r]) for r, k in enumerate(place)])


def pick(x: Array, rows: Sequence[int], which: Int[Array, " L"]) -> Array:
    """Each lane's entry in the row of its function `which` of x, whose rows are those of the
    functions `rows`; 0 where it is not among them."""
    xp = namespace(x)
    if on_host(x) or len(rows) > _FEW:
        place = np.full(max(rows, default=0) + 2, -1)  # the last for -1
        place[np.array(rows, int)] = np.arange(len(rows))
        k = xp.asarray(place)[xp.minimum(which, len(place) - 1)]
        return xp.where(k >= 0, x[k, np.arange(x.shape[1])], 0.0)
    out = xp.zeros_like(x[0])
    for k, row in enumerate(rows):
        out = xp.where(which == row, x[k], out)
    return out
