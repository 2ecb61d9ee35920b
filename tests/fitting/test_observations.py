"""Data that do not fit are refused where they are given."""

import numpy as np
import pytest

import hybridjax as hj

from .conftest import SECTIONS


H = np.ones((1, 3, 1, 1), complex)
F = np.array([0.1, 0.2, 0.3])


def records(**options):
    y = np.random.default_rng(0).normal(size=(2, 16, 1))
    return hj.ExperimentData(
        np.zeros((2, 16, 1)), options.pop("y", y), n_sections=8, periods=2, **options
    )


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: hj.ObservedHTF(hj.HTF(F, H, 0, 16), SECTIONS), "16 sections, the family has 8"),
        (lambda: hj.ObservedHTF(hj.HTF(F, H, 0, 8, variance=-H.real), SECTIONS), "variance"),
        (lambda: hj.ObservedSeries(records(), hj.ClockPhase(4)), "8 sections, the family 4"),
        (lambda: hj.ObservedSeries(records(result=[1, 1]), SECTIONS), "no experiment ran well"),
        (lambda: hj.ObservedSeries(records(), SECTIONS, std=(1.0, 2.0)), "one for each output"),
        (lambda: hj.ObservedSeries(records(y=np.zeros((2, 16, 1))), SECTIONS), "zero throughout"),
        (lambda: hj.ObservedCycle(SECTIONS), "`times`, or the `period`"),
        (lambda: hj.ObservedCycle(SECTIONS, "yM"), "`outputs` with their `values`"),
        (lambda: hj.ObservedCycle(SECTIONS, "yM", np.ones((4, 1))), r"the shape \(8, 1\)"),
        (lambda: hj.ObservedCycle(SECTIONS, "yM", np.zeros((8, 1))), "zero throughout"),
    ],
)
def test_bad_data_are_refused(make, message):
    with pytest.raises(hj.DefinitionError, match=message):
        make()
