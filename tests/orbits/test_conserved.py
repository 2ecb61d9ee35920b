"""Cycles of a family, chosen by a quantity that the system conserves."""

import numpy as np
import pytest

import hybridjax as hj

from ..toys import Field


class Oscillator(hj.HybridSystem):
    """x'' = -x, whose cycles are circles."""

    def charts(self):
        return {"a": Field(("x", "v"), lambda t, q, u: (q[1], -q[0]))}

    def outputs(self):
        energy = lambda t, q, u: (q[0] ** 2 + q[1] ** 2) / 2  # noqa: E731
        return (hj.Output("energy", energy),)


def find(**conserved):
    section = hj.Crossing("x", "rising")
    guess = hj.Guess("a", (0.0, 1.1))
    return hj.find_limit_cycle(Oscillator(), guess, section=section, conserved=conserved)


def test_the_circle_of_an_energy():
    cycle = find(energy=2.0)
    np.testing.assert_allclose(cycle.state["v"], 2.0, rtol=1e-10)
    np.testing.assert_allclose(float(cycle.period), 2 * np.pi, rtol=1e-10)
    np.testing.assert_array_equal(cycle.multipliers, [1.0])


def test_what_could_be_given_is_said():
    with pytest.raises(hj.ComputationError, match=r"conserved=\{'energy': 0\.605"):
        find()
