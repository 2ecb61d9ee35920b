"""Isolated spikes are found; steps, kinks, impacts and pulses are not."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj
from hybridjax.recordings.smoothing import input_spikes, spike_heights, without_spikes


T = np.arange(20000) / 500
WAVE = np.sin(2 * np.pi * T)


def noisy(x, noise=1e-3, seed=0):
    rng = np.random.default_rng(seed)
    return x + noise * rng.normal(size=len(x))


@pytest.mark.parametrize("noise", [0.0, 1e-1])
def test_all_spikes_are_found_and_little_else(noise):
    """Two per cent of all samples, so that many are neighbors."""
    rng = np.random.default_rng(1)
    clean = noisy(WAVE, noise)
    struck = rng.random(len(T)) < 0.02
    struck &= np.convolve(struck, [1, 1, 1, 1], "same") < 4  # three in a row at most
    spikes = rng.choice([-15, 15], len(T))
    x = clean + struck * spikes
    found = spike_heights(x)
    assert (found != 0)[struck].mean() > 0.999
    assert (found != 0)[~struck].mean() < 1e-3
    seen = struck & (found != 0)
    assert_allclose(np.abs(found[seen]), 15, atol=1)
    kept = without_spikes(x)
    assert_array_equal(np.isnan(kept), found != 0)
    is_clean = found == 0
    assert_array_equal(kept[is_clean], x[is_clean])


def pulse(width):
    """Of half a sine, once in a second; the first sample is not zero."""
    x = np.zeros(len(T))
    shape = np.sin(np.pi * (np.arange(width) + 0.5) / width)
    for first in range(100, len(T) - width, 500):
        x[first : first + width] += shape
    return x


SIGNS = np.where(np.arange(len(T)) % 2, 1, -1)
decay = np.exp(-40 * (T % 1))
RINGING = decay * SIGNS


@pytest.mark.parametrize(
    "x",
    [
        WAVE,
        np.abs(WAVE),
        T % 1,
        np.where(WAVE >= 0, 1.0, -1.0),
        np.round(WAVE, 2),
        np.round(noisy(WAVE, 2e-3), 2),
        WAVE + pulse(6),
        WAVE + np.ceil(pulse(4)),
        WAVE + RINGING,
        np.random.default_rng(0).normal(size=len(T)),
        np.zeros(len(T)),
        np.arange(5.0),
    ],
)
def test_what_is_no_spike(x):
    draws = np.random.default_rng(3).normal(size=len(x))
    noise = 1e-5 * draws
    for values in (x, x + noise):
        assert not spike_heights(values).any()


def test_pulses_are_the_input_and_spikes_are_not():
    """Single samples stand out of a smooth force only as errors."""
    single = np.zeros(len(T))
    places = np.random.default_rng(2).integers(0, len(T), 100)
    single[places] = 10.0
    found = input_spikes(noisy(WAVE) + single) != 0
    assert found[single > 0].all()
    assert not input_spikes(single).any()
    assert not input_spikes(noisy(single, 0.1)).any()
    inputs = hj.experiments.random_input(40, 500, 8)
    force = inputs[:, 0]
    assert not input_spikes(force).any()
    rng = np.random.default_rng(0)
    held = np.repeat(rng.normal(size=5000), 4)
    assert not input_spikes(held).any()


def test_impacts_are_part_of_the_motion(wave):
    """A transient of one sample in every cycle stays, those in between are left out."""
    t = wave.trials[0].time
    (f, x, v) = wave.trials[0].values.T
    impact = np.zeros(len(t))
    impact[30::100] = 3.0
    spikes = np.zeros(len(t))
    spikes[[417, 985, 1250]] = -4.0
    options = dict(inputs="f", outputs=("x", "v"), n_sections=8)
    phase = hj.KinematicPhase(8, position="x", velocity="v")

    def sampled(more):
        signals = {"f": f, "x": x + more, "v": v}
        recording = hj.Recording(t, signals)
        return hj.recordings.sample_sections(recording, phase, **options)

    assert sampled(impact).spikes == (0, 0, 0)
    both = sampled(impact + spikes)
    assert both.spikes == (0, 3, 0)
    assert "spikes left out: x 3)" in repr(both)
    assert_allclose(both.cycle_outputs, sampled(impact).cycle_outputs, atol=5e-3)
    without = sampled(0 * t)
    change = both.cycle_outputs[:, 0] - without.cycle_outputs[:, 0]
    assert np.ptp(change) > 0.05
