"""Sweeps: against closed forms, from store to store, and what is refused."""

import shutil

import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj
from hybridjax.scale.family import Points


pytest.importorskip("xarray")
pytest.importorskip("zarr")

# Pieces of four systems: the programs are those of tests/orbits/test_sweep.py.
OVER = {"slope": np.array([0.075, 0.08, 0.09]), "spokes": np.array([8.0, 8.5, 9.0])}
WANT = ("period", "spectral_radius", "state", "multipliers", "residual")


@pytest.fixture(scope="module")
def wheel():
    return hj.find_limit_cycle(hj.models.RimlessWheel())


@pytest.fixture(scope="module")
def options(wheel):
    return {"want": WANT, "guess": wheel, "chunk": 4}


@pytest.fixture(scope="module")
def whole(wheel, options):
    return hj.sweep(hj.models.RimlessWheel(), OVER, **options)


def test_a_map_has_the_multipliers_of_the_closed_form(whole):
    """That of the rimless wheel is cos^2 of the angle between spokes (McGeer 1990)."""
    exact = np.cos(2 * np.pi / OVER["spokes"]) ** 2
    expected = np.broadcast_to(exact, (3, 3))
    np.testing.assert_allclose(whole.spectral_radius, expected, rtol=1e-7)
    assert whole.spectral_radius.dims == ("slope", "spokes")
    assert (whole.result == 0).all() and (whole.residual < 1e-8).all()
    assert whole.slope.attrs["units"] == "rad"
    np.testing.assert_array_equal(
        np.abs(whole.multipliers).max("multiplier"), whole.spectral_radius
    )
    assert list(whole.coords) == ["slope", "spokes", "state_name", "state_unit"]
    alone = hj.find_limit_cycle(hj.models.RimlessWheel(slope=0.09, spokes=8.0))
    assert whole.period.sel(slope=0.09, spokes=8.0) == pytest.approx(float(alone.period))


def test_a_point_without_a_cycle_touches_no_other(wheel, options):
    """With so few spokes on so flat a slope, a wheel does not get over its next spoke."""
    points = Points({"slope": [0.075, 0.08, 0.03, 0.09], "spokes": [8.0, 8.5, 7.0, 9.0]})
    found = hj.sweep(hj.models.RimlessWheel(), points, **options)
    assert np.flatnonzero(found.result).tolist() == [2] and np.isnan(found.period[2])
    expected = np.delete(np.cos(2 * np.pi / found.spokes.values) ** 2, 2)
    np.testing.assert_allclose(np.delete(found.spectral_radius.values, 2), expected, rtol=1e-7)


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


def test_another_sweep_is_refused_by_its_difference(whole, options, tmp_path):
    store = tmp_path / "map.zarr"
    small = {name: x[:2] for name, x in OVER.items()}

    def run(system=None, over=small, **change):
        system = hj.models.RimlessWheel() if system is None else system
        return hj.sweep(system, over, store=store, **options | change)

    run()
    with pytest.raises(hj.DefinitionError, match=r"`over.slope` is not the same"):
        run(over=small | {"slope": np.array([0.071, 0.08])})
    with pytest.raises(hj.DefinitionError, match=r"`model.numbers.rate` is 1.0, not 1.1"):
        run(hj.models.RimlessWheel(rate=1.1))
    with pytest.raises(hj.DefinitionError, match=r"`want` is \['period', .*, not \['period'\]"):
        run(want="period")
    shutil.rmtree(store)
    store.mkdir()
    (store / "mine.txt").write_text("")
    with pytest.raises(hj.DefinitionError, match="is no store of results"):
        run()


def test_functions_of_parameters_lists_of_points_and_measures(wheel, whole):
    points = Points({"slope": [0.075, 0.09, 0.075, 0.09], "spokes": [8.0, 8.0, 9.0, 9.0]})

    def model(slope, spokes=8.0):
        return hj.models.RimlessWheel(slope=slope, spokes=spokes)

    def twice(cycle):
        if float(cycle.system.slope) > 0.08:
            raise hj.ComputationError("too steep")
        return jnp.stack([cycle.period, 2 * cycle.period])

    found = hj.sweep(model, points, ("period", twice), guess=wheel, chunk=4)
    assert found.period.dims == ("point",) and set(found.coords) == {"slope", "spokes"}
    np.testing.assert_allclose(found.period, whole.period.values[::2, ::2].T.ravel(), rtol=1e-9)
    np.testing.assert_allclose(found.twice[0], float(found.period[0]) * np.array([1, 2]))
    assert np.isnan(found.twice[1]).all()


def test_points_of_sobol_fill_the_box_and_are_always_the_same():
    ranges = {"k": (8.0, 13.0), "b": (3.0, 7.0)}
    points = Points.sobol(ranges, 48, seed=3)
    for name, (low, high) in ranges.items():
        values = points.values[name]
        assert len(points) == 48 and low <= values.min() and values.max() <= high
        assert np.histogram(values, 4, (low, high))[0].tolist() == pytest.approx([12] * 4, abs=2)
        np.testing.assert_array_equal(values, Points.sobol(ranges, 48, seed=3).values[name])


WRONG = {
    "no model": ({"x": [1.0]}, {"model": lambda x: x}, "a function of parameters that returns one"),
    "no axis": ({"x": [1.0]}, {"model": lambda x, y: x}, "needs `y`: give it an axis"),
}  # fmt: skip


@pytest.mark.parametrize(("over", "change", "message"), WRONG.values(), ids=WRONG)
def test_what_is_refused(options, over, change, message):
    arguments = {"model": hj.models.RimlessWheel(), "over": over} | options | change
    with pytest.raises(hj.DefinitionError, match=message):
        hj.sweep(**arguments)
