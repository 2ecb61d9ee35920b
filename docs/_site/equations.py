"""Equations become MathML, which browsers show without scripts."""

import html
import re

from math_core import LatexToMathML


_WRITTEN = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\\[(\[](?P<tex>.*?)\\[)\]]</(?P=tag)>',
    re.DOTALL,
)
_CONVERTER = LatexToMathML()


def on_page_content(content: str, **_) -> str:
    return _WRITTEN.sub(_mathml, content)


def _mathml(written: re.Match) -> str:
    tex, block = html.unescape(written["tex"]), written["tag"] == "div"
    return _CONVERTER.convert_with_local_state(tex, displaystyle=block)
