"""What stands beside docs/ and belongs to the site: executed notebooks, and lists of the root."""

import base64
import json
import re
from pathlib import Path

from mkdocs.plugins import event_priority
from mkdocs.structure.files import File


ROOT = Path(__file__).parents[2]
LISTS = {
    "CHANGELOG.md": "changelog.md",
    "CLAIMS.md": "claims.md",
    "KNOWN_GAPS.md": "known-gaps.md",
}


_outputs: dict[str, str] = {}
"""Tables and animations of notebooks, by what stands for them in the Markdown."""


def on_files(files, config):
    for name, page in LISTS.items():
        files.append(File.generated(config, page, abs_src_path=str(ROOT / name)))
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        for name, content in _pages(path).items():
            files.append(File.generated(config, f"notebooks/{name}", content=content))
    return files


def on_page_markdown(markdown: str, page, **_) -> str:
    """Links between docs/ and the files beside it. The home page takes the whole width."""
    if page.is_homepage:
        page.meta["hide"] = ["navigation", "toc"]
    up = "../" * page.file.src_uri.count("/")
    markdown = re.sub(
        r"\]\((?:\.\./)+(notebooks/\w+)\.ipynb", rf"]({up}\1.md", markdown
    )
    for name, target in LISTS.items():
        markdown = re.sub(rf"\]\((?:\.\./)+{name}", f"]({up}{target}", markdown)
    if page.file.src_uri in LISTS.values():
        markdown = markdown.replace("](docs/", "](")
    return markdown


@event_priority(-100)  # after all that change pages
def on_page_content(html: str, **_) -> str:
    """Outputs of notebooks as they are, in place of their marks."""
    for mark, output in _outputs.items():
        html = html.replace(mark, output)
    return html


def _pages(path: Path) -> dict[str, str | bytes]:
    """A notebook as a page, and its pictures."""
    parts, pictures = [], {}
    for cell in json.loads(path.read_text())["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            data = output.get("data", {"text/plain": output.get("text")})
            if "text/html" in data:
                # (Markdown would take part of it for its own, and scripts would not run.)
                mark = f'<div id="output-{path.stem}-{len(_outputs)}"></div>'
                _outputs[mark] = "".join(data["text/html"])
                parts.append(mark)
            elif "image/png" in data:
                name = f"{path.stem}-{len(pictures) + 1}.png"
                pictures[name] = base64.b64decode(data["image/png"])
                code = re.sub(r"[\[\]`\n]", " ", source.strip().rsplit("\n", 1)[-1])
                is_wide = (
                    int.from_bytes(pictures[name][16:20]) > 800
                )  # (where PNGs have it)
                kind = "{ .wide }" if is_wide else ""
                parts.append(
                    f"![Figure that the code above draws: {code}]({name}){kind}"
                )
            elif (
                "text/plain" in data
            ):  # (what a long call said of itself is empty in the end)
                parts.append(f"```text\n{''.join(data['text/plain'])}\n```")
    return {f"{path.stem}.md": "\n\n".join(parts)} | pictures
