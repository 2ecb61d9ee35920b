"""Other libraries get the same numbers, and give them back."""

import sys

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
    return hj.linear.LDTP.from_blocks(
        *blocks, inputs={"u": "N", "w": ""}, outputs={"y": "m"}
    )


def test_the_lifted_system_is_the_periodic_one(model):
    """In time, sample by sample, and in frequency, harmonic by harmonic."""
    lti = convert.to_lti(model)
    assert lti.n_sections == 1
    assert lti.A.shape == (1, 2, 2)
    assert lti.inputs[:3] == ("u[0]", "w[0]", "u[1]")
    assert lti.inputs[2].unit == "N"
    assert_allclose(lti.multipliers, model.multipliers, rtol=1e-12)

    periods = 4
    rng = np.random.default_rng(1)
    u = rng.normal(size=(periods * N, 2))
    y = lti.simulate(u.reshape(periods, -1))
    expected = model.simulate(u)
    assert_allclose(y.reshape(-1, 1), expected, rtol=0, atol=1e-13)

    f = np.linspace(0.01, 0.49, 7)
    H = model.htf(f)
    # From sample r, input u of a period to sample n, output y of it.
    G = np.asarray(lti.htf(f).H[0]).reshape(len(f), N, 1, N, 2)

    def wave(f):
        return np.exp(2j * np.pi * np.outer(f, np.arange(N)) / N)

    for m in H.harmonics:
        back = wave(-(f + m))
        turns = wave(f)
        found = np.einsum("fnyru,fn,fr->fyu", G, back, turns) / N
        assert_allclose(found, H[m], rtol=0, atol=1e-12)


def test_scipy(model):
    system = convert.to_scipy(model, period=2.0)
    lti = convert.to_lti(model)
    assert system.dt == 2.0
    for name in "ABCD":
        of_lti = getattr(lti, name)[0]
        assert_array_equal(getattr(system, name), of_lti)


def test_python_control_gets_the_lifted_system(model):
    pytest.importorskip("control")
    system = convert.to_control(model, period=2.0)
    assert system.dt == 2.0
    assert system.input_labels[2] == "u[1]"
    f = np.linspace(0.01, 0.49, 7)
    points = np.exp(2j * np.pi * f)
    response = system(points)
    expected = convert.to_lti(model).htf(f).H[0]
    assert_allclose(np.moveaxis(response, 2, 0), expected, rtol=0, atol=1e-12)


def test_python_control_gets_frequency_responses(model):
    control = pytest.importorskip("control")
    f = np.linspace(0.01, 0.49, 7)
    H = model.htf(f)
    data = convert.to_control(H, period=2.0)
    assert isinstance(data, control.FrequencyResponseData)
    assert data.output_labels == ["y[-2]", "y[-1]", "y[0]", "y[1]", "y[2]"]
    omega = 2 * np.pi * f / 2.0
    assert_allclose(data.omega, omega)
    of_harmonic = data(1j * data.omega)
    last_harmonic = np.asarray(H[-1])
    response = last_harmonic[:, 0]
    assert_array_equal(of_harmonic[1], response.T)

    one = convert.to_control(H.select([0]))[0, 0]
    drawn = control.bode_plot(one).lines[0, 0][0]
    H_0 = H[0][:, 0, 0]
    modulus = np.abs(H_0)
    assert_allclose(drawn.get_ydata(), modulus)


def recording():
    """Two trials of two signals, one of them with a missing sample."""
    t = np.arange(5) / 10
    with_gap = np.where(t == 0.2, np.nan, t**2)
    signals = {"a": t, "b": with_gap}
    events = {"e": [0.1, 0.3], "never": []}
    trials = []
    for name in ("first", "second"):
        trials.append(
            hj.Recording(t, signals, events=events, units={"a": "N"}, name=name)
        )
    return hj.Recording.join(trials)


def test_a_dataset_of_an_htf_can_be_cut_and_read_back(model):
    pytest.importorskip("xarray")
    H = model.htf(np.linspace(0.01, 0.4, 5))
    dataset = convert.to_xarray(H)
    one = dataset.H.sel(
        frequency=0.4,
        harmonic=-1,
        input="w",
        output="y",
    )
    expected = complex(H[-1][-1, 0, 1])
    assert one.item() == expected
    assert dataset.input_unit.sel(input="u").item() == "N"
    cut = dataset.isel(harmonic=[1, 2], input=[0])
    part = cut.sel(frequency=slice(0, 0.2))
    fewer = convert.from_xarray(part)
    assert fewer.harmonics == (-1, 0)
    assert fewer.inputs == ("u",)
    assert len(fewer.frequencies) == 2


def test_a_dataset_of_a_recording_knows_units_and_events():
    pytest.importorskip("xarray")
    dataset = convert.to_xarray(recording())
    assert dataset.a.attrs["units"] == "N"
    assert "units" not in dataset.b.attrs
    second = dataset.isel(sample=dataset.trial.values == 1)
    values = recording().trials[1].values
    assert_array_equal(second.b, values[:, 1])
    times = dataset.event_time[dataset.event == "e"]
    assert times.values.tolist() == [0.1, 0.3, 0.1, 0.3]


def test_a_dataset_of_a_model_has_named_dimensions(model):
    pytest.importorskip("xarray")
    dataset = convert.to_xarray(model)
    assert dataset.A.dims == ("section", "next_state", "state")
    assert dataset.B.dims == ("section", "next_state", "input")
    for part in (
        dataset.isel(section=slice(2)),
        dataset.roll(section=1, roll_coords=True),
    ):
        with pytest.raises(
            hj.errors.DefinitionError, match="`section` must be in order"
        ):
            convert.from_xarray(part)


def test_a_dataset_of_experiments_begins_at_section_0():
    pytest.importorskip("xarray")
    u = np.zeros((2, 4 * N, 2))
    drift = np.arange(4 * N)[:, None]
    y = u + drift
    data = hj.experiments.ExperimentData(u, y, n_sections=N, periods=2)
    dataset = convert.to_xarray(data)
    second_period = convert.from_xarray(dataset.isel(sample=slice(N, None)))
    assert_array_equal(second_period.y, data.y[:, N:])
    backwards = slice(None, None, -1)
    from_section_1 = slice(1, None)
    for part in (backwards, from_section_1):
        with pytest.raises(
            hj.errors.DefinitionError, match="`sample` must be in order, from section 0"
        ):
            convert.from_xarray(dataset.isel(sample=part))


def test_section_data(wave):
    pytest.importorskip("xarray")
    pytest.importorskip("pandas")
    crossing = hj.Crossing("v", "falling")
    data = hj.recordings.sample_sections(
        wave, crossing, inputs="f", outputs="x", n_sections=8
    )
    dataset = convert.to_xarray(data)
    values_of_x = data.records[0].y[:, 0]
    assert_array_equal(dataset.x.values, values_of_x)
    average = dataset.average_cycle.sel(signal="x")
    assert_array_equal(average.values, data.cycle_outputs[:, 0])
    with pytest.raises(hj.errors.DefinitionError, match="that `to_xarray` made of a"):
        convert.from_xarray(dataset)

    frame = data.to_pandas()
    assert_array_equal(frame["time"], data.times[0])
    first = frame["section"][0]
    expected = (first + np.arange(8)) % 8
    assert_array_equal(frame["section"][:8], expected)


def test_a_table_of_a_recording_is_read_back():
    pytest.importorskip("pandas")
    frame = recording().to_pandas()
    first = frame[frame["trial"] == 0].drop(columns="trial")
    again = hj.Recording.from_frame(first, units={"a": "N"})
    values = again.trials[0].values
    assert_array_equal(values, recording().trials[0].values)


def test_a_table_of_an_htf_has_a_row_for_each_value(model):
    pytest.importorskip("pandas")
    H = model.htf(np.linspace(0.01, 0.4, 5))
    table = H.to_pandas()
    frequency = H.frequencies[1].item()
    row = table.loc[-1, frequency, "y", "w"]
    value = complex(H[-1][1, 0, 1])
    expected = (value.real, value.imag, np.abs(value))
    assert tuple(row) == expected
    assert np.asarray(H).tobytes() == H.H.tobytes()


def test_tables_of_fits(model):
    pytest.importorskip("pandas")
    rng = np.random.default_rng(3)
    u = rng.normal(size=(60 * N, 2))
    record = hj.experiments.SectionSeries(u, model.simulate(u), n_sections=N)
    fit = hj.fit_series(record, order=1)
    table = fit.to_pandas()
    multipliers = table["real"] + 1j * table["imaginary"]
    assert_array_equal(multipliers, fit.multipliers)
    errors = np.hypot(table["real_error"], table["imaginary_error"])
    assert_array_equal(errors, fit.standard_errors)
    assert_array_equal(table["standard_error"], fit.standard_errors)

    htf = model.htf(np.linspace(0.01, 0.4, 20))
    rational = hj.identify.fit_rational(htf, input="u")
    table = rational.to_pandas()
    poles = table["pole_real"] + 1j * table["pole_imaginary"]
    assert_array_equal(poles, rational.poles[0])


def test_what_is_refused():
    pytest.importorskip("xarray")
    with pytest.raises(hj.errors.DefinitionError, match="that `to_xarray` made of a"):
        convert.from_xarray({"a": 1})
    clash = hj.Recording([0.0, 1.0], {"trial": [0.0, 1.0]})
    with pytest.raises(
        hj.errors.DefinitionError, match="'trial' is also the name of a coordinate"
    ):
        convert.to_xarray(clash)


@pytest.mark.parametrize(
    "call, library",
    [(convert.to_control, "control"), (convert.to_xarray, "xarray")],
    ids=["control", "xarray"],
)
def test_a_library_that_is_missing_is_named(call, library, model, monkeypatch):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(
        hj.errors.DefinitionError, match=rf"pip install 'hybridjax\[{library}\]'"
    ):
        call(model)
