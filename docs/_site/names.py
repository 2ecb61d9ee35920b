"""Public names in text lead to their entries in the reference: `hj.linearize`, and `LDTP`."""

import re
from collections import Counter
from pathlib import Path


REFERENCE = Path(__file__).parents[1] / "reference"
_CODE = re.compile(r"(?<!<span></span>)<code>((?:hj\.)?(\w[\w.]*\w))([^<]*)</code>")


def _entries() -> dict[str, str]:
    """Those that are known by their last word: one of a kind, and no word of everyday."""
    pages = "".join(path.read_text() for path in REFERENCE.glob("*.md"))
    names = re.findall(r"^::: (\S+)", pages, re.MULTILINE)
    count = Counter(name.split(".")[-1] for name in names)
    last = {name.split(".")[-1]: name for name in names}
    return {
        word: name for word, name in last.items() if count[word] == 1 and _special(word)
    }


def _special(word: str) -> bool:
    return "_" in word or not word.islower()


# Terms of the glossary, by their anchors.
_TERMS = {
    "chart": "charts?",
    "isochron": "isochrons?",
    "excited-line": "excited (?:lines?|frequenc(?:y|ies))",
    "htf": r"harmonic transfer functions?(?: \(HTFs?\))?|HTFs?",
    "ldtp": "LDTPs?(?: systems?)?",
    "limit-cycle": "limit cycles?",
    "modulus": "modul(?:us|i)",
    "multiplier": "(?:Floquet )?multipliers?",
    "section": "(?:Poincaré )?sections?",
    "return-map": "return maps?",
    "saltation": "saltation matri(?:x|ces)",
    "autonomous": "autonomous systems?",
    "coverage": "coverage",
    "cramer-rao": "Cramér-Rao bounds?",
    "distortion": "(?:nonlinear )?distortion",
    "realization": "realizations?",
    "phase-response": "phase responses?(?: curves?)?",
}
# Where no link may begin: in code, equations, headings, tables, HTML and other links.
_OTHER = r"```.*?^```|`[^`]*`|\$[^$]*\$|^[#|<!].*?$|\[[^\]]*\](?:\([^)]*\))?|^ {4}.*?$"


def on_page_markdown(markdown: str, page, **_) -> str:
    """The first mention of a term on a page leads to its entry in the glossary."""
    source = page.file.src_uri
    if source in ("glossary.md", "changelog.md") or source.startswith("reference/"):
        return markdown
    glossary = "../" * source.count("/") + "glossary.md"
    for anchor, term in _TERMS.items():
        pattern = re.compile(
            rf"{_OTHER}|\b(?P<term>{term})\b", re.MULTILINE | re.DOTALL
        )
        first = next((x for x in pattern.finditer(markdown) if x["term"]), None)
        if first:
            link = f"[{first['term']}]({glossary}#{anchor})"
            markdown = markdown[: first.start()] + link + markdown[first.end() :]
    return markdown


def on_page_content(content: str, page, **_) -> str:
    entries = _entries()
    # What does not exist stops a strict build; the changelog also names what once was.
    optional = "optional " if page.file.src_uri == "changelog.md" else ""

    def linked(code: re.Match) -> str:
        whole, name, rest = code.groups()
        identifier = (
            f"hybridjax.{name}" if whole.startswith("hj.") else entries.get(name)
        )
        if identifier is None:
            return code[0]
        return f'<autoref {optional}identifier="{identifier}"><code>{whole}{rest}</code></autoref>'

    return _CODE.sub(linked, content)
