"""A hybrid system with two inputs."""

import numpy as np
import pytest

import hybridjax as hj
from hybridjax.systems.chart import FieldChart


class TwoForces(hj.models.VerticalHopper):
    """The hopper with a second force, on its foot in the air."""

    inputs = ("body", "foot")
    input_units = ("N", "N")

    def charts(self):
        one = super().charts()

        def field(t, q, u):
            *others, acceleration = one["flight"].field(t, q, u)
            return *others, acceleration + u[1] / self.m

        flight = FieldChart(field, one["flight"].states, one["flight"].units)
        return {"flight": flight, "stance": one["stance"]}


@pytest.mark.slow
@pytest.mark.parametrize("amplitude, accuracy", [(1e-2, 1e-3), (1e-5, 1e-6)])
def test_both_inputs_are_told_apart(amplitude, accuracy):
    """All harmonics from both inputs to both outputs, estimated from a steady start."""
    cycle, outputs = hj.find_limit_cycle(TwoForces()), ("yM", "vM")
    placed = hj.place_sections(cycle, hj.ClockPhase(16, anchor=0.3))
    names = TwoForces.inputs
    design = hj.multisine(16, 32, band=(0, 4), amplitude=amplitude, lines="odd", inputs=names)
    data = hj.run_experiments(cycle, placed, design, outputs, start="steady", accuracy=1e-11)
    assert data.ok.all(), data.summary()
    estimate = hj.estimate_htf(data, harmonics=(-1, 0, 1))
    exact = hj.linearize(cycle, placed, outputs).htf(estimate.f, harmonics=(-1, 0, 1))
    assert estimate.H.shape[-2:] == (2, 2)
    assert np.max(estimate.error(exact)) < accuracy
