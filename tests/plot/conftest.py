import pytest

import hybridjax as hj

from ..linear.conftest import hopper as hopper


@pytest.fixture(scope="session")
def estimate(hopper):
    design = hj.multisine(periods=16, frequencies=(0, 4.0))
    data = hj.experiments.simulate_experiments(hopper, design, start="periodic")
    return hj.estimate_htf(data, (-1, 0, 1))


@pytest.fixture(scope="session")
def exact(hopper, estimate):
    return hopper.htf(estimate.frequencies, (-1, 0, 1))


@pytest.fixture(scope="session")
def rational(estimate):
    return hj.identify.fit_rational(estimate)


@pytest.fixture(scope="session")
def structured(estimate):
    return hj.fit_multipliers(estimate, 2, extra_lags=16)
