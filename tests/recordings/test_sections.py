"""Section data against closed forms, its masks, tables of designs, and the command."""

import dataclasses
import html
import json
import re

import equinox as eqx
import numpy as np
import pytest
from matplotlib import pyplot

import hybridjax as hj
from hybridjax.apps.cli import main
from hybridjax.recordings.data import SectionData
from hybridjax.recordings.impulse import ImpulseResponses, impulse_responses
from hybridjax.recordings.sampling import without_drift

from .conftest import MULTIPLIER
from .mishaps import mishandle, misjudged


CIRCLE = hj.KinematicPhase(
    8,
    position="x",
    velocity="v",
    center=(0, 0),
    scale=(1, 1),
)


def sample(recording, phase=CIRCLE, **options):
    options = {"inputs": "f", "outputs": ("x", "v")} | options
    return hj.recordings.sample_sections(recording, phase, **options)


def test_a_circle(wave):
    data = sample(wave)
    angles = np.pi / 4 * np.arange(8)
    circle = np.cos(angles)
    found = data.cycle_outputs[:, 0]
    np.testing.assert_allclose(found, circle, atol=2e-3)
    (record,) = data.records
    (times,) = data.times
    steps_of_time = np.diff(times)
    np.testing.assert_allclose(steps_of_time, 1 / 8, atol=1e-4)
    area = np.sin(3 * times)
    np.testing.assert_allclose(
        (
            record.u
            + data.cycle_inputs[(record.first_section + np.arange(len(times))) % 8]
        )[:-1, 0],
        np.diff(area) / 3 / np.diff(times),
        atol=2e-3,
    )
    assert record.lead == 1
    assert sample(wave, bandwidth=np.inf).records[0].lead == 0
    timed = sample(wave, timing="clock")
    assert timed.outputs == ("x", "v", "time")
    assert timed.rms()[1][2] < 1e-4
    with pytest.raises(
        hj.errors.DefinitionError, match="different n_sections: 16 and 8"
    ):
        sample(wave, n_sections=16)
    with pytest.raises(
        hj.errors.DefinitionError, match="events alone determine no multipliers"
    ):
        sample(wave, inputs=(), outputs=())
    for phase in (CIRCLE, hj.Crossing("v", "rising")):
        for call in (sample, hj.recordings.estimate_phase):
            with pytest.raises(
                hj.errors.DefinitionError,
                match="`bandwidth` removes the rhythm of 1 Hz",
            ):
                call(wave, phase, bandwidth=0.9)
    assert "SectionData(19.75 cycles of 8 sections in 1 record;" in repr(data)


def test_outputs_that_repeat_and_few_samples_are_named(rhythm):
    (trial,) = rhythm.trials
    names = rhythm.signals
    t = trial.time
    z = np.exp(2j * np.pi * trial.time)
    for inputs in ((), "force"):
        with pytest.raises(
            hj.errors.DefinitionError,
            match="^x is the same in all cycles, but for round",
        ):
            exact = hj.Recording(
                t, {"force": trial.values[:, 0], "x": z.real, "v": -z.imag}
            )
            sample(exact, inputs=inputs)
    assert sample(rhythm, inputs="force", timing="clock").outputs == ("x", "v", "time")
    for rate in (
        2 * np.pi,
        6.1,
    ):  # (with 64 samples in a cycle, all cycles are sampled alike)
        both = hj.Recording.beside(
            [rhythm, hj.Recording(t, {"clock": np.sin(rate * t)})]
        )
        with pytest.raises(
            hj.errors.DefinitionError,
            match="deviate only by rounding and interpolation",
        ):
            sample(both, hj.Crossing("clock", "rising"), inputs="force", timing="clock")
    for step, few in ((13, True), (5, False)):
        thin = hj.Recording(
            t[::step], dict(zip(names, trial.values[::step].T, strict=True))
        )
        data = sample(thin, inputs="force")
        fit = hj.fit_series(data, 1, check=False)
        diagnosis = hj.recordings.diagnose(data, fit)
        named = any(w.cause == "sampling" for w in diagnosis.findings)
        assert named == few


def test_multipliers_of_no_convergence_need_no_power(rhythm):
    """They are those at which the iteration stopped: no frequency to excite follows."""
    data = sample(rhythm, inputs="force")
    n = len(data.records[0].u)
    slow = np.cos(2 * np.pi * 0.05 * np.arange(n) / data.n_sections)
    records = (dataclasses.replace(data.records[0], u=slow[:, None]),)
    data = eqx.tree_at(lambda d: d.records, data, records)
    fit = hj.fit_series(data, 2, check=False)
    fit = eqx.tree_at(lambda f: f.multipliers, fit, np.array([0.5j, -0.5j]))

    def causes(result):
        stopped = dataclasses.replace(fit, result=int(result))
        return [x.cause for x in hj.recordings.diagnose(data, stopped).findings]

    assert "weak excitation" in causes(hj.errors.Result.OK)
    assert "weak excitation" not in causes(hj.errors.Result.NOT_CONVERGED)
    assert "narrow excitation" in causes(hj.errors.Result.NOT_CONVERGED)


def test_gaps_are_masked_and_cut(wave):
    t = wave.trials[0].time
    values = wave.trials[0].values.copy()
    values[(t > 4.3) & (t < 4.5), 1] = (
        np.nan
    )  # of an output, too short to lose the count
    values[(t > 9.1) & (t < 9.3), 0] = np.nan  # of the input, longer than a section
    hidden = (t > 14) & (t < 16)
    values[hidden, 1:] = np.nan
    data = sample(
        hj.Recording(t, dict(zip("fxv", values.T, strict=True))), timing="duration"
    )
    assert len(data.records) == 2
    for record, times in zip(data.records, data.times, strict=True):
        y = record.y[:, [0, 2]]
        lost, x = np.isnan(y).T
        lost_before = np.append(True, lost[:-1])
        np.testing.assert_array_equal(x, lost | lost_before)
        np.testing.assert_array_equal(lost & (times > 4.29) & (times < 4.51), lost)
        last = times[-1] + 0.125
        end = np.append(times[1:], last)
        np.testing.assert_array_equal(
            np.isnan(record.u[:, 0]), (end > 9.11) & (times < 9.29)
        )
    assert 0 < data.missing < 0.1


@pytest.mark.slow
def test_short_stretches_between_missed_events_and_a_pause(rhythm):
    """They count where they can; what is left out is counted and said."""
    marked = rhythm.mark("top", hj.Crossing("v", "falling"), bandwidth=16)
    dirty = mishandle(
        hj.testing.add_artifacts(marked, ("x", "v"), noise=1e-3),
        misjudged(lost=0.05, doubled=0.05),
        input="force",
        outputs=("x", "v"),
        event="top",
    )
    (trial,) = dirty.trials
    kept = np.abs(trial.time - 77) > 3.4
    events = {k: v[np.abs(v - 77) > 3.4] for k, v in trial.events.items()}
    signals = dict(zip(dirty.signals, trial.values[kept].T, strict=True))
    paused = hj.Recording(trial.time[kept], signals, events=events)
    names = {"inputs": "force", "outputs": ("x", "v"), "n_sections": 8}
    found = hj.identify_recording(paused, hj.AtEvent("top"), order=1, **names)
    assert found.fit.contains([MULTIPLIER], 0.999).all()
    assert found.phase.dropped == 10
    assert len(found.phase.stretches[0]) == 12
    assert found.phase.cycles + found.phase.missed == 199
    held = found.held_out.validation
    assert f"compare, left out: {held.left_out}" in repr(found)
    assert max(map(len, repr(found.held_out).splitlines())) <= 100
    assert held.independent
    assert held.fit.min() > 50


def test_gaps_over_crossings_leave_no_wrong_section(rhythm):
    """Two tenths of a cycle, five times, where cycles begin: sections are left out, or right."""
    t = rhythm.trials[0].time
    values = rhythm.trials[0].values
    names = rhythm.signals
    top = hj.Crossing("v", "falling")
    rng = np.random.default_rng(0)
    hidden = values.copy()
    for at in rng.choice(np.arange(10, 190), 5, replace=False):
        start = at + 0.5 - rng.uniform(0.02, 0.18)
        is_hidden = (t > start) & (t < start + 0.2)
        hidden[is_hidden, 1:] = np.nan
    options = {"inputs": "force", "n_sections": 16, "bandwidth": 8.0}
    both = [
        hj.Recording(t, dict(zip(names, x.T, strict=True))) for x in (values, hidden)
    ]
    clean, dirty = (sample(x, top, **options) for x in both)
    assert len(dirty.records) == 6
    assert dirty.cycles == pytest.approx(clean.cycles - 10, abs=0.1)
    (before,) = clean.times
    for record, times in zip(dirty.records, dirty.times, strict=True):
        distance = np.abs(before - times[0])
        first = int(np.argmin(distance))
        true = slice(first, first + len(times))
        np.testing.assert_allclose(times, before[true], atol=2e-3)
        assert (
            np.nanstd(record.y - clean.records[0].y[true])
            < 0.1 * clean.records[0].y.std()
        )


def test_slow_drift_is_taken_out(wave):
    t = wave.trials[0].time
    values = wave.trials[0].values
    drifting = dict(
        zip("fxv", (values + 0.3 * np.cos(np.pi * t / 20)[:, None]).T, strict=True)
    )
    recording = hj.Recording(t, drifting)
    assert sample(recording).rms()[1][0] > 0.1
    rough = hj.recordings.estimate_phase(recording, CIRCLE)
    flat = without_drift(recording, rough, ("f", "x", "v"), 4)
    assert sample(flat).rms()[1][0] < 0.02
    assert [x.records[0].drift for x in (sample(flat), sample(flat).with_drift(9))] == [
        np.inf,
        9,
    ]
    for phase, cycles, message in [
        (rough, 3, "four cycles or more, not 3"),
        (
            eqx.tree_at(lambda p: p.stretches, rough, ()),
            9,
            "numbers of trials: 0 and 1",
        ),
    ]:
        with pytest.raises(hj.errors.DefinitionError, match=message):
            without_drift(wave, phase, "x", cycles)


def test_designs_as_tables(tmp_path, wave):
    design = hj.multisine(n_sections=8, periods=16, frequencies=(0, 2.0))
    design.write(tmp_path / "phase.csv", cycles=19)
    for period, rows in ((0.2901, 465), (0.29, 16 * 29)):  # (0.29 * 100 is 28.999...)
        design.write(tmp_path / "time.csv", period=period, rate=100)
        assert (tmp_path / "time.csv").read_text().count(
            "\n"
        ) - 1 == design.experiments * rows
    for rate, message in (
        (None, "both the period and the rate"),
        (15.9, "must be 16 or more"),
    ):
        with pytest.raises(hj.errors.DefinitionError, match=message):
            design.write(tmp_path / "time.csv", period=0.5, rate=rate)
    # Applied at the phases of the recording, and found again in its section data.
    phase = hj.recordings.estimate_phase(wave, CIRCLE)
    with pytest.raises(hj.errors.FileFormatError, match="must be a table by phase"):
        hj.recordings.attach_design(wave, phase, tmp_path / "time.csv")
    lines = (tmp_path / "phase.csv").read_text().splitlines()
    head = lines[: 1 + 19 * 8]
    (tmp_path / "one.csv").write_text("\n".join(head))
    told = hj.recordings.attach_design(wave, phase, tmp_path / "one.csv")
    data = sample(told, phase, inputs="u", sampled="middle")
    record = data.records[0]
    samples = np.arange(len(record.u))
    section = (record.first_section + samples) % 8
    of_cycle = data.cycle_inputs[section, 0]
    deviation = data.records[0].u[:, 0]
    u = deviation + of_cycle
    first = -data.records[0].first_section % 8
    np.testing.assert_allclose(
        u[first : first + 150], design.signals(19)[0, :150, 0], atol=1e-9
    )
    with pytest.raises(
        hj.errors.DefinitionError, match="different numbers of trials: 1 and "
    ):
        hj.recordings.attach_design(wave, phase, tmp_path / "phase.csv")
    experiments = data.experiments(periods=16)
    assert experiments.u.shape[1] % 8 == 0
    assert experiments.n_sections == 8


@pytest.mark.parametrize("samples, stretches", [(200, 2), (None, 1)])
def test_a_command_that_ends_with_the_phase_is_reported(
    tmp_path, wave, samples, stretches
):
    """Cycles are not counted across it, so that the place in the table is unknown."""
    design = hj.multisine(8, 16, frequencies=(0.1, 0.4), experiments=1)
    design.write(tmp_path / "phase.csv", cycles=19)
    time, values = wave.trials[0].time, wave.trials[0].values.copy()
    values[len(time) // 2 :][:samples] = np.nan
    recording = hj.Recording(time, dict(zip(wave.signals, values.T, strict=True)))
    phase = hj.recordings.estimate_phase(recording, CIRCLE)
    assert len(phase.stretches[0]) == stretches
    told = hj.recordings.attach_design(recording, phase, tmp_path / "phase.csv")
    assert np.isnan(told["u"][len(time) // 2 + 200 :]).all()
    (finding,) = told.findings
    assert finding.cause == "command unknown"
    assert f"after {time[len(time) // 2 - 1]:.6g} s" in finding.text


@pytest.fixture(scope="module")
def files(tmp_path_factory, rhythm):
    folder = tmp_path_factory.mktemp("trials")
    (trial,) = hj.testing.add_artifacts(rhythm, ("x", "v"), noise=1e-3).trials
    half = len(trial.time) // 2
    for k, rows in enumerate((slice(0, half), slice(half, None))):
        table = np.column_stack([trial.time[rows], trial.values[rows]])
        np.savetxt(
            folder / f"trial{k}.csv",
            table,
            "%.9g",
            delimiter=",",
            comments="",
            header="time (s),force (N),x (m),v (m/s)",
        )
    return folder


def identify(files, out, *more):
    trials = [str(files / f"trial{k}.csv") for k in (0, 1)]
    options = [
        "--inputs",
        "force",
        "--outputs",
        "x,v",
        "--phase",
        "x,v",
        "--sections",
        "16",
    ]
    arguments = ["identify", *trials, *options, "--out", str(out), *more]
    return main(arguments)


@pytest.fixture(scope="module")
def out(files, tmp_path_factory):
    """The results of the command, in a folder that was not empty."""
    folder = tmp_path_factory.mktemp("results") / "out"
    folder.mkdir()
    (folder / "notes.txt").write_text("mine")
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.chdir(folder)
        assert identify(files, ".") == 0
    return folder


@pytest.fixture(scope="module")
def summary(out):
    return json.loads((out / "summary.json").read_text())


@pytest.mark.slow
def test_the_summary_of_the_command(summary):
    pairs = np.array(summary["multipliers"])
    (found,) = pairs @ [1, 1j]
    assert abs(found - MULTIPLIER) < 2e-2
    assert summary["held_out_fit_percent"][0] > 80
    assert summary["sampling_rates"] == pytest.approx([64, 64])
    units = {"time": "s", "force": "N", "x": "m", "v": "m/s"}
    assert summary["units"] == units


@pytest.mark.slow
def test_the_page_of_the_command(out, summary):
    page = (out / "report.html").read_text()
    assert page.count("data:image/png;base64,") >= 7
    assert "<script" not in page
    assert "p &lt; 0.001" in page or "p = " in page

    above_figures = page[: page.index("<img")]
    pairs_of_new = np.array(summary["multipliers"])
    (found,) = pairs_of_new @ [1, 1j]
    assert "± standard error" in above_figures
    assert f"<td>{found.real:.3f}" in above_figures
    assert "from force (N) to x (m), v (m/s)" in above_figures

    text = re.sub("</?code>", "`", above_figures)
    for warning in summary["warnings"]:
        assert f'<p class="warn">{html.escape(warning)}</p>' in text
    for reason, count in summary["left_out"].items():
        is_listed = html.escape(reason) in text
        assert is_listed == bool(count)


@pytest.mark.slow
def test_the_files_of_the_command(out):
    fit = hj.load(out / "fit.npz")
    assert fit.contains([MULTIPLIER], 0.999).all()
    assert hj.load(out / "htf.npz").variance is not None
    rows = (out / "sections.csv").read_text().splitlines()
    assert rows[0] == "trial,record,cycle,section,time (s),force (N),x (m),v (m/s)"
    assert len(rows) > 16 * 190
    formats = {p.suffix for p in (out / "figures").iterdir()}
    assert formats == {".png"}
    assert (out / "notes.txt").read_text() == "mine"


@pytest.mark.slow
def test_a_failure_of_the_command_leaves_nothing(files, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(hj.identify.Validation, "plot", lambda validation: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        identify(files, "new")
    assert not list(tmp_path.iterdir())
    assert not pyplot.get_fignums()


@pytest.mark.parametrize("name", ["summary.json", "figures/bode.png"])
def test_the_command_computes_nothing_where_a_file_is_in_the_way(
    files, tmp_path, name, capsys
):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("mine")
    with pytest.raises(SystemExit, match=f"{name}' is in the way"):
        identify(files, tmp_path)
    assert not capsys.readouterr().out
    written = [p.read_text() for p in tmp_path.rglob("*") if p.is_file()]
    assert written == ["mine"]


def test_signals_with_clocks_of_their_own(rhythm):
    """Position and velocity are never sampled together, the input more often than either."""
    (trial,) = rhythm.trials
    t = trial.time
    force, x, v = trial.values.T
    parts = [
        hj.Recording(t, {"force": force}),
        hj.Recording(t[::2], {"x": x[::2]}),
        hj.Recording(t[1::2], {"v": v[1::2]}),
    ]
    own = hj.Recording.beside(parts)
    angle = hj.KinematicPhase(
        16, position="x", velocity="v", center=(0, 0), scale=(1, 1)
    )
    common_clock = sample(rhythm, angle, inputs="force")
    own_clocks = sample(own, angle, inputs="force")
    assert own_clocks.missing == 0
    assert own_clocks.cycles == common_clock.cycles
    together = hj.fit_series(common_clock, order=1).multipliers
    apart = hj.fit_series(own_clocks, order=1).multipliers
    np.testing.assert_allclose(apart, together, rtol=0, atol=1e-5)
    np.testing.assert_allclose(apart, MULTIPLIER, rtol=0, atol=1e-3)


@pytest.mark.slow
def test_responses_of_a_model_are_by_the_section_of_the_push():
    """One state: a push of area 1 at section m decays by A; sections last 0.2, ..., 0.8."""
    N = 4
    a = 0.8
    b = np.array([1.0, 2.0, 3.0, 4.0])
    c = np.array([5.0, 7.0, 11.0, 13.0])
    columns = (x[:, None, None] for x in (b, c))
    A = np.full((N, 1, 1), a)
    model = hj.linear.LDTP(A, *columns, inputs="f", outputs="x")
    zero = np.zeros((N, 7, 1, 1))
    phases = np.arange(N) / N
    grid = (phases, np.arange(7) / N)
    steps = np.array([0.2, 0.4, 0.6, 0.8])
    rotated = np.roll(steps, 1)
    times = np.cumsum(np.tile(rotated, 60))
    found = ImpulseResponses(zero, zero, *grid, 0.0, steps, ("f",), ("x",))
    m = np.arange(N)[:, None]
    r = np.arange(1, 7)
    answer = b[m] * a ** (r - 1) * c[(m + r) % N]
    expected = answer / steps[m]
    found_responses = found.of_model(model)[:, 1:, 0, 0]
    np.testing.assert_allclose(found_responses, expected, rtol=1e-13)
    # Their standard errors are the scatter of fits.
    apart = []
    rng = np.random.default_rng(0)
    about = dict(inputs=("f",), outputs=("x",))
    for _ in range(60):
        u = rng.normal(size=(240, 1))
        response = np.asarray(model.simulate(u))
        y = response + 20 * rng.normal(size=(240, 1))
        record = hj.experiments.SectionSeries(u, y, n_sections=N, **about)
        cycle = np.zeros((N, 1))
        data = SectionData((record,), (times,), (0,), cycle, cycle, 2.0, 2.0, (0, 0))
        found = impulse_responses(
            hj.fit_series(record, 1, check=False), data, 4, width=0.0
        )
        difference = found.values - found.of_model(model)
        apart.append(difference / found.errors)
    np.testing.assert_allclose(found.durations, steps)
    size = np.sqrt(
        np.mean(np.array(apart)[:, :, [[1, 2, 3, 4], [13, 14, 15, 16]]] ** 2, (0, 1, 3))
    )
    np.testing.assert_allclose(size, 1, atol=0.06)
