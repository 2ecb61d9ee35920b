"""Phase from angles and events, and splines, against closed forms."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose
from scipy.interpolate import CubicSpline, make_smoothing_spline

import hybridjax as hj
from hybridjax.recordings.smoothing import spline


CIRCLE = hj.KinematicPhase(8, position="x", velocity="v")


def times_of_section_0(phase, winding=0):
    """The times at which a winding has a whole phase."""
    found = phase.stretches[0][winding]
    first = np.ceil(found.phase[0])
    last = np.floor(found.phase[-1])
    return found.when(np.arange(first, last + 1))


@settings(max_examples=15)
@given(st.integers(0, 1000), st.floats(0.0, 0.3), st.booleans())
def test_noise_gaps_and_irregular_samples(seed, noise, turned):
    rng = np.random.default_rng(seed)
    t = np.sort(rng.uniform(0, 12, 3000))
    sense = -1 if turned else 1
    x_noise = noise * rng.normal(size=t.size)
    v_noise = noise * rng.normal(size=t.size)
    cosine = np.cos(2 * np.pi * t)
    x = 3 + 2 * (cosine + x_noise)
    sine = np.sin(2 * np.pi * t)
    v = 5 * (sense * sine + v_noise)
    gap = (t > 5.2) & (t < 7.1)
    x[gap] = np.nan
    recording = hj.Recording(t, {"x": x, "v": v})
    phase = hj.recordings.estimate_phase(recording, CIRCLE)
    (windings,) = phase.stretches
    before, after = windings
    for k, winding in enumerate((before, after)):
        times = times_of_section_0(phase, k)
        fractions = times - np.round(times)
        error = np.abs(fractions).max()
        assert error < 0.02 + noise / 2
        assert (np.diff(winding.time) > 0).all()
        assert (np.diff(winding.phase) > 0).all()


def test_an_angle_as_the_anchor(wave):
    family = dataclasses.replace(CIRCLE, anchor=-np.pi / 2)
    phase = hj.recordings.estimate_phase(wave, family)
    assert_allclose(times_of_section_0(phase) % 1, 0.25, atol=2e-4)


@pytest.mark.parametrize(
    "crossing, time",
    [
        (hj.Crossing("v", "rising"), 0.5),
        (hj.Crossing("x", "falling"), 0.25),
        (hj.Crossing("x", "rising", value=0.5), 5 / 6),
    ],
)
def test_a_crossing_as_the_anchor(crossing, time, wave):
    """Section 0 lies at the angle at which the signal crosses the level."""
    family = dataclasses.replace(CIRCLE, anchor=crossing)
    phase = hj.recordings.estimate_phase(wave, family)
    times = times_of_section_0(phase)[1:-1]
    assert_allclose(times % 1, time, atol=1e-3)


def test_a_signal_that_crosses_at_several_angles_is_no_anchor(wave):
    (trial,) = wave.trials
    _, x, v = trial.values.T
    thrice = np.cos(6 * np.pi * trial.time)
    signals = {"x": x, "v": v, "w": thrice}
    recording = hj.Recording(trial.time, signals)
    family = dataclasses.replace(CIRCLE, anchor=hj.Crossing("w", "falling"))
    with pytest.raises(
        hj.errors.DefinitionError, match="w falling, .* all around the cycle"
    ):
        hj.recordings.estimate_phase(recording, family)


def recording_of(events):
    """A recording of a minute with these events."""
    t = np.arange(0, 61, 0.5)
    none = np.zeros(len(t))
    return hj.Recording(t, {"x": none}, events={"e": events})


@settings(max_examples=15)
@given(st.integers(0, 1000), st.floats(0.0, 0.05))
def test_irregular_events(seed, jitter):
    """Jitter, missed and doubled events: the phase grows, is right at the events, or nearly so."""
    rng = np.random.default_rng(seed)
    late = jitter * rng.uniform(-1, 1, 60)
    t = np.arange(0.3, 60) + late
    missed = 10 + rng.permutation(20)[0]
    doubled = 40 + rng.permutation(10)[0]
    seen = np.delete(t, missed)
    twice = t[doubled] + 0.1
    events = np.sort(np.append(seen, twice))
    recording = recording_of(events)
    phase = hj.recordings.estimate_phase(recording, hj.AtEvent("e"))
    assert phase.dropped == 1
    assert phase.missed == 2
    allowed = 2 * jitter + 1e-9
    assert phase.period == pytest.approx(1, abs=allowed)
    (windings,) = phase.stretches
    assert len(windings) == 2
    for winding in windings:
        assert (np.diff(winding.phase) > 0).all()
        assert (np.diff(winding.time) > 0).all()
        begun = t >= winding.time[0]
        not_ended = t <= winding.time[-1]
        inside = t[begun & not_ended]
        at_events = np.interp(inside, winding.time, winding.phase)
        counted = at_events[0] + np.arange(len(inside))
        assert_allclose(at_events, counted, rtol=0, atol=1e-9)


def test_what_is_no_phase(wave):
    t = wave.trials[0].time
    x = np.cos(t) + 5
    v = np.sin(t) + 5
    signals = {"x": x, "v": v, "c": 0 * t}
    still = hj.Recording(t, signals)
    for definition, message in [
        (
            dataclasses.replace(CIRCLE, center=(0, 0), scale=(1, 1)),
            "the phase does not wind",
        ),
        (dataclasses.replace(CIRCLE, velocity="c"), "c is constant: define"),
        (hj.AtEvent("strike"), "there is no event 'strike'; events are none"),
        (
            hj.Crossing("x", "falling", value=3.0),
            "x is never seen to cross 3, falling.*between",
        ),
        (
            hj.Crossing(lambda t, q: q[0], "falling"),
            "must name a signal, and no charts",
        ),
    ]:
        with pytest.raises(hj.errors.DefinitionError, match=message):
            hj.recordings.estimate_phase(still, definition)


def test_events_without_jitter():
    t = 0.3 + np.arange(60)
    events = 0.3 + np.arange(15)
    recording = hj.Recording(t, {"x": t}, events={"e": events})
    hj.recordings.estimate_phase(recording, hj.AtEvent("e")).plot()


def test_events_that_all_come_twice():
    t = np.arange(0.3, 60)
    twice = recording_of([*t, *(t + 0.02)])
    phase = hj.recordings.estimate_phase(twice, hj.AtEvent("e"))
    assert phase.dropped == 60


@settings(max_examples=15)
@given(st.integers(0, 1000), st.integers(8, 60), st.floats(0.02, 0.3))
def test_splines_are_those_of_scipy(seed, n, bandwidth):
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.5, 1.5, n))
    y = rng.normal(size=n)
    x = np.linspace(t[0], t[-1], 200)
    step = np.median(np.diff(t))
    cutoff = 2 * np.pi * bandwidth * step
    penalty = cutoff**-4
    smooth = make_smoothing_spline(t / step, y, lam=penalty)
    found = spline(t, y, bandwidth)(x)
    assert_allclose(found, smooth(x / step), atol=1e-9)
    through = CubicSpline(t, y, bc_type="natural")
    found_through = spline(t, y, np.inf)(x)
    assert_allclose(found_through, through(x), atol=1e-9)
