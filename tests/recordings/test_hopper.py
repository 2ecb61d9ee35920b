"""From a recording to multipliers, where the truth is known."""

import dataclasses

import numpy as np
import pytest

import hybridjax as hj


ABOUT = {"inputs": "u", "outputs": ("yM", "vM"), "n_sections": 16}


def add_artifacts(recording, signals=("yM", "vM"), **dirt):
    return hj.testing.add_artifacts(recording, signals, **dirt)


def test_cycles_from_apex_to_apex_tell_more(hopper_recording, hopper_cycle, angle):
    """At the sections of an angle of the two outputs, these are one number."""
    noisy = add_artifacts(hopper_recording, noise=1e-4)
    apex = hj.Crossing("vM", "falling")
    data = [
        hj.recordings.sample_sections(noisy, phase, **ABOUT) for phase in (angle, apex)
    ]
    fits = [hj.fit_series(x.records, order=2) for x in data]
    assert fits[1].standard_errors[0] < fits[0].standard_errors[0] / 1.5
    assert fits[1].contains(hopper_cycle.multipliers, 0.999).all()
    by_angle, by_apex = (
        hj.recordings.diagnose(*x).findings for x in zip(data, fits, strict=True)
    )
    said = "Outputs: yM and vM carry the same information at sections"
    assert any(repr(w).startswith(said) for w in by_angle)
    assert "199.94 cycles" in repr(data[0])
    assert not any(w.cause == "outputs" for w in by_apex)


@pytest.mark.slow
def test_spikes_of_twenty_deviations_change_little(hopper_recording, hopper_cycle):
    """Sixteen sections of four samples each, spikes in one per cent of force and outputs."""
    clean = add_artifacts(hopper_recording, noise=1e-4)
    fits = []
    data = []
    apex = hj.Crossing("vM", "falling")
    dirty = add_artifacts(clean, ("u", "yM", "vM"), spikes=1e-2, seed=1)
    for recording in (clean, dirty):
        data.append(hj.recordings.sample_sections(recording, apex, **ABOUT))
        fits.append(hj.fit_series(data[-1], order=2))
    clean_values = clean.trials[0].values
    differs = clean_values != dirty.trials[0].values
    changed = differs.sum(axis=0)
    missed = np.abs(data[1].spikes - changed)
    assert missed.max() <= 0.05 * max(changed) + 1
    error = fits[1].standard_errors[0]
    usual = fits[0].standard_errors[0]
    assert error < 2 * usual
    assert fits[1].contains(hopper_cycle.multipliers, 0.999).all()
    assert any(
        w.cause == "spikes" for w in hj.recordings.diagnose(data[1], fits[1]).findings
    )


@pytest.mark.slow
def test_responses_to_pushes(hopper_cycle, angle):
    """Against the exact linearization, averaged over the push, within the error of held inputs."""
    force = hj.experiments.random_input(200, 256, 8, rms=0.002, seed=0)
    recording = hj.testing.simulate_recording(
        hopper_cycle, force[None], ("yM", "vM"), rate=256
    )
    for N, most in ((16, 1e-3), (32, 2.5e-4)):
        sections = dataclasses.replace(angle, n_sections=N)
        data = hj.recordings.sample_sections(
            recording, sections, **ABOUT | {"n_sections": N}
        )
        fit = hj.fit_series(data.records, order=2)
        found = hj.recordings.impulse_responses(fit, data, cycles=2, width=0.08)
        sections = dataclasses.replace(sections, anchor=hj.Crossing("vM", "falling"))
        model = hj.linearize(hopper_cycle, sections, ("yM", "vM"))
        theory = found.of_model(model)
        k = np.arange(-N // 4, N // 4 + 1)
        m = 5
        r = 5 * N // 4
        distance = k / (N * found.width)
        push = np.exp(-0.5 * distance**2)
        area = push @ found.durations[(m + k) % N]
        response = model.impulse_response(4 * N)
        answers = response[(m + r) % N, r - k, :, 0]
        value = push @ answers / area
        of_theory = theory[m, r, :, 0]
        np.testing.assert_allclose(of_theory, value, rtol=1e-12)
        size = np.abs(theory).max(axis=(0, 1))
        assert (
            np.sqrt(np.mean((found.values - theory) ** 2, axis=(0, 1))) < most * size
        ).all()
