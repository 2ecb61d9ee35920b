"""Files of each kind, written by the library of their kind, and what is refused in one sentence."""

import struct
import sys
import tracemalloc

import numpy as np
import pytest
from scipy.sparse import eye_array

import hybridjax as hj
from hybridjax._core import limits
from hybridjax.errors import FileFormatError
from hybridjax.recordings.formats import arrays


SLOW = np.arange(20) / 100
FAST = np.arange(190) / 1000
X = np.sin(20 * SLOW)
F = np.cos(30 * FAST)


def samples(recording, name):
    """Times and values of one signal where it was sampled."""
    (trial,) = recording.trials
    x = trial.values[:, recording.column(name)]
    known = np.isfinite(x)
    return trial.time[known], x[known]


def check_two_rates(path, x="x", f="f", digits=15, **how):
    """Both signals are there, each with the times at which it was sampled and no others."""
    found = hj.read_recording(path, **how)
    for name, time, values in ((x, SLOW, X), (f, FAST, F)):
        t, v = samples(found, name)
        np.testing.assert_allclose(t, time, rtol=0, atol=1e-12)
        tolerance = 10.0**-digits
        np.testing.assert_allclose(v, values, rtol=tolerance, atol=tolerance)
    return found


def refused(says, *paths, kind=FileFormatError, **how):
    with pytest.raises(kind, match=says) as error:
        hj.read_recording(*paths, **how)
    assert str(paths[0]) in str(error.value)
    assert "\n" not in str(error.value)


# MATLAB and HDF5


def write_v5(path, variables, **how):
    pytest.importorskip("scipy.io").savemat(path, variables, **how)


def write_v73(path, variables):
    """As MATLAB writes it: axes reversed, classes as attributes, a block of its own in front."""
    h5py = pytest.importorskip("h5py")

    def fill(group, values):
        for name, value in values.items():
            if isinstance(value, dict):
                fill(group.create_group(name), value)
                group[name].attrs["MATLAB_class"] = np.bytes_("struct")
            elif isinstance(value, str):
                group[name] = np.frombuffer(value.encode("utf-16-le"), np.uint16)[
                    :, None
                ]
                group[name].attrs["MATLAB_class"] = np.bytes_("char")
            else:
                array = np.atleast_2d(value)
                group[name] = array.T if np.ndim(value) == 2 else array
                group[name].attrs["MATLAB_class"] = np.bytes_("double")

    with h5py.File(path, "w", userblock_size=512) as file:
        fill(file, variables)
    with open(path, "r+b") as file:
        mark = b"MATLAB 7.3 MAT-file".ljust(124)
        version = bytes([0, 2])
        file.write(mark + version + b"IM")


NESTED = {
    "force": {"time": FAST, "f": F, "events": {"strike": np.array([0.05, 0.1])}},
    "x": X,
    "pair": np.stack([X, 2 * X], axis=1),
    "time": SLOW,
    "rate": 100.0,
    "subject": "S3",
}


@pytest.mark.parametrize("write", [write_v5, write_v73])
def test_matlab(tmp_path, write):
    write(tmp_path / "x.mat", NESTED)
    found = check_two_rates(tmp_path / "x.mat", f="force.f")
    assert set(found.signals) == {"force.f", "x", "pair.0", "pair.1"}
    np.testing.assert_array_equal(samples(found, "pair.1")[1], 2 * X)
    strikes = found.trials[0].events["strike"]
    np.testing.assert_array_equal(strikes, [0.05, 0.1])
    signals = {"time": SLOW, "x": X, "f": F}
    write(tmp_path / "y.mat", signals)
    refused("'f' has the shape .*190.*, but its group 20 times", tmp_path / "y.mat")
    refused(
        "no times 't' for '[ftx]",
        tmp_path / "y.mat",
        time="t",
        kind=hj.errors.DefinitionError,
    )
    only = hj.read_recording(tmp_path / "x.mat", signals="pair", units={"pair.0": "m"})
    assert only.signals == ("pair.0", "pair.1")
    assert only.unit("pair.0") == "m"
    assert len(only.trials[0].time) == len(SLOW)
    says = "no signal 'f'; it has .*force.f"
    refused(says, tmp_path / "x.mat", signals="f", kind=hj.errors.DefinitionError)


def test_arrays_of_structs(tmp_path):
    h5py = pytest.importorskip("h5py")
    kind = [("time", "O"), ("x", "O")]
    write_v5(
        tmp_path / "x.mat", {"trials": np.array([(SLOW, X), (SLOW, X)], dtype=kind)}
    )
    refused("'trials' is an array of structs", tmp_path / "x.mat")
    write_v73(tmp_path / "y.mat", {"time": SLOW, "x": X})
    with h5py.File(tmp_path / "y.mat", "r+") as file:
        group = file.create_group("trials")
        references = [file["x"].ref, file["x"].ref]
        group["x"] = np.array(references, h5py.ref_dtype)
    refused("'trials' is an array of structs", tmp_path / "y.mat")
    assert hj.read_recording(tmp_path / "y.mat", signals="x").signals == ("x",)


def test_hdf5(tmp_path):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "x.h5"
    with h5py.File(path, "w") as file:
        file["time"] = SLOW
        file["x"] = X
        file["daq/f"] = F
        file["daq/time"] = 1000 * FAST
        file["daq/time"].attrs["units"] = "ms"
        file["daq/f"].attrs["units"] = "N"
        file["note"] = "left leg"
    found = check_two_rates(path, f="daq/f")
    assert found.unit("daq/f") == "N"
    assert found.unit("x") == ""
    assert hj.read_recording(path, signals="daq").signals == ("daq/f",)
    with h5py.File(path, "r+") as file:
        file["x"].attrs["units"] = np.nan
    refused("the unit of 'x' is nan", path)
    path.write_bytes(path.read_bytes()[:1000])
    refused("no HDF5 file, or damaged", path)
    layout = h5py.VirtualLayout((9,), "f8")
    layout[:] = h5py.VirtualSource(path, "x", (9,))
    for virtual in (True, False):
        with h5py.File(tmp_path / "y.h5", "w") as file:
            if virtual:
                file.create_virtual_dataset("x", layout)
            else:
                file.create_dataset("x", (9,), "f8", external=[(path, 0, 72)])
        refused("'x' lies in other files", tmp_path / "y.h5")


# Tables


def table(**more):
    pandas = pytest.importorskip("pandas")
    return pandas.DataFrame(
        {"time": SLOW, "x (m)": X, "event go": SLOW == SLOW[7], **more}
    )


def test_feather(tmp_path):
    pytest.importorskip("pyarrow")
    table(y=X).to_feather(tmp_path / "x.feather")
    found = hj.read_recording(tmp_path / "x.feather", signals="x")
    np.testing.assert_array_equal(samples(found, "x")[1], X)
    assert found.unit("x") == "m"
    events = found.trials[0].events["go"]
    assert events == [SLOW[7]]
    refused(
        "no signal 'z'; it has ",
        tmp_path / "x.feather",
        signals="z",
        kind=hj.errors.DefinitionError,
    )
    with pytest.raises(hj.errors.DefinitionError, match="different indices"):
        backwards = table()["x (m)"][::-1]
        hj.Recording(table()["time"], {"y": backwards})
    with pytest.raises(hj.errors.DefinitionError, match="different indices"):
        backwards_again = table()["x (m)"][::-1]
        values = table()
        hj.Recording.from_frame({"time": values["time"], "y": backwards_again})
    (tmp_path / "x.feather").write_bytes(b"ARROW1" + bytes(100))
    refused("no feather file, or damaged", tmp_path / "x.feather")


def test_excel(tmp_path):
    path = tmp_path / "x.xlsx"
    book = pytest.importorskip("openpyxl").Workbook()
    book.active.title = "walk"
    for row in (
        ["# subject, 3"],
        ["time", "x"],
        ["ms", None],
        *zip(1000 * SLOW, X, strict=True),
    ):
        plain = [float(v) if isinstance(v, np.floating) else v for v in row]
        book.active.append(plain)
    book.active["B8"] = None
    book.create_sheet("notes")
    book.save(path)
    found = hj.read_recording(path)
    t, x = samples(found, "x")
    np.testing.assert_allclose(x, np.delete(X, 4), rtol=1e-15)
    np.testing.assert_allclose(t, np.delete(SLOW, 4), rtol=1e-15)
    assert "of 2 sheets the first one, 'walk', was read" in found.findings[0].text
    book.active["B9"] = "high"
    book.save(path)
    refused("line 9: column 'x' holds 'high'", path)
    path.write_text("no zip")
    refused("no Excel file, or damaged", path)


TRC = """PathFileType\t4\t(X/Y/Z)\twalk.trc
DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames
100.00\t100.00\t3\t2\tmm\t100.00\t1\t3
Frame#\tTime\tR.ASIS\t\t\tL.ASIS\t\t
\t\tX1\tY1\tZ1\tX2\tY2\tZ2

1\t0.00\t1\t2\t3\t4\t5\t6\t
2\t0.01\t1.5\t2\t3\t\t\t\t
3\t0.02\t2\t2\t3\t4\t5\t6.5\t
"""


def test_trc(tmp_path):
    path = tmp_path / "walk.trc"
    path.write_text(TRC)
    found = hj.read_recording(path)
    assert found.signals[:2] == ("R.ASIS.x", "R.ASIS.y")
    assert found.unit("L.ASIS.z") == "mm"
    np.testing.assert_array_equal(
        samples(found, "R.ASIS.x"), [[0, 0.01, 0.02], [1, 1.5, 2]]
    )
    expected = [[0, 0.02], [6, 6.5]]
    np.testing.assert_array_equal(samples(found, "L.ASIS.z"), expected)
    assert hj.read_recording(path, signals="L.ASIS").signals[0] == "L.ASIS.x"
    path.write_text(TRC.replace("100.00\t3", "100.00\t4"))
    refused("3 frames, its header 4", path)
    path.write_text(TRC.replace("Frame#", "Number"))
    refused("does not name 'Frame#'", path)


# C3D


def write_c3d(
    path, *, first=0, events=((0.05, "Left", "Strike"), (0.1, "Left", "Strike"))
):
    file = pytest.importorskip("ezc3d").c3d()
    points = np.ones((4, 2, len(SLOW)))
    points[0, 0] = X
    points[1, 0] = 2 * X
    points[2, 1, 3] = np.nan
    file["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    file["parameters"]["POINT"]["LABELS"]["value"] = ("LASI", "LKnee")
    file["parameters"]["POINT"]["UNITS"]["value"] = ("mm",)
    file.add_parameter("POINT", "ANGLES", ("LKnee",))
    file.add_parameter("POINT", "ANGLE_UNITS", ("deg",))
    file["data"]["points"] = points
    file["header"]["points"]["first_frame"] = first
    file["parameters"]["ANALOG"]["RATE"]["value"] = [1000.0]
    file["parameters"]["ANALOG"]["LABELS"]["value"] = ("Fz1",)
    file["parameters"]["ANALOG"]["UNITS"]["value"] = ("N",)
    no_samples = np.zeros(10)
    force = np.append(F, no_samples)
    file["data"]["analogs"] = force[None, None]
    for at, context, label in events:
        file.add_event([0, at], context, label)
    file.write(str(path))


def test_c3d(tmp_path):
    path = tmp_path / "walk.c3d"
    write_c3d(path)
    found = hj.read_recording(path)
    t, x = samples(found, "LASI.x")
    np.testing.assert_allclose(t, SLOW, atol=1e-15)
    np.testing.assert_allclose(x, X, atol=1e-6)
    t, f = samples(found, "Fz1")
    np.testing.assert_allclose(t[:190], FAST, atol=1e-15)
    np.testing.assert_allclose(f[:190], F, atol=1e-6)
    units = [found.unit(x) for x in ("LASI.y", "LKnee.x", "Fz1")]
    assert units == ["mm", "deg", "N"]
    times, _ = samples(found, "LKnee.z")
    assert len(times) == len(SLOW) - 1
    np.testing.assert_allclose(
        found.trials[0].events["Left Strike"], [0.05, 0.1], atol=1e-7
    )
    analog = hj.read_recording(path, signals="Fz1")
    assert analog.signals == ("Fz1",)
    assert "Left Strike" in analog.trials[0].events
    refused(
        "no signal 'EMG1'; it has LASI.x",
        path,
        signals="EMG1",
        kind=hj.errors.DefinitionError,
    )
    path.write_bytes(path.read_bytes()[:2500])
    refused("frames, its header 20", path)
    write_c3d(tmp_path / "late.c3d", first=10)
    found = hj.read_recording(tmp_path / "late.c3d")
    strikes = found.trials[0].events["Left Strike"]
    np.testing.assert_allclose(strikes, [0.1], atol=1e-7)
    assert found.findings[-1].text == (
        "1 events 'Left Strike' outside of the recording were left out."
    )
    write_c3d(tmp_path / "late.c3d", first=50)
    refused(
        "all events 'Left Strike' .* are",
        tmp_path / "late.c3d",
        kind=hj.errors.DefinitionError,
    )
    path.write_bytes(b"no")
    refused("no C3D file, or damaged", path)


# ROS


def write_bag(path, version):
    """A topic with stamps that are not the times of arrival, one without, one of images."""
    pytest.importorskip("rosbags")
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    is_1 = version == "bag"
    store = get_typestore(Stores.ROS1_NOETIC if is_1 else Stores.ROS2_HUMBLE)
    kinds = store.types
    seq = {"seq": 0} if is_1 else {}
    time = kinds["builtin_interfaces/msg/Time"]
    header = kinds["std_msgs/msg/Header"]
    point = kinds["geometry_msgs/msg/Point"]
    stamped = kinds["geometry_msgs/msg/PointStamped"]
    layout = kinds["std_msgs/msg/MultiArrayLayout"]([], 0)
    zeros = np.zeros(1000, np.uint8)
    image = kinds["std_msgs/msg/UInt8MultiArray"](layout, zeros)
    messages = []
    for t, x in zip(SLOW, X, strict=True):
        seconds = 5 + int(t)
        stamp = time(seconds, round(t % 1 * 1e9))
        head = header(stamp=stamp, frame_id="", **seq)
        body = point(x, 2 * x, 0.0)
        messages.append((t, "/body", stamped(head, body)))
        messages.append((t, "/count", kinds["std_msgs/msg/Float64"](t)))
        messages.append((t, "/image", image))
    if is_1:
        writer = rosbag1.Writer(path)
        pack = store.serialize_ros1
    else:
        plugin = rosbag2.StoragePlugin[version.upper()]
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
        pack = store.serialize_cdr
    with writer:
        topics = {topic: x.__msgtype__ for _, topic, x in messages}
        connections = {
            x: writer.add_connection(x, k, typestore=store) for x, k in topics.items()
        }
        for t, topic, x in messages:
            arrival = round((5 + t) * 1e9) + 30_000_000
            writer.write(connections[topic], arrival, pack(x, topics[topic]))


@pytest.mark.parametrize("version", ["bag", "mcap"])
def test_bags(tmp_path, version):
    path = tmp_path / ("x.bag" if version == "bag" else "x")
    write_bag(path, version)
    found = hj.read_recording(path, signals=["body.point", "count"])
    assert found.signals == (
        "body.point.x",
        "body.point.y",
        "body.point.z",
        "count.data",
    )
    stamps = SLOW - 0.03  # of arrival, from which times count
    np.testing.assert_allclose(
        samples(found, "body.point.y"), [stamps, 2 * X], atol=1e-12
    )
    counted = samples(found, "count.data")
    np.testing.assert_allclose(counted, [SLOW, SLOW], atol=1e-12)
    texts = [finding.text for finding in found.findings]
    assert any("times of count are those of arrival" in text for text in texts)
    assert "image.data.0" not in hj.read_recording(path).signals
    refused(
        "no signal 'imu.x'; it has body, count",
        path,
        signals="imu.x",
        kind=hj.errors.DefinitionError,
    )
    if version != "bag":
        (single,) = (x for x in path.iterdir() if x.suffix != ".yaml")
        alone = hj.read_recording(single, signals="body")
        np.testing.assert_array_equal(samples(alone, "body.point.x")[1], X)
    else:
        path.write_bytes(path.read_bytes()[:500])
        refused("no bag of ROS, or damaged", path)


def test_libraries_that_are_not_there(tmp_path, monkeypatch):
    tables = (".feather", "pyarrow.dataset", "tables")
    bags = (".mcap", "rosbags.highlevel", "ros")
    for suffix, library, extra in (
        (".c3d", "ezc3d", "c3d"),
        (".h5", "h5py", "mat"),
        tables,
        bags,
    ):
        monkeypatch.setitem(sys.modules, library, None)
        (tmp_path / f"x{suffix}").write_bytes(b"x")
        with pytest.raises(
            hj.errors.DefinitionError, match=rf"pip install 'hybridjax\[{extra}\]'"
        ):
            hj.read_recording(tmp_path / f"x{suffix}")


def test_files_that_declare_more_than_they_hold(tmp_path, monkeypatch):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file.create_dataset("time", shape=(10**10,), chunks=(1000,), dtype=float)
    refused("declares arrays of 80000000000 bytes", tmp_path / "x.h5")
    zero = np.zeros(2**17)
    zeros = {"time": zero, "x": zero}
    write_v5(tmp_path / "x.mat", zeros, do_compression=True)
    monkeypatch.setattr(limits, "unpacked", lambda size: 100 * size)
    refused("declares arrays of 1048576 bytes or more", tmp_path / "x.mat")
    monkeypatch.setattr(limits, "RECORDED", 100)
    slow = hj.Recording(SLOW, {"x": X})
    fast = hj.Recording(FAST, {"f": F})
    parts = [slow, fast]
    with pytest.raises(
        hj.errors.DefinitionError, match="2 signals at 191 times are too many"
    ):
        hj.Recording.beside(parts)


# Costs, and errors that are not the file's


def memory_of(call):
    """Bytes that Python and numpy hold at most during a call, beside those before."""
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_a_packed_struct_is_refused_before_it_takes_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(limits, "unpacked", lambda size: 100 * size)
    path = tmp_path / "x.mat"
    zeros = np.zeros(2**22)  # 32 MB
    nested = {"imu": {"gyro": {"time": SLOW, "x": X, "more": zeros}}}
    write_v5(path, nested, do_compression=True)
    assert path.stat().st_size < 2**17
    refused("declares arrays of .* or more", path)
    assert memory_of(lambda: refused("declares arrays of .* or more", path)) < 2**21
    # Cells, empty ones too, complex numbers and sparse zeros count as they are.
    empty = np.empty(2**12, object)
    empty[:] = [np.zeros(0)] * len(empty)
    write_v5(path, {"time": SLOW, "x": X, "c": empty}, do_compression=True)
    refused("declares arrays of .* or more", path)
    mixed = np.array([1, "text", {"a": X}], object)
    few = {"c": mixed, "z": 1j * X, "on": X > 0}
    sparse = {"s": eye_array(10**6, format="csc")}
    write_v5(path, {"time": SLOW, "x": X} | few | sparse, do_compression=True)
    recording = hj.read_recording(path)
    np.testing.assert_array_equal(samples(recording, "x")[1], X)
    deep = {"time": SLOW, "x": X}
    for _ in range(limits.NESTED + 1):
        deep = {"g": deep}
    write_v5(path, deep, do_compression=True)
    refused(f"in more than {limits.NESTED} structs", path)


def test_one_blank_does_not_fill_a_sheet(tmp_path, monkeypatch):
    written = []
    line = arrays._line

    def counted(*row):
        written.append(row)
        assert len(written) < 100
        return line(*row)

    monkeypatch.setattr(arrays, "_line", counted)
    book = pytest.importorskip("openpyxl").Workbook()
    book.active.append(["time", "x", "y"])
    for row in zip(SLOW, X, strict=True):
        book.active.append([*map(float, row)])  # y is missing everywhere but once
    book.active["C4"] = 2.0
    path = tmp_path / "x.xlsx"
    book.save(path)
    expected = hj.read_recording(path)
    for corner in ("XFD3", "B1048576", "XFD1048576"):
        book.active[corner] = " "
        book.save(path)
        written.clear()
        found = hj.read_recording(path)
        assert found.signals == expected.signals == ("x", "y")
        values = found.trials[0].values
        expected_values = expected.trials[0].values
        np.testing.assert_array_equal(values, expected_values)


def test_columns_take_time_in_proportion_to_their_number(tmp_path):
    """Counted, not measured: the comparisons of names."""
    h5py = pytest.importorskip("h5py")

    class Name(str):
        compared = 0

        def __eq__(self, other):
            Name.compared += 1
            return str.__eq__(self, other)

        __hash__ = str.__hash__

    counts = []
    for n in (200, 400):
        Name.compared = 0
        signals = {Name(f"x{k}"): X for k in range(n)}
        single = hj.Recording(SLOW, {"y": X})
        parts = [hj.Recording(SLOW, signals), single]
        trial = hj.Recording.beside(parts)
        hj.Recording.join([trial] * 2)
        counts.append(Name.compared)
    allowed = 3 * max(counts[0], 1)
    assert counts[1] < allowed
    groups = "/".join("g" * (limits.NESTED + 1))
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["time"], file[f"{groups}/x"] = SLOW, X
    refused(f"groups in more than {limits.NESTED} others", tmp_path / "x.h5")


@pytest.mark.parametrize("error", [MemoryError("no memory"), OSError(5, "broken")])
def test_errors_of_the_computer_are_not_those_of_a_file(tmp_path, monkeypatch, error):
    scipy_io = pytest.importorskip("scipy.io")

    def fails(*_, **__):
        raise error

    path = tmp_path / "x.mat"
    write_v5(path, {"time": SLOW, "x": X})
    monkeypatch.setattr(scipy_io, "loadmat", fails)
    kind = MemoryError if isinstance(error, MemoryError) else hj.errors.DefinitionError
    with pytest.raises(kind, match="no memory|cannot read .*: broken"):
        hj.read_recording(path)


def test_errors_of_a_reader_itself_are_no_damage(tmp_path, monkeypatch):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["time"], file["x"] = SLOW, X
    monkeypatch.setattr(arrays, "Columns", None)
    with pytest.raises(TypeError, match="'NoneType' object is not callable"):
        hj.read_recording(tmp_path / "x.h5")


def test_attributes_of_netcdf_apply(tmp_path):
    """A scale, an offset and a mark of missing numbers, in a file of version 4 and of version 3."""
    h5py = pytest.importorskip("h5py")
    y = 4.0 + X
    scaled = (y - 4.0) / 1e-4
    stored = np.round(scaled).astype(np.int32)
    stored[3] = -32767
    y[3] = np.nan
    path = tmp_path / "new.nc"
    with h5py.File(path, "w") as file:
        file["time"] = SLOW * 1e3
        file["time"].attrs["units"] = "ms since 2026-01-01"
        file["y"] = stored
        file["y"].attrs.update(
            {"scale_factor": 1e-4, "add_offset": 4.0, "_FillValue": np.int32(-32767)}
        )
    old = tmp_path / "old.nc"
    netcdf_file = pytest.importorskip("scipy.io").netcdf_file
    with netcdf_file(old, "w") as file:
        file.createDimension("time", len(SLOW))
        time = file.createVariable("time", "d", ("time",))
        time[:] = SLOW
        time.units = "s"
        packed = file.createVariable("y", "i", ("time",))
        packed[:] = stored
        packed.scale_factor = 1e-4
        packed.add_offset = 4.0
        packed.missing_value = np.int32(-32767)
    for found in map(hj.read_recording, (path, old)):
        assert not found.findings
        np.testing.assert_allclose(found.time, SLOW, atol=1e-12)
        np.testing.assert_allclose(found["y"], y, atol=1e-4)


def test_texts_in_tables(tmp_path):
    """A row that begins with an error of a sheet, a column of text, and one byte of Latin-1."""
    pairs = zip(X, SLOW, strict=True)
    rows = [f"{x:.4f},{t:.3f},stance" for x, t in pairs]
    rows[4] = f"#N/A,{SLOW[4]:.3f},stance"
    path = tmp_path / "walk.csv"
    head = b"# M\xfcller\n" + "Öffnung (°),time (s),phase\n".encode()
    path.write_bytes(head + "\n".join(rows).encode())
    found = hj.read_recording(path)
    assert found.signals == ("Öffnung",)
    assert found.units == ("°",)
    missing = np.flatnonzero(np.isnan(found["Öffnung"]))
    assert missing == [4]
    assert "text were left out: 'phase'" in repr(found)
    assert not hj.read_recording(path, signals="Öffnung").findings
    refused("'phase' holds 'stance'", path, signals="phase")
    path.write_text(path.read_text("latin-1").replace("time (s)", "time"), "latin-1")
    rows[5] = rows[5].replace("0.05", "12:00:05")
    path.write_text("\n".join(["x,time,phase", *rows]))
    refused("column 'time' holds '12:00:05", path)


@pytest.mark.parametrize("last", [0, 2**16 - 1])  # (counted, or too many to be counted)
def test_c3d_without_frames(tmp_path, last):
    path = tmp_path / "empty.c3d"
    pytest.importorskip("ezc3d").c3d().c3d_swig.write(str(path))
    content = bytearray(path.read_bytes())
    content[6:10] = struct.pack("<HH", 1, last)
    path.write_bytes(content)
    refused("has no frames", path)


def test_c3d_that_is_longer_than_its_header_can_say(tmp_path):
    ezc3d = pytest.importorskip("ezc3d")
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [200]
    file["parameters"]["POINT"]["LABELS"]["value"] = ["M"]
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file["data"]["points"] = np.ones((4, 1, 66_000))
    path = tmp_path / "long.c3d"
    file.write(str(path))
    refused("of which only 65535 can be read: export parts", path)


def as_dec(numbers: bytes) -> bytes:
    """Little-endian floating-point numbers of IEEE in the form of DEC: the exponent is larger by 2,
    and both halves change places."""
    words = (4 * np.frombuffer(numbers, "<f4")).view("<u2").reshape(-1, 2)
    return words[:, ::-1].tobytes()


def write_as_dec(path):
    """Rewrite a C3D file in the numbers of DEC."""
    data = bytearray(path.read_bytes())

    def convert(begin, count):
        data[begin : begin + 4 * count] = as_dec(data[begin : begin + 4 * count])

    convert(12, 1)  # the scale
    convert(20, 1)  # the rate
    begin = 512 * (data[0] - 1)
    data[begin + 3] = 85
    place = begin + 4
    while data[place]:
        length, group = np.frombuffer(data[place : place + 2], np.int8)
        place += 2 + abs(int(length))
        following = place + int.from_bytes(data[place : place + 2], "little")
        if group > 0 and data[place + 2] == 4:
            axes = data[place + 3]
            sizes = data[place + 4 : place + 4 + axes]
            convert(place + 4 + axes, int(np.prod(sizes)))
        if following == place:
            break
        place = following
    first = 512 * (int.from_bytes(data[16:18], "little") - 1)
    convert(first, (len(data) - first) // 4)
    path.write_bytes(data)


@pytest.mark.parametrize("frames", [20, 2**16 - 1])
def test_c3d_in_the_numbers_of_dec(tmp_path, frames):
    """The sign of the scale, which gives the size of numbers, is in another byte."""
    ezc3d = pytest.importorskip("ezc3d")
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [200]
    file["parameters"]["POINT"]["LABELS"]["value"] = ["M"]
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file["data"]["points"] = np.full((4, 1, frames), 1.5)
    path = tmp_path / "dec.c3d"
    file.write(str(path))
    write_as_dec(path)
    t, x = samples(hj.read_recording(path), "M.x")
    assert len(t) == frames
    assert (x == 1.5).all()


def test_mcap_with_a_hole(tmp_path):
    """The index counts more messages than the file still has."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    number = store.types["std_msgs/msg/Float64"]
    kind = number.__msgtype__
    plugin = rosbag2.StoragePlugin.MCAP
    with rosbag2.Writer(tmp_path / "bag", version=9, storage_plugin=plugin) as writer:
        topic = writer.add_connection("/force", kind, typestore=store)
        for k in range(200):
            text = store.serialize_cdr(number(1.0 * k), kind)
            writer.write(topic, k * 10**7, text)
    (path,) = (tmp_path / "bag").glob("*.mcap")
    data = bytearray(path.read_bytes())
    assert len(hj.read_recording(path).time) == 200
    first = len(data) // 3
    data[first : first + 300] = bytes(300)
    path.write_bytes(data)
    refused("damaged: it has .* messages of 'force', its header 200", path)
