"""Designs: the rules on every partition, the exact minimum, signals, bad input."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import hybridjax as hj


def disturb(i, j, periods):
    """Whether f = i / P and j / P differ by an integer or add up to one."""
    return (i - j) % periods == 0 or (i + j) % periods == 0


def lines_of(design, experiment):
    return [int(j) for j in design.line[design.experiment == experiment]]


bands = st.tuples(st.integers(1, 9), st.integers(2, 12)).flatmap(
    lambda size: st.tuples(
        st.just(size[0]), st.just(size[1]), st.integers(1, size[0] * size[1] // 2)
    )
)


@settings(max_examples=60)
@given(
    bands,
    st.integers(0, 5),
    st.sampled_from(["all", "two-phase"]),
    st.integers(1, 3),
    st.integers(0, 9),
)
def test_every_multisine_obeys_the_rules_at_the_exact_minimum(band, seed, lines, nu, more):
    N, P, top = band
    arguments = dict(n_sections=N, periods=P, band=(0, top / P), lines=lines, inputs=nu)
    wanted = [j for j in range(top + 1) if lines == "two-phase" or (2 * j) % P]
    if not wanted:
        with pytest.raises(hj.DefinitionError, match="take more periods or a wider band"):
            hj.multisine(**arguments, seed=seed)
        return
    phases = {j: 2 if (2 * j) % P == 0 and 0 < 2 * j < N * P else 1 for j in wanted}
    # All lines that disturb j disturb each other: so many experiments are needed at least.
    needed = max(sum(phases[i] for i in wanted if disturb(i, j, P)) for j in wanted)

    smallest = hj.multisine(**arguments, seed=seed)
    assert smallest.experiments == nu * needed
    if nu * needed > 1:
        with pytest.raises(hj.DefinitionError, match=f"need at least {nu * needed}"):
            hj.multisine(**arguments, seed=seed, experiments=nu * needed - 1)

    number = min(nu * needed + more, nu * sum(phases.values()))
    design = hj.multisine(**arguments, seed=seed, experiments=number)
    np.testing.assert_array_equal(design.frequencies, np.array(wanted) / P)
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
            assert abs(np.cos(here[0] - here[1])) < 1e-12


def test_the_numbers_of_the_paper():
    paper, smallest = hj.paper_design(), hj.multisine()
    both = hj.multisine(lines="two-phase")
    assert len(paper.frequencies) == len(smallest.frequencies) == 620
    assert (paper.experiments, smallest.experiments) == (80, 20)
    assert set(np.bincount(paper.experiment)) == {7, 8}
    assert set(np.bincount(smallest.experiment)) == {31}
    assert (len(both.frequencies), both.experiments) == (641, 21)
    assert paper.cycles() == 80 * 84
    assert "80 experiments of 64 periods" in repr(paper) and "620, 0.01562" in repr(paper)
    with pytest.raises(hj.DefinitionError, match="need at least 20"):
        hj.multisine(experiments=19)


def test_signals_are_sums_of_cosines():
    design = hj.multisine(7, 6, (0, 3.5), 0.2, lines="two-phase", inputs=("left", "right"))
    n = np.arange(9 * 7)
    expected = np.zeros((design.experiments, len(n), 2))
    for e, j, i, a, phase in zip(
        design.experiment, design.line, design.channel, design.amplitude, design.phase, strict=True
    ):
        expected[e, :, i] += a * np.cos(2 * np.pi * j / (6 * 7) * n + phase)
    np.testing.assert_allclose(design.inputs(9), expected, atol=1e-14)
    np.testing.assert_allclose(design.inputs(), expected[:, : 6 * 7], atol=1e-14)
    rms = np.sqrt(np.mean(expected[:, : 6 * 7] ** 2, axis=1)).max(axis=1)
    np.testing.assert_allclose(
        design.crest_factors(), np.abs(expected).max(axis=(1, 2)) / rms, rtol=1e-12
    )


BAD = {
    "experiment 1: f = 1.25 and 2.25 differ by an integer": [[0.25], [1.25, 0.125, 2.25]],
    "experiment 0: f = 0.25 and 1.75 add up to an integer": [[0.25, 1.75]],
    "experiment 0: f = 0.25 is excited twice": [[0.25, 0.25]],
    "experiment 0: f = 1.5 lies on a multiple of 1/2": [[1.5], [1.5]],
    r"experiment 1: f = 4.125 lies outside \[0, N/2 = 4": [[0.25], [4.125]],
    "experiment 0: f = -0.25 lies outside": [[-0.25]],
    "f = 0.3 is not a multiple of 1/8": [[0.3]],
    "`frequencies.0.` must be finite, but is nan": [[np.nan]],
    "needs at least one frequency": [[0.25], []],
}


@pytest.mark.parametrize("message", BAD)
def test_designs_that_break_a_rule_name_what_breaks_it(message):
    with pytest.raises(hj.DefinitionError, match=message):
        hj.Design.from_lines(BAD[message], n_sections=8, periods=8)


def test_half_integers_by_hand():
    phases = [[0.0], [1.0]]
    design = hj.Design.from_lines([[1.5], [1.5]], 0.1, phases, n_sections=8, periods=8)
    assert design.experiments == 2
    hj.Design.from_lines([[0.0, 0.5], [4.0, 0.5]], 0.1, [[0, 0], [0, 1]], n_sections=8, periods=8)
    with pytest.raises(hj.DefinitionError, match="f = 0 is zero at every section"):
        hj.Design.from_lines([[0.0]], 0.1, np.pi / 2, n_sections=8, periods=8)


@pytest.mark.parametrize(
    "message, arguments",
    {
        "must lie in": dict(band=(0, 17.0)),
        "the band from 3.0 to 2.0": dict(band=(3.0, 2.0)),
        "`periods` must be an integer from 1 to 10000000, not -2": dict(periods=-2),
        "`amplitude` must be a positive number": dict(amplitude=0.0),
        "at most 620, not 621": dict(experiments=621),
        "no line of lines='odd', a multiple of 1/64, lies": dict(band=(0, 0.01), lines="odd"),
        "2 inputs need at least 40": dict(experiments=39, inputs=2),
    }.items(),
)
def test_bad_arguments_of_multisine(message, arguments):
    with pytest.raises(hj.DefinitionError, match=message):
        hj.multisine(**arguments)
