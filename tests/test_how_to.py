"""The sessions of how-to pages, index.md and experiments.md print what the pages show."""

import pytest
from matplotlib import pyplot

from .sessions import ROOT, Session, blocks, same_output


PAGES = ["docs/index.md", "docs/experiments.md"]
PAGES += [f"docs/how-to/{p.name}" for p in (ROOT / "docs/how-to").glob("*.md")]


@pytest.mark.slow
@pytest.mark.parametrize("page", sorted(PAGES))
def test_the_page_runs_and_prints_what_it_shows(page, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    session, printed = Session(page, monkeypatch), ""
    for language, text in blocks(page):
        if language == "python":
            session.run(text)
            printed = capsys.readouterr().out
        elif language == "text":
            assert same_output(text, printed), f"{page} shows\n{text}\nbut prints\n{printed}"
    pyplot.close("all")
