import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj


@pytest.fixture(scope="module")
def hoppers():
    """Three that are near the paper's, one that is in the air when its clock is at 0.5, and one
    that has no cycle with a touchdown: its spring pushes nothing."""
    k, b = jnp.array([8.0, 10.0, 13.0, 13.0, 0.0]), jnp.array([3.0, 5.0, 7.0, 3.0, 5.0])
    return eqx.filter_vmap(lambda k, b: hj.models.VerticalHopper(k=k, b=b))(k, b)


@pytest.fixture(scope="module")
def found(hoppers, hopper_cycle):
    return hj.find_limit_cycles(hoppers, hopper_cycle)


def test_each_is_the_cycle_that_is_found_alone(found):
    for i in range(4):
        cycle = found[i]
        alone = hj.find_limit_cycle(cycle.system, cycle)
        assert cycle.order == alone.order
        np.testing.assert_allclose(cycle.start.q, alone.start.q, atol=1e-9)
        np.testing.assert_allclose(found.multipliers[i, :2], alone.multipliers, atol=1e-8)
        np.testing.assert_allclose(cycle.multipliers, alone.multipliers, atol=1e-8)
    assert np.all(found.residual[:4] <= 1e-10)
    np.testing.assert_allclose(found.multipliers[:4, 2:], 0.0, atol=1e-9)


def test_charts_may_differ(found):
    assert len(np.unique(found.start.chart[:4])) == 2


def test_failures_are_reported_by_index(found):
    np.testing.assert_array_equal(found.failed, [4])
    assert np.isnan(found.multipliers[4]).all() and np.isfinite(found.multipliers[:4]).all()
    assert found.summary().startswith("4/5 found; #4: ")


def test_a_list_of_systems_is_the_same(found, hopper_cycle):
    systems = [found[i].system for i in range(5)]
    again = hj.find_limit_cycles(systems, hopper_cycle)
    np.testing.assert_array_equal(again.start.q, found.start.q)


def test_bad_arguments(hopper_cycle):
    one = hj.models.VerticalHopper()
    with pytest.raises(hj.DefinitionError, match="the same leading axis"):
        hj.find_limit_cycles(one, hopper_cycle)
    with pytest.raises(hj.DefinitionError, match="all of the same class"):
        hj.find_limit_cycles([one, hj.models.VanDerPol()], hopper_cycle)
    with pytest.raises(hj.DefinitionError, match="all of the same class"):
        hj.find_limit_cycles([], hopper_cycle)
