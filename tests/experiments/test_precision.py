"""Experiments in single precision: right to the error that they report, or refused."""

import numpy as np
import pytest

import hybridjax as hj

from ..conftest import OUTPUTS


N, CYCLES = 32, 84
SINGLE = hj.Execution(batch=40, precision="single")


@pytest.fixture(scope="module")
def design():
    return hj.paper_design()


@pytest.fixture(scope="module", params=("isochron", "kinematic"))
def both(request, hopper_cycle, design):
    """Placed sections, and the same experiments in double and in single precision."""
    placed = request.getfixturevalue(
        {"isochron": "placed_isochrons", "kinematic": "placed_kinematic"}[request.param]
    )
    double = hj.run_experiments(hopper_cycle, placed, design, OUTPUTS)
    single = hj.run_experiments(hopper_cycle, placed, design, OUTPUTS, execution=SINGLE)
    return placed, double, single


def test_errors_are_those_reported(both):
    _, double, single = both
    assert single.summary() == "80/80 ok" and single.y.dtype == np.float64
    size = np.abs(np.asarray(double.cycle_outputs)).max(axis=0)
    true = np.max(np.abs(single.y - double.y) / size, axis=(1, 2))
    assert np.all(true > 1e-8), "this was not single precision"
    assert np.all(true <= single.error) and np.all(single.error < 1e-4)
    assert np.median(single.error / true) < 30


def test_transfer_functions_are_those_of_double_precision(both):
    _, double, single = both
    exact, rounded = (hj.estimate_htf(data) for data in (double, single))
    assert np.max(rounded.error(exact)) < 5e-4


def test_a_failing_experiment_leaves_the_others_intact(hopper_cycle, both, design):
    placed, _, single = both
    u = design.inputs(CYCLES)
    u[17, 3 * N : 4 * N] = 60.0
    broken = hj.run_experiments(hopper_cycle, placed, u, OUTPUTS, discard=20, execution=SINGLE)
    assert list(np.flatnonzero(~broken.ok)) == [17]
    others = np.arange(80) != 17
    difference = np.max(np.abs(broken.y[others] - single.y[others]), axis=(1, 2))
    assert np.all(difference <= 2 * np.max(single.error))
    assert np.all(np.isnan(broken.y[17, broken.failed_at[17] + 1 :]))


def test_what_single_precision_cannot_give_is_refused(hopper_cycle, both, design):
    placed = both[0]
    with pytest.raises(hj.DefinitionError, match="single precision leaves errors of about .*e-0"):
        hj.run_experiments(hopper_cycle, placed, design, OUTPUTS, accuracy=1e-7, execution=SINGLE)
