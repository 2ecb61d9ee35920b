"""The gallery: thumbnails that move under the pointer, and a page for each model with its code.

The code of a page is that of its case in `benchmarks/gallery_cases.py`; numbers, text and the large
picture are those of `docs/gallery.md`.
"""

import ast
import re
from pathlib import Path

from mkdocs.structure.files import File


ROOT = Path(__file__).parents[2]
_ARGUMENTS = "guess", "section", "multiplicity", "conserved", "max_period"
_PICTURE = r"^!\[{name}\]\(images/gallery/{name}\.png\)$"


def slug(name: str) -> str:
    return "".join(x if x.isalnum() else "-" for x in name.lower()).replace("--", "-")


def codes() -> dict[str, tuple[str, str]]:
    """Title and code of each case, by the name of its picture."""
    tree = ast.parse((ROOT / "benchmarks/gallery_cases.py").read_text())
    values = {
        x.targets[0].id: x.value
        for x in tree.body
        if isinstance(x, ast.Assign) and isinstance(x.targets[0], ast.Name)
    }
    cases = next(x for x in tree.body if isinstance(x, ast.AnnAssign)).value
    return {
        slug(key.value): _code(slug(key.value), case.body, values)
        for key, case in zip(cases.keys, cases.values, strict=True)
    }


def _code(name: str, case: ast.Call, values: dict[str, ast.expr]) -> tuple[str, str]:
    given = {x.arg: x.value for x in case.keywords}
    plane = case.args[8]
    plane = ast.literal_eval(values[plane.id] if isinstance(plane, ast.Name) else plane)
    options = [f"{x}={ast.unparse(given[x])}" for x in _ARGUMENTS if x in given]
    system = re.sub(r"\bm\.", "hj.models.", ast.unparse(case.args[1]))
    find = ", ".join(["system", *options]).replace("m.Simplest", "hj.models.Simplest")
    shown = "".join(f", {x!r}" for x in plane or ()).replace("'", '"')
    call = f"cycle = hj.find_limit_cycle({find})"
    if len(call) > 88:  # (longer lines run out of their block)
        call = f"cycle = hj.find_limit_cycle(\n    {find}\n)"
    return case.args[0].value, (
        f"import hybridjax as hj\n\nhj.enable_x64()\nsystem = {system}\n"
        f"{call}\nprint(cycle)\n"
        f'hj.plot.animate(cycle{shown}).save("{name}.gif")\n'
    ).replace("'", '"')


def on_files(files, config):
    text = (ROOT / "docs/gallery.md").read_text()
    head, *rows = re.findall(r"^\| .*\|$", text.split("## Numbers")[1], re.MULTILINE)
    for name, (title, code) in codes().items():
        row = next(x for x in rows if x.startswith(f"| {title} |"))
        numbers = zip(head.split("|")[2:-1], row.split("|")[2:-1], strict=True)
        about = "\n".join(f"| {x} | {y} |" for x, y in numbers)
        words = _words(text, name)
        parts = [
            f"# {title[0].upper()}{title[1:]}\n\n{words}",
            _moving(name, title, "0s"),
            f"```python\n{code}```",
            f"![{_alt(title)}](../images/gallery/{name}.png){{ .wide }}",
            f"| number | value |\n|---|---|\n{about}",
            "[All models, and the meaning of the numbers](../gallery.md)",
        ]
        content = "\n\n".join(parts)
        files.append(File.generated(config, f"gallery/{name}.md", content=content))
    return files


def on_page_markdown(markdown: str, page, **_) -> str:
    """Thumbnails in place of the large pictures, and the table at the end."""
    if page.file.src_uri != "gallery.md":
        return markdown
    for part in re.split(r"^## ", markdown, flags=re.MULTILINE)[1:]:
        cards = []
        for name, (title, _) in codes().items():
            if re.search(_PICTURE.format(name=name), part, re.MULTILINE):
                hover = f"{name}.mouseover"
                svg = _moving(name, title, hover).replace("<svg", f'<svg id="{name}"')
                link = f'<a href="gallery/{name}.html">{svg}<span>{title}</span></a>'
                cards.append(link)
        if cards:
            title, rest = part.split("\n", 1)
            for name in codes():
                words = _words(markdown, name)
                rest = re.sub(_PICTURE.format(name=name), "", rest, flags=re.MULTILINE)
                rest = rest.replace(words + "\n", "") if words else rest
            grid = f'<div class="thumbnails">{"".join(cards)}</div>'
            markdown = markdown.replace(part, f"{title}\n\n{grid}\n{rest}")
    return markdown


def _words(text: str, name: str) -> str:
    """The paragraph before a picture."""
    before = re.split(_PICTURE.format(name=name), text, flags=re.MULTILINE)[0].rstrip()
    last = before.rsplit("\n\n", 1)[-1]
    return "" if last.startswith(("#", "!", "|")) else last


def _alt(title: str) -> str:
    return f"Limit cycle of the model ({title}) and its harmonic transfer functions over frequency"


def _moving(name: str, title: str, begin: str) -> str:
    svg = (ROOT / f"docs/images/gallery/{name}.svg").read_text().strip()
    end = f'begin="{begin}"' + (f' end="{name}.mouseout"' if begin != "0s" else "")
    return svg.replace('begin="0s"', end).replace(
        "<svg", f'<svg role="img" aria-label="{title}"'
    )
