"""Derivatives of HTFs, states on sections and event times by the hopper's parameters.

`sensitivity` holds p dr/dp of the residuals, in forward mode. The hopper has exact identities: a
change of the unit of force scales m, M, k, b and a together, which the HTFs from a force answer by
the inverse factor and the cycle not at all; and a change of the unit of length scales a, g and l0.
"""

import equinox as eqx
import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj

from ..conftest import OUTPUTS
from .conftest import HOPPER, SECTIONS


pytestmark = pytest.mark.slow
FORCES = [HOPPER.index(name) for name in ("m", "M", "k", "b", "a")]
STEP = 1e-5


def flat(H):
    real = np.asarray(H).real.ravel()
    imaginary = np.asarray(H).imag.ravel()
    return np.concatenate([real, imaginary])


def by_differences(cycle, look):
    """p d(look)/dp for each parameter, by central differences."""

    def at(name, factor):
        value = getattr(cycle.system, name) * factor
        system = eqx.tree_at(lambda s: getattr(s, name), cycle.system, value)
        return look(hj.find_limit_cycle(system, cycle)) / (2 * STEP)

    return np.stack(
        [at(name, 1 + STEP) - at(name, 1 - STEP) for name in HOPPER], axis=-1
    )


def test_htfs(hopper_htf, seen_in_htf):
    S = seen_in_htf.sensitivity
    weights = np.asarray(hj.fitting.ObservedHTF(hopper_htf, SECTIONS).weights)
    scaled = flat(np.asarray(hopper_htf.H) * weights)
    size = np.abs(S).max()
    by_forces = S[:, FORCES].sum(axis=1)
    assert_allclose(by_forces, -scaled, atol=1e-9 * size)
    by_length = S[:, HOPPER.index("l0")]
    assert_allclose(by_length, 0, atol=1e-9 * size)
    by_gravity = S[:, HOPPER.index("g")]
    by_both = S[:, HOPPER.index("a")] + by_gravity
    assert np.abs(by_both).max() < 1e-9 * size


def test_states_on_sections_and_times_of_events(
    hopper_cycle, hopper_observed, seen_in_cycle
):
    S = seen_in_cycle.sensitivity
    size = np.abs(S).max()
    by_forces = S[:, FORCES].sum(axis=1)
    assert_allclose(by_forces, 0, atol=1e-9 * size)

    def look(cycle):
        parts = []
        for one in hopper_observed:
            now = hj.fitting.ObservedCycle.of(cycle, one.sections, one.outputs)
            scales = one.prepare(hopper_cycle).scales
            parts += [
                np.ravel(x / s) for x, s in zip(now.measured, scales, strict=True)
            ]
        return np.concatenate(parts)

    assert_allclose(S, by_differences(hopper_cycle, look), atol=1e-6 * size)


def test_reverse_mode_gives_the_same(hopper_cycle, hopper_htf, seen_in_htf):
    """The gradient of a loss is the sum of its residuals' derivatives."""
    weights = hj.fitting.ObservedHTF(hopper_htf, SECTIONS).weights
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(2, *hopper_htf.H.shape))

    @eqx.filter_jit
    @eqx.filter_grad
    def gradient(system):
        cycle = hj.find_limit_cycle(system, hopper_cycle)
        model = hj.linearize(cycle, SECTIONS, OUTPUTS)
        H = model.htf(hopper_htf.frequencies, hopper_htf.harmonics).H * weights
        real = direction[0] * H.real
        imaginary = direction[1] * H.imag
        return (real + imaginary).sum()

    slopes = gradient(hopper_cycle.system)
    found = [
        float(getattr(slopes, n) * getattr(hopper_cycle.system, n)) for n in HOPPER
    ]
    true = direction.ravel() @ seen_in_htf.sensitivity
    tolerance = 1e-9 * np.abs(true).max()
    assert_allclose(found, true, atol=tolerance)
