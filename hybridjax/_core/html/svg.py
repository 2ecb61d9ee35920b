"""Small pictures: curves on two axes, as SVG of a few kilobytes, without matplotlib."""

import math
from collections.abc import Iterable, Iterator, Sequence
from html import escape
from typing import NamedTuple

import numpy as np


# Points of a curve that are drawn. Doubled: pictures of twice the size, no smoother to the eye.
_POINTS = 120
# The picture, and the room on its left, right, top and bottom for numbers and names.
_WIDTH, _HEIGHT = 300, 200
_LEFT, _RIGHT, _TOP, _BOTTOM = 48, 8, 20, 34
# About so many numbers on an axis.
_TICKS = 4
# Curves of more decades than this are cut off at the bottom.
_DECADES = 8
# Room around the curves, as a part of their height.
_MARGIN = 0.05

COLORS = ("#2b8cc4", "#d9692b", "#12a37a", "#c46fa0", "#c99214", "#8c8c8c")
"""Of curves: those of `hj.plot`, with a lightness that black and white let be seen."""


class Curve(NamedTuple):
    """Something that is drawn."""

    x: np.ndarray
    """Where it is; broken where x or y is NaN."""
    y: np.ndarray
    name: str = ""
    """What it is called, above the picture."""
    color: str = COLORS[0]
    points: bool = False
    """Whether it is a set of points, and no line."""


class _Scale(NamedTuple):
    """From numbers, of which the first two are ends of an axis, to pixels."""

    low: float
    high: float
    first: int
    last: int

    def __call__(self, v):
        return self.first + (v - self.low) / (self.high - self.low) * (self.last - self.first)


def thinned(n: int, share: float = 1.0) -> np.ndarray:
    """Indices of as many of n samples, evenly spaced, as are drawn; fewer of a part of a curve,
    which has a share of its points."""
    few = max(2, math.ceil(share * _POINTS))
    return np.unique(np.linspace(0, n - 1, min(n, few)).round().astype(int))


def picture(
    curves: Sequence[Curve], x: str = "", y: str = "", *, log: bool = False, square: bool = False
) -> str:
    """Curves on axes called `x` and `y`; none where there is nothing finite to be drawn.

    **Arguments:** `log`: whether the y axis is logarithmic. `square`: whether a unit is as long on
    both axes.
    """
    if log:
        curves = [c._replace(y=_log(c.y)) for c in curves]
    across, up = (_span([c[k] for c in curves]) for k in (0, 1))
    if across is None or up is None:
        return ""
    if log:
        up = max(up[0], up[1] - _DECADES), up[1]
    width, height = _WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM
    if square:
        unit = max((across[1] - across[0]) / width, (up[1] - up[0]) / height)
        across, up = (
            (sum(s) / 2 - unit * pixels / 2, sum(s) / 2 + unit * pixels / 2)
            for s, pixels in ((across, width), (up, height))
        )
    right, bottom = _LEFT + width, _TOP + height
    px, py = _Scale(*across, _LEFT, right), _Scale(*up, bottom, _TOP)
    parts = [
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" width="{_WIDTH}" height="{_HEIGHT}" role="img" '
        'fill="none" font-size="10" font-family="sans-serif">',
        f'<path d="M{_LEFT} {_TOP}V{bottom}H{right}" stroke="currentColor" opacity=".5"/>',
        '<g fill="currentColor" opacity=".8">',
        *(_tick(px(v), bottom + 12, label, "middle") for v, label in _ticks(across)),
        *(_tick(_LEFT - 4, py(v) + 3, label, "end") for v, label in _ticks(up, log)),
        _tick((_LEFT + right) / 2, _HEIGHT - 6, x, "middle"),
        f'<text x="4" y="11">{escape(y)}</text></g>',
    ]
    parts += [_drawn(c, px, py) for c in curves]
    parts.append(_legend(curves))
    return "".join(parts) + "</svg>"


def _drawn(c: Curve, px: _Scale, py: _Scale) -> str:
    keep = thinned(len(c.x))
    with np.errstate(invalid="ignore"):
        at = np.round(
            [px(np.asarray(c.x)[keep]), np.minimum(py(np.asarray(c.y)[keep]), py.first)], 1
        )
    if c.points:
        dots = (f'<circle cx="{a:g}" cy="{b:g}" r="2.5"/>' for a, b in at.T if a == a and b == b)
        return f'<g fill="{c.color}">{"".join(dots)}</g>'
    pieces = "".join(_path(piece) for piece in _unbroken(at))
    return f'<path d="{pieces}" stroke="{c.color}" stroke-width="1.5"/>'


def _unbroken(at: np.ndarray) -> Iterator[np.ndarray]:
    """The pieces between columns with NaN."""
    good = np.isfinite(at).all(axis=0)
    edges = np.flatnonzero(np.diff(good.astype(int), prepend=0, append=0)).reshape(-1, 2)
    yield from (at[:, a:b] for a, b in edges if b - a > 1)


def _path(piece: np.ndarray) -> str:
    """From point to point, by tenths of a pixel."""
    steps = np.diff(np.round(10 * piece).astype(int))
    steps = steps[:, (steps != 0).any(axis=0)] / 10
    return f"M{piece[0, 0]:g} {piece[1, 0]:g}l" + " ".join(f"{a:g} {b:g}" for a, b in steps.T)


def _legend(curves: Sequence[Curve]) -> str:
    named = [c for c in curves if c.name]
    if not named:
        return ""
    spans = (f'<tspan fill="{c.color}" dx="6">{escape(c.name)}</tspan>' for c in named)
    return f'<text x="{_WIDTH - _RIGHT}" y="11" text-anchor="end">{"".join(spans)}</text>'


def _tick(x: float | int, y: float | int, label: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(label)}</text>'


def _log(y: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log10(np.where(np.asarray(y) > 0, y, np.nan))


def _span(values: Iterable[np.ndarray]) -> tuple[float, float] | None:
    """From the smallest to the largest, with a little room; None if nothing is finite."""
    finite = [v[np.isfinite(v)] for v in map(np.asarray, values)]
    finite = [v for v in finite if v.size]
    if not finite:
        return None
    low, high = float(min(v.min() for v in finite)), float(max(v.max() for v in finite))
    # (What is constant up to rounding is drawn as a line in the middle.)
    room = max(_MARGIN * (high - low), 1e-6 * max(abs(low), abs(high))) or 1.0
    return low - room, high + room


def _ticks(span: tuple[float, float], log: bool = False) -> list[tuple[float, str]]:
    """Round numbers in a span, and how they are written."""
    low, high = span
    rough = (high - low) / _TICKS
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(x * power for x in (1, 2, 5, 10) if x * power >= rough * (1 - 1e-9))
    if log:
        step = max(1.0, float(round(step)))
    values = [step * k for k in range(math.ceil(low / step), math.floor(high / step) + 1)]
    if log:
        return [(v, f"1e{v:.0f}" if abs(v) > 2 else f"{10**v:g}") for v in values]
    # As many digits as tell neighbors apart.
    digits = max(6, math.ceil(math.log10(max(abs(low), abs(high)) / step)) + 1)
    return [(v, f"{v:.{digits}g}" if v else "0") for v in values]
