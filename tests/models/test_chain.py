"""The chain of bouncing masses: `python benchmarks/chain_truth.py` made the truth."""

import json

import numpy as np
import pytest

import hybridjax as hj

from ..conftest import DATA


TRUTH = json.loads((DATA / "bouncing_chain.json").read_text())


@pytest.mark.parametrize("n", [2, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 5, 10))])
def test_the_cycle_and_its_multipliers(n):
    cycle, truth = hj.find_limit_cycle(hj.models.BouncingChain(n=n)), TRUTH[str(n)]
    np.testing.assert_allclose(list(cycle.state.values()), truth["state"], atol=1e-12)
    exact = np.array(truth["multipliers"]) @ [1, 1j]
    apart = np.abs(exact[:, None] - cycle.multipliers)
    assert apart.min(axis=0).max() < 1e-12
    assert apart.min(axis=1).max() < 1e-12
    events = cycle.trajectory().events
    np.testing.assert_allclose([e.time for e in events], [t for t, _ in truth["impacts"]])
    assert [e.name for e in events] == [f"impact {i}" for _, i in truth["impacts"]]
