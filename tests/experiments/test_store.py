"""Folders of experiments that are damaged, hostile, or somewhere else than they seem to be."""

import json
import os

import numpy as np
import pytest

import hybridjax as hj
from hybridjax._core import limits
from hybridjax._core.files.archive import write_module
from hybridjax.experiments import StoredExperiments, store


ABOUT = {"format": store._FORMAT, "experiments": 5, "chunk": 2, "n_sections": 4}


def data(experiments, seed=0):
    u = np.random.default_rng(seed).normal(size=(experiments, 8, 1))
    return hj.ExperimentData(u, u, n_sections=4, periods=2)


@pytest.fixture
def stored(tmp_path):
    """Five experiments in three chunks."""
    store._open(tmp_path, ABOUT)
    stored = StoredExperiments(tmp_path)
    for k, experiments in enumerate((2, 2, 1)):
        write_module(stored.path(k), data(experiments, k), stored.path(k).stem)
    return stored


def test_chunks_are_read_in_order(stored):
    assert len(stored) == 3 and stored.missing() == []
    read = np.concatenate([part.u for part in stored])
    np.testing.assert_array_equal(
        read, np.concatenate([data(n, k).u for k, n in enumerate((2, 2, 1))])
    )
    assert stored.summary() == "5/5 ok"


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (dict(chunk=0), "`chunk` is 0"),
        (dict(chunk=-1), "`chunk` is -1"),
        (dict(chunk=None), "`chunk` is None"),
        (dict(chunk=True), "`chunk` is True"),
        (dict(chunk="2"), "`chunk` is '2'"),
        (dict(experiments=10**12), "declares 500000000000 chunks"),
        (dict(experiments=2.5), "`experiments` is 2.5"),
        (dict(experiments=[]), "`experiments` is "),
        (dict(n_sections=0), "`n_sections` is 0"),
        (dict(format="hybridjax experiments 1"), "of another version"),
        ([], "damaged, or of another version"),
        (None, "damaged, or of another version"),
    ],
)
def test_manifests(tmp_path, change, says):
    about = ABOUT | change if isinstance(change, dict) else change
    (tmp_path / "experiments.json").write_text(json.dumps(about))
    with pytest.raises(hj.errors.FileFormatError, match=says) as error:
        StoredExperiments(tmp_path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("text", ["", "{", "[" * 100_000, '{"format": 1}', "\x00"])
def test_manifests_that_are_no_json(tmp_path, text):
    (tmp_path / "experiments.json").write_text(text)
    with pytest.raises(hj.errors.FileFormatError, match="damaged, or of another version"):
        StoredExperiments(tmp_path)


def test_a_manifest_without_fields(tmp_path):
    (tmp_path / "experiments.json").write_text(json.dumps({"format": store._FORMAT}))
    with pytest.raises(hj.errors.FileFormatError, match="`experiments` is None"):
        StoredExperiments(tmp_path)


def test_a_manifest_longer_than_any(tmp_path, monkeypatch):
    monkeypatch.setattr(limits, "TEXT", 10)
    with pytest.raises(hj.errors.FileFormatError, match="damaged"):
        store._open(tmp_path, ABOUT)


@pytest.mark.parametrize(
    "cycle", [None, {}, {"points": 1, "scales": []}, {"points": [[1], [1, 2]]}]
)
def test_a_cycle_that_is_none(tmp_path, cycle):
    own = {"points": [[0.0, 1.0]], "scales": [[1.0, 1.0]]}
    (tmp_path / "experiments.json").write_text(json.dumps(ABOUT | {"cycle": cycle}))
    with pytest.raises(hj.DefinitionError, match="other experiments .its `cycle`"):
        store._open(tmp_path, ABOUT | {"cycle": own})


def other_module(path):
    write_module(path, data(2, 9), "000001-other")


REPLACED = {
    "another kind": (lambda path: hj.save(path, hj.multisine()), "holds a 'Design'"),
    "other data": (lambda path: hj.save(path, data(2, 9)), "was replaced by another file"),
    "a chunk of others": (other_module, "was replaced by another file"),
    "another chunk": (
        lambda path: path.write_bytes(next(path.parent.glob("000000-*")).read_bytes()),
        "was replaced by another file",
    ),
    "an archive": (lambda path: np.savez(path, u=np.zeros(3)), "was not written by hybridjax"),
}


@pytest.mark.parametrize(("replace", "says"), REPLACED.values(), ids=REPLACED)
def test_chunks_that_were_replaced(stored, replace, says):
    replace(stored.path(1))
    for use in (list, StoredExperiments.summary):
        with pytest.raises(hj.errors.FileFormatError, match=says) as error:
            use(stored)
        assert str(stored.path(1)) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["mine.npz", "000003-{}.npz", "1-{}.npz", "0000000000001-{}.npz"])
def test_files_that_do_not_belong_there(stored, name):
    name = name.format(stored.path(0).stem.partition("-")[2])
    (stored.folder / name).write_text("")
    with pytest.raises(hj.DefinitionError, match=f"{name}' does not belong to the experiments"):
        StoredExperiments(stored.folder)
    assert (stored.folder / name).exists()


def test_nothing_is_written_through_links(stored, tmp_path):
    away = tmp_path / "away"
    away.write_text("mine")
    stored.path(1).unlink()
    os.symlink(away, stored.path(1))
    with pytest.raises(hj.DefinitionError, match="is a link"):
        write_module(stored.path(1), data(2), "")
    assert away.read_text() == "mine" and stored.path(1).is_symlink()
