"""Definitions keep their digits, whenever JAX is switched to 64 bits; all else is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj

from ..conftest import ISOCHRONS, OUTPUTS


DEFINITIONS = {
    "system": lambda: hj.models.VerticalHopper(k=10.1),
    "guess": lambda: hj.Guess("stance", (2.1, 1.9), time=0.1),
    "settings": lambda: hj.orbits.Settings(1e-11, 1e-13, scale=np.full((2, 4), 0.1)),
    "crossing": lambda: hj.Crossing("vM", "falling", value=0.1),
    "clock": lambda: hj.ClockPhase(8, anchor=0.1),
    "kinematic": lambda: hj.KinematicPhase(
        8, "yM", "vM", (1.9, 0.1), [0.3, 1.9], anchor=0.2
    ),
    "schedule": lambda: hj.systems.Scheduled(0.1, 0.7),
}


@pytest.mark.parametrize("define", DEFINITIONS.values(), ids=DEFINITIONS)
def test_definitions_may_be_built_before_the_switch(define):
    with jax.enable_x64(False):
        early = define()
    numbers = [jax.tree_util.tree_leaves(x) for x in (early, define())]
    for a, b in zip(*numbers, strict=True):
        assert (
            a == b
            if isinstance(a, str)
            else a.dtype == b.dtype == float and (a == b).all()
        )


def test_arrays_that_have_lost_their_digits_are_refused():
    with jax.enable_x64(False):
        k = jnp.asarray(10.1)
        early = hj.models.VerticalHopper(k=k)
        guess = hj.Guess("stance", jnp.asarray([2.0, 1.9]))
    with pytest.raises(
        hj.errors.PrecisionError, match="`k` is float32: it was built before"
    ):
        hj.find_limit_cycle(early)
    with pytest.raises(hj.errors.PrecisionError, match="`state` is float32"):
        hj.find_limit_cycle(hj.models.VerticalHopper(), guess)


@pytest.fixture(scope="module")
def late(hopper_cycle, placed_isochrons, isochron_ldtp):
    """Calls for a time when JAX has been switched back to 32 bits."""
    cycle, placed, ldtp = hopper_cycle, placed_isochrons, isochron_ldtp
    hopper = cycle.system
    design = hj.multisine()
    u = np.zeros((1, 32, 1))
    response = hj.experiments.response_function(cycle, placed, OUTPUTS)
    map = hj.sections.section_map(cycle, placed, 0, 1)
    htf = ldtp.htf([0.1])
    return {
        "simulate": lambda: hj.simulate(hopper, "stance", (2.0, 1.9), 1.0),
        "find_limit_cycle": lambda: hj.find_limit_cycle(hopper, cycle),
        "continuation": lambda: hj.continuation(cycle, "M", (1.9, 2.0)),
        "place_sections": lambda: hj.sections.place_sections(cycle, ISOCHRONS),
        "linearize": lambda: hj.linearize(cycle, placed),
        "section_map": lambda: map(map.fixed_point),
        "observe": lambda: placed.observe(OUTPUTS),
        "run_experiments": lambda: hj.run_experiments(cycle, placed, design, OUTPUTS),
        "response": lambda: response(u),
        "LDTP": lambda: hj.linear.LDTP(ldtp.A, ldtp.B, ldtp.C),
        "LDTP.simulate": lambda: ldtp.simulate(u[0]),
        "LDTP.htf": lambda: ldtp.htf([0.1]),
        "HTF": lambda: hj.linear.HTF([0.1], np.ones((1, 1, 1, 1)), [0], 4),
        "HTF.error": lambda: htf.error(htf),
    }


def test_single_precision_is_refused_at_the_call(late):
    with jax.enable_x64(False):
        for name, call in late.items():
            with pytest.raises(
                hj.errors.PrecisionError, match="call `hybridjax.enable_x64"
            ):
                call()
                pytest.fail(name)
