"""Whatever happens in the laboratory: the multipliers are right, refused, or the cause is named."""

import numpy as np
import pytest

import hybridjax as hj

from .mishaps import EVENT_MISHAPS, MISHAPS, mishandle


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
