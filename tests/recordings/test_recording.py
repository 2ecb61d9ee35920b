"""Recordings, their files, and what is refused."""

import jax
import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st

import hybridjax as hj
from hybridjax.errors import FileFormatError


T = np.arange(5.0)
GOOD = {"a": T, "b": 2 * T}


@pytest.mark.parametrize(
    ("time", "signals", "options", "message"),
    [
        ([0, 1, 1, 2, 3], GOOD, {}, "time does .* at sample 2 .1, then 1.: leave out"),
        ([0, 1, 0.5, 2, 3], GOOD, {}, "increase at sample 2 .1, then 0.5.: sort"),
        ([0, 1, np.nan, 2, 3], GOOD, {}, "sample 2 .1, then nan.: leave out such"),
        (T, {"a": T[1:]}, {}, "a and time have different lengths: 4 and 5"),
        (T, {"a": [0, 1, np.inf, 0, 0]}, {}, "a is infinite at sample 2"),
        (T, {"a": list("abcde")}, {}, "a must be real numbers"),
        (T, GOOD, {"units": {"c": "N"}}, "there is no signal 'c'; signals are a, b"),
        (T, GOOD, {"events": {"e": [np.inf]}}, "e is infinite at sample 0"),
        (
            T,
            GOOD,
            {"events": {"e": [9.0]}},
            "events 'e' .* are outside of the recording",
        ),
        (T, GOOD, {"events": {"a": [1.0]}}, "'a' is a signal and an event"),
    ],
)
def test_bad_recordings(time, signals, options, message):
    with pytest.raises(hj.errors.DefinitionError, match=message):
        hj.Recording(time, signals, **options)


def test_events_outside_of_the_samples_are_left_out():
    """As in files. An event one sample after the end is allowed."""
    time = np.arange(0.0, 10.0, 0.1)
    hits = [1.0, 10.0, 25.0, np.nan]
    recording = hj.Recording(time, {"x": time}, events={"hit": hits})
    np.testing.assert_array_equal(recording.trials[0].events["hit"], [1.0, 10.0])
    (finding,) = recording.findings
    assert finding.text == "1 events 'hit' outside of the recording were left out."


def test_trials_must_belong_together():
    one = hj.Recording(T, GOOD, units={"a": "N"}, name="one")
    signals = {"b": T, "a": T}
    other = hj.Recording(T, signals, units={"a": "N"}, name="two")
    both = hj.Recording.join([one, other])
    column = both.column("b")
    second = both.trials[1].values[:, column]
    np.testing.assert_array_equal(second, T)
    assert "Recording(2 trials: a (N), b)" in repr(both)
    with pytest.raises(
        hj.errors.DefinitionError, match="'two' have different units of a: N and kN"
    ):
        other_unit = hj.Recording(T, GOOD, units={"a": "kN"}, name="two")
        hj.Recording.join([one, other_unit])
    with pytest.raises(
        hj.errors.DefinitionError, match="different signals: ..a', 'b'. and ..a"
    ):
        hj.Recording.join([one, hj.Recording(T, {"a": T})])


@st.composite
def recordings(draw):
    """Recordings of trials with uneven times, gaps and events, and their clocks apart or shared."""
    trials = []
    for name in draw(st.sampled_from(["a", "ab", "abc"])):
        steps = draw(st.lists(st.floats(0.01, 2.0), min_size=1, max_size=12))
        time = draw(st.floats(-50.0, 50.0)) + np.cumsum([0.0, *steps])
        values = np.where(np.arange(len(time)) % 5 == 3, np.nan, np.sin(time))
        hits = np.array(draw(st.lists(st.floats(0.0, 1.0), max_size=6)))
        trials.append(
            hj.Recording(
                time,
                {"x": values, "f": np.arange(len(time))},
                events={"hit": time[0] + hits * np.ptp(time)},
                units={"f": "N"},
                name=name,
            )
        )
    return hj.Recording.join(trials)


@settings(max_examples=60, deadline=None)
@given(recordings(), st.floats(-60.0, 80.0), st.floats(-60.0, 80.0))
def test_a_part_has_the_samples_and_events_between_two_times(whole, first, second):
    start, stop = sorted((first, second))
    assume(start < stop)
    expected = []
    for trial in whole.trials:
        within = (trial.time >= start) & (trial.time < stop)
        if within.sum() > 1:
            expected.append((trial, within))
    if not expected:
        with pytest.raises(hj.errors.DefinitionError, match="fewer than two"):
            whole.crop(start, stop)
        return
    part = whole.crop(start, stop)
    assert (part.signals, part.units) == (whole.signals, whole.units)
    for cropped, (trial, within) in zip(part.trials, expected, strict=True):
        assert cropped.name == trial.name
        np.testing.assert_array_equal(cropped.time, trial.time[within])
        np.testing.assert_array_equal(cropped.values, trial.values[within])
        hits = trial.events["hit"]
        kept = cropped.events["hit"]
        sure = (hits >= cropped.time[0]) & (hits <= cropped.time[-1])
        assert set(hits[sure]) <= set(kept) <= set(hits)
        assert ((kept >= start) & (kept < stop)).all()


@settings(max_examples=60, deadline=None)
@given(recordings(), st.floats(0.0, 1.0))
def test_two_parts_side_by_side_have_all_samples(whole, share):
    """Those of each trial, once, if two of them or more are left on both sides."""
    low = max(trial.time[1] for trial in whole.trials)
    high = min(trial.time[-2] for trial in whole.trials)
    middle = low + share * (high - low)
    assume(low < middle <= high)
    both = hj.Recording.join([whole.crop(stop=middle), whole.crop(middle)])
    n = len(whole)
    for k, trial in enumerate(whole.trials):
        parts = both.trials[k], both.trials[n + k]
        time, values = (
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("time", "values")
        )
        np.testing.assert_array_equal(time, trial.time)
        np.testing.assert_array_equal(values, trial.values)


def test_parts_that_cannot_be():
    whole = hj.Recording(T, GOOD, events={"hit": [0.5, 3.5]}, name="walk")
    assert whole.crop().trials[0].events["hit"].tolist() == [0.5, 3.5]
    assert whole.crop(0.6, 3.0).trials[0].events["hit"].tolist() == []
    other = hj.Recording(100 + T, GOOD, name="run")
    both = hj.Recording.join([whole, other])
    assert [trial.name for trial in both.crop(50).trials] == ["run"]
    for start, stop, message in (
        (3.0, 1.0, "`start` must be before `stop`, not 3 and 1"),
        (2.0, 2.0, "`start` must be before `stop`, not 2 and 2"),
        (1.5, 2.5, "fewer than two samples .* lie in 0 to 4 s .'walk'., 100 to 104 s"),
        (7, None, None),
        (500, None, "fewer than two samples from 500 s on"),
        (None, -1.0, "fewer than two samples before -1 s"),
        ("a", None, "`start` must be a finite number"),
        (np.nan, None, "`start` must be a finite number"),
    ):
        if message is None:
            assert len(both.crop(start, stop)) == 1
            continue
        with pytest.raises(hj.errors.DefinitionError, match=message):
            both.crop(start, stop)


def test_csv_with_units_events_and_missing_samples(tmp_path):
    path = tmp_path / "x.csv"
    path.write_text("time (s);force [N];event strike\n0;1;0\n1;;1\n2;NA;0\n3;4;0\n")
    found = hj.read_recording(path)
    assert found.signals == ("force",)
    assert found.units == ("N",)
    first = found.trials[0].values[:, 0]
    np.testing.assert_array_equal(first, [1, np.nan, np.nan, 4])
    strikes = found.trials[0].events["strike"]
    np.testing.assert_array_equal(strikes, [1.0])
    assert found.trials[0].name == "x"
    np.savez(
        tmp_path / "x.npz",
        time=np.arange(4.0),
        force=np.ones(4),
        **{"event strike": [1.5]},
    )
    both = hj.read_recording([path, tmp_path / "x.npz"], units={"force": "kN"})
    assert both.units == ("kN",)
    assert both.trials[1].events["strike"] == [1.5]


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        ("time (s);F (µN)\n0,5;1\n1,5;-2,5e-1\n", "latin-1"),  # a European spreadsheet
        ("time (s)\tF (µN)\n0,5\t1\n1,5\t-0,25\n", "utf-16"),
        ("time;F\ns;µN\n0.5;1\n1.5;-0.25\n", "utf-8"),  # units in a row of their own
        ("time,F,\n(s),[µN],\n0.5,1,\n1.5,-0.25,\n", "utf-8-sig"),
        ("# by hand\ntime (s),F (µN)\n0.5,1\n// a note\n\n1.5,-0.25\n", "utf-8"),
        ("% numpy.savetxt\n% time (s) F (µN)\n0.5 1\n1.5 -0.25\n", "utf-8"),
        ("Time (s)   F (µN)\n0.5   1\n 1.5  -0.25\n", "utf-8"),
        (",time (s),F (µN)\n0,0.5,1\n1,1.5,-0.25\n", "utf-8"),  # the index of pandas
        ('"time (s)","F (µN)"\n"0.5","1"\n"1.5","-0.25"\n', "utf-8"),
        ("time_ms,F (µN)\n500,1\n1500,-0.25\n", "utf-8"),
        (
            "Subject; 3\n\n;time;F\n;s;µN\n1;0,5;1\n2;1,5;-0,25\n",
            "utf-8",
        ),  # lines above
        ("time (min);F (µN)\n0.00833333333333333333;1\n0.025;-0.25\n", "utf-8"),
    ],
)
def test_what_spreadsheets_write(tmp_path, text, encoding):
    if ";" in text:
        text = text.replace("\n", "\r\n")
    elif "\t" in text:
        text = text.replace("\n", "\r")
    (tmp_path / "x.csv").write_text(text, encoding=encoding, newline="")
    found = hj.read_recording(
        tmp_path / "x.csv", time="time_ms" if "_ms" in text else "time"
    )
    assert found.signals == ("F",)
    assert found.units == ("µN",)
    times = found.trials[0].time
    np.testing.assert_allclose(times, [0.5, 1.5], rtol=1e-15)
    first = found.trials[0].values[:, 0]
    np.testing.assert_array_equal(first, [1.0, -0.25])


OPENSIM = """Coordinates
version=1
nRows=2
nColumns=3
inDegrees=yes

endheader
time\tpelvis_ty\tforce_vx
0.5\t1\t2
1.5\t-0.25\t3
"""
VICON = """Devices
1000
,,Imported Plate - Force,,
Frame,Sub Frame,Fx,Fy,
,,N,N,
1,0,0.5,1,
1,1,1.5,2,
2,0,2.5,3,
2,1,3.5,4,

Trajectories
500
,,subject:TOE,,
Frame,Sub Frame,X,Y,
,,mm,mm,
1,0,10,20,
2,0,11,21,
"""


@pytest.mark.parametrize("blanks", ["\t", "  "])
def test_opensim(tmp_path, blanks):
    path = tmp_path / "walk.mot"
    path.write_text(OPENSIM.replace("\t", blanks))
    found = hj.read_recording(path)
    assert found.signals == ("pelvis_ty", "force_vx")
    assert [x.text for x in found.findings] == ["angles are in degrees."]
    values = found.trials[0].values
    expected = [[1, 2], [-0.25, 3]]
    np.testing.assert_array_equal(values, expected)
    path.write_text(OPENSIM.replace("nRows=2", "nRows=3"))
    with pytest.raises(FileFormatError, match="2 rows, its header 3"):
        hj.read_recording(path)


@pytest.mark.parametrize("separator", [",", "\t", ";"])
def test_vicon(tmp_path, separator):
    """Two blocks of different rates on one axis of time."""
    path = tmp_path / "walk.csv"
    path.write_text(VICON.replace(",", separator))
    found = hj.read_recording(path)
    plate = "Imported Plate - Force"
    toe = "TOE"
    forces = (f"{plate}.Fx", f"{plate}.Fy", f"{toe}.X", f"{toe}.Y")
    assert found.signals == forces
    assert found.units == ("N", "N", "mm", "mm")
    times = found.trials[0].time
    np.testing.assert_allclose(times, [0, 0.001, 0.002, 0.003])
    expected = [[1, 2, 3, 4], [10, np.nan, 11, np.nan]]
    values = found.trials[0].values[:, 1:3]
    np.testing.assert_array_equal(values.T, expected)
    assert any("different rates" in x.text for x in found.findings)
    path.write_text(VICON.replace("500", "400"))
    with pytest.raises(FileFormatError, match="of different rates"):
        hj.read_recording(path)
    path.write_text(VICON.replace("\n2,1,3.5", "\n1,1,3.5"))
    with pytest.raises(
        FileFormatError, match="frames that are missing, or not in order"
    ):
        hj.read_recording(path)
    path.write_text(VICON[: VICON.index("\n\n")])
    assert hj.read_recording(path).findings == ()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("time,a\n", "has a header, but no samples"),
        ("0,1\n1,2\n", "begins with numbers"),
        ("\n,,\n# a\n", "no line with the names"),
        ("time,a\n0,1\n1,x\n", "line 3: column 'a' holds 'x', which is not a number"),
        ("time,a\n0,1\n1\n", "line 3: 1 fields, but the header names 2"),
        ("time,a,a\n0,1,1\n1,2,2\n", "two columns 'a'"),
        ("t,a\n0,1\n1,2\n", "no column 'time': choose `time` from t, a"),
        ("time,a\n0,5,1,2\n1,5,1,3\n", "line 2: 4 fields, .* another separator"),
        ("time;a\n0,5;1\n1.5;2\n", "line 3: there are points beside"),
        ("time (ms),time (s)\n0,1\n1,2\n", "two columns 'time'"),
        (b"time,a\x00\x01", "not a text file"),
        (b"\xff\xfe\x00\xd8\x00", "not a text file"),
    ],
)
def test_bad_csv(tmp_path, text, message):
    path = tmp_path / "x.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(hj.errors.HybridJaxError, match=message) as error:
        hj.read_recording(path)
    assert "\n" not in str(error.value)


def test_the_unit_of_time(tmp_path):
    """Seconds, whatever the file says; assumed, and said, where it says nothing."""
    columns = {"time (ms)": T, "a": T, "event e": [1.5, 2.5]}
    np.savez(tmp_path / "x.npz", **columns)
    found = hj.read_recording(tmp_path / "x.npz")
    times = found.trials[0].time
    np.testing.assert_allclose(times, T / 1000)
    events = found.trials[0].events["e"]
    np.testing.assert_allclose(events, [1.5e-3, 2.5e-3])
    is_event = T == 1
    frame = hj.Recording.from_frame({"time (ms)": T, "a (N)": T, "event e": is_event})
    times_of_frame = frame.trials[0].time
    np.testing.assert_allclose(times_of_frame, T / 1000)
    assert (frame.signals, frame.units, frame.trials[0].events["e"]) == (
        ("a",),
        ("N",),
        1e-3,
    )
    (tmp_path / "y.csv").write_text("frame,a\n0,1\n1,2\n2,4\n")
    by_frame = hj.read_recording(tmp_path / "y.csv", time="frame")
    both = hj.Recording.join([by_frame] * 2)
    assert "the times in 'frame' have no unit: taken as seconds" in repr(both)
    assert "every 1 s (1 Hz)" in repr(both)
    assert len(both.findings) == 1
    (tmp_path / "y.csv").write_text("time (samples),a\n0,1\n1,2\n2,4\n")
    with pytest.raises(
        hj.errors.DefinitionError, match="are in 'samples': convert them"
    ):
        hj.read_recording(tmp_path / "y.csv")


def test_other_bad_files(tmp_path):
    (tmp_path / "x.xls").write_bytes(b"?")
    with pytest.raises(hj.errors.HybridJaxError, match="ends in '.xls'"):
        hj.read_recording(tmp_path / "x.xls")
    with pytest.raises(hj.errors.DefinitionError, match="cannot read .*No such file"):
        hj.read_recording(tmp_path / "none.csv")


@pytest.mark.parametrize("strides", [4, 6])
def test_a_recording_that_is_too_short_is_refused(rhythm, strides):
    trial = rhythm.trials[0]
    kept = trial.time < strides
    signals = dict(zip(rhythm.signals, trial.values[kept].T, strict=True))
    short = hj.Recording(trial.time[kept], signals)
    inputs, *outputs = rhythm.signals
    names = dict(inputs=inputs, outputs=outputs, n_sections=8)
    with pytest.raises(hj.errors.DefinitionError, match="too few|reach beyond"):
        crossing = hj.Crossing(outputs[0], "rising")
        hj.identify_recording(short, crossing, **names)


def test_a_trial_without_series_prints_its_name():
    """Trees that JAX makes of it hold other leaves."""
    recording = hj.Recording([0.0, 1.0, 2.0], {"a": [1.0, 2.0, 1.0]})
    (trial,) = recording.trials
    other = jax.tree_util.tree_map(lambda _: None, trial)
    assert repr(other) == f"Trial({trial.name})"
    assert "3 samples" in repr(trial)
