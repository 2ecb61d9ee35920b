"""Sweeps: against closed forms, from store to store, and what is refused.

Cycles of many systems and the command line are tested here too, since one program serves them all.
"""

import shutil

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj
from hybridjax.apps.cli import main
from hybridjax.orbits import batches
from hybridjax.scale.family import SweepPoints


pytest.importorskip("xarray")
pytest.importorskip("zarr")

# In pieces of four.
FOUR = hj.scale.Execution(batch=4)
OVER = {"slope": np.array([0.075, 0.08, 0.09]), "spokes": np.array([8.0, 8.5, 9.0])}
WANT = ("period", "spectral_radius", "state", "multipliers", "residual")


@pytest.fixture(scope="module")
def wheel():
    return hj.find_limit_cycle(hj.models.RimlessWheel())


@pytest.fixture(scope="module")
def options(wheel):
    return {"quantities": WANT, "guess": wheel, "chunk": 4}


@pytest.fixture(scope="module")
def whole(wheel, options):
    return hj.sweep(hj.models.RimlessWheel(), OVER, **options)


def test_a_map_has_the_multipliers_of_the_closed_form(whole):
    """That of the rimless wheel is cos^2 of the angle between spokes (McGeer 1990)."""
    angle = 2 * np.pi / OVER["spokes"]
    multiplier = np.cos(angle) ** 2
    expected = np.broadcast_to(multiplier, (3, 3))
    assert_allclose(whole.spectral_radius, expected, rtol=1e-7)
    assert whole.spectral_radius.dims == ("slope", "spokes")
    assert (whole.result == 0).all()
    assert (whole.residual < 1e-8).all()
    assert 2 not in whole.result.attrs["flag_values"]  # (a code that is not in use)
    assert whole.slope.attrs["units"] == "rad"
    assert_array_equal(
        np.abs(whole.multipliers).max("multiplier"), whole.spectral_radius
    )
    assert list(whole.coords) == ["slope", "spokes", "state_name", "state_unit"]
    alone = hj.find_limit_cycle(hj.models.RimlessWheel(slope=0.09, spokes=8.0))
    assert whole.period.sel(slope=0.09, spokes=8.0) == pytest.approx(
        float(alone.period)
    )


@pytest.mark.slow
def test_a_point_without_a_cycle_touches_no_other(wheel, options):
    """With so few spokes on so flat a slope, a wheel does not get over its next spoke."""
    points = SweepPoints(
        {"slope": [0.075, 0.08, 0.03, 0.09], "spokes": [8.0, 8.5, 7.0, 9.0]}
    )
    found = hj.sweep(hj.models.RimlessWheel(), points, **options)
    assert np.flatnonzero(found.result).tolist() == [2]
    assert np.isnan(found.period[2])
    angle = 2 * np.pi / found.spokes.values
    multiplier = np.cos(angle) ** 2
    expected = np.delete(multiplier, 2)
    assert_allclose(np.delete(found.spectral_radius.values, 2), expected, rtol=1e-7)


@pytest.mark.slow
def test_a_store_is_resumed_and_checked_to_the_last_bit(whole, options, tmp_path):
    store = tmp_path / "map.zarr"
    first = hj.sweep(hj.models.RimlessWheel(), OVER, store=store, **options)
    assert first.load().identical(whole)
    (store / "period/c/0/0").unlink()  # a piece that was lost, and one that rotted
    rotten = store / "spectral_radius/c/1/0"
    content = bytearray(rotten.read_bytes())
    content[3] ^= 1
    rotten.write_bytes(content)
    kept = (store / "period/c/0/1").stat().st_mtime_ns
    again = hj.sweep(hj.models.RimlessWheel(), OVER, store=store, **options)
    assert again.load().identical(whole)
    assert (store / "period/c/0/1").stat().st_mtime_ns == kept


@pytest.mark.slow
def test_another_sweep_is_refused_by_its_difference(whole, options, tmp_path):
    store = tmp_path / "map.zarr"
    small = {name: x[:2] for name, x in OVER.items()}

    def run(system=None, over=small, **change):
        system = hj.models.RimlessWheel() if system is None else system
        return hj.sweep(system, over, store=store, **options | change)

    run()
    with pytest.raises(
        hj.errors.DefinitionError, match=r"`values.slope` is not the same"
    ):
        other = small | {"slope": np.array([0.071, 0.08])}
        run(over=other)
    with pytest.raises(
        hj.errors.DefinitionError, match=r"`model.numbers.rate` is 1.0, not 1.1"
    ):
        run(hj.models.RimlessWheel(rate=1.1))
    with pytest.raises(
        hj.errors.DefinitionError,
        match=r"`quantities` is \['period', .*, not \['period'\]",
    ):
        run(quantities="period")
    shutil.rmtree(store)
    store.mkdir()
    (store / "mine.txt").write_text("")
    with pytest.raises(hj.errors.DefinitionError, match="is no store of results"):
        run()


@pytest.mark.slow
def test_functions_of_parameters_lists_of_points_and_measures(wheel, whole):
    points = SweepPoints(
        {"slope": [0.075, 0.09, 0.075, 0.09], "spokes": [8.0, 8.0, 9.0, 9.0]}
    )

    def model(slope, spokes=8.0):
        return hj.models.RimlessWheel(slope=slope, spokes=spokes)

    def twice(cycle):
        if float(cycle.system.slope) > 0.08:
            raise hj.errors.ComputationError("too steep")
        two_periods = cycle.trajectory(2.0)
        return jnp.stack([cycle.period, two_periods.t[-1]])

    found = hj.sweep(model, points, ("period", twice), guess=wheel, chunk=4)
    assert found.period.dims == ("point",)
    assert set(found.coords) == {"slope", "spokes"}
    part = whole.period.values[::2, ::2]
    expected = part.T.ravel()
    assert_allclose(found.period, expected, rtol=1e-9)
    period = float(found.period[0])
    expected = period * np.array([1, 2])
    assert_allclose(found.twice[0], expected)
    assert np.isnan(found.twice[1]).all()
    for wrong, message in (
        (lambda x: x, "a function of parameters that returns one"),
        (lambda x, y: x, "needs `y`: give it an axis"),
    ):
        with pytest.raises(hj.errors.DefinitionError, match=message):
            hj.sweep(wrong, {"x": [1.0]}, guess=wheel)


def test_points_of_sobol_fill_the_box_and_are_always_the_same():
    ranges = {"k": (8.0, 13.0), "b": (3.0, 7.0)}
    points = SweepPoints.sobol(ranges, 48, seed=3)
    for name, (low, high) in ranges.items():
        values = points.values[name]
        assert len(points) == 48
        assert low <= values.min()
        assert values.max() <= high
        measured = np.histogram(values, 4, (low, high))[0].tolist()
        assert measured == (pytest.approx([12] * 4, abs=2))
        expected = SweepPoints.sobol(ranges, 48, seed=3).values[name]
        assert_array_equal(values, expected)


@pytest.mark.slow
def test_sweep_draws_a_map(tmp_path, capsys):
    (tmp_path / "my_wheel.py").write_text(
        "from hybridjax.models import RimlessWheel as Mine\n"
    )
    model = f"{tmp_path}/my_wheel.py:Mine"
    out = str(tmp_path / "map.zarr")
    axes = ["--values", "slope=0.075:0.09:2", "--values", "spokes=8:9:2"]
    assert (
        main(["sweep", model, *axes, "--quantities", "spectral_radius", "--out", out])
        == 0
    )
    assert "4 of 4 points have a limit cycle" in capsys.readouterr().out
    assert (tmp_path / "map-spectral_radius.png").stat().st_size > 5_000
    for wrong, says in (
        ([model, "--values", "slop=0:1:2"], "there is no parameter 'slop'"),
        ([model.replace("my_", "no_"), *axes], "there is no file"),
        ([model, *axes, *axes], "has two axes"),
        (
            [model, *axes, "--quantities", "period"],
            "holds other results: its `quantities`",
        ),
    ):
        with pytest.raises(SystemExit, match=says):
            main(["sweep", *wrong, "--out", out])


@pytest.mark.slow
def test_each_is_the_cycle_that_is_found_alone(hopper_cycle, monkeypatch):
    """Three hoppers near the paper's, one that is in the air when its clock is at 0.5, to which
    turns lead, and one that has no cycle with a touchdown: its spring pushes nothing."""
    monkeypatch.setattr(batches, "_SETTLE", ())
    k = jnp.array([8.0, 10.0, 13.0, 13.0, 0.0])
    b = jnp.array([3.0, 5.0, 7.0, 3.0, 5.0])
    hoppers = eqx.filter_vmap(lambda k, b: hj.models.VerticalHopper(k=k, b=b))(k, b)
    found = hj.orbits.find_limit_cycles(hoppers, hopper_cycle)
    for i in range(4):
        cycle = found[i]
        alone = hj.find_limit_cycle(cycle.system, cycle)
        assert cycle.event_sequence == alone.event_sequence
        assert_allclose(cycle.anchor.q, alone.anchor.q, atol=1e-9)
        leading = found.multipliers[i, :2]
        assert_allclose(leading, alone.multipliers, atol=1e-8)
        assert_allclose(cycle.multipliers, alone.multipliers, atol=1e-8)
    assert np.all(found.residual[:4] <= 1e-10)
    charts = np.unique(found.anchor.chart[:4])
    assert len(charts) == 2  # also in other charts
    others = found.multipliers[:4, 2:]
    assert_allclose(others, 0.0, atol=1e-9)


@pytest.mark.slow
def test_without_a_clock_and_in_waves(wheel):
    """The wheel's multiplier is cos(2 pi / 8)^2 = 1/2 at any slope. At steep ones a step is so
    much shorter than the guess's that the flow from one impact passes the next."""
    slopes = np.linspace(0.08, 0.16, 11)
    systems = [hj.models.RimlessWheel(slope=x) for x in slopes]
    found = hj.orbits.find_limit_cycles(systems, wheel, execution=FOUR)
    assert found.ok.all()
    assert np.all(np.diff(found.period) < 0)
    assert found.period[-1] < 0.7 * wheel.period
    assert_allclose(found.multipliers[:, 0], 0.5, atol=1e-7)
    sequences = {found[i].event_sequence for i in range(11)}
    assert sequences == {(0,)}


def test_systems_that_are_alike_or_undefined(wheel):
    """Neither takes the others down with it."""
    slopes = jnp.array([0.08] * 9 + [np.nan, 0.08])
    wheels = eqx.filter_vmap(lambda x: hj.models.RimlessWheel(slope=x))(slopes)
    found = hj.orbits.find_limit_cycles(wheels, wheel, execution=FOUR)
    assert_array_equal(found.failed, [9])
    assert np.isnan(found.multipliers[9]).all()
    assert np.isfinite(found.multipliers[:9]).all()
    words = found.summary().split()
    assert words[:3] == ["10/11", "found;", "#9:"]
    assert hj.orbits.find_limit_cycles(
        [found[0].system] * 6, wheel, execution=FOUR
    ).ok.all()


def test_a_guess_with_too_long_a_period(wheel):
    cycle = hj.find_limit_cycle(hj.models.RimlessWheel(slope=0.16), wheel)
    assert cycle.event_sequence == (0,)
    assert cycle.period < 0.7 * wheel.period
    assert_allclose(cycle.multipliers, [0.5], rtol=1e-9)
