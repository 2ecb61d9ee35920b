"""Units: declared with charts, systems, outputs, recordings, they arrive at figures and files."""

import numpy as np
import pytest

import hybridjax as hj
from hybridjax._core.signal import unit_of
from hybridjax.systems.chart import FieldChart

from ..toys import toy


def units(names):
    return [unit_of(name) for name in names]


def small_htf(**names):
    values = np.ones((1, 2, 1, 1))
    return hj.linear.HTF([0.1, 0.2], values, 0, 8, **names)


def test_units_go_from_the_model_to_the_fit(kinematic_ldtp, tmp_path):
    assert units(kinematic_ldtp.outputs) == ["m", "m/s"]
    assert units(kinematic_ldtp.inputs) == ["N"]
    design = hj.multisine(periods=16, frequencies=(0, 4.0))
    data = hj.experiments.simulate_experiments(kinematic_ldtp, design, start="periodic")
    estimate = hj.estimate_htf(data)
    fit = hj.fit_multipliers(estimate, 2, extra_lags=16)
    for thing in (
        data,
        data.records[0],
        estimate,
        fit,
        fit.htf([0.1]),
        hj.identify.fit_rational(estimate),
    ):
        assert units(thing.outputs) == ["m", "m/s"]
    for thing in (kinematic_ldtp, data, estimate, fit):
        hj.save(tmp_path / "thing.npz", thing)
        loaded = hj.load(tmp_path / "thing.npz")
        assert units(loaded.outputs) == ["m", "m/s"]
        assert units(loaded.inputs) == ["N"]


def test_what_has_other_units_is_not_compared():
    with pytest.raises(
        hj.errors.DefinitionError, match=r"\('y' \(m\),\) and \('y' \(mm\),\)"
    ):
        small_htf(outputs={"y": "m"}).error(small_htf(outputs={"y": "mm"}))
    in_meters = small_htf(outputs={"y": "m"})
    assert in_meters.error(small_htf(outputs="y")) == 0


def test_units_that_do_not_fit_are_refused():
    def still(t, q, u):
        return q

    charts = {unit: FieldChart(still, ("y",), (unit,)) for unit in ("m", "mm")}
    with pytest.raises(
        hj.errors.DefinitionError, match=r"two units: 'y' \(m\), .*'y' \(mm\)"
    ):
        hj.simulate(toy(charts), "m", (1.0,), 1.0)
