"""Linear models inside of programs, where cycles and sections follow those of a known cycle."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj
from hybridjax.sections import linearization as module


HOPPER = hj.models.VerticalHopper()
OUTPUTS = "yM", "vM"
APEX = hj.Crossing("vM", "falling")
FAMILIES = {
    "phases of the clock": hj.ClockPhase(5),
    "angles": hj.KinematicPhase(5, "yM", "vM", (1.9, 0.0), (0.3, 1.9), anchor=APEX),
    "a list": hj.sections.SectionList(
        [hj.AtEvent("liftoff"), APEX, hj.AtEvent("touchdown")]
    ),
    # (On each section the next one's function is negative, and rises before it falls.)
    "two heights": hj.sections.SectionList(
        [hj.Crossing("yM", "falling", value=2.0), hj.Crossing("vM", "falling")]
    ),
}


@pytest.fixture(scope="module")
def known():
    return hj.find_limit_cycle(HOPPER)


@pytest.fixture
def no_search(monkeypatch):
    """The other way to a traced model must not hide a fault of this one."""
    monkeypatch.setattr(module, "_of_family", None)


def model_of(system, known, family):
    cycle = hj.find_limit_cycle(system, known)
    return hj.linearize(cycle, family, OUTPUTS)


@pytest.mark.parametrize("name", FAMILIES)
@pytest.mark.slow
def test_a_traced_model_is_that_outside_of_the_program(name, known, no_search):
    family = FAMILIES[name]
    system = hj.models.VerticalHopper(k=1.02 * HOPPER.k, b=0.97 * HOPPER.b)
    expected = model_of(system, known, family)
    traced = eqx.filter_jit(lambda system: model_of(system, known, family))(system)
    d = expected.A.shape[-1]
    # (Inside of programs, matrices are padded to the largest chart.)
    A = traced.A[:, :d, :d]
    B = traced.B[:, :d]
    C = traced.C[:, :, :d]
    found = A, B, C, traced.D
    for matrix, true in zip(found, expected.matrices[:4], strict=True):
        np.testing.assert_allclose(matrix, true, rtol=0, atol=1e-11)


def test_sections_that_are_made_inside_of_a_program_need_no_search(known, no_search):
    def model(system):
        anchor = hj.Crossing("vM", "falling", value=0.0)
        return model_of(system, known, hj.ClockPhase(5, anchor=anchor))

    shapes = eqx.filter_eval_shape(model, HOPPER)
    assert shapes.A.shape == (5, 5, 5)


@pytest.mark.slow
def test_derivatives_of_a_traced_model_are_differences(known, no_search):
    family = FAMILIES["angles"]

    def number(k):
        system = eqx.tree_at(lambda h: h.k, HOPPER, k)
        return model_of(system, known, family).characteristic_polynomial()[2]

    k = jnp.asarray(HOPPER.k, float)
    h = 1e-3
    slope = jax.jit(jax.grad(number))(k)
    forwards = jax.jit(jax.jacfwd(number))(k)
    higher = number(k + h)
    change = higher - number(k - h)
    difference = change / (2 * h)
    np.testing.assert_allclose(slope, difference, rtol=1e-6)
    np.testing.assert_allclose(forwards, slope, rtol=1e-12)


def test_an_event_that_changes_places_with_a_section_is_no_number(known, no_search):
    """A section stays at its height; with another ground, liftoff is on its other side."""
    at_liftoff = hj.sections.place_sections(known, [hj.AtEvent("liftoff")])
    height = float(at_liftoff.observe("yM")[0, 0])
    just_above = hj.Crossing("yM", "rising", value=height + 1e-3)
    family = hj.sections.SectionList([just_above])
    traced = eqx.filter_jit(lambda system: model_of(system, known, family))
    assert np.isfinite(traced(HOPPER).A).all()
    beyond = traced(hj.models.VerticalHopper(k=1.2 * HOPPER.k))
    assert np.isnan(beyond.A).all()
