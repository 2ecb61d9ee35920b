"""Linear recursions over all samples of records, for many columns at once.

All cycles are gone through side by side: first from zero at the start of each, then, once the
states at the starts are known from cycle to cycle, from these.
"""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from jaxtyping import Float


Columns = Float[np.ndarray, "_ _ _ _"]
"""(R, T, d, columns): states of R records in T cycles, one for each column."""


def recursion(
    F: Sequence[Float[np.ndarray, "_ _ _ _"]],
    shape: tuple[int, int, int],
    enter: Callable[[int, Columns], None],
    drive: Callable[[int, Columns], None],
    filled: Sequence[int],
) -> Iterator[Columns]:
    """$x[n+1] = F[n] x[n] + \\ldots$ from zero on: x at each section.

    **Arguments:**

    - `F`: (R, T, after, d), one for each section; the first axes may have the length 1.
    - `shape`: R, T and the columns.
    - `enter`: adds what enters at a section to x there, before it is given; `drive`: what enters
      after it to the next x.
    - `filled`: how many columns are not zero in the first cycle at the end of each section.
    """
    R, T, columns = shape
    x, phi = np.zeros((R, T, F[0].shape[-1], columns)), np.eye(F[0].shape[-1])[None, None]
    for n, step in enumerate(F):
        enter(n, x)
        later = np.zeros((R, T, step.shape[-2], columns))
        later[..., : filled[n]] = step @ x[..., : filled[n]]
        drive(n, later)
        x, phi = later, step @ phi
    starts = np.zeros_like(x)
    for k in range(T - 1):
        starts[:, k + 1] = phi[:, min(k, phi.shape[1] - 1)] @ starts[:, k] + x[:, k]
    x = starts
    for n, step in enumerate(F):
        enter(n, x)
        yield x
        x = step @ x
        drive(n, x)
