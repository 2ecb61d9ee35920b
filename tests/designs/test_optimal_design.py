"""Designs for a question: what they are worth, and that this is true."""

import functools

import numpy as np
import pytest

import hybridjax as hj

from .conftest import expected_htf


NOISE = {"yM": 1e-4, "vM": 3e-4}
HARMONICS = (-2, -1, 0, 1, 2)
with_variance = functools.partial(expected_htf, noise=NOISE, harmonics=HARMONICS)


@pytest.fixture(scope="module")
def usual():
    """Fewer lines than the paper's, for the time of it."""
    return hj.multisine(periods=32, amplitude=0.003)


@pytest.fixture(scope="module")
def plan(isochron_ldtp, usual):
    return hj.optimal_design(isochron_ldtp, usual, noise=NOISE)


def test_standard_errors_are_the_cramer_rao_bound(plan, isochron_ldtp):
    """That of `multiplier_bound`, which projects numerators out in another way."""
    for design, said in (
        (plan.usual, plan.usual_standard_errors),
        (plan.design, plan.standard_errors),
    ):
        bound = hj.identify.multiplier_bound(isochron_ldtp, with_variance(isochron_ldtp, design))
        variances = np.diag(bound.multiplier_covariances[0])
        # (They differ in which combination of powers counts as rounding: one of 84.)
        np.testing.assert_allclose(said**2, variances, rtol=2e-3)


def test_no_other_design_is_better_than_the_certificate_allows(plan, isochron_ldtp):
    """With as much power at the input."""
    assert plan.certificate < 1.04
    rng = np.random.default_rng(0)
    shapes = [lambda f: np.exp(-((f - 0.3) ** 2)), lambda f: 1 / (0.1 + f), np.ones_like]
    shapes.append(lambda f: np.sqrt(np.interp(f, plan.frequencies, plan.power) + 1e-9))
    shapes += [lambda f: rng.exponential(size=f.shape) for _ in range(3)]
    for shape in shapes:
        other = hj.multisine(periods=32, amplitude=shape)
        rms = np.sqrt(np.mean(other.inputs() ** 2))
        other = other.scaled(plan.usual_rms["u"])
        assert rms > 0
        bound = hj.identify.multiplier_bound(isochron_ldtp, with_variance(isochron_ldtp, other))
        assert np.trace(bound.multiplier_covariances[0]) > plan.criterion / plan.certificate


def test_the_hopper_with_its_input_limited(isochron_ldtp):
    """620 lines. An independent script, with all numerators free and complex (that knows nothing of
    H_{-m}(-w) = conj H_m(w)), saves 19.3 of 20.3 strides; deviations are 5.8 times larger."""
    found = hj.optimal_design(isochron_ldtp)
    assert found.saved == pytest.approx(19.17, abs=0.3)
    assert 1 <= found.certificate < 1.03
    assert found.rms["yM"] / found.usual_rms["yM"] == pytest.approx(5.83, abs=0.05)
    assert found.frequencies[np.argmax(found.power)] == pytest.approx(0.3, abs=0.04)
    assert "one stride does the work of 19" in repr(found)
    np.testing.assert_allclose(found.rms["u"], found.usual_rms["u"])


def test_the_hopper_with_deviations_limited(isochron_ldtp):
    found = hj.optimal_design(isochron_ldtp, limit="output")
    assert 1 < found.saved < 1.05
    assert found.certificate < 1.03
    assert "nearly optimal" in found.advice
    assert all(found.rms[n] <= found.usual_rms[n] * (1 + 1e-9) for n in ("yM", "vM"))


def test_experiments_are_as_promised(plan, isochron_ldtp):
    """Power and deviations are those of the signals themselves, the same in all experiments."""
    u = plan.design.inputs()
    powers = np.mean(u**2, axis=(1, 2))
    np.testing.assert_allclose(powers, plan.rms["u"] ** 2, rtol=1e-3)
    data = hj.experiments.simulate_experiments(isochron_ldtp, plan.design, start="periodic")
    rms = np.sqrt(np.mean(data.y**2, axis=(0, 1)))
    np.testing.assert_allclose(rms, [plan.rms["yM"], plan.rms["vM"]], rtol=1e-3)
    assert plan.strides == plan.usual.cycles(0)


@pytest.mark.slow
def test_fits_reach_what_is_promised(plan, isochron_ldtp):
    """60 draws of the noise: the rms error has a standard error of 7 %."""
    data = hj.experiments.simulate_experiments(isochron_ldtp, plan.design, start="periodic")
    variance = with_variance(isochron_ldtp, plan.design).variance
    errors = []
    for seed in range(60):
        noisy = hj.experiments.add_noise(data, std=list(NOISE.values()), seed=seed)
        htf = hj.estimate_htf(noisy, HARMONICS)
        htf = hj.HTF(htf.f, htf.H, HARMONICS, 32, "u", ("yM", "vM"), variance=variance)
        errors.append(hj.fit_multipliers(htf, 2).compare(isochron_ldtp.multipliers).error[0])
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(
        np.linalg.norm(plan.standard_errors), rel=0.2
    )


def test_rms_values_by_name(isochron_ldtp, usual):
    found = hj.optimal_design(isochron_ldtp, usual, limit={"u": 0.02, "yM": 0.001}, noise=NOISE)
    assert found.rms["u"] <= 0.02 * (1 + 1e-9) and found.rms["yM"] <= 0.001 * (1 + 1e-9)
    assert found.limited == ("u", "yM")
    assert found.certificate < 1.04


def test_forbidden_frequencies_and_amplitudes(isochron_ldtp, usual, plan):
    def allowed(f):
        return np.where((f > 1.1) & (f < 1.5), 0, 0.006)

    found = hj.optimal_design(isochron_ldtp, usual, noise=NOISE, largest=allowed)
    f = found.design.f
    assert not ((f > 1.1) & (f < 1.5)).any()
    assert found.design.amplitude.max() <= 0.006 < plan.design.amplitude.max()
    assert found.criterion > plan.criterion
    bound = hj.identify.multiplier_bound(isochron_ldtp, with_variance(isochron_ldtp, found.design))
    assert found.criterion == pytest.approx(np.trace(bound.multiplier_covariances[0]), rel=1e-2)


def test_fewer_experiments_hold_fewer_lines(isochron_ldtp, usual, plan):
    found = hj.optimal_design(isochron_ldtp, usual, noise=NOISE, experiments=10)
    assert found.design.experiments == 10
    assert found.strides == 320
    assert found.saved > 0.8 * plan.saved


@pytest.mark.parametrize("limit", ["input", "output"])
def test_units_do_not_matter(isochron_ldtp, usual, limit):
    """Newtons, piconewtons and meganewtons."""
    found = [
        hj.optimal_design(isochron_ldtp, usual.scaled(rms), limit=limit)
        for rms in (1e-12, 0.01, 1e6)
    ]
    for one in found:
        assert one.certificate == pytest.approx(found[1].certificate, rel=1e-6)
        assert one.saved == pytest.approx(found[1].saved, rel=1e-6)


def test_nothing_within_amplitudes_is_better_than_the_certificate_says(isochron_ldtp, usual):
    """Beside experiments in which the best lines of each class take turns, as large as allowed."""
    limit = {"u": 0.01}
    plan = hj.optimal_design(isochron_ldtp, usual, largest=0.006, noise=NOISE, limit=limit)
    assert plan.design.amplitude.max() <= 0.006 and plan.saved >= 1 / plan.certificate
    classes = np.minimum(plan.design.line % 32, -plan.design.line % 32)
    strongest, rng, f = plan.power * plan.sensitivity, np.random.default_rng(0), []
    line = np.rint(plan.frequencies * 32).astype(int)
    each = [np.flatnonzero(np.minimum(line % 32, -line % 32) == c) for c in np.unique(classes)]
    for e in range(usual.experiments):
        best = [k[np.argsort(-strongest[k])][e % min(4, len(k))] for k in each]
        f.append(np.sort(plan.frequencies[best]))
    other = hj.Design.from_lines(
        f, 0.006, [rng.uniform(0, 6, len(one)) for one in f], n_sections=32, periods=32
    )
    rms = float(np.sqrt(np.mean(other.inputs() ** 2)))
    found = hj.optimal_design(isochron_ldtp, other, noise=NOISE, limit={"u": rms})
    assert found.usual_criterion * (1 + 1e-9) > plan.criterion / plan.certificate
    assert plan.certificate < 1.3


def test_the_usual_design_keeps_to_amplitudes(isochron_ldtp, usual):
    """What is saved is compared with experiments that are allowed as well."""
    plan = hj.optimal_design(
        isochron_ldtp, usual, noise=NOISE, largest=lambda f: 0.004 * (f > 1), limit={"u": 0.1}
    )
    assert plan.usual.frequencies.min() > 1 and plan.usual.amplitude.max() <= 0.004
    assert plan.saved >= 1 / plan.certificate


def test_inputs_have_the_names_of_the_model(isochron_ldtp):
    with pytest.raises(hj.DefinitionError, match="the inputs F, the model 32 and u"):
        hj.optimal_design(isochron_ldtp, hj.multisine(periods=32, inputs=("F",)))


@pytest.mark.parametrize(
    "goal",
    [
        hj.designs.Multipliers(criterion="D"),
        hj.designs.Multipliers(0, "modulus"),
        hj.designs.Multipliers(harmonics=0),
    ],
)
def test_other_goals(isochron_ldtp, usual, goal):
    found = hj.optimal_design(isochron_ldtp, usual, goal=goal, noise=NOISE)
    assert found.certificate < 1.1
    assert found.saved > 5


def test_strides_for_a_standard_error(plan):
    half = plan.standard_errors.max() / 2
    assert plan.strides_for(half) == 4 * plan.strides


def test_several_inputs():
    model = hj.testing.synthetic_ldtp()
    found = hj.optimal_design(
        model, hj.multisine(6, 32, band=(0, 3), inputs=model.inputs),
        goal=hj.designs.Multipliers(harmonics=(-1, 0, 1)),
    )  # fmt: skip
    assert found.certificate < 1.03 and found.saved > 1
    assert set(found.limited) == set(model.inputs)


def test_from_an_estimate(isochron_ldtp, usual):
    htf = with_variance(isochron_ldtp, usual)
    fit = hj.fit_multipliers(htf, 2)
    found = hj.optimal_design(fit, usual, noise=NOISE)
    assert found.saved > 5


NEAR = hj.LDTP(
    np.array([np.eye(2), [[0.5, 0.01], [0, 0.5 + 1e-9]]]), np.ones((2, 2, 1)), np.ones((2, 1, 2))
)


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(limit={"z": 1.0}), "`limit` limits 'z'; what can be limited is the rms value of u"),
        (dict(limit={}), "`limit` limits nothing"),
        (dict(noise={"z": 1.0}), "`noise` names 'z'; the outputs are yM, vM"),
        (dict(largest=lambda f: 0 * f), "`largest` is zero at all frequencies"),
        (dict(largest=lambda f: f - 1), "amplitudes that are not negative"),
        (dict(goal=hj.designs.Multipliers(5)), "there is no multiplier 5, the model has 2"),
        (dict(goal=hj.designs.Multipliers(harmonics=1)), "symmetric about 0"),
        (dict(design=hj.multisine(8)), "the design has 8 sections"),
        (dict(design=hj.multisine(lines="two-phase", periods=4)), "is a multiple of 1/2"),
        (dict(limit={"u": 0.0}), "positive"),
    ],
)
def test_bad_input(isochron_ldtp, usual, change, message):
    with pytest.raises(hj.DefinitionError, match=message):
        hj.optimal_design(isochron_ldtp, **({"design": usual} | change))


def test_multipliers_that_are_not_simple():
    with pytest.raises(hj.DefinitionError, match="is not simple"):
        goal = hj.designs.Multipliers(harmonics=0)
        hj.optimal_design(NEAR, hj.multisine(2, 32, band=(0, 1)), goal=goal)


@pytest.mark.slow
def test_physical_parameters():
    """Their standard errors with the usual design are those of `fit_model`'s sensitivities."""
    cycle = hj.find_limit_cycle(hj.models.Duffing())
    sections = hj.ClockPhase(8, anchor=hj.Crossing("x", "falling"))
    model = hj.linearize(cycle, sections, outputs=("x", "v"))
    usual, free = hj.multisine(8, periods=16).scaled(0.001), ("damping", "amplitude")
    goal = hj.designs.Parameters(cycle, sections, free, harmonics=(-1, 0, 1))
    plan = hj.optimal_design(model, usual, goal=goal, noise={"x": 1e-4})
    assert plan.certificate < 1.03 and plan.saved > 10

    htf = model.htf(usual.frequencies, (-1, 0, 1))
    variance = np.broadcast_to(usual.expected_variance(1e-4)[:, None], (3, len(htf.f), 1, 1))
    seen = hj.HTF(htf.f, htf.H[:, :, :1], (-1, 0, 1), 8, htf.inputs, "x", variance=variance)
    S = hj.fitting.identifiability(
        cycle.system, hj.ObservedHTF(seen, sections), free, guess=cycle
    ).sensitivity
    bound = np.sqrt(np.diag(np.linalg.inv(S.T @ S)))
    np.testing.assert_allclose(plan.usual_standard_errors, bound, rtol=1e-6)
