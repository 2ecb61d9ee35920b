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
    difference = (i - j) % periods
    total = (i + j) % periods
    return difference == 0 or total == 0


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
    arguments = dict(
        n_sections=N, periods=P, frequencies=(0, top / P), lines=lines, inputs=nu
    )
    phases = phases_of_lines(N, P, top, lines)
    if not phases:
        require_refusals(N, P, arguments, seed)
        return
    # All lines that disturb j disturb each other: so many experiments are needed at least.
    crowds = []
    for j in phases:
        others = [phases[i] for i in phases if disturb(i, j, P)]
        crowds.append(sum(others))
    needed = nu * max(crowds)

    smallest = hj.multisine(**arguments, seed=seed)
    assert smallest.experiments == needed
    if needed > 1:
        with pytest.raises(hj.errors.DefinitionError, match=f"must be {needed} to "):
            hj.multisine(**arguments, seed=seed, experiments=needed - 1)

    largest = nu * sum(phases.values())
    number = min(needed + more, largest)
    design = hj.multisine(**arguments, seed=seed, experiments=number)
    assert_array_equal(design.frequencies, np.array(list(phases)) / P)
    sizes = np.bincount(design.experiment, minlength=number)
    assert sizes.min() >= 1
    if nu == 1:
        assert np.ptp(sizes) <= 1
    for experiment in range(number):
        require_undisturbed(design, experiment, P)
    for channel in range(nu):
        require_phases(design, channel, phases)


def phases_of_lines(N, P, top, lines):
    """The number of phases with which each excited line j, the frequency j / P, is excited:
    multiples of 1/2 with two or not at all."""
    phases = {}
    for j in range(top + 1):
        is_half = (2 * j) % P == 0
        inside = 0 < 2 * j < N * P
        if not is_half:
            phases[j] = 1
        elif lines == "two-phase":
            phases[j] = 2 if inside else 1
    return phases


def require_refusals(N, P, arguments, seed):
    with pytest.raises(
        hj.errors.DefinitionError, match="take more periods or a wider band"
    ):
        hj.multisine(**arguments, seed=seed)
    with pytest.raises(hj.errors.DefinitionError, match="must increase in"):
        hj.multisine(N, P, frequencies=(1.0, 0.5))


def require_undisturbed(design, experiment, P):
    """An experiment excites one input, by lines that do not disturb each other."""
    for i, j in itertools.combinations(lines_of(design, experiment), 2):
        text = f"lines {i} and {j} of {experiment}"
        assert not disturb(i, j, P), text
    channels = design.channel[design.experiment == experiment]
    assert len(set(channels)) == 1


def require_phases(design, channel, phases):
    """A channel has each line in as many phases as it takes; two are a quarter period apart."""
    for j, count in phases.items():
        is_here = (design.line == j) & (design.channel == channel)
        here = design.phase[is_here]
        assert len(here) == count
        if count == 2:
            cosine = np.cos(here[0] - here[1])
            assert abs(cosine) < 1e-12


def test_the_numbers_of_the_paper():
    paper = hj.experiments.paper_design()
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
    with pytest.raises(hj.errors.DefinitionError, match="must be 20 to 620"):
        hj.multisine(experiments=19)
    with pytest.raises(
        hj.errors.DefinitionError, match="take `periods` that 3 does not divide"
    ):
        hj.multisine(
            periods=12,
            frequencies=(0, 2.0),
            lines="all",
            experiments=9,
            division="sum-free",
        )


def test_signals_are_sums_of_cosines():
    N = 7
    P = 6
    design = hj.multisine(
        N, P, (0, 3.5), 0.2, lines="two-phase", inputs=("left", "right")
    )
    n = np.arange(9 * N)
    expected = np.zeros((design.experiments, len(n), 2))
    for k in range(len(design.line)):
        rate = 2 * np.pi * design.line[k] / (P * N)
        angle = rate * n + design.phase[k]
        wave = design.amplitude[k] * np.cos(angle)
        experiment = design.experiment[k]
        channel = design.channel[k]
        expected[experiment, :, channel] += wave
    assert_allclose(design.signals(9), expected, atol=1e-14)
    one_round = expected[:, : P * N]
    assert_allclose(design.signals(), one_round, atol=1e-14)
    squares = one_round**2
    rms_of_rounds = np.sqrt(np.mean(squares, axis=1))
    rms = rms_of_rounds.max(axis=1)
    peak = np.abs(one_round).max(axis=(1, 2))
    assert_allclose(design.crest_factors(), peak / rms, rtol=1e-12)


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
    with pytest.raises(hj.errors.DefinitionError, match=message):
        hj.experiments.Design.from_lines(BAD[message], n_sections=8, periods=8)


def test_cosines_by_hand_are_in_the_order_of_experiments():
    """Parts of signals are found by their places."""
    experiment = np.array([1, 0])
    line = np.array([1, 2])
    ones = np.ones(2)
    with pytest.raises(hj.errors.DefinitionError, match="`experiment` must ascend"):
        hj.experiments.Design(experiment, line, 0 * line, ones, ones, 8, 8, 2)


def test_a_cosine_that_stands_twice_is_named_and_not_a_line_of_two_inputs():
    frequencies = [[0.125, 0.125, 0.25, 0.25], [0.125, 0.125]]
    with pytest.raises(
        hj.errors.DefinitionError, match="experiment 0: f = 0.25 is excited twice"
    ):
        hj.experiments.Design.from_lines(
            frequencies,
            phases=[[0.0, 1.0, 0.0, 0.0], [0.0, 2.0]],
            channels=[[0, 1, 0, 0], [0, 1]],
            inputs=2,
            n_sections=8,
            periods=8,
        )


def test_half_integers_by_hand():
    twice = hj.experiments.Design.from_lines(
        [[1.5], [1.5]], 0.1, [[0.0], [1.0]], n_sections=8, periods=8
    )
    assert twice.experiments == 2
    hj.experiments.Design.from_lines(
        [[0.0, 0.5], [4.0, 0.5]], 0.1, [[0, 0], [0, 1]], n_sections=8, periods=8
    )
    with pytest.raises(
        hj.errors.DefinitionError, match="f = 0 is zero at every section"
    ):
        hj.experiments.Design.from_lines(
            [[0.0]], 0.1, np.pi / 2, n_sections=8, periods=8
        )


@pytest.mark.parametrize(
    "options, count",
    [
        (dict(lines="odd", periods=64), 20),
        (
            dict(
                lines="all",
                periods=32,
                frequencies=(0, 8.0),
                experiments=80,
                division="sum-free",
            ),
            80,
        ),
    ],
    ids=["odd", "sum-free"],
)
def test_even_products_miss_the_lines(options, count):
    """Sums and differences of odd lines; of any lines in a division that is sum-free."""
    design = hj.multisine(**options)
    assert design.experiments == count
    periods = options["periods"]

    def folded(lines):
        """Lines as they are seen once in each period."""
        smaller = np.minimum(lines % periods, -lines % periods)
        return set(smaller.ravel().tolist())

    for experiment in range(count):
        lines = np.array(lines_of(design, experiment))
        sums = folded(lines[:, None] + lines)
        differences = folded(lines[:, None] - lines)
        excited = folded(lines)
        assert excited.isdisjoint(sums)
        assert excited.isdisjoint(differences)


@pytest.mark.parametrize("division", ["random", "disjoint", "orthogonal"])
def test_several_inputs(division):
    n_inputs = 3
    n_lines = 12
    blocks = blocks_at_random(5, (2, 1, 3, 2), 2, n_inputs)
    model = hj.linear.LDTP.from_blocks(*blocks)
    design = hj.multisine(4, 8, (0, 2.0), 1.0, inputs=n_inputs, division=division)
    assert design.experiments == n_inputs * 4
    assert len(design.frequencies) == n_lines
    peaks = np.abs(design.signals()).max(axis=1)
    acts = peaks > 0
    if division == "random":
        assert acts.mean() == 1 / 3
    elif division == "orthogonal":
        assert acts.mean() == 1.0
    else:
        assert acts.mean() > 0.6

    realizations = design.realizations(2)
    data = hj.experiments.simulate_experiments(model, realizations, start="periodic")
    estimate = hj.estimate_htf(data)
    assert len(estimate.frequencies) == n_lines
    exact = model.htf(estimate.frequencies)
    assert_allclose(estimate.H, exact.H, rtol=0, atol=1e-11)

    # As many experiments give `n_inputs` times the power, and less variance.
    power = 1 / design.expected_variance()
    gain = n_inputs if division == "orthogonal" else 1
    assert_allclose(power, gain * 4 * 8 / 4)


def test_crest_factors():
    random = hj.multisine(periods=32, frequencies=(0, 3.0), seed=1)
    low = random.optimize_phases(seed=1)
    assert_array_equal(low.line, random.line)
    assert_array_equal(low.amplitude, random.amplitude)
    assert random.crest_factors().mean() > 2.9
    assert low.crest_factors().max() < 2.3
    orthogonal = hj.multisine(4, 8, (0, 2), inputs=2, division="orthogonal")
    with pytest.raises(
        hj.errors.DefinitionError, match="no phase of this design is free"
    ):
        orthogonal.optimize_phases()


def test_phases_that_are_not_random_have_no_variance_of_distortion(hopper):
    random = hj.multisine(periods=32, frequencies=(0, 3.0), seed=1)
    lines = []
    phases = []
    for seed in (1, 5):
        low = random.optimize_phases(seed=seed)
        for experiment in range(6):
            lines.append(np.array(lines_of(low, experiment)) / 32)
            phases.append(low.phase[low.experiment == experiment])
    twice = hj.experiments.Design.from_lines(lines, 0.01, phases, periods=32)
    data = hj.experiments.simulate_experiments(
        hopper, twice, start="periodic", discard=32
    )
    noisy = hj.experiments.add_noise(data, snr=20)
    with pytest.raises(
        hj.errors.DefinitionError, match=r"the phases are not random \(12 of 12"
    ):
        hj.estimate_htf(noisy, 0, repeats=2, variance="total")
    estimate = hj.estimate_htf(noisy, 0, repeats=2)
    assert estimate.noise_variance is None
    assert_array_equal(estimate.variance_dof.dof, 2)


def test_realizations_pairs_and_scales():
    design = hj.multisine(8, 6, (0, 4.0), lambda f: 1 / (1 + f), lines="two-phase")
    assert_allclose(design.amplitude, 1 / (1 + design.frequency))

    five = design.realizations(5, seed=2)
    assert five.experiments == 5 * design.experiments
    assert five.cycles(0) == 5 * design.cycles(0)
    assert_array_equal(five.frequency, np.tile(design.frequency, 5))
    different_phases = len(np.unique(five.phase))
    assert different_phases > 4 * len(design.frequency) - 20

    signals = design.signals()
    pairs = design.with_negatives().signals()
    assert_allclose(pairs[::2], signals, atol=1e-14)
    assert_allclose(pairs[1::2], -signals, atol=1e-14)

    scaled = design.scaled(0.3).signals()
    rms = np.sqrt(np.mean(scaled**2, axis=1))
    assert_allclose(rms, 0.3)
    with pytest.raises(hj.errors.DefinitionError):
        design.scaled(0.0)
    with pytest.raises(hj.errors.DefinitionError):
        design.realizations(0)


def test_expected_variance_is_that_of_the_estimate():
    """Noise of unit variance as output, many realizations."""
    design = hj.multisine(4, 8, (0, 2.0), 0.5)
    u = design.realizations(400).signals()
    rng = np.random.default_rng(0)
    y = rng.normal(size=(*u.shape[:2], 1))
    estimate = hj.estimate_htf(
        hj.experiments.ExperimentData(u, y, n_sections=4, periods=8), 0
    )
    expected = design.expected_variance()[:, 0] / 400
    assert_allclose(np.mean(estimate.variance), expected.mean(), rtol=0.02)


def test_inputs_in_another_order_are_refused():
    """By position, the amplitudes of one input would be those of another one."""
    model = hj.testing.synthetic_ldtp()
    inputs = ("u1", "u0")
    design = hj.multisine(model.n_sections, periods=4, inputs=inputs)
    with pytest.raises(
        hj.errors.DefinitionError, match="different orders of inputs: .'u1', 'u0'. and"
    ):
        hj.experiments.simulate_experiments(model, design)
    other = hj.multisine(model.n_sections, periods=4, inputs=("force", "torque"))
    assert hj.experiments.simulate_experiments(model, other).inputs == model.inputs


def test_a_random_input_has_a_sample():
    message = "shorter than half of the time between samples, 0.02"
    with pytest.raises(hj.errors.DefinitionError, match=message):
        hj.experiments.random_input(1e-3, 50, bandwidth=8)
