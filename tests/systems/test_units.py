"""Units: declared with charts, systems, outputs, recordings, they arrive at figures and files."""

import json
import pickle

import jax
import numpy as np
import pytest
from matplotlib import pyplot

import hybridjax as hj
from hybridjax._core.signal import Signal, ratio, unit_of


def test_a_signal_is_its_name_and_knows_its_unit():
    y = Signal("y", "m")
    assert y == "y" and "y" == y and hash(y) == hash("y") and {"y": 1}[y] == 1
    assert y == Signal("y", "m") != Signal("y", "mm") and y != Signal("v", "m")
    assert unit_of(pickle.loads(pickle.dumps(y))) == "m" and unit_of("y") == ""
    assert repr(y) == "'y' (m)" and f"{y}" == "y"


@pytest.mark.parametrize(
    "output, input, unit",
    [
        ("m", "N", "m/N"),
        ("m/s", "N", "(m/s)/N"),
        ("m", "N s", "m/(N s)"),
        ("m", "", ""),
        ("", "N", ""),
    ],
)
def test_units_of_responses(output, input, unit):
    assert ratio(Signal("y", output), Signal("u", input)) == unit


def units(names):
    return [unit_of(name) for name in names]


def small_htf(**names):
    return hj.HTF([0.1, 0.2], np.ones((1, 2, 1, 1)), 0, 8, **names)


def test_units_go_from_the_model_to_the_fit(kinematic_ldtp, tmp_path):
    assert units(kinematic_ldtp.outputs) == ["m", "m/s"] and units(kinematic_ldtp.inputs) == ["N"]
    design = hj.multisine(periods=16, band=(0, 4.0))
    data = hj.experiments.simulate_experiments(kinematic_ldtp, design, start="periodic")
    estimate = hj.estimate_htf(data)
    fit = hj.fit_multipliers(estimate, 2, overhang=16)
    for thing in (data, data.records[0], estimate, fit, fit.htf([0.1]), hj.fit_rational(estimate)):
        assert units(thing.outputs) == ["m", "m/s"]
    for thing in (kinematic_ldtp, data, estimate, fit):
        hj.save(tmp_path / "thing.npz", thing)
        loaded = hj.load(tmp_path / "thing.npz")
        assert units(loaded.outputs) == ["m", "m/s"] and units(loaded.inputs) == ["N"]


def test_files_without_units_can_be_read(tmp_path):
    hj.save(tmp_path / "new.npz", small_htf(outputs={"y": "m"}))
    with np.load(tmp_path / "new.npz") as file:
        arrays = dict(file)
    header = json.loads(arrays.pop("header").item())
    assert header.pop("units") == {"y": "m"}
    np.savez(tmp_path / "old.npz", header=np.array(json.dumps(header)), **arrays)
    assert hj.load(tmp_path / "old.npz").outputs == ("y",)
    header["units"] = ["m"]
    np.savez(tmp_path / "bad.npz", header=np.array(json.dumps(header)), **arrays)
    with pytest.raises(hj.errors.FileFormatError, match="damaged"):
        hj.load(tmp_path / "bad.npz")


def test_a_jitted_function_does_not_mix_units_up(kinematic_ldtp):
    parts = [getattr(kinematic_ldtp, name) for name in ("A", "B", "C", "D", "dims")]
    look = jax.jit(lambda ldtp: ldtp.htf(np.array([0.1])))
    for unit in ("m", "mm"):
        htf = look(hj.LDTP(*parts, inputs="u", outputs={"y": unit, "v": ""}))
        assert units(htf.outputs) == [unit, ""]


def test_what_has_other_units_is_not_compared():
    with pytest.raises(hj.DefinitionError, match=r"\('y' \(m\),\) and \('y' \(mm\),\)"):
        small_htf(outputs={"y": "m"}).error(small_htf(outputs={"y": "mm"}))
    assert small_htf(outputs={"y": "m"}).error(small_htf(outputs="y")) == 0


def test_units_of_a_recording_arrive_in_its_figures():
    t = np.arange(0, 20, 0.01)
    signals = {"x": np.cos(6.3 * t), "v": -np.sin(6.3 * t), "F": np.cos(15 * t)}
    recording = hj.Recording(t, signals, units={"x": "m", "F": "N"})
    phase = hj.KinematicPhase(8, position="x", velocity="v")
    data = hj.recordings.section_data(recording, phase, inputs="F", outputs=("x", "v"))
    assert data.units == ("N", "m", "") and units(data.records[0].outputs) == ["m", ""]
    axes = hj.plot.section_data(data).axes
    labels = [ax.get_ylabel() for ax in axes.ravel()]
    assert labels[:4] == ["F (N)", r"$\delta$ F (N)", "power (N²)", "x (m)"] and labels[6] == "v"
    pyplot.close("all")


def test_axes_say_units(hopper_cycle, placed_kinematic, kinematic_ldtp):
    def of(plot):
        return plot.ax.get_xlabel(), plot.ax.get_ylabel()

    assert of(hj.plot.cycle(hopper_cycle)) == ("yM (m)", "vM (m/s)")
    htf = kinematic_ldtp.htf(np.linspace(0.1, 2, 20), (0, 1))
    assert of(hj.plot.magnitude(htf, harmonics=(0,)))[1] == "$|H_m|$, yM (m/N)"
    assert of(hj.plot.bode(htf, outputs="yM"))[1] == "$|H_{0}|$ (m/N)"
    both = hj.plot.bode(htf).ax
    texts = [text.get_text() for text in both.get_legend().get_texts()]
    assert texts == ["yM (m/N)", "vM ((m/s)/N)", "exact"] and both.get_ylabel() == "$|H_{0}|$"
    pyplot.close("all")


class Chart(hj.Chart):
    states = ("y", "v")
    units = ("m",)

    def field(self, t, q, u):
        return q[1], -q[0]


class Other(Chart):
    units = ("mm", "m/s")


class Right(Chart):
    units = ("m", "m/s")


class System(hj.HybridSystem):
    kinds: tuple = ()

    def charts(self):
        return {kind.__name__: kind() for kind in self.kinds}


class TwoUnits(System):
    input_units = ("N", "N")


@pytest.mark.parametrize(
    "system, words",
    [
        (System((Chart,)), "has the states 'y', 'v', but 1 units"),
        (System((Right, Other)), "give a state different units: 'y' (m), 'v' (m/s), 'y' (mm)"),
        (TwoUnits((Right,)), "TwoUnits has the inputs 'u', but 2 units"),
    ],
)
def test_units_that_do_not_fit_are_refused(system, words):
    with pytest.raises(hj.DefinitionError) as error:
        hj.simulate(system, "Right", (1.0, 0.0), 1.0)
    assert words in str(error.value)
