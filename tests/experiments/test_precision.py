"""Experiments in single precision: right to the error that they report, or refused."""

import numpy as np
import pytest

import hybridjax as hj

from ..conftest import OUTPUTS


N, CYCLES = 32, 12
BATCH = dict(batch=40, discard=0)


@pytest.fixture(scope="module", params=("isochron", "kinematic"))
def both(request, hopper_cycle):
    """Placed sections, and the same 40 experiments in both precisions."""
    placed = request.getfixturevalue(
        {"isochron": "placed_isochrons", "kinematic": "placed_kinematic"}[request.param]
    )
    u = hj.paper_design().inputs(CYCLES)[::2]
    go = hopper_cycle, placed, u, OUTPUTS
    return placed, *(
        hj.run_experiments(*go, **BATCH, accuracy=a, precision=p)
        for p, a in (("double", 1e-9), ("single", 1e-4))
    )


def test_errors_are_those_reported(both):
    placed, double, single = both
    assert single.summary() == "40/40 ok"
    size = np.abs(np.asarray(double.cycle_outputs)).max(axis=0)
    true = np.max(np.abs(single.y - double.y) / size, axis=(1, 2))
    assert np.all(true < single.error) and np.all(single.error < 1e-5)
    assert np.all(true > 1e-9), "this was not single precision"
    assert np.median(single.error / true) < 30
