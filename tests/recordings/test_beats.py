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
    assert exact.left_out > 0.9999
    assert exact.result == 0
    assert exact.miscounted == 0
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
    is_inside = (low <= CURVE) & (CURVE <= high)
    assert np.mean(is_inside) > 0.9
    assert 3 < found.detail < 10
    assert abs(found.jitter - 0.05) < 0.01
    assert found.p_flat < 1e-3
    assert rms(found.values - CURVE) < 0.12
    assert found.left_out_flat + 0.01 < found.left_out < 1
    assert "Resolution: the jitter" in repr(found)
    curve = PhaseCurve(X, CURVE, "u", time_unit="ms")
    drawn = hj.plot.phase_response(curve, model=found).ax
    band = found.interval(found.phase)[0]
    line = drawn.lines[1].get_ydata()
    np.testing.assert_allclose(line, found.values / 1000)
    path = drawn.collections[0].get_paths()[0]
    heights = path.vertices[:, 1]
    lowest = band.min() / 1000
    assert heights.min() == pytest.approx(lowest)
    other = [PhaseCurve(X, CURVE, Signal("u", unit)) for unit in ("nA", "pA")]
    with pytest.raises(hj.errors.DefinitionError, match="different units: nA and pA"):
        hj.plot.phase_response(other[0], model=other[1])


def test_forecasts_average_a_curve_over_the_jitter(found, noisy):
    """Of trials that were left out: with the curve, with its mean, and with no jitter."""
    others = beats(0.05, trials=8, seed=7)
    ahead = found.forecast(others, BEAT)
    assert ahead.result == 0
    assert ahead.counted.all()
    assert found.left_out_flat + 0.01 < ahead.explained < 1
    missed = (ahead.measured - ahead.duration) * 10
    assert missed.std() == pytest.approx(0.05, rel=0.2)
    np.testing.assert_allclose(ahead.rates, 10, rtol=0.03)
    # The averaged curve varies less, most at the end of the cycle.
    smoothed = found.with_jitter(X)
    assert np.ptp(smoothed) < np.ptp(found(X))
    smoothed_there = found.with_jitter([0.0])
    np.testing.assert_allclose(smoothed_there, found([0.0]))
    assert "free of jitter" in repr(found)


@pytest.mark.slow
def test_a_rate_that_wanders_is_no_memory():
    """The rate makes a random walk, 2 % from a cycle to the next, under a slow input."""
    rng = np.random.default_rng(0)
    noise = slow_noise(rng, trials=1, samples=2501, highest=0.5 * 10 / 100)
    force = 2 * noise[0]
    draws = rng.normal(size=2501)
    steps = 0.2 * np.sqrt(0.1) * draws
    walk = np.cumsum(steps)
    phase = 0.0
    events = []
    for k in range(2500):
        response = CURVE[int(200 * phase)]
        own = max(10 + walk[k], 2.0)
        rate = own + response * force[k]
        jitter = 0.05 * np.sqrt(0.1) * rng.normal()
        step = max(rate, 0.0) * 0.01 + jitter
        phase = max(phase + step, 0.0)
        if phase >= 1:
            phase -= 1
            part = phase / step
            events.append((k + 1 - part) * 0.01)
    wandering = hj.Recording(
        np.arange(2501) * 0.01, {"u": force}, events={"beat": np.array(events)}
    )
    found = hj.recordings.phase_response(wandering, BEAT, input="u")
    assert found.wander > 0.01
    assert "memory" not in [x.cause for x in found.findings]
    error = np.sqrt(found.covariance[0, 0])
    bias = abs(found.coefficients[0] - CURVE.mean())
    assert bias < 3 * error


def rms(values):
    return np.sqrt(np.mean(values**2))


def test_slopes_are_derivatives(noisy):
    intervals = intervals_of(noisy, hj.recordings.estimate_phase(noisy, BEAT), "u")
    table = tabulated(4, 0.05)
    a = np.array([1, -0.4, 0.2, 0.1, 0])
    rates = np.full(8, 10.0)
    base = forecast(intervals, table, a, rates)
    for k in range(5):
        ahead = a + 1e-5 * np.eye(5)[k]
        moved = forecast(intervals, table, ahead, rates)
        difference = (moved.duration - base.duration) / 1e-5
        slope = base.slopes[:, k]
        np.testing.assert_allclose(slope, difference, atol=0.02 * 0.1)
    difference = (
        forecast(intervals, table, a, rates + 1e-5).duration - base.duration
    ) / 1e-5
    slope = base.slopes[:, -1]
    np.testing.assert_allclose(slope, difference, atol=5e-4)


def test_intervals_of_all_lengths_are_no_missed_events():
    """A slow current makes some intervals three times as long as others."""
    times = np.arange(0, 20.0005, 1e-3)
    wave = np.sin(np.pi * times)
    slow = 5 * wave[None]
    slow = hj.testing.simulate_beats([1.0], slow, rate=1000, rhythm=10.0, jitter=0.03)
    (periods,) = hj.recordings.estimate_phase(slow, BEAT).periods
    assert periods.max() > 1.8 * np.median(periods)
    beats = slow.trials[0].events["beat"]
    assert len(periods) == len(beats) - 1


@pytest.mark.slow
def test_events_alone_are_identified(noisy, tmp_path):
    found = hj.identify_recording(
        noisy, BEAT, inputs="u", outputs=(), order=1, n_sections=1
    )
    assert found.fit.outputs == ("duration",)
    assert np.isfinite(found.fit.numerators).all()
    assert (found.write_report(tmp_path).parent / "figures" / "curve.png").exists()
    assert any("Resolution: the jitter" in repr(x) for x in found.diagnosis.findings)


def slow_noise(rng, trials, samples, highest):
    """Noise of variance 1 up to `highest` cycles per sample."""
    spectrum = np.fft.rfft(rng.normal(size=(trials, samples)))
    frequencies = np.fft.rfftfreq(samples)
    spectrum[:, frequencies > highest] = 0
    noise = np.fft.irfft(spectrum, samples)
    return noise / noise.std()


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.slow
def test_of_a_slow_input_the_band_is_wide_and_holds_the_curve(seed):
    """An input far slower than the rhythm says little of the shape, and does not exclude one."""
    rng = np.random.default_rng(seed)
    force = slow_noise(rng, trials=4, samples=1201, highest=0.2 * 10 / 100)
    slow = hj.testing.simulate_beats(
        CURVE, 2 * force, rate=100, rhythm=10.0, jitter=0.05, seed=seed
    )
    found = hj.recordings.phase_response(slow, BEAT, input="u")
    low, high = found.interval(X)
    assert np.isfinite(found.errors).all()
    is_inside = (low <= CURVE) & (CURVE <= high)
    assert np.mean(is_inside) > 0.9
    assert "slow input" in [x.cause for x in found.findings]


def spikes_of_izhikevich(current, noise, adapts, step=0.05):
    """Spikes, in ms, of v' = 0.04 v^2 + 5 v + 140 - w + I, w' = a (0.2 v - w), with a = 0.1 and
    w + 2 after a spike, or with a constant w = -10: one state, and no memory."""
    a, jump = (0.1, 2.0) if adapts else (0.0, 0.0)
    trials = len(current)
    v = np.full(trials, -65.0)
    w = np.full(trials, -6.6 if adapts else -10.0)
    spikes = [[] for _ in range(trials)]
    for i in range(current.shape[1]):
        before = v
        voltage = 0.04 * v**2 + 5 * v + 140
        rate_v = voltage - w + current[:, i]
        rate_w = a * (0.2 * v - w)
        middle_v = v + step / 2 * rate_v
        middle_w = w + step / 2 * rate_w
        middle_voltage = 0.04 * middle_v**2 + 5 * middle_v + 140
        rate_v = middle_voltage - middle_w + current[:, i]
        drift = step * rate_v
        v = v + drift + noise[:, i]
        w = w + step * a * (0.2 * middle_v - middle_w)
        fires = v >= 30
        for k in np.flatnonzero(fires):
            part = (30 - before[k]) / (v[k] - before[k])
            spikes[k].append((i + part) * step)
        v = np.where(fires, -65.0, v)
        w = np.where(fires, w + jump, w)
    return [np.array(x) for x in spikes]


@pytest.mark.parametrize("adapts", [True, False])
@pytest.mark.slow
def test_a_push_that_changes_the_next_interval_is_named(adapts):
    """The mean of a curve is the change of the rate by a constant current, unless the neuron
    adapts: then the intervals after a push take a part of its effect back."""
    rng = np.random.default_rng(1)
    n = 20_000
    still = np.zeros((2, n))
    currents = np.array([[9.0], [11.0]])
    steady = spikes_of_izhikevich(currents + still, still, adapts)
    rates = [1e3 / np.diff(x)[20:].mean() for x in steady]
    slower, faster = rates
    truth = (faster - slower) / 2
    period = 2e-3 / (slower + faster) * 1e3
    push = 0.4 * slow_noise(rng, trials=4, samples=n + 1, highest=0.05e-3 / period)
    size = 0.5 * np.sqrt(0.05)
    kicks = size * rng.normal(size=(4, n))
    ends = push[:, 1:] + push[:, :-1]
    middle = ends / 2
    spikes = spikes_of_izhikevich(10 + middle, kicks, adapts)
    time = np.arange(n + 1) * 0.05e-3
    trials = [
        hj.Recording(time, {"u": u}, events={"beat": 1e-3 * x}, name=f"trial {k}")
        for k, (u, x) in enumerate(zip(push, spikes, strict=True))
    ]
    joined = hj.Recording.join(trials)
    found = hj.recordings.phase_response(joined, BEAT, input="u")
    error = np.sqrt(found.covariance[0, 0])
    off = (found.coefficients[0] - truth) / error
    causes = [x.cause for x in found.findings]
    if adapts:
        assert off > 5
        assert found.carried < -0.3
        assert "memory" in causes
    else:
        assert abs(off) < 3
        assert "memory" not in causes


def test_what_is_refused(noisy):
    t = np.arange(0.0, 10, 0.01)
    sine = np.sin(6 * t)
    cosine = np.cos(6 * t)
    wave = {"u": np.sin(t), "a": cosine, "b": sine}
    beat = {"beat": np.arange(9.0)}
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
