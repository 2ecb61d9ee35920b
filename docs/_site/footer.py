"""The footer of each page: version, license, source, and the citation, which a click selects."""

import html
import re
from pathlib import Path

import hybridjax


ROOT = Path(__file__).parents[2]
LICENSE = "https://www.apache.org/licenses/LICENSE-2.0"


def on_page_context(context, page, config, **_):
    up = "../" * page.file.src_uri.count("/")
    source = config.repo_url or f"{up}design.html"
    links = " · ".join(
        [
            f"hybridjax {hybridjax.__version__}",
            f'License: <a href="{LICENSE}">Apache-2.0</a>',
            f'<a href="{source}">Source</a>',
            f'<a href="{up}known-gaps.html">Known gaps</a>',
        ]
    )
    config.copyright = (
        f"<p>{links}</p><details><summary>Cite (BibTeX)</summary>"
        f'<pre class="citation"><code>{html.escape(citation())}</code></pre></details>'
    )
    return context


def citation() -> str:
    """The BibTeX entry of the software, from the page about citing."""
    page = (ROOT / "docs/cite.md").read_text()
    block = re.search(r"```bibtex\n(.*?)```", page, re.DOTALL)[1]
    return block.split("\n\n")[0]
