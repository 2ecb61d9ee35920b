"""Limits: the signals themselves obey them. Noise: its spectrum attracts or repels power."""

import numpy as np
import pytest

import hybridjax as hj
from hybridjax.identify.joint.noise import noise_spectrum

from .conftest import TWO_NOISE


Limits = hj.designs.Limits
RMS = {"u0": 0.1, "u1": 0.05}


def test_peaks_hold_in_every_experiment(optimal_two):
    free = optimal_two()
    plan = optimal_two(limit=Limits(rms={"u1": 0.05}, peak={"u0": 0.1}))
    peak = np.abs(plan.design.inputs()).max(axis=1)
    np.testing.assert_allclose(peak[:, 0], 0.1)
    assert plan.limited == ("u1", "peak of u0")
    # (The crest factor is about 2.)
    assert 1.5 < plan.for_peaks < 5 and "peaks cost" in repr(plan)
    assert plan.certificate > plan.for_peaks
    assert plan.criterion == pytest.approx(free.criterion * plan.for_peaks, rel=0.05)
    # The usual amplitudes get phases for low peaks, too: the design saves strides by its powers.
    assert set(np.abs(plan.usual.inputs()).max(axis=1)[:, 0].round(6)) == {0.0, 0.1}
    np.testing.assert_allclose(np.mean(plan.design.inputs()[..., 1] ** 2), plan.rms["u1"] ** 2)
    # A peak that nothing exceeds changes nothing.
    assert optimal_two(limit=Limits(rms=RMS, peak={"u0": 9.0})).for_peaks == pytest.approx(1)


def test_rates(optimal_two):
    """The change from one section to the next, also from the last one to the first."""
    plan = optimal_two(limit=Limits(rms=RMS, rate={"u0": 0.03}))
    change = np.diff(plan.design.inputs(33), axis=1)[:, : 6 * 32]
    assert np.sqrt(np.mean(change[..., 0] ** 2)) == pytest.approx(0.03, rel=1e-3)
    assert plan.certificate < 1.03
    assert "rms of u0 and u1 and rate of u0 limited" in plan.advice


def test_strides(optimal_two, two_usual):
    """A smaller number of experiments holds fewer lines; words and strides go together."""
    plan = optimal_two(limit=Limits(rms="input", strides=300))
    assert plan.design.experiments == 300 // 32 and plan.strides <= 300
    power = np.sqrt(np.mean(two_usual.inputs() ** 2, axis=(0, 1)))
    assert all(plan.rms[f"u{i}"] <= power[i] * (1 + 1e-9) for i in (0, 1))
    with pytest.raises(hj.DefinitionError, match="allows 31 strides, but one experiment has 32"):
        optimal_two(limit=Limits(rms=RMS, strides=31))


def test_states(isochron_ldtp):
    """The foot, which is no output, and stands still in stance."""
    usual = hj.multisine(periods=16)
    noise = {"yM": 1e-4, "vM": 3e-4}
    plan = hj.optimal_design(isochron_ldtp, usual, noise=noise, limit={"u": 0.1, "ym": 0.002})
    assert plan.rms["ym"] == pytest.approx(0.002, rel=1e-3) and plan.certificate < 1.03
    u = plan.design.inputs()
    x0 = isochron_ldtp.periodic_states(u, 16)
    square = 0.0
    for signal, start in zip(u, x0, strict=True):
        x = np.asarray(isochron_ldtp.states(signal, start))[:-1]
        for n, names in enumerate(isochron_ldtp.coordinates):
            if "ym" in names:
                square += np.sum(x[n::32, names.index("ym")] ** 2)
    assert np.sqrt(square / u[..., 0].size) == pytest.approx(0.002, rel=0.02)


@pytest.mark.parametrize(
    "limit, message",
    [
        (Limits(), "limits nothing"),
        ({}, "limits nothing"),
        ({"z": 1.0}, "has 'z'; rms values can be limited of u0, u1, y0, y1"),
        (Limits(peak={"y0": 1.0}), "has the peak of 'y0'; the inputs are u0, u1"),
        (Limits(rate={"z": 1.0}), "has the rate of 'z'"),
        (Limits(rms={"rate of u0": 1.0}), "has 'rate of u0'; rms values"),
        (Limits(peak={"u0": 1.0}), "limit the input, too"),
    ],
)
def test_bad_limits(optimal_two, limit, message):
    with pytest.raises(hj.DefinitionError, match=message):
        optimal_two(limit=limit)


def test_noise_by_frequency(optimal_two):
    """A spectrum that is constant is white noise; less noise at a frequency attracts power."""
    limit = {"u0": 0.1, "u1": 0.1}
    white = optimal_two(limit=limit)
    level = {name: (lambda f, s=s: np.full(f.shape, s)) for name, s in TWO_NOISE.items()}
    same = optimal_two(limit=limit, noise=level)
    assert same.usual_criterion == pytest.approx(white.usual_criterion, rel=1e-9)
    quiet = {
        n: (lambda f, s=s: np.where(np.abs(f - 1.5) < 0.5, s / 10, s)) for n, s in TWO_NOISE.items()
    }
    goal = hj.designs.Multipliers(harmonics=0)
    plans = [optimal_two(limit=limit, goal=goal, noise=noise) for noise in (quiet, TWO_NOISE)]
    band = np.abs(plans[0].frequencies - 1.5) < 0.5
    assert plans[0].power[band].sum() > 1.1 * plans[1].power[band].sum()


def test_noise_of_a_model(two, optimal_two, isochron_ldtp):
    """White noise of each output; then noise that is different at each harmonic, against
    `multiplier_bound`, which takes numerators out in another way."""
    limit = {"u0": 0.1, "u1": 0.1}
    D = np.tile(np.diag(list(TWO_NOISE.values())), (6, 1, 1))
    A, B, C = np.full((6, 1, 1), 0.8), np.full((6, 1, 2), [0.02, 0.01]), np.ones((6, 2, 1))
    static = hj.LDTP(A, 0 * B, C, D, outputs=tuple(TWO_NOISE))
    white = optimal_two(limit=limit)
    same = optimal_two(limit=limit, noise=static)
    assert same.usual_criterion == pytest.approx(white.usual_criterion, rel=1e-9)
    red = hj.LDTP(A, B, C, D, outputs=tuple(TWO_NOISE))
    plan = optimal_two(limit=limit, noise=red)
    assert plan.certificate < 1.03
    harmonics = (-1, 0, 1)
    htf = two.htf(plan.usual.frequencies, harmonics)
    spectrum = noise_spectrum(red, htf.f, harmonics)[..., None]
    variance = spectrum * plan.usual.expected_variance()[:, None, :]
    htf = hj.HTF(htf.f, htf.H, harmonics, 6, two.inputs, two.outputs, variance=variance)
    bound = hj.identify.multiplier_bound(two, htf)
    total = np.trace(bound.multiplier_covariances[0])
    assert plan.usual_criterion == pytest.approx(total, rel=1e-6)
    with pytest.raises(hj.DefinitionError, match="has 32 sections and the outputs"):
        optimal_two(noise=isochron_ldtp)


def test_amplitudes_at_which_distortion_is_allowed(two, optimal_two):
    """A part of second order in the inputs: relative to the output it grows as they do."""

    def run(u):
        y = np.stack([two.simulate(x) + 0.5 * x[:, :1] ** 2 for x in u])
        return hj.ExperimentData(u, y, n_sections=6, periods=32, outputs=two.outputs)

    plan = optimal_two()
    sweep = hj.identify.amplitude_sweep(run, two, plan.design.inputs(64), (0.01, 0.1, 1))
    allowed = sweep.misfit[-1].max() / 20
    share = sweep.limit(allowed)
    weaker = optimal_two(limit={name: share * plan.rms[name] for name in plan.limited})
    again = hj.identify.amplitude_sweep(run, two, weaker.design.inputs(64), (1.0,))
    assert again.misfit.max() == pytest.approx(allowed, rel=0.05)
    assert weaker.strides_for(1e-3) == pytest.approx(400 * plan.strides_for(1e-3), rel=0.05)
