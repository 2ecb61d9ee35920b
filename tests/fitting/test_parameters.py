"""Coordinates of free parameters keep to bounds and come back; data that do not fit are refused."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj
from hybridjax.fitting.problem import free_parameters

from .conftest import SECTIONS


HOPPER = hj.models.VerticalHopper
BOUNDS = st.sampled_from(
    [None, (-np.inf, np.inf), (0.5, np.inf), (-np.inf, 40.0), (0.5, 40.0)]
)
VALUES = st.floats(0.6, 39.0)
COORDINATES = st.floats(-8.0, 8.0)


@given(VALUES, BOUNDS, COORDINATES)
def test_values_come_back_and_keep_to_their_bounds(value, bounds, x):
    parameters = free_parameters(HOPPER(k=value), {"k": bounds})
    values = parameters.read(HOPPER(k=value), ())
    assert_allclose(parameters.decode(parameters.encode(values)), values, rtol=1e-12)
    low, high = (0.0, np.inf) if bounds is None else bounds
    decoded = parameters.decode(jnp.array([x]))[0]
    assert low <= decoded <= high


def test_a_parameter_keeps_its_sign_by_default():
    system = HOPPER(k=-3.0, b=0.0)
    parameters = free_parameters(system, ("k", "b", "g"))
    encoded = jnp.array([5.0, -5.0, -5.0])
    far = parameters.decode(encoded)
    assert far[0] < 0
    assert far[1] == -5.0
    assert far[2] > 0
    moved = parameters.insert(system, far)
    assert_array_equal([moved.k, moved.b, moved.g], far)


H = np.ones((1, 3, 1, 1), complex)
F = np.array([0.1, 0.2, 0.3])
TIMES = np.arange(8.0)


def records(**options):
    rng = np.random.default_rng(0)
    y = rng.normal(size=(2, 16, 1))
    y[:, 0] = options.pop("begin", 0.0)
    return hj.experiments.ExperimentData(
        np.zeros((2, 16, 1)), options.pop("y", y), n_sections=8, periods=2, **options
    )


@pytest.mark.parametrize(
    "make, message",
    [
        (
            lambda: hj.fitting.ObservedHTF(hj.linear.HTF(F, H, 0, 16), SECTIONS),
            "different n_sections: 16 and 8",
        ),
        (
            lambda: hj.fitting.ObservedHTF(
                hj.linear.HTF(F, H, 0, 8, variance=-H.real), SECTIONS
            ),
            "variance",
        ),
        (
            lambda: hj.fitting.ObservedSeries(records(), hj.ClockPhase(4)),
            "different n_sections: 8 and 4",
        ),
        (
            lambda: hj.fitting.ObservedSeries(records(result=[1, 1]), SECTIONS),
            "no experiment ran to",
        ),
        (
            lambda: hj.fitting.ObservedSeries(records(), SECTIONS, std=(1.0, 2.0)),
            r"of shape \(1 outputs\)",
        ),
        (
            lambda: hj.fitting.ObservedSeries(
                records(y=np.zeros((2, 16, 1))), SECTIONS
            ),
            "zero throughout",
        ),
        (
            lambda: hj.fitting.ObservedSeries(records(begin=0.8), SECTIONS),
            "do not begin on the cycle",
        ),
        (
            lambda: hj.fitting.ObservedSeries(records(begin=0.8), SECTIONS, 0.1),
            "do not begin on the cycle",
        ),
        (lambda: hj.fitting.ObservedCycle(SECTIONS), "`times`, or a `period`"),
        (
            lambda: hj.fitting.ObservedCycle(SECTIONS, "yM"),
            "`outputs` with their `values`",
        ),
        (
            lambda: hj.fitting.ObservedCycle(SECTIONS, "yM", np.ones((4, 1))),
            r"shape \(8 sections, 1 out",
        ),
        (
            lambda: hj.fitting.ObservedCycle(SECTIONS, "yM", np.zeros((8, 1))),
            "zero throughout",
        ),
        (
            lambda: hj.fitting.ObservedCycle(
                SECTIONS, times=TIMES, period=1.0, period_std=0.1
            ),
            "or of none",
        ),
    ],
)
def test_bad_data_are_refused(make, message):
    with pytest.raises(hj.errors.DefinitionError, match=message):
        make()
