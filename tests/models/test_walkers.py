"""Linearizations of the walkers with feedback.

The truth is `benchmarks/walkers_truth.py`: differences of another simulation, equations by hand.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj

from ..conftest import DATA


# Walkers, the angles that make up that of the stance leg, and its levels.
WALKERS = {
    "TorsoWalker": ([1.0, 0, 0], (-0.2, 0.0, 0.2)),
    "FiveLinkBiped": ([0.5, 0.5, 0, 0, 0], (-0.1, 0.0, 0.1)),
}


def placed(name):
    leg, levels = WALKERS[name]

    def angle(t, q):
        return np.array(leg) @ q[: len(leg)]

    levels = [hj.Crossing(angle, "rising", level) for level in levels]
    cycle = hj.find_limit_cycle(getattr(hj.models, name)())
    return hj.sections.place_sections(cycle, [hj.AtEvent("touchdown"), *levels])


def along_section(left_out, leg):
    """Moves in one coordinate take the one that is left out along the section."""
    moves = np.eye(len(leg))
    if left_out >= 0:
        moves[left_out] -= leg / leg[left_out]
    return moves


@pytest.mark.slow
@pytest.mark.parametrize("name", WALKERS)
def test_A_and_B(name):
    truth = np.load(DATA / "walkers.npz")
    state = truth[f"{name}.state"]
    by_state = truth[f"{name}.by_state"]
    by_input = truth[f"{name}.by_input"]
    sections = placed(name)
    assert_allclose(sections.lanes.q[:, 0], state, rtol=0, atol=1e-10)
    output = sections.cycle.system.charts()["step"].states[0]
    model = hj.linearize(sections.cycle, sections, output)

    d = len(state)
    leg = np.zeros(d)
    values = WALKERS[name][0]
    leg[: len(values)] = values
    for n in range(4):
        out_before = int(sections.drop[n]) - 1
        dropped = int(sections.drop[(n + 1) % 4])
        out_after = dropped - 1
        rows = np.flatnonzero(np.arange(d) != out_after)
        columns = np.flatnonzero(np.arange(d) != out_before)
        moved = by_state[n] @ along_section(out_before, leg)
        A = moved[np.ix_(rows, columns)]
        B = by_input[n][rows]
        tolerance = 1e-8 * np.max(np.abs(A))
        whole = model.A[n]
        found = whole[: len(rows), : len(columns)]
        assert_allclose(found, A, rtol=0, atol=tolerance, err_msg=f"A[{n}]")
        tolerance = 1e-8 * np.max(np.abs(B))
        found = model.B[n][: len(rows), 0]
        assert_allclose(found, B, rtol=0, atol=tolerance, err_msg=f"B[{n}]")
