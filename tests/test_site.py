"""The site: every public name is in its reference, and it needs no other host."""

import ast
import html
import importlib
import re
import shutil
import subprocess
from collections import Counter
from urllib.parse import unquote

import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj

from .sessions import ROOT, run_python
from .test_typing import UNCHECKED


def public_names() -> list[str]:
    """What the tables of public names (`__init__.pyi`) hold."""
    names = []
    for table in (ROOT / "hybridjax").rglob("__init__.pyi"):
        package = ".".join(table.parent.relative_to(ROOT).parts)
        for line in ast.parse(table.read_text()).body:
            if (
                isinstance(line, ast.ImportFrom) and line.module
            ):  # (others import namespaces)
                names += [f"{package}.{alias.asname}" for alias in line.names]
    return names


def test_every_public_name_is_in_the_reference_once():
    files = (ROOT / "docs/reference").glob("*.md")
    pages = "".join(page.read_text() for page in files)
    assert Counter(re.findall(r"^::: (\S+)$", pages, re.MULTILINE)) == Counter(
        public_names()
    )


# Results of functions, and classes of errors.
GIVEN = UNCHECKED["made by this package"] | {
    "ComputationError",
    "Design",
    "FileFormatError",
    "Flow",
    "FindingWarning",
    "LDTP",
    "PrecisionError",
    "PlantCycle",
    "Simulated",
    "StoredExperiments",
}


# Constants, types for annotations and `except`, and codes.
NOT_CALLED = {"COLORS", "PAGE", "Parameter", "Fit", "Result"} | {
    "DefinitionError",
    "HybridJaxError",
}


def test_users_call_or_construct_150_names_at_most():
    others = GIVEN | NOT_CALLED
    called = [name for name in public_names() if name.split(".")[-1] not in others]
    assert len(called) <= 150


def test_every_public_name_that_a_user_writes_is_in_an_example():
    """Slow tests run the how-to pages and the README; notebooks run when they are built."""
    guides = (ROOT / "docs/how-to").glob("*.md")
    pages = [ROOT / "README.md", *guides]
    text = "".join(page.read_text() for page in pages)
    code = "".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL))
    files = (ROOT / "notebooks").glob("*.py")
    code += "".join(page.read_text() for page in files)
    last_parts = {name.split(".")[-1] for name in public_names()}
    written = last_parts - GIVEN
    missing = {name for name in written if not re.search(rf"\b{name}\b", code)}
    assert not missing


def test_citations_have_the_version_of_the_package():
    bibtex, cff = ((ROOT / x).read_text() for x in ("docs/cite.md", "CITATION.cff"))
    assert f"version = {{{hj.__version__}}}" in bibtex
    assert f"version: {hj.__version__}" in cff


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    pytest.importorskip(
        "mkdocs", reason="pip install '.[docs]' installs what builds the site"
    )
    folder = tmp_path_factory.mktemp("site")
    run_python("-m", "mkdocs", "build", "--strict", "--site-dir", folder, cwd=ROOT)
    return folder


@pytest.mark.slow
def test_the_pictures_of_the_home_page_are_those_that_are_drawn_now(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs/_site")
    pictures = importlib.import_module("pictures")
    for name, plot in pictures.draw().items():
        for now, file in zip(pictures.numbers(plot), pictures.drawn(name), strict=True):
            off = np.subtract(now["points"], file["points"])
            size = np.abs(file["points"])
            assert np.all(
                np.abs(off) <= file["within"] * size.max(axis=0, initial=1e-9)
            )


@pytest.mark.slow
def test_thumbnails_are_those_of_the_code_on_their_pages(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs/_site")
    pictures = importlib.import_module("pictures")

    def values(text):
        return np.array(re.findall(r"-?\d+(?:\.\d+)?", text), float)

    for name in ("compass-gait", "slip", "van-der-pol"):
        drawing = (pictures.IMAGES / f"gallery/{name}.svg").read_text()
        file = values(drawing)
        assert_allclose(
            values(pictures.thumbnail(*pictures.run(name))), file, atol=1.01
        )


@pytest.mark.slow
def test_the_gallery_has_a_page_with_code_for_each_thumbnail(site):
    pages = re.findall(
        r'<a href="(gallery/[\w-]+\.html)"><svg', (site / "gallery.html").read_text()
    )
    assert len(set(pages)) == 29
    for page in pages:
        assert "find_limit_cycle" in (site / page).read_text()


@pytest.mark.slow
def test_nothing_is_fetched_from_another_host(site):
    fetched = re.compile(r"<(?!a\s)[^>]*\s(?:src|href)=[\"']?(?:https?:)?//[^>]*>")
    for page in site.rglob("*.html"):
        assert not fetched.findall(page.read_text()), page
    for style in site.rglob("*.css"):
        assert not re.findall(
            r"url\([\"']?(?:https?:)?//|@import", style.read_text()
        ), style


@pytest.mark.slow
def test_links_lead_somewhere(site):
    """Also those that MkDocs does not look at: in HTML, and in the theme's."""
    pages = {page: page.read_text() for page in site.rglob("*.html")}
    known = {
        page: set(re.findall(r'\sid="([^"]+)"', text)) for page, text in pages.items()
    }
    for page, text in pages.items():
        # (The page of errors has links from the root of the host.)
        for link in (
            re.findall(r'\s(?:href|src)="([^":]*)"', text) if page.stem != "404" else ()
        ):
            path, _, anchor = unquote(html.unescape(link)).partition("#")
            target = (page.parent / path).resolve() if path else page
            target = target / "index.html" if target.is_dir() else target
            assert target.exists(), (page, link)
            anchors = known.get(target, {anchor})
            assert anchor in anchors | {""}, (page, link)


@pytest.mark.slow
def test_footers_have_version_license_and_citation(site):
    for page in site.rglob("*.html"):
        footer = page.read_text().partition('class="md-copyright"')[2]
        assert page.stem == "404" or all(
            text in footer for text in (hj.__version__, "Apache-2.0", "@software{")
        ), page


@pytest.mark.slow
def test_equations_are_rendered(site):
    page = (site / "mathematics.html").read_text()
    assert page.count("<math") > 100
    assert "arithmatex" not in page
    assert "$" not in re.sub(r"<(pre|code|script).*?</\1>", "", page, flags=re.DOTALL)


@pytest.mark.slow
def test_notebooks_come_with_their_pictures(site):
    for notebook in (ROOT / "notebooks").glob("*.ipynb"):
        page = (site / "notebooks" / f"{notebook.stem}.html").read_text()
        pictures = re.findall(r'src="([\w-]+\.png)"', page)
        text = notebook.read_text()
        # or animations
        assert len(pictures) == text.count('"image/png"')
        assert "image/" in text
        for name in pictures:
            assert (site / "notebooks" / name).exists()


@pytest.mark.slow
@pytest.mark.parametrize("notebook", ["play", "simulator"])
def test_animations_of_notebooks_run_in_a_browser(site, notebook, tmp_path):
    """Of two pictures that lie upon each other, the script changes the second."""
    names = ("chromium", "chromium-browser", "google-chrome")
    browser = next(filter(None, map(shutil.which, names)), None)
    if browser is None:
        pytest.skip("there is no Chromium here: its packages are called 'chromium'")

    def pictures(text):
        boxes = re.findall(r'<div id="motion-.*?<script>', text, re.DOTALL)
        return [re.findall(r'<img[^>]*src="([^"]+)"', box)[1] for box in boxes]

    page = site / f"notebooks/{notebook}.html"
    first = pictures(page.read_text())
    count = (ROOT / f"notebooks/{notebook}.ipynb").read_text().count('id=\\"motion-')
    assert len(first) == count > 0
    options = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage")
    profile = f"--user-data-dir={tmp_path}"
    moved = set()
    for time in (
        300,
        700,
    ):  # ms after the start (a cycle may be as short as one of them)
        budget = f"--virtual-time-budget={time}"
        run = [browser, *options, profile, budget, "--dump-dom", page.as_uri()]
        shown = subprocess.run(run, capture_output=True, text=True, timeout=120).stdout
        now = pictures(shown)
        changed = {k for k in range(count) if now[k] != first[k]}
        moved |= changed
    assert moved == set(range(count))
