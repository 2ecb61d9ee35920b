"""Multipliers of the made-up periodic system, and experiments on it."""

import numpy as np


def test_multipliers(synthetic):
    assert list(synthetic.dims) == [3, 2, 3, 2, 3, 2]
    pair = 0.3270675 + 0.0596405918293070j
    np.testing.assert_allclose(synthetic.multipliers, [pair, pair.conjugate()], rtol=1e-13)
