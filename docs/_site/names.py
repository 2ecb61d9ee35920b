"""Public names in a page's text lead to their entries in the reference."""

import re


def on_page_content(content: str, **_) -> str:
    return re.sub(
        r"<code>hj\.([\w.]+\w)([^<]*)</code>",
        r'<autoref identifier="hybridjax.\1"><code>hj.\1\2</code></autoref>',
        content,
    )
