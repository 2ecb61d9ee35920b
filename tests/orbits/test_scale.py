"""What counts as 1 in each state, before a cycle is known and on it."""

import dataclasses

import numpy as np
import pytest

import hybridjax as hj


@pytest.mark.slow
@pytest.mark.parametrize("factor", [100.0, 0.5])
def test_a_cycle_is_as_accurate_from_other_sizes(factor):
    cycle = hj.find_limit_cycle(hj.models.PaddleJuggler())
    settings = dataclasses.replace(cycle.settings, scale=factor * cycle.settings.scale)
    again = hj.find_limit_cycle(cycle.system, dataclasses.replace(cycle, settings=settings))
    assert again.residual < 1e-13
    np.testing.assert_allclose(again.anchor.q, cycle.anchor.q, rtol=1e-11, atol=1e-12)
    y, v = (np.abs(np.asarray(again.legs.q[k])).max() for k in (0, 1))
    assert again.scale == pytest.approx({"y": y, "v": v})
