"""What limits experiments: the signals themselves keep to it."""

import numpy as np
import pytest

import hybridjax as hj

from .two_inputs import NOISE, model as model, usual as usual


GOAL = hj.designs.Multipliers(harmonics=(-1, 0, 1))
Limits = hj.designs.Limits


def optimal(model, usual, **options):
    return hj.optimal_design(model, usual, **({"goal": GOAL, "noise": NOISE} | options))


def test_peaks_hold_in_every_experiment(model, usual):
    free = optimal(model, usual, limit={"u0": 0.1, "u1": 0.05})
    plan = optimal(model, usual, limit=Limits(rms={"u1": 0.05}, peak={"u0": 0.1}))
    peak = np.abs(plan.design.inputs()).max(axis=1)
    np.testing.assert_allclose(peak[:, 0], 0.1)
    assert plan.limited == ("u1", "peak of u0")
    # (The crest factor is about 2.)
    assert 1.5 < plan.for_peaks < 5 and "peaks cost" in repr(plan)
    assert plan.certificate > plan.for_peaks
    assert plan.criterion == pytest.approx(free.criterion * plan.for_peaks, rel=0.05)
    # The usual amplitudes get phases for low peaks, too: what is saved is not saved by phases.
    assert set(np.abs(plan.usual.inputs()).max(axis=1)[:, 0].round(6)) == {0.0, 0.1}
    np.testing.assert_allclose(np.mean(plan.design.inputs()[..., 1] ** 2), plan.rms["u1"] ** 2)


def test_peaks_that_nothing_exceeds_cost_nothing(model, usual):
    plan = optimal(model, usual, limit=Limits(rms={"u0": 0.1, "u1": 0.05}, peak={"u0": 9.0}))
    assert plan.for_peaks == pytest.approx(1)


def test_rates(model, usual):
    """The change from one section to the next, also from the last one to the first."""
    limit = Limits(rms={"u0": 0.1, "u1": 0.05}, rate={"u0": 0.03})
    plan = optimal(model, usual, limit=limit)
    change = np.diff(plan.design.inputs(33), axis=1)[:, : 6 * 32]
    assert np.sqrt(np.mean(change[..., 0] ** 2)) == pytest.approx(0.03, rel=1e-3)
    assert plan.certificate < 1.03
    assert "rms of u0 and u1 and rate of u0 limited" in plan.advice


def test_strides(model, usual):
    limit = Limits(rms={"u0": 0.1, "u1": 0.05}, strides=300)
    plan = optimal(model, usual, limit=limit)
    assert plan.design.experiments == 300 // 32 and plan.strides <= 300
    with pytest.raises(hj.DefinitionError, match="allows 300 strides, but 10 experiments of 32"):
        optimal(model, usual, limit=limit, experiments=10)
    with pytest.raises(hj.DefinitionError, match="allows 31 strides, but 1 experiments of 32"):
        optimal(model, usual, limit=Limits(rms={"u0": 0.1, "u1": 0.05}, strides=31))


def test_states(isochron_ldtp):
    """The foot, which is no output, and stands still in stance."""
    usual = hj.multisine(periods=16)
    noise = {"yM": 1e-4, "vM": 3e-4}
    plan = hj.optimal_design(isochron_ldtp, usual, noise=noise, limit={"u": 0.1, "ym": 0.002})
    assert plan.rms["ym"] == pytest.approx(0.002, rel=1e-3) and plan.certificate < 1.03
    u = plan.design.inputs()
    x0 = isochron_ldtp.periodic_states(u, 16)
    names = isochron_ldtp.coordinates
    square = 0.0
    for one, start in zip(u, x0, strict=True):
        x = np.asarray(isochron_ldtp.states(one, start))[:-1]
        for n, here in enumerate(names):
            if "ym" in here:
                square += np.sum(x[n::32, here.index("ym")] ** 2)
    assert np.sqrt(square / u[..., 0].size) == pytest.approx(0.002, rel=0.02)


@pytest.mark.parametrize(
    "limit, message",
    [
        (Limits(), "limits nothing"),
        (Limits(peak={"y0": 1.0}), "limits the peak of 'y0'; the inputs are u0, u1"),
        (Limits(rate={"z": 1.0}), "limits the rate of 'z'"),
        (Limits(rms={"rate of u0": 1.0}), "limits 'rate of u0'; what can be limited"),
        (Limits(peak={"u0": 1.0}), None),
    ],
)
def test_bad_limits(model, usual, limit, message):
    message = message or "limit the input, too"
    with pytest.raises(hj.DefinitionError, match=message):
        optimal(model, usual, limit=limit)


def test_noise_by_frequency(model, usual):
    """A spectrum that is constant is white noise; less noise at a frequency draws power there."""
    limit = {"u0": 0.1, "u1": 0.1}
    white = optimal(model, usual, limit=limit)
    level = {name: (lambda f, s=s: np.full(f.shape, s)) for name, s in NOISE.items()}
    same = optimal(model, usual, limit=limit, noise=level)
    assert same.usual_criterion == pytest.approx(white.usual_criterion, rel=1e-9)
    quiet = {
        n: (lambda f, s=s: np.where(np.abs(f - 1.5) < 0.5, s / 10, s)) for n, s in NOISE.items()
    }
    goal = hj.designs.Multipliers(harmonics=0)
    plan = optimal(model, usual, limit=limit, noise=quiet, goal=goal)
    before = optimal(model, usual, limit=limit, goal=goal)
    there = np.abs(plan.frequencies - 1.5) < 0.5
    assert plan.power[there].sum() > 1.1 * before.power[there].sum()


def test_noise_of_a_model(model, usual):
    """White noise of each output; then one whose harmonics have different noise, against
    `multiplier_bound`, which takes numerators out in another way."""
    limit = {"u0": 0.1, "u1": 0.1}
    D = np.tile(np.diag(list(NOISE.values())), (6, 1, 1))
    A, B, C = np.full((6, 1, 1), 0.8), np.full((6, 1, 2), [0.02, 0.01]), np.ones((6, 2, 1))
    still = hj.LDTP(A, 0 * B, C, D, outputs=tuple(NOISE))
    white = optimal(model, usual, limit=limit)
    same = optimal(model, usual, limit=limit, noise=still)
    assert same.usual_criterion == pytest.approx(white.usual_criterion, rel=1e-9)
    red = hj.LDTP(A, B, C, D, outputs=tuple(NOISE))
    plan = optimal(model, usual, limit=limit, noise=red)
    assert plan.certificate < 1.03
    harmonics = (-1, 0, 1)
    htf = model.htf(plan.usual.frequencies, harmonics)
    spectrum = hj.identify.noise_spectrum(red, htf.f, harmonics)[..., None]
    variance = spectrum * plan.usual.expected_variance()[:, None, :]
    htf = hj.HTF(htf.f, htf.H, harmonics, 6, model.inputs, model.outputs, variance=variance)
    bound = hj.identify.multiplier_bound(model, htf)
    total = np.trace(bound.multiplier_covariances[0])
    assert plan.usual_criterion == pytest.approx(total, rel=1e-6)


def test_noise_of_another_system_is_refused(model, usual, isochron_ldtp):
    with pytest.raises(hj.DefinitionError, match="is of 32 sections and the outputs"):
        optimal(model, usual, noise=isochron_ldtp)


def test_as_strong_as_distortion_allows(model, usual):
    """A part of second order in the inputs: relative to the output it grows as they do."""

    def run(u):
        y = np.stack([model.simulate(x) + 0.5 * x[:, :1] ** 2 for x in u])
        return hj.ExperimentData(u, y, n_sections=6, periods=32, outputs=model.outputs)

    plan = optimal(model, usual, limit={"u0": 0.1, "u1": 0.05})
    sweep = hj.identify.amplitude_sweep(run, model, plan.design.inputs(64), (0.01, 0.1, 1))
    allowed = sweep.misfit[-1].max() / 20
    share = sweep.limit(allowed)
    limit = {name: share * plan.rms[name] for name in plan.limited}
    weaker = optimal(model, usual, limit=limit)
    again = hj.identify.amplitude_sweep(run, model, weaker.design.inputs(64), (1.0,))
    assert again.misfit.max() == pytest.approx(allowed, rel=0.05)
    assert weaker.strides_for(1e-3) == pytest.approx(400 * plan.strides_for(1e-3), rel=0.05)
