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
    return hj.place_sections(cycle, [hj.AtEvent("touchdown"), *levels])


@pytest.mark.slow
@pytest.mark.parametrize("name", WALKERS)
def test_A_and_B(name):
    truth = np.load(DATA / "walkers.npz")
    sections = placed(name)
    model = hj.linearize(
        sections.cycle, sections, sections.cycle.system.charts()["step"].states[0]
    )
    state, by_state, by_input = (
        truth[f"{name}.{x}"] for x in ("state", "by_state", "by_input")
    )
    assert_allclose(sections.lanes.q[:, 0], state, rtol=0, atol=1e-10)
    leg = np.pad(WALKERS[name][0], (0, len(state) - len(WALKERS[name][0])))
    d = len(state)
    for n in range(4):
        # A move in one coordinate takes the one that is left out along the section.
        out = int(sections.drop[n]) - 1
        dropped = int(sections.drop[(n + 1) % 4]) - 1
        moves = (
            np.eye(d)
            if out < 0
            else np.eye(d) - np.outer(np.eye(d)[out], leg / leg[out])
        )
        rows = np.flatnonzero(np.arange(d) != dropped)
        columns = np.flatnonzero(np.arange(d) != out)
        A = (by_state[n] @ moves)[np.ix_(rows, columns)]
        B = by_input[n][rows]
        ours = model.A[n][: len(rows), : len(columns)], model.B[n][: len(rows), 0]
        tolerance = 1e-8 * np.max(np.abs(A))
        assert_allclose(ours[0], A, rtol=0, atol=tolerance)
        tolerance = 1e-8 * np.max(np.abs(B))
        assert_allclose(ours[1], B, rtol=0, atol=tolerance)
