"""Multipliers of the made-up periodic system, and experiments on it."""

import numpy as np

import hybridjax as hj


def test_multipliers(synthetic):
    assert list(synthetic.dims) == [3, 2, 3, 2, 3, 2]
    pair = 0.3270675 + 0.0596405918293070j
    np.testing.assert_allclose(synthetic.multipliers, [pair, pair.conjugate()], rtol=1e-13)


def test_experiments_find_its_transfer_functions(synthetic):
    design = hj.multisine(n_sections=6, periods=16, band=(0, 2.0), inputs=2, amplitude=0.1)
    estimate = hj.estimate_htf(
        hj.experiments.simulate_experiments(synthetic, design, start="periodic")
    )
    assert np.max(estimate.error(synthetic.htf(estimate.f, estimate.harmonics))) < 1e-12
