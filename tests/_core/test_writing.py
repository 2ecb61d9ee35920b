"""All or nothing is written, nothing through links, and nothing of anybody else is touched."""

import json
import os

import pytest

import hybridjax as hj
from hybridjax._core.writing import results_folder


LIST = ".hybridjax-report.json"


def tree(folder):
    """All files and folders by name, with their contents; links with what they point to."""
    found = {}
    for path in folder.rglob("*"):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink():
            found[name] = "-> " + os.readlink(path)
        else:
            found[name] = path.read_text() if path.is_file() else None
    return found


def write(folder, results, names=()):
    with results_folder(folder, "report", names) as new:
        for name, text in results.items():
            (new / name).parent.mkdir(exist_ok=True)
            (new / name).write_text(text)


RESULTS = {"report.html": "page", "figures/bode.png": "image"}
MINE = {
    "notes.txt": "mine",
    "figures/mine.png": "mine",
    "data/trial.csv": "mine",
    ".hidden": "mine",
}


@pytest.fixture
def full(tmp_path):
    """A folder of somebody else, with links out of it."""
    folder = tmp_path / "full"
    for name, text in MINE.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    (tmp_path / "away").mkdir()
    (tmp_path / "away" / "file").write_text("away")
    os.symlink(tmp_path / "away", folder / "link")
    os.symlink("nowhere", folder / "dangling")
    return folder


def test_results_stand_beside_what_is_there(full):
    before = tree(full)
    write(full, RESULTS)
    after = tree(full)
    kept = {k: v for k, v in after.items() if k in before}
    assert kept == before
    added = {k: v for k, v in after.items() if k not in before and k != LIST}
    assert added == RESULTS


def test_later_results_take_the_place_of_earlier_ones(full):
    write(full, RESULTS | {"figures/old.png": "image"})
    write(full, {"report.html": "new page", "figures/bode.png": "image"})
    after = tree(full)
    assert after["report.html"] == "new page"
    assert "figures/old.png" not in after
    for name, text in MINE.items():
        assert after[name] == text
    listed = json.loads(after[LIST])
    assert set(listed) == set(RESULTS)


def link_to_away(folder):
    for path in (folder / "figures").iterdir():
        path.unlink()
    (folder / "figures").rmdir()
    os.symlink(folder.parent / "away", folder / "figures")


BLOCKS = {
    "file": lambda folder: (folder / "report.html").write_text("mine"),
    "link": lambda folder: os.symlink(folder / "notes.txt", folder / "report.html"),
    "folder": lambda folder: (folder / "report.html").mkdir(),
    "linked folder": link_to_away,
    "linked list": lambda folder: os.symlink(folder / "notes.txt", folder / LIST),
    "pipe as list": lambda folder: os.mkfifo(folder / LIST),
}


@pytest.mark.parametrize("early", [True, False], ids=["before", "after"])
@pytest.mark.parametrize("block", BLOCKS.values(), ids=BLOCKS)
def test_what_is_in_the_way_stays(full, block, early):
    """Refused before anything is computed, if the names of results are known by then."""
    block(full)
    before = tree(full.parent)
    with pytest.raises(
        hj.errors.DefinitionError,
        match="is in the way, and was not written by hybridjax",
    ):
        with results_folder(full, "report", RESULTS if early else ()) as new:
            assert not early
            (new / "figures").mkdir()
            for name, text in RESULTS.items():
                (new / name).write_text(text)
    assert tree(full.parent) == before


def test_nothing_is_written_through_a_link_to_a_folder(full):
    before = tree(full.parent / "away")
    with pytest.raises(hj.errors.DefinitionError, match="is a link or a device"):
        write(full / "link", RESULTS)
    assert tree(full.parent / "away") == before


def test_a_list_with_names_outside_touches_nothing_there(full):
    away = full.parent / "away" / "file"
    places = ["../away/file", str(away)]
    (full / LIST).write_text(json.dumps(places))
    write(full, RESULTS)
    assert away.read_text() == "away"


def test_an_error_leaves_nothing(tmp_path):
    for error in (ValueError, KeyboardInterrupt):
        with pytest.raises(error):
            with results_folder(tmp_path / "new" / "er", "report", []) as new:
                (new / "report.html").write_text("half")
                raise error
    assert tree(tmp_path) == {}


def test_an_interruption_while_results_take_their_places(full, monkeypatch):
    """Whatever is there then is known to be a result, so that the next call replaces it."""
    write(full, RESULTS | {"summary.json": "1"})
    replace = os.replace
    left = iter([True, True, False])

    def interrupted(source, target):
        if not next(left):
            raise KeyboardInterrupt
        replace(source, target)

    monkeypatch.setattr(os, "replace", interrupted)
    new = {name: "new" for name in RESULTS}
    with pytest.raises(KeyboardInterrupt):
        write(full, new)
    monkeypatch.undo()
    assert all((full / name).exists() for name in RESULTS)
    write(full, new)
    replaced = {k: v for k, v in tree(full).items() if v == "new"}
    assert replaced == new
    assert not [
        name for name in tree(full) if name.startswith(".hybridjax-") and name != LIST
    ]


DESIGN = hj.multisine(n_sections=4, periods=4, frequencies=(0.25, 0.5))
WRITERS = {
    "save": (lambda path: hj.save(path, DESIGN), "x.npz"),
    "Design.write": (lambda path: DESIGN.write(path), "x.csv"),
    "plot.save": (lambda path: DESIGN.plot().save(path), "x.png"),
}


@pytest.mark.parametrize(("writer", "name"), WRITERS.values(), ids=WRITERS)
def test_nothing_is_written_through_a_link(tmp_path, writer, name):
    folder = tmp_path / "folder"
    folder.mkdir()
    (tmp_path / "away").write_text("mine")
    os.symlink(tmp_path / "away", folder / name)
    with pytest.raises(hj.errors.DefinitionError, match="is a link"):
        writer(folder / name)
    assert (tmp_path / "away").read_text() == "mine"
    assert (folder / name).is_symlink()
    hidden = [path for path in folder.iterdir() if path.name.startswith(".")]
    assert not hidden
    (folder / name).unlink()
    os.mkfifo(folder / name)
    with pytest.raises(hj.errors.DefinitionError, match="is a link or a device"):
        writer(folder / name)
    (folder / name).unlink()
    writer(folder / name)
    assert (folder / name).stat().st_size > 100
