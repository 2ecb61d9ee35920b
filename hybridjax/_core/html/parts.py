"""Pieces of HTML, of which the `_repr_html_` of a result is made: cards, facts, tables.

All texts are escaped here, names of users among them. Colors are those around: text and lines are
drawn in the current color, on no background, so that both light and dark themes can be read.
"""

from collections.abc import Iterable, Mapping, Sequence
from html import escape


# Rows of a table that are shown. Doubled: twice the size of tables of many trials, or points.
_ROWS = 12

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


def card(kind: str, of: str, *parts: str) -> str:
    """A result: what it is, and of what; its parts side by side where there is room.

    **Arguments:** `kind` and `of` are texts; `parts` HTML, made by the functions of this folder.
    """
    head = f"<strong>{escape(kind)}</strong> {escape(of)}".rstrip()
    return f'{_STYLE}<div class="hybridjax">{head}<div>{"".join(parts)}</div></div>'


def facts(pairs: Mapping[str, str]) -> str:
    """What is known, by what it is called."""
    rows = (f"<tr><th>{escape(x)}</th><td>{escape(text)}</td></tr>" for x, text in pairs.items())
    return f'<table class="plain">{"".join(rows)}</table>'


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table, of which the first rows are shown, and how many more there are."""
    rows = list(rows)
    lines = [_row("th", head), *(_row("td", row) for row in rows[:_ROWS])]
    if len(rows) > _ROWS:
        lines.append(_row("td", [f"and {len(rows) - _ROWS} more"]))
    return f'<table class="plain">{"".join(lines)}</table>'


def text(lines: str) -> str:
    """Lines as they would be printed."""
    return f"<pre>{escape(lines)}</pre>" if lines else ""


def _row(cell: str, texts: Sequence[str]) -> str:
    return f"<tr>{''.join(f'<{cell}>{escape(x)}</{cell}>' for x in texts)}</tr>"
