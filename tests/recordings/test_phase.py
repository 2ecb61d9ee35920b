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


def whole(phase, winding=0):
    w = phase.stretches[0][winding]
    return w.when(np.arange(np.ceil(w.phase[0]), np.floor(w.phase[-1]) + 1))


@settings(max_examples=15)
@given(st.integers(0, 1000), st.floats(0.0, 0.3), st.booleans())
def test_noise_gaps_and_irregular_samples(seed, noise, turned):
    rng = np.random.default_rng(seed)
    t = np.sort(rng.uniform(0, 12, 3000))
    sense = -1 if turned else 1
    x = 3 + 2 * np.cos(2 * np.pi * t) + 2 * noise * rng.normal(size=t.size)
    v = 5 * sense * np.sin(2 * np.pi * t) + 5 * noise * rng.normal(size=t.size)
    x[(t > 5.2) & (t < 7.1)] = np.nan
    phase = hj.recordings.estimate_phase(hj.Recording(t, {"x": x, "v": v}), CIRCLE)
    assert [len(s) for s in phase.stretches] == [2]
    for k in (0, 1):
        found = whole(phase, k)
        error = np.abs(found - np.round(found)).max()
        assert error < 0.02 + noise / 2
        assert (np.diff(phase.stretches[0][k].time) > 0).all()
        assert (np.diff(phase.stretches[0][k].phase) > 0).all()


def test_a_crossing_as_the_anchor(wave):
    """Section 0 lies at the angle at which the signal crosses the level, or at a given one."""
    late = hj.recordings.estimate_phase(
        wave, dataclasses.replace(CIRCLE, anchor=-np.pi / 2)
    )
    assert_allclose(whole(late) % 1, 0.25, atol=2e-4)
    for crossing, clock in [
        (hj.Crossing("v", "rising"), 0.5),
        (hj.Crossing("x", "falling"), 0.25),
        (hj.Crossing("x", "rising", value=0.5), 5 / 6),
    ]:
        definition = dataclasses.replace(CIRCLE, anchor=crossing)
        phase = hj.recordings.estimate_phase(wave, definition)
        assert_allclose(whole(phase)[1:-1] % 1, clock, atol=1e-3)
    thrice = hj.Crossing("w", "falling")
    t = wave.trials[0].time
    (_, x, v) = wave.trials[0].values.T
    recording = hj.Recording(t, {"x": x, "v": v, "w": np.cos(6 * np.pi * t)})
    with pytest.raises(hj.DefinitionError, match="w falling, .* all around the cycle"):
        hj.recordings.estimate_phase(
            recording, dataclasses.replace(CIRCLE, anchor=thrice)
        )


@settings(max_examples=15)
@given(st.integers(0, 1000), st.floats(0.0, 0.05))
def test_irregular_events(seed, jitter):
    """Jitter, missed and doubled events: the phase grows, is right at the events, or nearly so."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.3, 60) + jitter * rng.uniform(-1, 1, 60)
    missed = 10 + rng.permutation(20)[0]
    doubled = 40 + rng.permutation(10)[0]
    events = np.sort(np.append(np.delete(t, missed), t[doubled] + 0.1))
    recording = hj.Recording(
        np.arange(0, 61, 0.5), {"x": np.zeros(122)}, events={"e": events}
    )
    phase = hj.recordings.estimate_phase(recording, hj.AtEvent("e"))
    assert phase.dropped == 1
    assert phase.missed == 2
    assert len(phase.stretches[0]) == 2
    assert phase.period == pytest.approx(1, abs=2 * jitter + 1e-9)
    for w in phase.stretches[0]:
        assert (np.diff(w.phase) > 0).all()
        assert (np.diff(w.time) > 0).all()
        own = t[(t >= w.time[0]) & (t <= w.time[-1])]
        at = np.interp(own, w.time, w.phase)
        error = np.abs(at - at[0] - np.arange(len(own))).max()
        assert error <= 1e-9
    exact = hj.Recording(t, {"x": t}, events={"e": 0.3 + np.arange(15)})
    hj.plot.phase(hj.recordings.estimate_phase(exact, hj.AtEvent("e")))
    twice = hj.Recording(
        np.arange(62), {"x": np.zeros(62)}, events={"e": [*t, *(t + 0.02)]}
    )
    assert hj.recordings.estimate_phase(twice, hj.AtEvent("e")).dropped == 60


def test_what_is_no_phase(wave):
    t = wave.trials[0].time
    still = hj.Recording(t, {"x": np.cos(t) + 5, "v": np.sin(t) + 5, "c": 0 * t})
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
        with pytest.raises(hj.DefinitionError, match=message):
            hj.recordings.estimate_phase(still, definition)


@settings(max_examples=15)
@given(st.integers(0, 1000), st.integers(8, 60), st.floats(0.02, 0.3))
def test_splines_are_those_of_scipy(seed, n, bandwidth):
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.5, 1.5, n))
    y = rng.normal(size=n)
    x = np.linspace(t[0], t[-1], 200)
    step = np.median(np.diff(t))
    reference = make_smoothing_spline(
        t / step, y, lam=(2 * np.pi * bandwidth * step) ** -4
    )
    measured = spline(t, y, bandwidth)(x)
    assert_allclose(measured, reference(x / step), atol=1e-9)
    through = CubicSpline(t, y, bc_type="natural")
    assert_allclose(spline(t, y, np.inf)(x), through(x), atol=1e-9)
