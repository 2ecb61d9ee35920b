"""Cycles of a family, chosen by a quantity that the system conserves.

Numbers of the SLIP runner were computed apart from this package, with DOP853 and mpmath to 34
digits.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj

from ..toys import Field, toy


APEX = hj.Crossing("vy", "falling")


@pytest.fixture(scope="module")
def running():
    return hj.find_limit_cycle(
        hj.models.SLIPRunner(), section=APEX, conserved={"energy": 1784.8}
    )


@pytest.mark.slow
def test_one_cycle_of_a_family(running):
    state = [running.state["y"], running.state["vx"]]
    assert_allclose(state, [0.940267144379607, 5.11585365577165], rtol=1e-12)
    assert_allclose(running.period, 0.252532613817573, rtol=1e-11)
    assert_allclose(running.multipliers, [1, -0.161307631037475], rtol=1e-10)
    assert running.multipliers[0] == 1
    assert running.is_stable
    assert "(1: conserved energy)" in repr(running)


@pytest.mark.slow
def test_what_is_not_conserved_is_refused():
    with pytest.raises(hj.errors.DefinitionError, match="'y' is not conserved"):
        hj.find_limit_cycle(hj.models.SLIPRunner(), section=APEX, conserved={"y": 0.94})


@pytest.mark.slow
def test_derivatives_at_a_fixed_energy_and_by_the_energy(running):
    def height(k, energy):
        runner = eqx.tree_at(lambda x: x.k, running.system, k)
        cycle = hj.find_limit_cycle(runner, running, conserved={"energy": energy})
        return cycle.anchor.q[0, 0]

    k = jnp.array(20000.0)
    energy = jnp.array(1784.8)
    along_k = (1.0, 0.0)
    _, by_k = jax.jvp(height, (k, energy), along_k)
    along_energy = (0.0, 1.0)
    _, by_energy = jax.jvp(height, (k, energy), along_energy)
    above = height(k + 4.0, energy)
    difference = above - height(k - 4.0, energy)
    assert_allclose(by_k, difference / 8.0, rtol=1e-5)
    more = height(k, energy + 0.05)
    difference = more - height(k, energy - 0.05)
    assert_allclose(by_energy, difference / 0.1, rtol=1e-5)


ENERGY = hj.Output("energy", lambda t, q, u: (q[0] ** 2 + q[1] ** 2) / 2)


# x'' = -x, whose cycles are circles.
def rates(t, q, u):
    return (q[1], -q[0])


chart = Field(("x", "v"), rates)
CIRCLES = toy({"a": chart}, outputs=(ENERGY,))


def find(**conserved):
    section = hj.Crossing("x", "rising")
    guess = hj.Guess("a", (0.0, 1.1))
    return hj.find_limit_cycle(CIRCLES, guess, section=section, conserved=conserved)


def test_the_circle_of_an_energy():
    cycle = find(energy=2.0)
    assert_allclose(cycle.state["v"], 2.0, rtol=1e-10)
    assert_allclose(float(cycle.period), 2 * np.pi, rtol=1e-10)
    assert_array_equal(cycle.multipliers, [1.0])


def test_what_could_be_given_is_said():
    with pytest.raises(
        hj.errors.ComputationError, match=r"conserved=\{'energy': 0\.605"
    ):
        find()
