"""Parts of the HTML that results show in notebooks: cards, tables, multipliers, small pictures.

All texts, names of users among them, are escaped here. Text and axes are drawn in the current color
on no background, so that both light and dark themes can be read.

If a page breaks, look whether its text goes through `text`, `facts` or `table`, which escape; if a
picture is empty, at `picture`.
"""

import io
import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from .text import number, rounded, standard_error


# Rows of a table, and points of a curve, that are shown. More make notebooks large: 12 rows fill
# half a screen, and a curve of 300 pixels with 120 points looks smooth.
_ROWS = 12
_POINTS = 120

_STYLE = (
    "<style>.hybridjax{font-size:13px;line-height:1.4}"
    ".hybridjax>div{display:flex;flex-wrap:wrap;gap:4px 24px;align-items:flex-start;"
    "overflow:auto}"
    ".hybridjax table{border-collapse:collapse;margin:4px 0;width:auto;"
    "color:inherit;font-size:inherit}"
    ".hybridjax th,.hybridjax td{padding:1px 10px 1px 0;border:0;text-align:left;"
    "white-space:nowrap;background:none;vertical-align:top}"
    ".hybridjax th{font-weight:normal;opacity:.7}"
    ".hybridjax td{font-variant-numeric:tabular-nums}"
    ".hybridjax pre{margin:4px 0;padding:0;background:none;color:inherit;font-size:12px;"
    "white-space:pre-wrap}"
    ".hybridjax svg{color:inherit;max-width:100%}</style>"
)
# A color of matplotlib that stands for the current color of the page.
_INK = "#010203"

COLORS = ("#2b8cc4", "#d9692b", "#12a37a", "#c46fa0", "#c99214", "#8c8c8c")
"""Colors of curves: those of `hj.plot`, light enough for a black page and dark enough for a white
one."""
CHARTS = tuple(COLORS[k] for k in (0, 4, 2, 3))
"""Those of the charts of a system, as in `hj.plot.cycle`."""


def card(kind: str, of: str, *parts: str) -> str:
    """The page of a result: its kind, what it belongs to, and its parts (HTML) side by side."""
    head = f"<strong>{escape(kind)}</strong> {escape(of)}".rstrip()
    return f'{_STYLE}<div class="hybridjax">{head}<div>{"".join(parts)}</div></div>'


def facts(pairs: Mapping[str, str]) -> str:
    """A table of values by name."""
    rows = [_row("td", [text], head=name) for name, text in pairs.items()]
    return f'<table class="plain">{"".join(rows)}</table>'


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """The first rows of a table, and how many more there are."""
    rows = list(rows)
    lines = [_row("th", head)]
    for row in rows[:_ROWS]:
        lines.append(_row("td", row))
    more = len(rows) - _ROWS
    if more > 0:
        lines.append(_row("td", [f"and {more} more"]))
    return f'<table class="plain">{"".join(lines)}</table>'


def text(lines: str) -> str:
    """Lines as they would be printed."""
    return f"<pre>{escape(lines)}</pre>" if lines else ""


def _row(cell: str, texts: Sequence[str], head: str | None = None) -> str:
    """A row of cells (`td`, `th`), after a head if there is one."""
    cells = [f"<{cell}>{escape(x)}</{cell}>" for x in texts]
    if head is not None:
        cells.insert(0, f"<th>{escape(head)}</th>")
    return f"<tr>{''.join(cells)}</tr>"


def multiplier_table(
    values: Complex[np.ndarray, " d"], errors: Float[np.ndarray, " d"] | None = None
) -> str:
    """The multipliers, their standard errors if they are given, and their moduli."""
    if errors is None:
        columns = {"multiplier": [number(z) for z in values]}
    else:
        columns = {
            "multiplier": [*map(rounded, values, errors)],
            "± standard error": [standard_error(x) for x in errors],
        }
    columns["modulus"] = [f"{abs(z):.6g}" for z in values]
    return table(tuple(columns), zip(*columns.values(), strict=True))


class Curve(NamedTuple):
    """A curve of a picture."""

    x: Any
    y: Any
    """Broken where x or y is NaN."""
    name: str = ""
    color: str = COLORS[0]
    points: bool = False
    """Whether it is a set of points and not a line."""


def unit_circle(
    values: Complex[np.ndarray, " d"], regions: Sequence[Complex[np.ndarray, " _"]] = ()
) -> str:
    """A picture of multipliers, with the borders of their confidence regions."""
    circle = np.exp(2j * np.pi * np.linspace(0, 1, _POINTS))
    real = np.real(circle)
    imaginary = np.imag(circle)
    curves = [Curve(real, imaginary, color=COLORS[-1])]
    for z in regions:
        x = np.real(z).clip(-3, 3)
        y = np.imag(z).clip(-3, 3)
        curves.append(Curve(x, y, color=COLORS[0]))
    x = np.real(values)
    y = np.imag(values)
    curves.append(Curve(x, y, color=COLORS[1], points=True))
    return picture(curves, "real part", "imaginary part", square=True)


def picture(
    curves: Sequence[Curve],
    x: str = "",
    y: str = "",
    *,
    log: bool = False,
    square: bool = False,
) -> str:
    """An SVG of curves on axes called `x` and `y`, or "" where nothing finite can be drawn.

    **Arguments:** `log`: whether the y axis is logarithmic. `square`: whether both axes have one
    scale.
    """
    shown = [np.isfinite(c.x) & np.isfinite(c.y) for c in curves]
    if log:
        shown = [k & (np.asarray(c.y) > 0) for k, c in zip(shown, curves, strict=True)]
    if not any(visible.any() for visible in shown):
        return ""
    import matplotlib  # heavy, and needed by notebooks only
    from matplotlib.figure import Figure

    colors = (
        "axes.edgecolor",
        "axes.labelcolor",
        "text.color",
        "xtick.color",
        "ytick.color",
    )
    look: dict[Any, Any] = {"text.parse_math": False, **dict.fromkeys(colors, _INK)}
    look |= {"svg.fonttype": "none", "font.sans-serif": ["DejaVu Sans"], "font.size": 7}
    with matplotlib.rc_context(look):
        figure = Figure(figsize=(3.2, 2.2), layout="constrained")
        axes = figure.add_subplot(
            xlabel=x,
            title=y,
            aspect="equal" if square else "auto",
            yscale="log" if log else "linear",
        )
        axes.title.set(ha="left", x=0, size=7)
        axes.spines[["top", "right"]].set_visible(False)
        axes.locator_params(axis="x", nbins=5)
        axes.minorticks_off()
        if log:
            axes.yaxis.set_major_formatter("{x:g}")
        for c, visible in zip(curves, shown, strict=True):
            n = len(visible)
            places = np.linspace(0, n - 1, min(n, _POINTS))
            k = places.round().astype(int)
            values = np.where(visible, c.y, np.nan)[k]
            line: dict[str, Any] = (
                {"ls": "", "marker": "o", "ms": 3} if c.points else {"lw": 1}
            )
            color = _INK if c.color == "currentColor" else c.color
            axes.plot(
                np.asarray(c.x)[k], values, color=color, label=c.name or None, **line
            )
        if any(c.name for c in curves):
            axes.legend(frameon=False, handlelength=1, labelcolor="linecolor")
        file = io.StringIO()
        bare = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        figure.savefig(file, format="svg", transparent=True, metadata=bare)
    svg = file.getvalue()
    svg = re.sub(
        r"<style.*?</style>|<!--.*?-->|\n\s*", " ", svg[svg.index("<svg") :], flags=re.S
    )
    return svg.replace(_INK, "currentColor")
