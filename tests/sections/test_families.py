"""Families of one's own."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from numpy.testing import assert_allclose

import hybridjax as hj

from ..conftest import APEX, OUTPUTS


class Chosen(hj.sections.AbstractSections):
    """Sections at chosen phases of the clock, in periods."""

    label: ClassVar[str] = "chosen"
    values: Float[Array, " N"] = eqx.field(converter=jnp.asarray)

    @property
    def n_sections(self):
        return len(self.values)

    @property
    def anchor(self):
        return None

    def check(self, s):
        pass

    def bind(self, s, orbit):
        return hj.sections.BoundSections.at_times(self.values * orbit.period)

    def describe(self, i):
        value = float(self.values[i])
        return f"section {i} (at {value:.3g})"


class Levels(hj.sections.AbstractLevels):
    values: Float[Array, " N"]

    def present(self, s, a):
        return True

    def level(self, s, a, i, t, q):
        return q[0] - self.values[i]


class FallingPast(Chosen):
    """Sections where the first state falls past each of some values."""

    def bind(self, s, orbit):
        return hj.sections.BoundSections.at_levels(Levels(self.values), self.n_sections)


def test_a_family_of_clock_phases(hopper_cycle):
    family = Chosen([0.1, 0.25, 0.8])
    placed = hj.sections.place_sections(hopper_cycle, family)
    phases = placed.lanes.t % 1
    assert_allclose(phases, [0.1, 0.25, 0.8], atol=1e-12)
    ldtp = hj.linearize(hopper_cycle, placed, "yM")
    assert_allclose(ldtp.multipliers, hopper_cycle.multipliers, atol=1e-9)


@pytest.mark.slow
def test_a_family_of_levels(vanderpol_cycle):
    family = FallingPast([1.0, 0.0, -1.0])
    one_by_one = [hj.Crossing("x", "falling", value=float(x)) for x in family.values]
    own = hj.sections.place_sections(vanderpol_cycle, family)
    listed = hj.sections.place_sections(vanderpol_cycle, one_by_one)
    assert_allclose(own.lanes.q, listed.lanes.q, atol=1e-12)
    observed = own.observe("x")[:, 0]
    assert_allclose(observed, family.values, atol=1e-12)
    a = hj.linearize(vanderpol_cycle, own, "v")
    b = hj.linearize(vanderpol_cycle, listed, "v")
    assert_allclose(a.A, b.A, atol=1e-12)


@pytest.mark.slow
def test_equal_arc_lengths(hopper_cycle, isochron_ldtp):
    """Measured along a trajectory that is sampled densely, between its events."""
    scale = np.array([0.3, 1.9])
    family = hj.sections.ArcLength(8, OUTPUTS, APEX, scale=scale)
    placed = hj.sections.place_sections(hopper_cycle, family)
    t, *signals = hopper_cycle.trajectory(3.0)(*OUTPUTS, per_step=200)
    scaled = np.stack(signals) / scale[:, None]
    steps = np.diff(scaled, axis=1)
    lengths = np.linalg.norm(steps, axis=0)
    length = np.append(0.0, np.cumsum(lengths))
    at = np.append(placed.lanes.t, placed.lanes.t[0] + 1.0) + np.ceil(
        t[0] - placed.lanes.t[0]
    )
    pieces = np.diff(np.interp(at, t, length))
    assert_allclose(pieces, pieces.mean(), rtol=2e-3)
    assert np.ptp(placed.duration) > 0.004
    ldtp = hj.linearize(hopper_cycle, placed, OUTPUTS)
    assert_allclose(ldtp.multipliers, isochron_ldtp.multipliers, atol=1e-9)
