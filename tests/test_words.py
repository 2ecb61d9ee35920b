"""Pages, docstrings and messages use the field's words (CONTRIBUTING.md, "How to write")."""

import ast
import pathlib
import re


ROOT = pathlib.Path(__file__).parents[1]
# Private word: the standard term. Only phrases that have no other use are listed.
EXCLUDED = {
    r"Gauss and Newton's": "Gauss-Newton",
    r"Levenberg and Marquardt's": "Levenberg-Marquardt",
    r"normal errors": "Gaussian errors",
    r"thrown back": "restitution",
    r"invented by noise": "spurious",
    r"(?:goes?|brought|brings?|come|comes) home": "reach the target section",
    r"the data (?:carry|see|allow)": "identify, support",
    r"flows? freely|flowing freely": "simulate without solving, burn-in",
    r"the values end": "end of the parameter range",
    r"(?:is|are) dear": "expensive",
    r"numbers from elsewhere": "published values",
    r"the free one": "floating-base model",
    r"calmly|eventfully": "no-event path, event path",
    r"solved for inside": "eliminated (variable projection)",
}
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
FILES = [p for p in PAGES if p.name not in ("CONTRIBUTING.md", "CHANGELOG.md")]
FILES += (ROOT / "hybridjax").rglob("*.py")


def texts(path: pathlib.Path) -> str:
    """A page, or the strings and comments of a module."""
    source = path.read_text()
    if path.suffix == ".md":
        return source
    nodes = (x for x in ast.walk(ast.parse(source)) if isinstance(x, ast.Constant))
    strings = [x.value for x in nodes if isinstance(x.value, str)]
    return "\n".join([*strings, *re.findall(r"#(.*)", source)])


def test_private_words_have_standard_terms():
    pages = {str(path.relative_to(ROOT)): texts(path) for path in FILES}
    for phrase, term in EXCLUDED.items():
        pattern = re.compile(rf"\b(?:{phrase})\b".replace(" ", r"\s+"))
        assert not [name for name, text in pages.items() if pattern.search(text)], (
            f"write {term!r}"
        )
