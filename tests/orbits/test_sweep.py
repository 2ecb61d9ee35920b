import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj
from hybridjax._core.compilation import is_left_to_lapack, one_tier
from hybridjax.orbits import batches


ONES = np.ones(2)
FOUR = hj.Execution(batch=4)


@pytest.fixture(scope="module")
def hoppers():
    """Three that are near the paper's, one that is in the air when its clock is at 0.5, and one
    that has no cycle with a touchdown: its spring pushes nothing."""
    k, b = jnp.array([8.0, 10.0, 13.0, 13.0, 0.0]), jnp.array([3.0, 5.0, 7.0, 3.0, 5.0])
    return eqx.filter_vmap(lambda k, b: hj.models.VerticalHopper(k=k, b=b))(k, b)


@pytest.fixture(scope="module")
def found(hoppers, hopper_cycle):
    return hj.find_limit_cycles(hoppers, hopper_cycle)


@pytest.mark.slow
def test_each_is_the_cycle_that_is_found_alone(found):
    for i in range(4):
        cycle = found[i]
        alone = hj.find_limit_cycle(cycle.system, cycle)
        assert cycle.event_sequence == alone.event_sequence
        np.testing.assert_allclose(cycle.anchor.q, alone.anchor.q, atol=1e-9)
        np.testing.assert_allclose(found.multipliers[i, :2], alone.multipliers, atol=1e-8)
        np.testing.assert_allclose(cycle.multipliers, alone.multipliers, atol=1e-8)
    assert np.all(found.residual[:4] <= 1e-10)
    assert len(np.unique(found.anchor.chart[:4])) == 2  # also in other charts
    np.testing.assert_allclose(found.multipliers[:4, 2:], 0.0, atol=1e-9)


@pytest.fixture(scope="module")
def wheel():
    return hj.find_limit_cycle(hj.models.RimlessWheel(slope=0.08), section=hj.AtEvent("impact"))


def test_without_a_clock_and_in_waves(wheel):
    """The wheel's multiplier is cos(2 pi / 8)^2 = 1/2 at any slope. At steep ones a step is so
    much shorter than the guess's that the flow from one impact passes the next."""
    slopes = np.linspace(0.08, 0.16, 11)
    systems = [hj.models.RimlessWheel(slope=x) for x in slopes]
    found = hj.find_limit_cycles(systems, wheel, execution=FOUR)
    assert found.ok.all() and np.all(np.diff(found.period) < 0)
    assert found.period[-1] < 0.7 * wheel.period
    np.testing.assert_allclose(found.multipliers[:, 0], 0.5, atol=1e-7)
    assert {found[i].event_sequence for i in range(11)} == {(0,)}


def test_systems_that_are_alike_or_undefined(wheel):
    """Neither takes the others down with it."""
    slopes = jnp.array([0.08] * 9 + [np.nan, 0.08])
    wheels = eqx.filter_vmap(lambda x: hj.models.RimlessWheel(slope=x))(slopes)
    found = hj.find_limit_cycles(wheels, wheel, execution=FOUR)
    np.testing.assert_array_equal(found.failed, [9])
    assert np.isnan(found.multipliers[9]).all() and np.isfinite(found.multipliers[:9]).all()
    assert found.summary().startswith("10/11 found; #9: ")
    alike = hj.find_limit_cycles([found[0].system] * 6, wheel, execution=FOUR)
    assert alike.ok.all()


def test_programs_in_threads_factorize_nothing(wheel):
    """XLA's pool would deadlock on LAPACK's calls for many matrices at once."""
    systems = eqx.filter_vmap(lambda x: hj.models.RimlessWheel(slope=x))(wheel.system.slope * ONES)
    repeat = lambda x: np.repeat(np.asarray(x)[None], 2, 0)  # noqa: E731
    start, period = jax.tree_util.tree_map(repeat, (wheel.anchor, wheel.period))
    arguments = systems, wheel.return_map, start, period, jnp.array(True)
    assert not is_left_to_lapack(one_tier(batches._turn, False), *arguments)


def test_a_guess_with_too_long_a_period(wheel):
    cycle = hj.find_limit_cycle(hj.models.RimlessWheel(slope=0.16), wheel)
    assert cycle.event_sequence == (0,) and cycle.period < 0.7 * wheel.period
    np.testing.assert_allclose(cycle.multipliers, [0.5], rtol=1e-9)
