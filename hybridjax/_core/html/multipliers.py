"""Floquet multipliers in a notebook: a table, and their places beside the unit circle."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Complex, Float

from .parts import table
from .svg import COLORS, Curve, picture


_CIRCLE = np.exp(2j * np.pi * np.linspace(0, 1, 121))


def complex_number(z: complex, digits: int = 6) -> str:
    """`-0.248983 + 0.699333i`."""
    if not z.imag:
        return f"{z.real:.{digits}g}"
    return f"{z.real:.{digits}g} {'-' if z.imag < 0 else '+'} {abs(z.imag):.{digits}g}i"


def multiplier_table(
    values: Complex[np.ndarray, " d"], half_widths: Float[np.ndarray, "d 2"] | None = None
) -> str:
    """The multipliers and their moduli; with half the widths of intervals of 95 % of their real and
    imaginary parts, if these are known."""
    if half_widths is None:
        rows = [(complex_number(z), f"{abs(z):.6g}") for z in values]
        return table(("multiplier", "modulus"), rows)
    rows = [
        (_with(z.real, a), _with(z.imag, b) if z.imag else "", f"{abs(z):.4g}")
        for z, (a, b) in zip(values, half_widths, strict=True)
    ]
    return table(("multiplier, 95 % interval", "imaginary part", "modulus"), rows)


def unit_circle(
    values: Complex[np.ndarray, " d"], regions: Sequence[Complex[np.ndarray, " _"]] = ()
) -> str:
    """A picture of the multipliers, with the borders of their confidence regions."""
    curves = [
        Curve(_CIRCLE.real, _CIRCLE.imag, color=COLORS[-1]),
        *(Curve(np.clip(z.real, -3, 3), np.clip(z.imag, -3, 3), color=COLORS[0]) for z in regions),
        Curve(values.real, values.imag, color=COLORS[1], points=True),
    ]
    return picture(curves, "real part", "imaginary part", square=True)


def _with(value: float, half_width: float) -> str:
    """`-0.24898 ± 0.00012`: as many digits as the interval deserves."""
    if not np.isfinite(half_width):
        return f"{value:.4g} (unknown)"
    if not half_width:
        return f"{value:.6g}"
    digits = int(np.clip(1 - np.floor(np.log10(half_width)), 0, 12))
    return f"{value:.{digits}f} ± {half_width:.{digits}f}"
