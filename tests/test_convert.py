"""Other libraries get the same numbers, and give them back."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj

from .linear.conftest import blocks_at_random
from .recordings.conftest import wave as wave


convert = hj.convert
N = 5


@pytest.fixture(scope="module")
def model():
    """A stable system whose dimension varies, with two inputs and an output."""
    blocks = blocks_at_random(0, [2, 3, 2, 1, 3], 1, 2)
    return hj.LDTP.from_blocks(*blocks, inputs={"u": "N", "w": ""}, outputs={"y": "m"})


def test_the_lifted_system_is_the_periodic_one(model):
    """In time, sample by sample, and in frequency, harmonic by harmonic."""
    lti = convert.to_lti(model)
    assert lti.n_sections == 1
    assert lti.A.shape == (1, 2, 2)
    assert lti.inputs[:3] == ("u[0]", "w[0]", "u[1]")
    assert lti.inputs[2].unit == "N"
    assert_allclose(lti.multipliers, model.multipliers, rtol=1e-12)
    u = np.random.default_rng(1).normal(size=(4 * N, 2))
    y = lti.simulate(u.reshape(4, -1))
    assert_allclose(y.reshape(-1, 1), model.simulate(u), rtol=0, atol=1e-13)
    f = np.linspace(0.01, 0.49, 7)
    n = np.arange(N)
    H = model.htf(f)
    G = np.asarray(lti.htf(f).H[0]).reshape(len(f), N, 1, N, 2)

    def wave(f):
        return np.exp(2j * np.pi * np.outer(f, n) / N)

    for m in H.harmonics:
        found = np.einsum("fnyru,fn,fr->fyu", G, wave(-(f + m)), wave(f)) / N
        assert_allclose(found, H[m], rtol=0, atol=1e-12)


def test_python_control(model):
    control = pytest.importorskip("control")
    f = np.linspace(0.01, 0.49, 7)
    system = convert.to_control(model, period=2.0)
    assert system.dt == 2.0
    assert system.input_labels[2] == "u[1]"
    expected = convert.to_lti(model).htf(f).H[0]
    response = system(np.exp(2j * np.pi * f))
    assert_allclose(np.moveaxis(response, 2, 0), expected, rtol=0, atol=1e-12)
    H = model.htf(f)
    data = convert.to_control(H, period=2.0)
    assert data.output_labels == ["y[-2]", "y[-1]", "y[0]", "y[1]", "y[2]"]
    measured = data(1j * data.omega)[1]
    assert_array_equal(measured, np.asarray(H[-1])[:, 0].T)
    assert_allclose(data.omega, np.pi * f)
    assert isinstance(data, control.FrequencyResponseData)
    lines = control.bode_plot(convert.to_control(H.select([0]))[0, 0]).lines
    measured = lines[0, 0][0].get_ydata()
    assert_allclose(measured, np.abs(H[0][:, 0, 0]))


def test_scipy(model):
    system = convert.to_scipy(model, period=2.0)
    lti = convert.to_lti(model)
    assert system.dt == 2.0
    for name in "ABCD":
        assert_array_equal(getattr(system, name), getattr(lti, name)[0])


def recording():
    t = np.arange(5) / 10
    one = {"a": t, "b": np.where(t == 0.2, np.nan, t**2)}
    parts = [
        hj.Recording(
            t, one, events={"e": [0.1, 0.3], "never": []}, units={"a": "N"}, name=name
        )
        for name in ("first", "second")
    ]
    return hj.Recording.join(parts)


def test_datasets_know_names_and_units(model):
    pytest.importorskip("xarray")
    H = model.htf(np.linspace(0.01, 0.4, 5))
    dataset = convert.to_xarray(H)
    one = dataset.H.sel(harmonic=-1, input="w", output="y").sel(f=0.4)
    assert one.item() == complex(H[-1][-1, 0, 1])
    assert dataset.input_unit.sel(input="u").item() == "N"
    fewer = convert.from_xarray(
        dataset.isel(harmonic=[1, 2], input=[0]).sel(f=slice(0, 0.2))
    )
    assert fewer.harmonics == (-1, 0)
    assert fewer.inputs == ("u",)
    assert len(fewer.f) == 2
    made = convert.to_xarray(recording())
    assert made.a.attrs["units"] == "N"
    assert "units" not in made.b.attrs
    second = made.isel(sample=made.trial.values == 1)
    assert_array_equal(second.b, recording().trials[1].values[:, 1])
    assert made.event_time[made.event == "e"].values.tolist() == [0.1, 0.3, 0.1, 0.3]
    dims = {name: x.dims for name, x in convert.to_xarray(model).data_vars.items()}
    assert dims["A"] == ("section", "next_state", "state")
    assert dims["B"] == ("section", "next_state", "input")
    u = np.zeros((2, 4 * N, 2))
    data = hj.ExperimentData(u, u + np.arange(4 * N)[:, None], n_sections=N, periods=2)
    dataset = convert.to_xarray(data)
    whole = convert.to_xarray(model)
    later = convert.from_xarray(dataset.isel(sample=slice(N, None)))
    assert_array_equal(later.y, data.y[:, N:])
    backwards = slice(None, None, -1)
    late = slice(1, None)
    for part in (dataset.isel(sample=x) for x in (backwards, late)):
        with pytest.raises(
            hj.DefinitionError, match="`sample` must be in order, from section 0"
        ):
            convert.from_xarray(part)
    for part in (whole.isel(section=slice(2)), whole.roll(section=1, roll_coords=True)):
        with pytest.raises(hj.DefinitionError, match="`section` must be in order"):
            convert.from_xarray(part)


def test_section_data(wave):
    pytest.importorskip("xarray")
    pytest.importorskip("pandas")
    crossing = hj.Crossing("v", "falling")
    about = {"inputs": "f", "outputs": "x"}
    data = hj.recordings.section_data(wave, crossing, **about, n_sections=8)
    dataset = convert.to_xarray(data)
    frame = convert.to_pandas(data)
    assert_array_equal(dataset.x.values, data.records[0].y[:, 0])
    assert_array_equal(frame["time"], data.times[0])
    expected = (frame["section"][0] + np.arange(8)) % 8
    assert_array_equal(frame["section"][:8], expected)
    with pytest.raises(hj.DefinitionError, match="that `to_xarray` made of a"):
        convert.from_xarray(dataset)
    average = dataset.average_cycle.sel(signal="x").values
    assert_array_equal(average, data.cycle_outputs[:, 0])


def test_pandas(model):
    pytest.importorskip("pandas")
    pytest.importorskip("xarray")
    frame = convert.to_pandas(recording())
    first = frame[frame["trial"] == 0].drop(columns="trial")
    again = hj.Recording.from_frame(first, units={"a": "N"})
    assert_array_equal(again.trials[0].values, recording().trials[0].values)
    H = model.htf(np.linspace(0.01, 0.4, 5))
    row = convert.to_pandas(H).loc[-1, H.f[1].item(), "y", "w"]
    z = complex(H[-1][1, 0, 1])
    assert tuple(row) == (z.real, z.imag, np.abs(z))
    assert np.asarray(H).tobytes() == H.H.tobytes()
    u = np.random.default_rng(3).normal(size=(60 * N, 2))
    fit = hj.fit_series(hj.Record(u, model.simulate(u), n_sections=N), order=1)
    table = convert.to_pandas(fit)
    assert_array_equal(table["real"] + 1j * table["imaginary"], fit.multipliers)
    errors = np.hypot(table["real_error"], table["imaginary_error"])
    assert_array_equal(errors, fit.standard_errors)
    assert_array_equal(table["standard_error"], fit.standard_errors)
    rational = hj.fit_rational(model.htf(np.linspace(0.01, 0.4, 20)), input="u")
    table = convert.to_pandas(rational)
    poles = table["pole_real"] + 1j * table["pole_imaginary"]
    assert_array_equal(poles, rational.poles[0])


def test_what_is_refused(model, monkeypatch):
    pytest.importorskip("xarray")
    with pytest.raises(hj.DefinitionError, match="that `to_xarray` made of a"):
        convert.from_xarray({"a": 1})
    clash = hj.Recording([0.0, 1.0], {"trial": [0.0, 1.0]})
    with pytest.raises(
        hj.DefinitionError, match="'trial' is also the name of a coordinate"
    ):
        convert.to_xarray(clash)
    for call, name in ((convert.to_control, "control"), (convert.to_xarray, "xarray")):
        monkeypatch.setitem(__import__("sys").modules, name, None)
        with pytest.raises(
            hj.DefinitionError, match=rf"pip install 'hybridjax\[{name}\]'"
        ):
            call(model)
