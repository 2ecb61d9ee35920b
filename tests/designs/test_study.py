"""Studies stop at the requested precision, and their intervals hold then."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import hybridjax as hj
from hybridjax.designs.study_estimate import refuse_transient


NOISE = {"x": 1e-4, "v": 3e-4}
ASKED = 7e-5


@pytest.fixture(scope="module")
def first():
    return hj.multisine(8, periods=32, lines="odd", frequencies=(0, 4)).scaled(0.001)


def measured(model, design, seed=0, factor=1.0):
    """A laboratory."""
    data = hj.experiments.simulate_experiments(model, design, start="periodic")
    return hj.experiments.add_noise(
        data, std=factor * np.array(list(NOISE.values())), seed=seed
    )


@pytest.fixture(scope="module")
def studies(model, first):
    """One, after each of its blocks."""
    study = hj.designs.SequentialDesign(first, order=2, standard_error=ASKED)
    found = [study]
    while not study.done:
        data = measured(model, study.design, seed=len(found))
        study = study.add(data)
        found.append(study)
    return found


def test_it_stops_at_the_precision_that_was_asked(studies, model, first):
    *_, before, end = studies
    assert end.blocks == len(studies) - 1
    assert end.blocks >= 2
    assert before.standard_errors[-1].max() > ASKED
    assert end.standard_errors[-1].max() <= ASKED
    assert end.fit.contains(model.multipliers, 0.999).all()

    plan = hj.optimal_design(model, first, noise=NOISE)
    error = end.standard_errors[-1, 0]
    usual_cycles = plan.usual.cycles(0)
    strides_of_first = plan.usual_criterion * usual_cycles / error**2
    assert strides_of_first > 4 * end.cycles[-1]
    # The bound of as many strides, all of them with the best design for the true model.
    bound_of_plan = np.linalg.norm(plan.standard_errors)
    left = plan.cycles / end.cycles[-1]
    bound = bound_of_plan * np.sqrt(left)
    assert error > 0.95 * bound


def test_every_block_is_counted_and_none_is_changed(studies, model, first):
    blocks = [study.blocks for study in studies]
    assert blocks == list(range(len(studies)))
    assert studies[0].design is first
    assert studies[0].fit is None
    cycles = [study.design.cycles(0) for study in studies[:-1]]
    assert_array_equal(studies[-1].cycles, np.cumsum(cycles))
    for before, after in zip(studies[1:], studies[2:], strict=False):
        allowed = 3 * before.cycles[-1]
        assert after.cycles[-1] <= allowed
    for study in studies[1:]:
        assert study.noise == pytest.approx(NOISE, rel=0.1)
    again = studies[0].add(measured(model, first, seed=1))
    assert_array_equal(again.standard_errors, studies[1].standard_errors)
    assert_array_equal(again.design.phase, studies[1].design.phase)


def test_too_much_noise_to_begin_with(model, first):
    """The first design is repeated with other phases."""
    study = hj.designs.SequentialDesign(first, order=2, standard_error=1e-3)
    lost = study.add(measured(model, first, factor=1e4))
    assert not lost.done
    assert np.isnan(lost.standard_errors).all()
    assert lost.plan is None
    text = repr(lost)
    assert "the first design again, since the data show no multiplier above" in text
    assert "check=" not in text
    assert_array_equal(lost.design.line, first.line)
    assert (lost.design.phase != first.phase).all()
    found = lost.add(measured(model, lost.design))
    assert np.isnan(found.standard_errors[0]).all()
    assert found.plan is not None


@pytest.mark.parametrize(
    "goal", [dict(which=0), dict(part="modulus", harmonics=(-1, 0, 1))]
)
def test_goals(model, first, goal):
    study = hj.designs.SequentialDesign(
        first, 2, 1e-4, goal=hj.designs.MultiplierGoal(**goal)
    )
    study = study.add(measured(model, first))
    assert study.standard_errors.shape == (1, 1)
    assert study.plan.saved > 3
    found = study.standard_errors[0, 0]
    by_fit = study.fit.standard_errors[0]
    assert found <= by_fit * (1 + 1e-12)


def test_repeated_windows_count(model, first):
    """Twice the windows, half the variance."""
    long = hj.experiments.simulate_experiments(
        model, first, discard=32, start="periodic"
    )
    std = list(NOISE.values())
    noisy = hj.experiments.add_noise(long, std=std, seed=1)
    study = hj.designs.SequentialDesign(first, 2, 1e-5)
    once = study.add(noisy)
    twice = study.add(noisy, repeats=2)
    both = 2 * first.cycles(0)
    assert once.cycles[0] == twice.cycles[0] == both
    of_once = once.noise["x"]
    of_twice = twice.noise["x"]
    assert of_once == pytest.approx(of_twice, rel=0.1)
    assert twice.plan.criterion == pytest.approx(once.plan.criterion, rel=0.2)


def test_an_order_that_is_too_low_is_named(model, first):
    study = hj.designs.SequentialDesign(first, 1, 1e-5)
    with pytest.raises(hj.errors.DefinitionError, match="show more than 1 multipliers"):
        for k in range(4):
            study = study.add(measured(model, study.design, seed=k))


@pytest.mark.parametrize("order", [3, 4])
def test_an_order_that_is_too_high_is_named(model, first, order):
    """Of the first block, too, the fits of all lower orders are compared with the noise."""
    study = hj.designs.SequentialDesign(first, order, 2.5e-4)
    study = study.add(measured(model, first))
    assert f"the data support 2 multipliers, not {order}" in repr(study)
    with pytest.raises(
        hj.errors.DefinitionError,
        match=f"support 2 multipliers, not {order}, .*study with order=2",
    ):
        for k in range(1, 6):
            study = study.add(measured(model, study.design, seed=k))


def test_bad_data(model, first):
    with pytest.raises(
        hj.errors.DefinitionError, match="`limit` .*no signal 'nope'; signals are u"
    ):
        hj.designs.SequentialDesign(first, 2, 1e-4, limit={"nope": 1.0})
    study = hj.designs.SequentialDesign(first, 2, 1e-4)
    data = measured(model, first)
    for change, message in (
        (dict(outputs=("a", "b")), "blocks of one study have different outputs"),
        (dict(result=[3] * len(data.u)), "no experiment ran to its end \\(0/8 ok"),
        (dict(n_sections=4), "have different n_sections: 4 and 8"),
    ):
        with pytest.raises(hj.errors.DefinitionError, match=message):
            study.add(data).add(dataclasses.replace(data, **change))


@pytest.fixture(scope="module")
def from_the_cycle(model, first):
    """With 20 cycles discarded, after which 0.5 of the transient is left."""
    data = hj.experiments.simulate_experiments(model, first, discard=20)
    return hj.experiments.add_noise(data, std=list(NOISE.values()), seed=1)


def test_what_is_left_of_the_start_is_refused(model, first, from_the_cycle):
    study = hj.designs.SequentialDesign(first, 2, 1e-3)
    with pytest.raises(
        hj.errors.DefinitionError, match="of the start's transient is left"
    ):
        study.add(from_the_cycle)
    found = study.add(hj.identify.remove_transient(from_the_cycle, 2).data)
    assert found.fit.contains(model.multipliers, 0.999).all()


def test_few_degrees_of_freedom_are_paid_for(model, first, monkeypatch):
    """Where Student's intervals are half as wide again, a study is not done at the standard error
    that was asked, and the next block is longer by 1.5 squared, or as long as it may be."""
    data = measured(model, first)
    study = hj.designs.SequentialDesign(first, 2, 1.0).add(data)
    error = study.standard_errors[0, 0]
    # The scatter of few lines understates the error of a first block, but the noise level does not.
    plan = hj.optimal_design(model, first, noise=NOISE)
    assert error > 0.95 * np.linalg.norm(plan.usual_standard_errors)
    asked = 1.2 * error
    assert hj.designs.SequentialDesign(first, 2, asked).add(data).done
    study_of_half = hj.designs.SequentialDesign(first, 2, 0.4 * error)
    half = study_of_half.add(data)
    monkeypatch.setattr("hybridjax.designs.study._student", lambda fit: 1.5)
    study_asked = hj.designs.SequentialDesign(first, 2, asked)
    assert not study_asked.add(data).done
    assert (
        hj.designs.SequentialDesign(first, 2, 0.4 * error).add(data).plan.cycles
        > half.plan.cycles
    )


N = 4
P = 8
S = 40
MULTIPLIERS = np.array([0.8, 0.3 + 0j])


def test_an_unstable_estimate_repeats_the_first_design(model, first):
    study = hj.designs.SequentialDesign(first, order=2, standard_error=1e-3)
    unstable = dataclasses.replace(model, A=1.05 * model.A)
    study = study.add(measured(unstable, first))
    assert "again, since the estimate is unstable" in repr(study)


def records(size, noise=0.0, *, before=5, repeats=1, seed=0):
    """Return two outputs of rms one, the second with a transient, larger in the first cycle."""
    cycles = np.arange(before + P * repeats)
    cycle = np.repeat(cycles, N)
    n = np.arange(len(cycle))
    angle = 2 * np.pi * n / (N * P)
    wave = np.sqrt(2) * np.cos(angle)
    start = 3 * (cycle == 0)
    transient = size * (0.8**cycle + start)
    y = np.stack([wave, wave + transient], axis=1)
    rng = np.random.default_rng(seed)
    y = y + noise * rng.normal(size=(S, *y.shape))
    u = np.zeros((S, len(cycle), 1))
    return hj.experiments.ExperimentData(u, y, n_sections=N, periods=P)


@pytest.mark.parametrize(
    "before, repeats, left",
    [
        (5, 1, 0.8**5 * (1 - 0.8**P)),
        (3, 2, 0.8**3 * (1 - 0.8**P)),
        (1, 1, 0.8 * (4 - 0.8**P)),  # The first cycle is the only one.
    ],
)
def test_a_transient_in_the_window_is_refused(before, repeats, left):
    size = 1e-3
    data = records(size, before=before, repeats=repeats)
    no_noise = np.zeros(2)
    refuse_transient(data, repeats, MULTIPLIERS, no_noise, 1.05 * size * left)
    with pytest.raises(
        hj.errors.DefinitionError, match=f"after {before} discarded cycles"
    ):
        refuse_transient(data, repeats, MULTIPLIERS, no_noise, 0.95 * size * left)
    refuse_transient(records(1.0, before=0), 1, MULTIPLIERS, no_noise, 0.0)


def test_noise_is_no_transient():
    """Unless its mean square is beyond six standard deviations of that of noise, which the
    difference of two cycles contains twice."""
    noise = np.array([0.01, 0.01])
    level = 2 * 0.01**2
    spread = np.sqrt(2 / (N * S))
    power = 6 * level * spread
    response = 0.8 * (1 - 0.8**P)
    size = np.sqrt(power) / response
    for seed in range(20):
        refuse_transient(records(0.0, 0.01, seed=seed), 1, MULTIPLIERS, noise, 0.0)
        with pytest.raises(hj.errors.DefinitionError, match="transient is left"):
            refuse_transient(records(size, 0.01, seed=seed), 1, MULTIPLIERS, noise, 0.0)
