"""What counts as 1 in each state, before a cycle is known and on it."""

import dataclasses

import numpy as np
import pytest

import hybridjax as hj
from hybridjax.orbits import find, newton


@pytest.mark.parametrize(
    "factor, solved", [(100.0, 2), pytest.param(2.0, 1, marks=pytest.mark.slow)]
)
def test_a_cycle_is_solved_again_only_if_its_sizes_were_too_large(monkeypatch, factor, solved):
    """With sizes that are too small it was found more accurately than asked."""
    cycle = hj.find_limit_cycle(hj.models.PaddleJuggler())
    settings = dataclasses.replace(cycle.settings, scale=factor * cycle.settings.scale)
    solutions, solve = [], newton.solve

    def counted(*arguments):
        solutions.append(solve(*arguments))
        return solutions[-1]

    monkeypatch.setattr(find, "solve", counted)
    monkeypatch.setattr(newton, "solve", counted)
    again = hj.find_limit_cycle(cycle.system, dataclasses.replace(cycle, settings=settings))
    assert len(solutions) == solved
    assert again.residual < 1e-13
    np.testing.assert_allclose(again.anchor.q, cycle.anchor.q, rtol=1e-11, atol=1e-12)
    y, v = (np.abs(np.asarray(again.legs.q[k])).max() for k in (0, 1))
    assert again.scale == pytest.approx({"y": y, "v": v})
