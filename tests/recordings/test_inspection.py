"""Faults of recordings are named, and nothing is found where there is none."""

import functools
import warnings
from collections import Counter

import equinox as eqx
import numpy as np
import pytest
from scipy import signal

import hybridjax as hj
from hybridjax.apps.identify import _page
from hybridjax.recordings.inspection.differences import slow_changes

from .mishaps import EVENT_MISHAPS, MISHAPS, mishandle, scaled, signals


STRIDES = 60
TRIALS = 3
RATE = 64
NAMES = {"input": "f", "outputs": ("x", "v"), "event": "top"}
TOP = hj.Crossing("v", "falling", value=0.0)


@functools.cache
def made_up(seed, force=0.1, noise=1e-3):
    """A rhythm of period 1; a deviation w' = -0.3 w + f is seen in x, and in v at some phases."""
    rng = np.random.default_rng(seed)
    time = np.arange(STRIDES * RATE) / RATE
    trials = []
    for k in range(TRIALS):
        f = hj.experiments.random_input(
            STRIDES, RATE, 6, rms=force, seed=100 * seed + k
        )[:, 0]
        decay = np.exp(-0.3 / RATE)
        w = signal.lfilter([0, 1 / RATE], [1, -decay], f)
        angle = 2 * np.pi * time
        noise_x = noise * rng.normal(size=len(f))
        x = 2.0 + np.cos(angle) + w + noise_x
        forced = 4 * w * np.cos(angle)
        swing = -6 * np.sin(angle) + forced
        v = swing + noise * rng.normal(size=len(f))
        signals = {"f": f, "x": x, "v": v}
        trials.append(hj.Recording(time, signals, name=f"trial {k}"))
    return hj.Recording.join(trials).mark("top", TOP, bandwidth=16)


def findings(recording, phase=TOP):
    """All of them, or the sentence of what is refused."""
    names = {"inputs": "f", "outputs": ("x", "v")}
    inspection = hj.recordings.check_recording(recording, **names)
    if any(f.action == "refused" for f in inspection.findings):
        return inspection.findings
    clean = inspection.recording
    found = hj.recordings.estimate_phase(clean, phase)
    data = hj.recordings.sample_sections(clean, found, n_sections=16, **names)
    return hj.recordings.check_recording(
        recording, **names, phase=found, data=data
    ).findings


def causes(recording, phase=TOP):
    return {f.cause for f in findings(recording, phase)}


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("force", "noise"), [(0.1, 1e-3), (0.3, 0.0)])
def test_nothing_is_found_where_nothing_is_wrong(seed, force, noise):
    assert findings(made_up(seed, force, noise)) == ()


def test_findings_are_warnings_on_which_a_pipeline_can_stop():
    names = {"inputs": "f", "outputs": ("x", "v")}
    bad = mishandle(made_up(0), "clipped at the top", **NAMES)
    with pytest.warns(hj.errors.FindingWarning, match="^Clipp"):
        hj.recordings.check_recording(bad, **names)
    with (
        pytest.raises(hj.errors.FindingWarning),
        warnings.catch_warnings(action="error"),
    ):
        hj.recordings.check_recording(bad, **names)


CAUSES = {
    "drift": ["slow drift", "the zero wanders", "sensor slips in one trial"],
    "clipped": ["clipped at the top", "clipped at both ends", "push clipped"],
    "overflow": ["integers overflow", "16 bits overflow"],
    "a silent input": ["push lost in two trials"],
    "missed events": [
        "a gap over each seventh crossing",
        "a third of the samples not there",
    ],
    "odd cycles": ["packets lost and renumbered"],
    "inexact events": ["events jitter"],
    "no value": ["-9999 for no value"],
    "frozen": [
        "0 for no value",
        "output frozen for a while",
        "push frozen for a while",
    ],
    "an empty trial": ["output frozen"],
    "another unit": [
        "millimeters in one trial",
        "kilonewtons in one trial",
        scaled("y0", 57.3),
    ],
    "another sign": ["sign of an output in one trial", "sign of the push in one trial"],
    "another zero": ["other zero in one trial"],
    "swapped columns": ["columns swapped in one trial"],
    "a signal twice": ["an output twice"],
    "feedback": ["push feels an output"],
    "foreign input": ["push of another trial", "push late in one trial"],
    "no answer": ["push unrelated in all"],
    "disturbed": ["push switched on late"],
    "a trial twice": ["the same trial thrice", "overlapping trials"],
    "jump of the clock": ["a pause", "clock set forward"],
    "another unit of time": ["milliseconds in one trial"],
    "another period": ["slow clock in one trial"],
    "another event": ["another event in one trial"],
    "": [
        "rounded to 12 bits",
        "slow sensors",
        "sensor saturates softly",
        "1 % of the samples lost",
        "gap of five cycles",
        "gap of the push",
        "few samples",
        "clock slows down",
        "push late",
        "push early",
        "events lost and doubled",
    ],
}


@pytest.mark.parametrize(
    ("cause", "mishap"), [(c, x) for c in CAUSES for x in CAUSES[c]]
)
@pytest.mark.slow
def test_causes_are_named(cause, mishap):
    phase = hj.AtEvent("top") if mishap in EVENT_MISHAPS else TOP
    named = causes(mishandle(made_up(0), mishap, **NAMES), phase)
    assert cause in named if cause else not named


def test_drift_that_is_left_asks_for_a_smaller_number():
    recording = mishandle(made_up(0), "slow drift", **NAMES)
    phase = hj.recordings.estimate_phase(recording, TOP)
    for removed, advised in (np.inf, 50), (50.0, 25):
        finding, *_ = slow_changes(recording, phase, ("x", "v"), removed)
        assert f"`drift={advised}` takes it out" in finding.text


@pytest.mark.slow
def test_an_order_that_is_too_low_is_named():
    """Sensors with a high-pass filter add a mode to that of the system."""
    edge = signal.butter(1, 0.1, "high", fs=RATE)
    filtered = signals("y", lambda x, s: signal.lfilter(*edge, x - x.mean()))
    names = {"inputs": "f", "outputs": ("x", "v"), "n_sections": 8, "order": 1}
    for recording, named in (
        (made_up(0), 0),
        (mishandle(made_up(0), filtered, **NAMES), 1),
    ):
        result = hj.identify_recording(recording, TOP, **names)
        assert (
            len([x for x in result.diagnosis.findings if "Compare order=2" in x.text])
            == named
        )
    names |= {"order": None, "n_sections": 32}
    with pytest.warns(hj.errors.FindingWarning) as seen:
        twice = hj.Recording.join(
            [made_up(0), made_up(0).with_trials(made_up(0).trials[:1])]
        )
        untried = hj.identify_recording(twice, TOP, **names)
    told = Counter(str(x.message) for x in seen)
    assert set(told.values()) == {1}
    assert set(told) >= {repr(x) for x in untried.findings}
    assert max(map(len, "\n".join(map(str, untried.findings)).split("\n"))) <= 100
    replaced = signals("y0", lambda x, s: 0 * x + 1)
    constant = mishandle(twice, replaced, **NAMES)
    with pytest.raises(
        hj.errors.DefinitionError,
        match="no trial has samples of all .*x does not change",
    ):
        hj.identify_recording(constant, TOP, **names)
    with pytest.raises(
        hj.errors.DefinitionError, match="'f' is in `inputs` and in `outputs`"
    ):
        hj.identify_recording(twice, TOP, inputs="f", outputs=("f", "x"))
    text = "129 cycles (a quarter is held out) are too few for order 2 with 32 sections: record 28"
    assert (
        f"since {text} more, or take 21 sections." in untried.diagnosis.findings[1].text
    )
    with pytest.warns(
        hj.errors.FindingWarning, match="orders above 1 could not be tried"
    ):
        hj.select_order(untried.data)


@pytest.mark.slow
def test_residuals_that_depend_on_the_input_are_named_if_they_are_large(hopper_cycle):
    """A hundredth, which distortion of small pushes may be, is no reason to doubt; a third is."""
    force = hj.experiments.random_input(100, 100, 8, rms=0.02, seed=0)
    made = hj.testing.simulate_recording(
        hopper_cycle, force[None], ("yM", "vM"), rate=100
    )
    names = {"inputs": "u", "outputs": ("yM", "vM"), "n_sections": 16, "order": 2}
    result = hj.identify_recording(made, APEX, **names)
    validation = result.held_out.validation
    assert validation.independent
    assert validation.fit.min() > 99
    for fit, named in (99.3, False), (70.0, True):
        tests = np.full(2, fit), np.zeros(2), np.full(2, float(named))
        worse = eqx.tree_at(
            lambda x: (x.fit, x.independence, x.no_better), validation, tests
        )
        causes = [
            x.cause
            for x in hj.recordings.diagnose(result.data, result.fit, worse).findings
        ]
        assert ("left over" in causes) == ("no fit" in causes) == named
    # So many strides as give no finite standard error are left out of the report.
    few = eqx.tree_at(
        lambda x: x.diagnosis.expected, result, result.diagnosis.expected.copy()
    )
    few.diagnosis.expected[0] = np.inf
    assert "<td>300</td>" in _page(few, {})
    assert "<td>inf" not in _page(few, {})


APEX = hj.Crossing("vM", "falling")


@pytest.mark.slow
@pytest.mark.parametrize("mishap", [*MISHAPS, *EVENT_MISHAPS])
def test_none_is_silently_wrong(hopper_cycle, mishap):
    """Four trials of 75 strides, with noise, in which each apex is an event."""
    force = [
        hj.experiments.random_input(75, 128, 8, rms=0.02, seed=k) for k in range(4)
    ]
    outputs = ("yM", "vM")
    made = hj.testing.simulate_recording(
        hopper_cycle, np.stack(force), outputs, rate=128, steps=1
    )
    trials = hj.testing.add_artifacts(made, outputs, noise=1e-4).mark(
        "apex", APEX, bandwidth=16
    )
    phase = hj.AtEvent("apex") if mishap in EVENT_MISHAPS else APEX
    try:
        dirty = mishandle(trials, mishap, input="u", outputs=outputs, event="apex")
        names = {"inputs": "u", "outputs": outputs, "n_sections": 16}
        found = hj.identify_recording(dirty, phase, order=2, **names)
    except hj.errors.DefinitionError:
        return
    assert found.findings or found.fit.contains(hopper_cycle.multipliers, 0.999).all()


def test_coarse_stamps_are_named_and_lost_samples_are_not():
    """Samples 1/64 s apart have stamps of 60 Hz frames; then a third of the samples is missing."""
    (trial, *_) = made_up(0).trials
    values = {"f": trial.values[:, 0], "x": trial.values[:, 1], "v": trial.values[:, 2]}

    def named(time, kept):
        signals = {k: x[kept] for k, x in values.items()}
        recording = hj.Recording(time[kept], signals)
        found = hj.recordings.check_recording(
            recording, inputs="f", outputs=("x", "v")
        ).findings
        return {finding.cause for finding in found}

    every = np.ones(len(trial.time), bool)
    coarse = np.round(trial.time / 0.007) * 0.007
    assert named(coarse, every) == {"coarse time stamps"}
    rng = np.random.default_rng(0)
    drawn = rng.random(len(trial.time))
    lost = drawn < 1 / 3
    assert named(trial.time, every) == set()
    assert "coarse time stamps" not in named(trial.time, ~lost)


@pytest.mark.parametrize("late", [0.0, 0.05])
def test_strikes_of_both_sides_are_named(late):
    """Cycles that begin at each step would give a multiplier of -1."""
    recording = made_up(0)
    trials = []
    for trial in recording.trials:
        at = trial.events["top"]
        pairs = at[1:] + at[:-1]
        middles = pairs / 2
        other = middles + late
        steps = np.sort(np.concatenate([at, other]))
        events = {"step": steps, "top": at}
        trials.append(eqx.tree_at(lambda t: t.events, trial, events))
    recording = recording.with_trials(trials)
    assert "alternating cycles" in causes(recording, hj.AtEvent("step"))
    assert causes(recording, hj.AtEvent("top")) == set()


def test_a_trial_that_runs_backwards_is_named():
    """Its average cycle is that of the others in reverse: here a wave that rises fast and falls
    slowly, which no change of sign explains."""
    trials = []
    for k, trial in enumerate(made_up(0).trials):
        angle = 2 * np.pi * trial.time
        f, x, v = trial.values.T
        second = 0.9 * np.sin(2 * angle)
        third = 0.6 * np.sin(3 * angle)
        x = x + second + third
        backwards = slice(None, None, -1)
        order = backwards if k == 1 else slice(None)
        signals = {"f": f[order], "x": x[order], "v": v[order]}
        trials.append(hj.Recording(trial.time, signals, name=f"trial {k}"))
    (found,) = [
        finding
        for finding in findings(hj.Recording.join(trials))
        if finding.action == "refused"
    ]
    assert found.cause == "backwards"
    assert "'trial 1'" in found.text


@pytest.mark.parametrize("width", [0.001, 0.003, 0.01])
def test_a_short_trigger_defines_the_phase(width):
    time = np.arange(0, 40, 0.001)
    rng = np.random.default_rng(0)
    strikes = np.cumsum(rng.uniform(0.9, 1.1, size=37)) + 0.5
    last = np.searchsorted(strikes, time) - 1
    since = time - strikes[last]
    pulse = 5.0 * ((since >= 0) & (since < width))
    recording = hj.Recording(time, {"trigger": pulse, "x": np.sin(time)})
    crossing = hj.Crossing("trigger", "rising", 2.5)
    (found,) = hj.recordings.estimate_phase(recording, crossing).periods
    np.testing.assert_allclose(found, np.diff(strikes), atol=0.0015)
    with pytest.raises(
        hj.errors.DefinitionError, match="not its smoothing spline of 8 Hz"
    ):
        hj.recordings.estimate_phase(recording, crossing, bandwidth=8.0)


def test_the_advice_for_a_clock_that_wraps_undoes_it():
    time = np.arange(0, 50, 0.01)
    wrapped = np.mod(time + 7.0, 32.768)
    with pytest.raises(hj.errors.DefinitionError, match="numpy.unwrap") as error:
        hj.Recording(wrapped, {"x": time})
    after = str(error.value).split("period=")[1]
    period = float(after.split(")")[0])
    unwrapped = np.unwrap(wrapped, period=period)
    undone = hj.Recording(unwrapped, {"x": time})
    np.testing.assert_allclose(undone.time, time + 7.0, atol=1e-6)
