"""Hostile files: each is refused in a sentence, and before memory is taken for what it declares."""

import io
import json
import tracemalloc
import zipfile
from unittest.mock import Mock

import numpy as np
import pytest

import hybridjax as hj
from hybridjax._core import archive, limits


def npy(shape, data=b"", dtype="<f8"):
    """An array file with this header, whatever its data are."""
    file = io.BytesIO()
    header = {"descr": dtype, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, header)
    return file.getvalue() + data


def pack(path, members, **options):
    with zipfile.ZipFile(path, "w", **options) as archive:
        for name, content in members:
            archive.writestr(name, content)


def saved(path, static):
    """A design, with other static fields than it was saved with."""
    hj.save(path, hj.multisine(n_sections=4, periods=4, frequencies=(0.25, 0.5)))
    with np.load(path) as file:
        content = dict(file)
    header = json.loads(str(content.pop("header")))
    header["static"] |= static
    np.savez(path, header=np.array(json.dumps(header)), **content)


def bomb(path):
    block = bytes(2**27)
    zeros = npy((2**24,), block)
    pack(path, [("time.npy", zeros)], compression=zipfile.ZIP_DEFLATED, compresslevel=9)


def overlapping(path):
    """Many entries of the archive's directory that stand for the same data."""
    shape = (2**19,)
    zeros = bytes(2**22)
    pack(path, [("time.npy", npy(shape, zeros))])
    with zipfile.ZipFile(path, "a") as archive:
        entry = archive.infolist()[0]
        for k in range(200):
            twin = zipfile.ZipInfo(f"x{k}.npy")
            for name in (
                "header_offset",
                "file_size",
                "compress_size",
                "CRC",
                "compress_type",
            ):
                setattr(twin, name, getattr(entry, name))
            archive.filelist.append(twin)
        archive._didModify = True


HOSTILE = {
    "a bomb": (bomb, "declares arrays of 134217856 bytes"),
    "overlapping members": (overlapping, "declares arrays of"),
    "a huge shape": (
        lambda p: pack(p, [("time.npy", npy((10**12,)))]),
        "not that large",
    ),
    "a shape that is too small": (
        lambda p: pack(p, [("time.npy", npy((1,), bytes(80)))]),
        "not that large",
    ),
    "a negative shape": (
        lambda p: pack(p, [("time.npy", npy((-1,), bytes(8)))]),
        "is damaged",
    ),
    "two of one name": (
        lambda p: pack(p, [("time.npy", npy((0,))), ("time.npy", npy((0,)))]),
        "two of its arrays have one name",
    ),
    "objects": (lambda p: np.savez(p, time=np.array([{}])), "holds Python objects"),
    "a renamed npy": (lambda p: p.write_bytes(npy((1,), bytes(8))), "is damaged"),
}
DECLARED = {
    "sections": (dict(n_sections=10**12), "n_sections is 1000000000000"),
    "experiments that are not there": (dict(experiments=10**6), "needs a frequency"),
    "a window": (
        dict(n_sections=10**5, periods=10**6),
        "more samples than an experiment",
    ),
    "a name that is none": (dict(inputs=[["u"]]), "inputs is"),
}


def refused(call, path, says):
    """The call raises one short sentence, and takes less than 32 MiB for it."""
    tracemalloc.start()
    try:
        with pytest.raises(hj.errors.FileFormatError, match=says) as error:
            call(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 2**25
    assert str(path) in str(error.value)
    text = str(error.value)
    longest = 400 + len(str(path))
    assert len(text) < longest


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize(
    "read", [hj.load, hj.read_recording], ids=["load", "read_recording"]
)
@pytest.mark.parametrize(("make", "says"), HOSTILE.values(), ids=HOSTILE)
def test_hostile_archives(tmp_path, read, make, says):
    path = tmp_path / "hostile.npz"
    make(path)
    refused(read, path, says)


@pytest.mark.parametrize(("static", "says"), DECLARED.values(), ids=DECLARED)
def test_hostile_headers(tmp_path, static, says):
    path = tmp_path / "hostile.npz"
    saved(path, static)
    refused(hj.load, path, says)


def test_headers_are_nested_and_long(tmp_path, monkeypatch):
    path = tmp_path / "hostile.npz"
    np.savez(path, header=np.array("[" * 100_000))
    refused(hj.load, path, "not written by `hj.save`")
    monkeypatch.setattr(limits, "TEXT", 100)
    saved(path, {})
    refused(hj.load, path, "not written by `hj.save`")


def test_a_parquet_file_that_declares_more_than_it_holds(tmp_path):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    path = tmp_path / "hostile.parquet"
    indices = np.zeros(2**24, np.int8)
    values = pyarrow.DictionaryArray.from_arrays(indices, [0.0])
    parquet.write_table(pyarrow.table({"time": values}), path)
    assert path.stat().st_size < 2**20
    refused(
        hj.read_recording,
        path,
        "it declares .*, and is not that large|declares 16777216 rows",
    )


@pytest.mark.parametrize("error", [MemoryError(), OSError(5, "Input/output error")])
def test_a_computer_that_fails_is_no_damaged_file(tmp_path, monkeypatch, error):
    path = tmp_path / "good.npz"
    saved(path, {})
    monkeypatch.setattr(archive, "_array", Mock(side_effect=error))
    with pytest.raises(type(error)):
        archive.read_arrays(path)
