"""Whether the start of records can still be seen in them."""

import numpy as np
from jaxtyping import Complex, Float

from ...errors import DefinitionError
from ...experiments.data import ExperimentData


# Standard deviations by which a transient exceeds the noise before it is believed. Doubled: weaker
# ones, which matter less, are taken for noise.
_BEYOND_NOISE = 3.0


def refuse_transient(
    data: ExperimentData,
    repeats: int,
    multipliers: Complex[np.ndarray, " d"],
    noise: Float[np.ndarray, " ny"],
    allowed: float,
) -> None:
    """A transient is what the cycles before the window have, and the same ones P later have not.
    (The first of them is left out: there also what dies within a cycle is seen.)

    **Arguments:** `noise`, the standard deviation of each output's; `allowed`, the part of the
    response that may be left of it when the window begins.

    **Raises:** `DefinitionError` if more is left.
    """
    N, P, y = data.n_sections, data.periods, data.y[data.ok]
    before = y.shape[1] // N - P * repeats
    if not before:
        return
    k = min(1, before - 1)
    here, later = (y[:, N * n : N * (n + 1)] for n in (k, k + P))
    found = np.mean((here - later) ** 2, axis=(0, 1)) - 2 * noise**2
    beyond = _BEYOND_NOISE * 2 * noise**2 * np.sqrt(2 / here[..., 0].size)
    size = np.sqrt(np.maximum(found, 0) / np.mean(y**2, axis=(0, 1)))
    left = np.where(found > beyond, size, 0).max() * np.abs(multipliers).max() ** (before - k)
    if left > allowed:
        raise DefinitionError(
            f"after {before} cycles that are discarded a part of {left:.1g} of the start's "
            f"transient is left in the response, but {allowed:.1g} is asked for: add "
            "`hj.identify.remove_transient(data).data`, or begin in the periodic response "
            "(start='steady' in simulations)."
        )
