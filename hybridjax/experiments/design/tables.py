"""Inputs of experiments as a CSV table, for hardware that plays it.

`Design.write` calls `write_table`. `recordings/design_tables.py` reads such a table again.
"""

import csv
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..._core.writing import replacing
from ...errors import DefinitionError


BY_PHASE = ("experiment", "cycle", "section", "phase")


def write_table(
    path: Path,
    names: tuple[str, ...],
    u: Float[np.ndarray, "S n nu"],
    n_sections: int,
    period: float | None,
    rate: float | None,
) -> None:
    """Write inputs as CSV, see `Design.write`."""
    if (period is None) != (rate is None):
        raise DefinitionError(
            "a table against time needs both the period and the rate."
        )
    n = u.shape[1]
    N = n_sections
    if period is None or rate is None:
        header = BY_PHASE
        cycle, section = np.divmod(np.arange(n), N)
        place = np.stack([cycle, section, section / N], axis=1)
    elif period * rate < N:
        raise DefinitionError(
            f"`rate` must be {N / period:g} or more: a sample for each section."
        )
    else:
        header = ("experiment", "time")
        rounding = 1e-6
        samples = np.ceil(n / N * period * rate - rounding)
        time = np.arange(samples) / rate
        held = (time * N / period + 1e-9).astype(int)
        u = u[:, np.minimum(held, n - 1)]
        place = time[:, None]
    with (
        replacing(path) as new,
        open(new, "w", newline="", encoding="utf-8") as file,
    ):
        table = csv.writer(file)
        table.writerow([*header, *names])
        for experiment, inputs in enumerate(u):
            for row in np.concatenate([place, inputs], axis=1):
                table.writerow([experiment, *(f"{x:.10g}" for x in row)])
