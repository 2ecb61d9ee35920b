"""Derivatives of cycles and sections, which come from the host outside of programs."""

import dataclasses
import functools as ft

import equinox as eqx
import jax
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj
from hybridjax._core.host_derivatives import only_on_host

from ..conftest import APEX, KINEMATIC


@pytest.fixture
def compiles_none():
    with only_on_host():
        yield


def measured(guess, family):
    """What users differentiate, as a function of a system."""

    def measure(system):
        cycle = hj.find_limit_cycle(system, guess)
        model = hj.linearize(cycle, family)
        # (Repeated cycles are divided into other pieces.)
        monodromy = ft.reduce(lambda product, factor: factor @ product, cycle.factors)
        matrices = model.A, model.B, model.C, monodromy
        polynomial = model.characteristic_polynomial()
        return *matrices, polynomial, cycle.period, cycle.anchor.q

    return measure


def numbers_of(arrays, shapes):
    """All numbers of arrays in a row, without the zeros by which they are padded."""
    kept = []
    for array, shape in zip(arrays, shapes, strict=True):
        inside = tuple(slice(n) for n in shape)
        kept.append(np.asarray(array)[inside].ravel())
    return np.concatenate(kept)


def agrees(system, measure, rtol):
    """Derivatives of all outputs in a direction of all parameters, and reverse mode."""
    parameters, others = eqx.partition(system, eqx.is_inexact_array)
    flat, unravel = ravel_pytree(parameters)
    rng = np.random.default_rng(0)
    direction = flat * rng.uniform(-1, 1, flat.shape)

    def at(h):
        changed = unravel(flat + h * direction)
        return measure(eqx.combine(changed, others))

    # Under transformations, matrices are padded with zeros.
    plain = at(0.0)
    shapes = [np.shape(x) for x in plain]
    values, pull_back = jax.vjp(at, 0.0)
    expected = numbers_of(plain, shapes)
    assert_allclose(numbers_of(values, shapes), expected, rtol=1e-9, atol=1e-9)

    _, tangents = jax.jvp(at, (0.0,), (1.0,))
    derivative = numbers_of(tangents, shapes)
    h = 2e-4
    ahead = numbers_of(at(h), shapes)
    behind = numbers_of(at(-h), shapes)
    once = ahead - behind
    far_ahead = numbers_of(at(2 * h), shapes)
    far_behind = numbers_of(at(-2 * h), shapes)
    twice = far_ahead - far_behind
    difference = (8 * once - twice) / (12 * h)
    tolerance = rtol * np.max(np.abs(derivative))
    assert_allclose(derivative, difference, rtol=rtol, atol=tolerance)

    weights = []
    for x in values:
        wave = np.cos(np.arange(np.size(x)))
        weights.append(wave.reshape(np.shape(x)))
    forward = 0.0
    for weight, tangent in zip(weights, tangents, strict=True):
        forward += np.sum(weight * np.asarray(tangent))
    (reverse,) = pull_back(tuple(weights))
    assert_allclose(reverse, forward, rtol=1e-11)


FAMILIES = {
    "clock": hj.ClockPhase(4, anchor=0.3),
    "angle": hj.KinematicPhase(4, "yM", "vM", (1.9, 0.0), (0.3, 1.9), anchor=APEX),
    "arc": hj.sections.ArcLength(4, ("yM", "vM"), APEX),
    "event": [hj.AtEvent("touchdown"), APEX],
}


SLOW = [pytest.param(x, marks=pytest.mark.slow) for x in ("clock", "arc", "event")]


@pytest.mark.usefixtures("compiles_none")
@pytest.mark.parametrize("family", ["angle", *SLOW])
@pytest.mark.slow
def test_a_hopper(hopper_cycle, family):
    """Two charts, clock; the sections move with the cycle."""
    agrees(hopper_cycle.system, measured(hopper_cycle, FAMILIES[family]), 1e-8)


@pytest.mark.usefixtures("compiles_none")
@pytest.mark.slow
def test_an_autonomous_wheel():
    """The period depends on the parameters, and the flow is projected out of the factors."""
    wheel = hj.models.RimlessWheel()
    cycle = hj.find_limit_cycle(wheel, section=hj.AtEvent("impact"))
    sections = [hj.AtEvent("impact"), hj.Crossing("th", "rising", 0.1)]
    agrees(wheel, measured(cycle, sections), 1e-8)


@pytest.mark.usefixtures("compiles_none")
@pytest.mark.slow
def test_numbers_of_sections(hopper_cycle):
    """A section is a definition, whose numbers have derivatives as those of systems."""

    def determinant(value):
        sections = [hj.Crossing("vM", "falling", value)]
        return hj.linearize(hopper_cycle, sections, "yM").C[0, 0, 0]

    e = 1e-4
    change = determinant(e) - determinant(-e)
    differences = change / (2 * e)
    assert_allclose(jax.grad(determinant)(0.0), differences, rtol=1e-6, atol=1e-9)


@pytest.mark.usefixtures("compiles_none")
@pytest.mark.slow
def test_a_converter():
    """Events that are scheduled by a parameter."""
    cycle = hj.find_limit_cycle(hj.models.BuckConverter())
    sections = hj.ClockPhase(2, anchor=-0.2)
    agrees(cycle.system, measured(cycle, sections), 1e-8)


@pytest.mark.slow
def test_the_multipliers_of_the_hopper_by_its_parameters(hopper_cycle):
    """Against independent digits; m, M, k, b, l0, a, g for the positive imaginary part."""
    true = {
        "m": -0.0824974078 - 0.0323664570j,
        "M": 0.2607460076 + 0.3114094110j,
        "k": -0.0368909415 - 0.0622806965j,
        "b": -0.0580410737 + 0.0358755413j,
        "l0": 0.0,
        "a": 0.0110060088 - 0.0073511553j,
        "g": -0.1100600879 + 0.0735115530j,
    }

    def multiplier(hopper):
        cycle = hj.find_limit_cycle(hopper, hopper_cycle)
        ldtp = hj.linearize(cycle, hj.ClockPhase(8, anchor=APEX), outputs="yM")
        monodromy = ldtp.monodromy(5)
        trace = jax.numpy.trace(monodromy)
        square = jax.numpy.trace(monodromy @ monodromy)
        determinant = (trace**2 - square) / 2
        distance = determinant - trace**2 / 4
        root = jax.numpy.sqrt(distance)
        return jax.numpy.stack([trace / 2, root])

    slopes = eqx.filter_jit(eqx.filter_jacfwd(multiplier))(hopper_cycle.system)
    for name, value in true.items():
        assert complex(*np.asarray(getattr(slopes, name))) == pytest.approx(
            value, abs=1e-9
        ), name


def test_later_calls_repeat_the_first_to_the_last_bit():
    """Programs are chosen by what a call is given, not by the calls before."""

    class Hopper(hj.models.VerticalHopper):
        """Its programs are its own."""

    cycle = hj.find_limit_cycle(Hopper())
    matrices = []
    for _ in range(10):
        ldtp = hj.linearize(dataclasses.replace(cycle), KINEMATIC, "yM")
        matrices.append(ldtp.matrices)
    assert_array_equal(ravel_pytree(matrices[-1])[0], ravel_pytree(matrices[0])[0])
