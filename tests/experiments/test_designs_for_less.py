"""Odd lines, few experiments, several inputs at once, crest factors, realizations."""

import numpy as np
import pytest

import hybridjax as hj

from ..linear.conftest import blocks_at_random, hopper as hopper


def own(design, experiment):
    return design.line[design.experiment == experiment]


def products(j, periods):
    """Lines, modulo P and sign, where a quadratic distortion answers."""
    both = np.concatenate([(j[:, None] + j).ravel(), (j[:, None] - j).ravel()]) % periods
    return {min(x, periods - x) for x in both.tolist()}


@pytest.mark.parametrize(
    "choice, periods, count, frequencies",
    [
        (dict(lines="odd"), 64, 20, 320),
        (dict(lines="odd"), 128, 20, 640),
    ],
)
def test_even_products_miss_the_lines(choice, periods, count, frequencies):
    design = hj.multisine(periods=periods, **choice)
    assert (design.experiments, len(design.frequencies)) == (count, frequencies)
    for s in range(count):
        j = own(design, s)
        assert products(j, periods).isdisjoint(np.minimum(j % periods, -j % periods).tolist())


@pytest.mark.parametrize("division, lines", [("random", 12), ("disjoint", 12), ("orthogonal", 12)])
def test_several_inputs(division, lines):
    model = hj.LDTP.from_blocks(*blocks_at_random(5, (2, 1, 3, 2), 2, 3))
    design = hj.multisine(4, 8, (0, 2.0), 1.0, inputs=3, division=division)
    assert design.experiments == 3 * 4 and len(design.frequencies) == lines
    together = np.abs(design.inputs()).max(axis=1) > 0
    assert together.mean() == {"random": 1 / 3, "orthogonal": 1.0}.get(division, together.mean())
    assert together.mean() > 0.6 or division == "random"
    data = hj.experiments.simulate_experiments(model, design.realizations(2), start="periodic")
    estimate = hj.estimate_htf(data)
    assert len(estimate.f) == lines
    assert np.abs(estimate.H - model.htf(estimate.f).H).max() < 1e-11
    # As many experiments give nu times the power, and less variance.
    power = 1 / design.expected_variance()
    np.testing.assert_allclose(power, power[0, 0])
    np.testing.assert_allclose(power[0, 0], (3 if division == "orthogonal" else 1) * 4 * 8 / 4)


def test_crest_factors(hopper):
    random = hj.multisine(periods=32, band=(0, 3.0), seed=1)
    low = hj.experiments.optimize_phases(random, seed=1)
    np.testing.assert_array_equal(low.line, random.line)
    np.testing.assert_array_equal(low.amplitude, random.amplitude)
    assert random.crest_factors().mean() > 2.9 and low.crest_factors().max() < 2.3
    again = hj.Design.from_lines(
        [own(low, s) / 32 for s in range(6)] * 2,
        0.01,
        [*(low.phase[low.experiment == s] for s in range(6)),
         *(hj.experiments.optimize_phases(random, 5).phase[low.experiment == s] for s in range(6))],
        periods=32,
    )  # fmt: skip
    data = hj.experiments.simulate_experiments(hopper, again, start="periodic", discard=32)
    data = hj.experiments.add_noise(data, snr=20)
    with pytest.raises(hj.DefinitionError, match="the phases are not random: 12 of 12 signals"):
        hj.estimate_htf(data, 0, repeats=2, variance="total")
    auto = hj.estimate_htf(data, 0, repeats=2)
    assert auto.noise_variance is None
    np.testing.assert_array_equal(auto.scatter.freedom, 2)
    with pytest.raises(hj.DefinitionError, match="belong together in several experiments"):
        hj.experiments.optimize_phases(
            hj.multisine(4, 8, (0, 2.0), inputs=2, division="orthogonal")
        )


def test_realizations_pairs_and_scales():
    design = hj.multisine(8, 6, (0, 4.0), lambda f: 1 / (1 + f), lines="two-phase")
    np.testing.assert_allclose(design.amplitude, 1 / (1 + design.f))
    many = design.realizations(5, seed=2)
    assert many.experiments == 5 * design.experiments and many.cycles(0) == 5 * design.cycles(0)
    np.testing.assert_array_equal(many.f, np.tile(design.f, 5))
    assert len(np.unique(many.phase)) > 4 * len(design.f) - 20
    pairs = design.with_negatives().inputs()
    np.testing.assert_allclose(pairs[::2], design.inputs(), atol=1e-14)
    np.testing.assert_allclose(pairs[1::2], -design.inputs(), atol=1e-14)
    rms = np.sqrt(np.mean(design.scaled(0.3).inputs() ** 2, axis=1))
    np.testing.assert_allclose(rms, 0.3)
    for bad in (lambda: design.scaled(0.0), lambda: design.realizations(0)):
        with pytest.raises(hj.DefinitionError):
            bad()


def test_expected_variance_is_that_of_the_estimate():
    """Noise of unit variance as output, many realizations."""
    design = hj.multisine(4, 8, (0, 2.0), 0.5)
    many = design.realizations(400)
    u = many.inputs()
    y = np.random.default_rng(0).normal(size=(*u.shape[:2], 1))
    estimate = hj.estimate_htf(hj.ExperimentData(u, y, n_sections=4, periods=8), 0)
    expected = design.expected_variance()[:, 0] / 400
    np.testing.assert_allclose(np.mean(estimate.variance), expected.mean(), rtol=0.02)


@pytest.mark.parametrize(
    "message, arguments",
    {
        "`lines` must be 'all', 'odd' or 'two-phase', not 'even'": dict(lines="even"),
        "`division` must be 'random', 'sum-free', .*, not 'fair'": dict(division="fair"),
        "goes with division='random' or": dict(division="disjoint", lines="two-phase"),
        "an even number of periods, not 63": dict(lines="odd", periods=63),
    }.items(),
)
def test_bad_choices(message, arguments):
    with pytest.raises(hj.DefinitionError, match=message):
        hj.multisine(**arguments)
