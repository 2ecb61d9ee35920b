"""Frequency responses as a notebook shows them."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..signal import ratio, with_unit
from .parts import card, table
from .svg import COLORS, Curve, picture


# Outputs and harmonics that a notebook shows: the largest ones of these. Doubled: twice the size.
_OUTPUTS, _HARMONICS = 3, 5


def response_card(
    f: Float[np.ndarray, " F"],
    size: Float[np.ndarray, "M F ny"],
    harmonics: Sequence[int],
    u: str,
    outputs: Sequence[str],
    about: str,
) -> str:
    """HTFs from one input.

    **Arguments:** `size`: their moduli. `about`: their `repr`, `HTF(source; what they are)`.
    """
    order, peaks = np.argsort(f), np.nanmax(size, axis=1)
    largest = np.argsort(-np.nanmax(peaks, axis=1), kind="stable")[:_HARMONICS]
    drawn, rows = [], []
    for j, y in enumerate(outputs[:_OUTPUTS]):
        curves = [
            Curve(f[order], size[k, order, j], f"H_{harmonics[k]}", COLORS[i])
            for i, k in enumerate(np.sort(largest))
        ]
        name = with_unit(f"|H|, {u} to {y}", ratio(y, u))
        drawn.append(picture(curves, "f (cycles/period)", name, log=True))
        rows += [
            (y, f"H_{harmonics[k]}", f"{peaks[k, j]:.4g}", f"{f[size[k, :, j].argmax()]:.4g}")
            for k in np.sort(largest)
        ]
    source, _, rest = about.removeprefix("HTF(").partition("; ")
    values = table(("output", "", "largest modulus", "at f"), rows)
    return card("HTF", f"({source}): {rest.removesuffix(')')}", *drawn, values)
