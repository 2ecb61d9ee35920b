"""Estimated multipliers beside the true ones: the pairing with the smallest sum of distances."""

import numpy as np
import pytest
import scipy.optimize

from hybridjax.identify.multiplier_estimate import compare_multipliers


@pytest.mark.parametrize(("estimated", "true"), [(1, 3), (3, 2), (2, 2), (4, 4)])
def test_no_pairing_is_closer(estimated, true):
    """Neither where each finds another nearest one, nor where they compete for it."""
    rng, competing = np.random.default_rng(0), 0
    for _ in range(20):
        found, known = (rng.normal(size=(2, n)).T @ [1, 1j] for n in (estimated, true))
        distance = np.abs(found[:, None] - known)
        rows, columns = scipy.optimize.linear_sum_assignment(distance)
        pairs = compare_multipliers(found, known)
        assert np.sum(pairs.error) == pytest.approx(distance[rows, columns].sum(), rel=1e-12)
        assert set(pairs.true) <= set(known) and len(set(pairs.estimated)) == min(estimated, true)
        competing += len(set(distance.argmin(axis=0))) < true
    assert true == 3 or 0 < competing < 20
