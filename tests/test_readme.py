"""Sessions of the README and of pages run and print what is shown."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from hybridjax.apps.cli import main

from .sessions import ROOT, Session, blocks, fences, run_python, same_output


CLAIMS = ROOT / "CLAIMS.md"
TOUR = "docs/how-to/tour.md"


def blocks_of(language):
    return [text for kind, text in blocks("README.md") if kind == language]


def test_the_comparison_sees_differences():
    assert same_output("x 1.0 error 2.0e-05\n", "x 1.0000001  error 3.0e-05")
    assert not same_output("x 1.0", "x 1.01")
    assert not same_output("x 1.0", "y 1.0")
    assert not same_output("error 2e-5", "error 2e-4")


def test_a_newcomer_meets_a_picture_and_code_first():
    lines = (ROOT / "README.md").read_text().splitlines()
    picture = next(n for n, line in enumerate(lines, 1) if line.startswith("!["))
    code = next(n for n, line in enumerate(lines, 1) if line.startswith("import "))
    found = (picture <= 8, code <= 12, len(lines) <= 90)
    assert found == (True, True, True)


def test_every_how_to_page_is_one_click_from_the_index():
    index = (ROOT / "docs/index.md").read_text()
    pages = {page.name for page in (ROOT / "docs/how-to").glob("*.md")}
    assert pages == set(re.findall(r"\]\(how-to/([\w-]+\.md)", index))


def test_sessions_print_what_the_readme_shows(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    session = Session("README.md", monkeypatch)
    for code, shown in zip(blocks_of("python"), blocks_of("text"), strict=True):
        session.run(code)
        printed = capsys.readouterr().out
        differ = f"README.md shows\n{shown}\nbut this is printed\n{printed}"
        assert same_output(shown, printed), differ


@pytest.fixture(scope="module")
def read_section(tmp_path_factory):
    """A function that runs the fences of one section of the tour after those of its opening, and
    returns the module in which they ran."""
    folder = tmp_path_factory.mktemp("tour")
    parts = re.split(r"^## (.*)$", (ROOT / TOUR).read_text(), flags=re.MULTILINE)
    sections = dict(zip(parts[1::2], parts[2::2], strict=True))

    def read(heading):
        for language, text in fences(sections[heading]):
            if language in ("python", "py"):
                session.run(text)
            elif language == "bash":
                command = text.replace("\\\n", "")
                arguments = shlex.split(command)[1:]
                assert main(arguments) in (None, 0)
        return session.module

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        session = Session(TOUR, patch)
        read("A session")
        read("Your own system")
        yield read


# (What they begin with takes as long as each, so one worker gets them.)
def section(test):
    grouped = pytest.mark.xdist_group("tour")(test)
    return pytest.mark.slow(pytest.mark.long(grouped))


@section
@pytest.mark.parametrize("heading", ["Batches and derivatives", "Fewer strides"])
def test_the_section_runs(heading, read_section):
    read_section(heading)


@section
def test_the_section_on_fits_finds_the_parameters(read_section):
    made = read_section("Continuation and parameter fits")
    for name in ("M", "k", "b"):  # up to the distortion that the experiments hold
        value, true = (float(getattr(x, name)) for x in (made.fit.system, made.hopper))
        assert abs(value / true - 1) < 1e-4, name


@section
def test_the_section_on_recordings_finds_the_multipliers(read_section):
    made = read_section("From a recording")
    found = made.result.fit.compare(made.cycle.multipliers)
    assert found.max_error < 1e-2
    assert Path("report/report.html").exists()


def test_links_lead_somewhere():
    documents = (ROOT / "docs").rglob("*.md")
    pages = [*ROOT.glob("*.md"), *documents]
    for page in pages:
        for link in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
            if "://" not in link:
                target = page.parent / link
                assert target.exists(), f"{page.name} links to {link}"


def test_files_that_documents_name_are_there():
    for page in [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]:
        if page.name != "CHANGELOG.md":
            for name in re.findall(r"`(\w+/[\w/]+\.py)\b", page.read_text()):
                places = ROOT / name, ROOT / "hybridjax" / name
                is_there = any(place.exists() for place in places)
                assert is_there, f"{page.name}: {name}"


def test_there_is_one_test_command_for_ci_to_find():
    found = [
        block
        for block in blocks_of("bash")
        if re.match("python3 -m venv .* pytest$", block)
    ]
    assert len(found) == 1
    script = ROOT / ".ci/run"
    assert script.stat().st_mode & 0o100
    assert "README.md" in script.read_text()


def test_claims_name_tests_that_exist():
    for path, name in re.findall(
        r"`(?:[^`]* )?(tests/\S+?\.py)(?:::(\w+))?`", CLAIMS.read_text()
    ):
        text = (ROOT / path).read_text()
        assert f"def {name}" in text, f"there is no {path}::{name}"


PAGES = ["docs/index.md", "docs/experiments.md"]
PAGES += [f"docs/how-to/{p.name}" for p in (ROOT / "docs/how-to").glob("*.md")]


def long_or_not(x):
    return [pytest.mark.long] * (Path(x).stem in LONG)


LONG = """experiments figures fit-parameters fmu identify-from-recordings learn-a-policy models
mujoco populations scale sweep unperturbed-gait""".split()


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [pytest.param(x, marks=long_or_not(x)) for x in sorted(PAGES)]
)
def test_the_page_runs_and_prints_what_it_shows(page, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    session = Session(page, monkeypatch)
    printed = ""
    for language, text in blocks(page):
        if language == "python":
            session.run(text)
            printed = capsys.readouterr().out
        elif language == "text":
            assert same_output(text, printed), (
                f"{page} shows\n{text}\nbut prints\n{printed}"
            )


@pytest.mark.slow
def test_the_example_runs_in_processes_of_its_own(tmp_path):
    *_, script = (
        text for kind, text in blocks("docs/how-to/scale.md") if kind == "python"
    )
    (tmp_path / "script.py").write_text(script)
    parts = run_python("script.py", cwd=tmp_path, timeout=300).split("around")
    scatter, mean = (
        [complex(z) for z in part.strip(" []\n").split()] for part in parts
    )
    true = (0.6 + 0.5j) ** 4
    np.testing.assert_allclose(mean, [true, true.conjugate()], atol=1e-3)
    assert 0 < abs(scatter[0]) < 2e-3
