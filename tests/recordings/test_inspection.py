"""Faults of recordings are named, and none where there is none; multipliers are right, or refused."""

import functools

import numpy as np
import pytest
from scipy import signal

import hybridjax as hj

from .mishaps import EVENT_MISHAPS, MISHAPS, mishandle


STRIDES, TRIALS, RATE = 60, 3, 64
NAMES = {"input": "f", "outputs": ("x", "v"), "event": "top"}
TOP = hj.Crossing("v", "falling", value=0.0)


@functools.cache
def made_up(seed, force=0.1, noise=1e-3):
    """A rhythm of period 1; a deviation w' = -0.3 w + f is seen in x, and in v at some phases."""
    rng = np.random.default_rng(seed)
    time = np.arange(STRIDES * RATE) / RATE
    trials = []
    for k in range(TRIALS):
        f = hj.testing.random_force(STRIDES, RATE, 6, rms=force, seed=100 * seed + k)[:, 0]
        w = signal.lfilter([0, 1 / RATE], [1, -np.exp(-0.3 / RATE)], f)
        angle = 2 * np.pi * time
        x = 2.0 + np.cos(angle) + w + noise * rng.normal(size=len(f))
        v = -6 * np.sin(angle) + 4 * w * np.cos(angle) + noise * rng.normal(size=len(f))
        one = hj.Recording(time, {"f": f, "x": x, "v": v}, name=f"trial {k}")
        trials.append(one)
    return hj.Recording.join(trials).mark("top", TOP, bandwidth=16)


def findings(recording, phase=TOP):
    """All of them, or the sentence of what is refused."""
    names = {"inputs": "f", "outputs": ("x", "v")}
    inspection = hj.recordings.inspect(recording, **names)
    if any(f.action == "refused" for f in inspection.findings):
        return inspection.findings
    clean = inspection.recording
    found = hj.recordings.estimate_phase(clean, phase)
    data = hj.recordings.section_data(clean, found, n_sections=16, **names)
    return hj.recordings.inspect(recording, **names, phase=found, data=data).findings


def causes(recording, phase=TOP):
    return {f.cause for f in findings(recording, phase)}


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("force", "noise"), [(0.1, 1e-3), (0.3, 0.0)])
def test_nothing_is_found_where_nothing_is_wrong(seed, force, noise):
    assert findings(made_up(seed, force, noise)) == ()


SAID = {
    "slow drift": "drift",
    "the zero wanders": "drift",
    "clipped at the top": "clipped",
    "clipped at both ends": "clipped",
    "push clipped": "clipped",
    "integers overflow": "overflow",
    "-9999 for no value": "no value",
    "0 for no value": "frozen",
    "output frozen for a while": "frozen",
    "output frozen": "an empty trial",
    "push frozen for a while": "frozen",
    "millimeters in one trial": "another unit",
    "kilonewtons in one trial": "another unit",
    "sign of an output in one trial": "another sign",
    "sign of the push in one trial": "another sign",
    "other zero in one trial": "another zero",
    "sensor slips in one trial": "drift",
    "columns swapped in one trial": "swapped columns",
    "an output twice": "a signal twice",
    "push of another trial": "foreign input",
    "push unrelated in all": "no answer",
    "push switched on late": "disturbed",
    "the same trial thrice": "a trial twice",
    "overlapping trials": "a trial twice",
    "a pause": "jump of the clock",
    "clock set forward": "jump of the clock",
    "milliseconds in one trial": "another unit of time",
    "slow clock in one trial": "another period",
    "push late in one trial": "foreign input",
    "another event in one trial": "another event",
}


@pytest.mark.parametrize("mishap", SAID)
def test_causes_are_named(mishap):
    phase = hj.AtEvent("top") if mishap in EVENT_MISHAPS else TOP
    assert SAID[mishap] in causes(mishandle(made_up(0), mishap, **NAMES), phase)


HARMLESS = sorted({
    "rounded to 12 bits", "slow sensors", "sensor saturates softly", "1 % of the samples lost",
    "gap of five cycles", "gap of the push", "a third of the samples not there", "few samples",
    "clock slows down", "push late", "push early", "events lost and doubled",
})  # fmt: skip


@pytest.mark.parametrize("mishap", HARMLESS)
def test_nothing_is_said_of_what_does_no_harm(mishap):
    phase = hj.AtEvent("top") if mishap in EVENT_MISHAPS else TOP
    assert not causes(mishandle(made_up(0), mishap, **NAMES), phase)


def test_all_mishaps_are_tried():
    """Here, or (where noise is all that happens) by `python benchmarks/recordings.py mishaps`."""
    noisy = {
        "white noise", "hum of the mains", "push leaks into outputs", "jitter of the time stamps",
        "other gain in one trial", "0.1 % spikes", "1 % spikes", "0.1 % spikes of the push",
        "gaps over the crossing", "events inexact", "clock of the push is fast",
    }  # fmt: skip
    refused = {"push not plugged in", "clock set back"}
    assert {*SAID, *HARMLESS, *noisy, *refused} == {*MISHAPS, *EVENT_MISHAPS}
    assert len(MISHAPS | EVENT_MISHAPS) >= 40


APEX = hj.Crossing("vM", "falling")


@pytest.fixture(scope="module")
def trials(hopper_cycle):
    """Four trials of 75 strides, with noise, in which each apex is an event."""
    force = [hj.testing.random_force(75, 128, 8, rms=0.02, seed=k) for k in range(4)]
    made = hj.testing.simulate_recording(
        hopper_cycle, np.stack(force), ("yM", "vM"), rate=128, steps=1
    )
    noisy = hj.testing.spoil(made, ("yM", "vM"), noise=1e-4)
    return noisy.mark("apex", APEX, bandwidth=16)


def identify(recording, phase=APEX):
    return hj.identify_recording(
        recording, phase, inputs="u", outputs=("yM", "vM"), n_sections=16, order=2
    )


@pytest.mark.slow
@pytest.mark.parametrize("mishap", [*MISHAPS, *EVENT_MISHAPS])
def test_none_is_silently_wrong(trials, hopper_cycle, mishap):
    names = {"input": "u", "outputs": ("yM", "vM"), "event": "apex"}
    phase = hj.AtEvent("apex") if mishap in EVENT_MISHAPS else APEX
    try:
        found = identify(mishandle(trials, mishap, **names), phase)
    except hj.DefinitionError:
        return
    assert found.findings or found.fit.contains(hopper_cycle.multipliers, 0.999).all()


@pytest.mark.slow
def test_what_is_found_is_printed_and_copies_count_once(trials):
    clean = identify(trials)
    assert clean.findings == ()
    names = {"input": "u", "outputs": ("yM", "vM"), "event": "apex"}
    thrice = identify(mishandle(trials, "the same trial thrice", **names))
    np.testing.assert_array_equal(thrice.fit.multipliers, clean.fit.multipliers)
    assert "A trial twice (left out): " in repr(thrice)
    assert thrice.advice.warnings[: len(thrice.findings)] == thrice.findings
