"""Phase response curves of rhythms of which only the events are known."""

import dataclasses

import numpy as np
import pytest

import hybridjax as hj
from hybridjax._core.signal import Signal
from hybridjax.orbits.responses import PhaseCurve
from hybridjax.recordings.beats.model import forecast, intervals_of, tabulated

from .mishaps import mishandle, misjudged


X = np.arange(200) / 200
CURVE = 1 - 0.5 * np.cos(2 * np.pi * X) + 0.2 * np.sin(2 * np.pi * X)
BEAT = hj.AtEvent("beat")


def beats(jitter, trials=4, seconds=4, seed=0, curve=CURVE):
    t = np.arange(0, seconds + 1e-9, 1e-3)
    force = np.stack(
        [6 * np.sin(2 * np.pi * f * t) for f in np.linspace(2, 17, trials)]
    )
    return hj.testing.simulate_beats(
        curve, force, rate=1000, rhythm=10.0, jitter=jitter, seed=seed
    )


@pytest.fixture(scope="module")
def noisy():
    return beats(0.05, trials=8)


@pytest.fixture(scope="module")
def found(noisy):
    """With one event in ten missed."""
    lost = mishandle(
        noisy, misjudged(lost=0.1), input="u", outputs=(), event="beat", seed=1
    )
    return hj.recordings.phase_response(lost, BEAT, input="u")


@pytest.mark.slow
def test_a_rhythm_without_noise_is_found_exactly():
    exact = hj.recordings.phase_response(beats(0.0, trials=3), BEAT, input="u")
    np.testing.assert_allclose(exact.values, CURVE, atol=0.02)
    np.testing.assert_allclose(exact.rates, 10, atol=5e-3)
    assert exact.left_out > 0.9999 and exact.result == 0 and exact.miscounted == 0
    # With an offset of the sensor, or under a constant current, the curve is the same.
    r = beats(0.0, trials=3)
    u = [
        dataclasses.replace(t, values=t.values + 100 * k)
        for k, t in enumerate(r.trials)
    ]
    shifted = hj.recordings.phase_response(r.with_trials(u), BEAT, input="u")
    np.testing.assert_allclose(shifted.values, exact.values, rtol=1e-6)


def test_the_band_holds_the_curve_and_forecasts_gain_from_it(found):
    low, high = found.interval(X, 0.99)
    assert np.mean((low <= CURVE) & (CURVE <= high)) > 0.9
    assert (
        3 < found.detail < 10
        and abs(found.jitter - 0.05) < 0.01
        and found.p_flat < 1e-3
    )
    assert rms(found.values - CURVE) < 0.12
    assert found.left_out_flat + 0.01 < found.left_out < 1
    assert "Resolution: the jitter" in repr(found)
    curve = PhaseCurve(X, CURVE, "u", time_unit="ms")
    drawn, band = (
        hj.plot.phase_response(curve, model=found).ax,
        found.interval(found.phase)[0],
    )
    np.testing.assert_allclose(drawn.lines[1].get_ydata(), found.values / 1000)
    heights = drawn.collections[0].get_paths()[0].vertices[:, 1]
    assert heights.min() == pytest.approx(band.min() / 1000)
    other = [PhaseCurve(X, CURVE, Signal("u", unit)) for unit in ("nA", "pA")]
    with pytest.raises(hj.errors.DefinitionError, match="different units: nA and pA"):
        hj.plot.phase_response(other[0], model=other[1])


def rms(values):
    return np.sqrt(np.mean(values**2))


def test_slopes_are_derivatives(noisy):
    intervals = intervals_of(noisy, hj.recordings.estimate_phase(noisy, BEAT), "u")
    table, a, rates = (
        tabulated(4, 0.05),
        np.array([1, -0.4, 0.2, 0.1, 0]),
        np.full(8, 10.0),
    )
    base = forecast(intervals, table, a, rates)
    for k in range(5):
        moved = forecast(intervals, table, a + 1e-5 * np.eye(5)[k], rates)
        difference = (moved.duration - base.duration) / 1e-5
        np.testing.assert_allclose(base.slopes[:, k], difference, atol=0.02 * 0.1)
    difference = (
        forecast(intervals, table, a, rates + 1e-5).duration - base.duration
    ) / 1e-5
    np.testing.assert_allclose(base.slopes[:, -1], difference, atol=5e-4)


def test_intervals_of_all_lengths_are_no_missed_events():
    """A slow current makes some intervals three times as long as others."""
    slow = 5 * np.sin(np.pi * np.arange(0, 20.0005, 1e-3))[None]
    slow = hj.testing.simulate_beats([1.0], slow, rate=1000, rhythm=10.0, jitter=0.03)
    (periods,) = hj.recordings.estimate_phase(slow, BEAT).periods
    assert periods.max() > 1.8 * np.median(periods)
    assert len(periods) == len(slow.trials[0].events["beat"]) - 1


@pytest.mark.slow
def test_events_alone_are_identified(noisy, tmp_path):
    found = hj.identify_recording(
        noisy, BEAT, inputs="u", outputs=(), order=1, n_sections=1
    )
    assert (
        found.fit.outputs == ("duration",) and np.isfinite(found.fit.numerators).all()
    )
    assert (found.write_report(tmp_path).parent / "figures" / "curve.png").exists()
    assert any("Resolution: the jitter" in repr(x) for x in found.diagnosis.findings)


def test_what_is_refused(noisy):
    t = np.arange(0.0, 10, 0.01)
    wave, beat = (
        {"u": np.sin(t), "a": np.cos(6 * t), "b": np.sin(6 * t)},
        {"beat": np.arange(9.0)},
    )
    angle = hj.KinematicPhase(4, position="a", velocity="b")
    for message, signals, phase in [
        ("no event 'spike'", wave, hj.AtEvent("spike")),
        ("u is constant", {"u": 0 * t}, BEAT),
        ("has no samples of u", {"u": np.nan * t}, BEAT),
        ("8 intervals are too few", wave, BEAT),
        ("must be of events or a Crossing", wave, angle),
    ]:
        recording = hj.Recording(t, signals, events=beat)
        phase = (
            phase
            if phase is not angle
            else hj.recordings.estimate_phase(recording, angle)
        )
        with pytest.raises(hj.errors.DefinitionError, match=message):
            hj.recordings.phase_response(recording, phase, input="u")
