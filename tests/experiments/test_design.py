"""Designs: the rules on every partition, the exact minimum, signals, crest factors."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj

from ..linear.conftest import blocks_at_random, hopper as hopper


def disturb(i, j, periods):
    """Whether f = i / P and j / P differ by an integer or add up to one."""
    return (i - j) % periods == 0 or (i + j) % periods == 0


def lines_of(design, experiment):
    return [int(j) for j in design.line[design.experiment == experiment]]


bands = st.tuples(st.integers(1, 9), st.integers(2, 12)).flatmap(
    lambda n: st.tuples(st.just(n[0]), st.just(n[1]), st.integers(1, n[0] * n[1] // 2))
)


@settings(max_examples=60)
@given(
    bands,
    st.integers(0, 5),
    st.sampled_from(["all", "two-phase"]),
    st.integers(1, 3),
    st.integers(0, 9),
)
def test_every_multisine_obeys_the_rules_at_the_exact_minimum(
    band, seed, lines, nu, more
):
    N, P, top = band
    arguments = dict(n_sections=N, periods=P, band=(0, top / P), lines=lines, inputs=nu)
    wanted = [j for j in range(top + 1) if lines == "two-phase" or (2 * j) % P]
    if not wanted:
        with pytest.raises(
            hj.DefinitionError, match="take more periods or a wider band"
        ):
            hj.multisine(**arguments, seed=seed)
        with pytest.raises(hj.DefinitionError, match="must increase in"):
            hj.multisine(N, P, band=(1.0, 0.5))
        return
    phases = {j: 2 if (2 * j) % P == 0 and 0 < 2 * j < N * P else 1 for j in wanted}
    # All lines that disturb j disturb each other: so many experiments are needed at least.
    needed = max(sum(phases[i] for i in wanted if disturb(i, j, P)) for j in wanted)

    assert hj.multisine(**arguments, seed=seed).experiments == nu * needed
    if nu * needed > 1:
        with pytest.raises(hj.DefinitionError, match=f"must be {nu * needed} to "):
            hj.multisine(**arguments, seed=seed, experiments=nu * needed - 1)

    number = min(nu * needed + more, nu * sum(phases.values()))
    design = hj.multisine(**arguments, seed=seed, experiments=number)
    assert_array_equal(design.frequencies, np.array(wanted) / P)
    sizes = np.bincount(design.experiment, minlength=number)
    assert sizes.min() >= 1
    if nu == 1:
        assert np.ptp(sizes) <= 1
    for experiment in range(number):
        pairs = itertools.combinations(lines_of(design, experiment), 2)
        assert not any(disturb(i, j, P) for i, j in pairs)
        assert len(set(design.channel[design.experiment == experiment])) == 1
    for j, channel in itertools.product(wanted, range(nu)):
        here = design.phase[(design.line == j) & (design.channel == channel)]
        assert len(here) == phases[j]
        if len(here) == 2:
            error = abs(np.cos(here[0] - here[1]))
            assert error < 1e-12


def test_the_numbers_of_the_paper():
    paper = hj.paper_design()
    smallest = hj.multisine()
    both = hj.multisine(lines="two-phase")
    assert len(paper.frequencies) == len(smallest.frequencies) == 620
    assert paper.experiments == 80
    assert smallest.experiments == 20
    assert paper.cycles() == 80 * 84
    assert set(np.bincount(paper.experiment)) == {7, 8}
    assert set(np.bincount(smallest.experiment)) == {31}
    assert len(both.frequencies) == 641
    assert both.experiments == 21
    assert "80 experiments of 64 periods" in repr(paper)
    assert "620, 0.01562" in repr(paper)
    with pytest.raises(hj.DefinitionError, match="must be 20 to 620"):
        hj.multisine(experiments=19)
    with pytest.raises(
        hj.DefinitionError, match="take `periods` that 3 does not divide"
    ):
        hj.multisine(
            periods=12, band=(0, 2.0), lines="all", experiments=9, division="sum-free"
        )


def test_signals_are_sums_of_cosines():
    design = hj.multisine(
        7, 6, (0, 3.5), 0.2, lines="two-phase", inputs=("left", "right")
    )
    n = np.arange(9 * 7)
    expected = np.zeros((design.experiments, len(n), 2))
    for e, j, i, a, phase in zip(
        design.experiment,
        design.line,
        design.channel,
        design.amplitude,
        design.phase,
        strict=True,
    ):
        expected[e, :, i] += a * np.cos(2 * np.pi * j / (6 * 7) * n + phase)
    assert_allclose(design.inputs(9), expected, atol=1e-14)
    assert_allclose(design.inputs(), expected[:, : 6 * 7], atol=1e-14)
    rms = np.sqrt(np.mean(expected[:, : 6 * 7] ** 2, axis=1)).max(axis=1)
    assert_allclose(
        design.crest_factors(), np.abs(expected).max(axis=(1, 2)) / rms, rtol=1e-12
    )


BAD = {
    "experiment 1: f = 1.25 and 2.25 differ by an integer": [
        [0.25],
        [1.25, 0.125, 2.25],
    ],
    "experiment 0: f = 0.25 and 1.75 add up to an integer": [[0.25, 1.75]],
    "experiment 0: f = 0.25 is excited twice": [[0.25, 0.25]],
    "experiment 0: f = 1.5 lies on a multiple of 1/2": [[1.5], [1.5]],
    r"experiment 1: f = 4.125 lies outside \[0, N/2 = 4": [[0.25], [4.125]],
    "experiment 0: f = -0.25 lies outside": [[-0.25]],
    "f = 0.3 is not a multiple of 1/8": [[0.3]],
    "`frequencies.0.` must be finite, but is nan": [[np.nan]],
    "needs a frequency": [[0.25], []],
}


@pytest.mark.parametrize("message", BAD)
def test_designs_that_break_a_rule_name_what_breaks_it(message):
    with pytest.raises(hj.DefinitionError, match=message):
        hj.Design.from_lines(BAD[message], n_sections=8, periods=8)


def test_half_integers_by_hand():
    design = hj.Design.from_lines(
        [[1.5], [1.5]], 0.1, [[0.0], [1.0]], n_sections=8, periods=8
    )
    assert design.experiments == 2
    hj.Design.from_lines(
        [[0.0, 0.5], [4.0, 0.5]], 0.1, [[0, 0], [0, 1]], n_sections=8, periods=8
    )
    with pytest.raises(hj.DefinitionError, match="f = 0 is zero at every section"):
        hj.Design.from_lines([[0.0]], 0.1, np.pi / 2, n_sections=8, periods=8)


@pytest.mark.parametrize("lines, periods, count", [("odd", 64, 20), ("all", 32, 80)])
def test_even_products_miss_the_lines(lines, periods, count):
    """Sums and differences of odd lines; of any lines in a division that is sum-free."""
    more = (
        {}
        if lines == "odd"
        else dict(band=(0, 8.0), experiments=count, division="sum-free")
    )
    design = hj.multisine(periods=periods, lines=lines, **more)
    assert design.experiments == count
    for s in range(count):
        j = np.array(lines_of(design, s))
        both = (
            np.concatenate([(j[:, None] + j).ravel(), (j[:, None] - j).ravel()])
            % periods
        )
        products = set(np.minimum(both, periods - both).tolist())
        assert products.isdisjoint(np.minimum(j % periods, -j % periods).tolist())


@pytest.mark.parametrize("division", ["random", "disjoint", "orthogonal"])
def test_several_inputs(division, lines=12):
    model = hj.LDTP.from_blocks(*blocks_at_random(5, (2, 1, 3, 2), 2, 3))
    design = hj.multisine(4, 8, (0, 2.0), 1.0, inputs=3, division=division)
    assert design.experiments == 3 * 4
    assert len(design.frequencies) == lines
    together = np.abs(design.inputs()).max(axis=1) > 0
    assert together.mean() == {"random": 1 / 3, "orthogonal": 1.0}.get(
        division, together.mean()
    )
    assert together.mean() > 0.6 or division == "random"
    data = hj.experiments.simulate_experiments(
        model, design.realizations(2), start="periodic"
    )
    estimate = hj.estimate_htf(data)
    assert len(estimate.f) == lines
    error = np.abs(estimate.H - model.htf(estimate.f).H).max()
    assert error < 1e-11
    # As many experiments give nu times the power, and less variance.
    power = 1 / design.expected_variance()
    assert_allclose(power, power[0, 0])
    expected = (3 if division == "orthogonal" else 1) * 4 * 8 / 4
    assert_allclose(power[0, 0], expected)


def test_crest_factors(hopper):
    random = hj.multisine(periods=32, band=(0, 3.0), seed=1)
    low = hj.experiments.optimize_phases(random, seed=1)
    assert_array_equal(low.line, random.line)
    assert_array_equal(low.amplitude, random.amplitude)
    assert random.crest_factors().mean() > 2.9
    assert low.crest_factors().max() < 2.3
    again = hj.Design.from_lines(
        [np.array(lines_of(low, s)) / 32 for s in range(6)] * 2,
        0.01,
        [
            *(low.phase[low.experiment == s] for s in range(6)),
            *(
                hj.experiments.optimize_phases(random, 5).phase[low.experiment == s]
                for s in range(6)
            ),
        ],
        periods=32,
    )
    data = hj.experiments.simulate_experiments(
        hopper, again, start="periodic", discard=32
    )
    data = hj.experiments.add_noise(data, snr=20)
    with pytest.raises(
        hj.DefinitionError, match=r"the phases are not random \(12 of 12"
    ):
        hj.estimate_htf(data, 0, repeats=2, variance="total")
    auto = hj.estimate_htf(data, 0, repeats=2)
    assert auto.noise_variance is None
    assert_array_equal(auto.scatter.freedom, 2)
    with pytest.raises(hj.DefinitionError, match="no phase of this design is free"):
        hj.experiments.optimize_phases(
            hj.multisine(4, 8, (0, 2), inputs=2, division="orthogonal")
        )


def test_realizations_pairs_and_scales():
    design = hj.multisine(8, 6, (0, 4.0), lambda f: 1 / (1 + f), lines="two-phase")
    assert_allclose(design.amplitude, 1 / (1 + design.f))
    many = design.realizations(5, seed=2)
    assert many.experiments == 5 * design.experiments
    assert many.cycles(0) == 5 * design.cycles(0)
    assert_array_equal(many.f, np.tile(design.f, 5))
    assert len(np.unique(many.phase)) > 4 * len(design.f) - 20
    pairs = design.with_negatives().inputs()
    assert_allclose(pairs[::2], design.inputs(), atol=1e-14)
    assert_allclose(pairs[1::2], -design.inputs(), atol=1e-14)
    measured = np.sqrt(np.mean(design.scaled(0.3).inputs() ** 2, axis=1))
    assert_allclose(measured, 0.3)
    for bad in (lambda: design.scaled(0.0), lambda: design.realizations(0)):
        with pytest.raises(hj.DefinitionError):
            bad()


def test_expected_variance_is_that_of_the_estimate():
    """Noise of unit variance as output, many realizations."""
    design = hj.multisine(4, 8, (0, 2.0), 0.5)
    u = design.realizations(400).inputs()
    rng = np.random.default_rng(0)
    y = rng.normal(size=(*u.shape[:2], 1))
    estimate = hj.estimate_htf(hj.ExperimentData(u, y, n_sections=4, periods=8), 0)
    expected = design.expected_variance()[:, 0] / 400
    assert_allclose(np.mean(estimate.variance), expected.mean(), rtol=0.02)


def test_inputs_in_another_order_are_refused():
    """By position, the amplitudes of one input would be those of another one."""
    model = hj.testing.synthetic_ldtp()
    inputs = ("u1", "u0")
    design = hj.multisine(model.n_sections, periods=4, inputs=inputs)
    with pytest.raises(
        hj.DefinitionError, match="different orders of inputs: .'u1', 'u0'. and"
    ):
        hj.experiments.simulate_experiments(model, design)
    other = hj.multisine(model.n_sections, periods=4, inputs=("force", "torque"))
    assert hj.experiments.simulate_experiments(model, other).inputs == model.inputs
