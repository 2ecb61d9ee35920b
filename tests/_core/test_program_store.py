"""Nothing is read that may have been written by somebody else, or is damaged."""

import os
from concurrent.futures import ThreadPoolExecutor

import pytest

from hybridjax._core import limits
from hybridjax._core.compilation.program_store import ProgramStore


DATA = bytes(range(256)) * 4


@pytest.fixture
def store(tmp_path):
    store = ProgramStore(tmp_path / "a" / "programs")
    store.write("one", DATA)
    return store


def test_what_is_written_is_read(store):
    assert store.read("one") == DATA
    assert store.read("two") is None
    store.write("one", b"")
    assert store.read("one") == b""
    assert [path.name for path in store.folder.iterdir()] == ["one"]


def flip(path):
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)


def link(path):
    path.rename(path.with_name("elsewhere"))
    path.symlink_to("elsewhere")


MISHAPS = {
    "a bit": flip,
    "the head": lambda path: path.write_bytes(b"x" + path.read_bytes()[1:]),
    "truncated": lambda path: path.write_bytes(path.read_bytes()[:-1]),
    "empty": lambda path: path.write_bytes(b""),
    "longer": lambda path: path.write_bytes(path.read_bytes() + b"x"),
    "others can write to it": lambda path: path.chmod(0o602),
    "a group can write to it": lambda path: path.chmod(0o620),
    "others can write to the folder": lambda path: path.parent.chmod(0o702),
    "not to be read": lambda path: (path.unlink(), path.mkdir()),
    "a link": link,
}


@pytest.mark.parametrize("mishap", MISHAPS)
def test_what_is_not_to_be_trusted_is_not_read(store, mishap):
    MISHAPS[mishap](store.folder / "one")
    assert store.read("one") is None


def test_a_file_under_another_name_is_not_read(store):
    (store.folder / "one").rename(store.folder / "two")
    assert store.read("two") is None


def test_files_of_another_user_are_not_read(store, monkeypatch):
    owner = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
    assert store.read("one") is None


def test_only_the_user_can_read_and_write(store):
    assert store.folder.stat().st_mode & 0o777 == 0o700
    assert (store.folder / "one").stat().st_mode & 0o777 == 0o600


def test_a_damaged_file_is_replaced(store):
    flip(store.folder / "one")
    store.write("one", DATA)
    assert store.read("one") == DATA


def test_what_has_not_been_used_for_longest_goes(store, monkeypatch):
    monkeypatch.setattr(limits, "PROGRAMS", 3 * len(DATA) + 300)
    store.write("two", DATA)
    for age, name in enumerate(("two", "one")):
        os.utime(store.folder / name, (age, age))
    assert store.read("two") == DATA
    store.write("three", DATA)
    store.write("four", DATA)
    assert sorted(path.name for path in store.folder.iterdir()) == ["four", "three", "two"]


def test_whoever_writes_at_the_same_time_what_is_read_is_whole(store):
    def write(k):
        for _ in range(50):
            store.write("one", bytes([k]) * (1000 * k))

    with ThreadPoolExecutor(3) as pool:
        writing = [pool.submit(write, k) for k in (1, 2, 3)]
        while not all(one.done() for one in writing):
            assert store.read("one") in (DATA, *(bytes([k]) * (1000 * k) for k in (1, 2, 3)))
    assert [path.name for path in store.folder.iterdir()] == ["one"]


def test_a_folder_that_cannot_be_written_is_no_error(tmp_path):
    (tmp_path / "file").write_text("")
    store = ProgramStore(tmp_path / "file" / "programs")
    store.write("one", DATA)
    assert store.read("one") is None
