"""Stores of experiments: resumed, damaged, of others, or none at all."""

import shutil

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj
from hybridjax.experiments import StoredExperiments
from hybridjax.experiments.run import Options
from hybridjax.experiments.stored import experiment_job

from ..conftest import OUTPUTS


pytest.importorskip("zarr")

COUNT = 100
DESIGN = hj.multisine(experiments=COUNT)
BATCH = {"execution": hj.Execution(batch=40)}
stream = hj.experiments.stream_experiments


@pytest.fixture(scope="module")
def arguments(hopper_cycle, placed_isochrons):
    return hopper_cycle, placed_isochrons, DESIGN, OUTPUTS


@pytest.fixture(scope="module")
def whole(arguments):
    return hj.run_experiments(*arguments, **BATCH)


@pytest.fixture(scope="module")
def made(arguments, tmp_path_factory):
    folder = tmp_path_factory.mktemp("stores") / "records.zarr"
    return stream(*arguments, Options(**BATCH), store=folder, chunk=40)


@pytest.fixture
def stored(made, tmp_path):
    """A store of 100 experiments in three chunks, for one test."""
    shutil.copytree(made.address, tmp_path / "records.zarr")
    return StoredExperiments(tmp_path / "records.zarr")


def records(parts):
    return np.concatenate([part.y for part in parts])


def test_stored_experiments_are_those_of_the_whole(made, whole):
    assert len(made) == 3 and made.experiments == COUNT and made.missing() == []
    np.testing.assert_array_equal(records(made), whole.y)
    np.testing.assert_array_equal(np.concatenate([part.u for part in made]), whole.u)
    np.testing.assert_array_equal(np.concatenate([part.error for part in made]), whole.error)
    np.testing.assert_array_equal(made[0].cycle_outputs, whole.cycle_outputs)
    assert made[0].outputs[0].unit == "m"
    assert made.summary() == whole.summary() == "100/100 ok"
    assert "100 experiments, 3 of 3 chunks" in repr(StoredExperiments(made.address))
    assert made.dataset.y.dims == ("experiment", "sample", "output")
    np.testing.assert_array_equal(made.dataset.y.sel(output="vM"), whole.y[..., 1])


def test_estimates_take_it_chunk_by_chunk(made, whole):
    estimate, expected = hj.estimate_htf(made), hj.estimate_htf(whole)
    error = np.abs(estimate.H - expected.H).max() / np.abs(expected.H).max()
    assert error < 1e-12


def test_only_what_is_missing_or_damaged_is_run(stored, arguments, whole, tmp_path):
    (tmp_path / "records.zarr/y/c/1/0/0").unlink()
    assert stored.missing() == [1]
    with pytest.raises(hj.DefinitionError, match="1 of 3 chunks .* missing, the first is 1"):
        hj.estimate_htf(stored)
    rotten = tmp_path / "records.zarr/u/c/2/0/0"
    content = bytearray(rotten.read_bytes())
    content[100] ^= 1
    rotten.write_bytes(content)
    with pytest.raises(hj.errors.FileFormatError, match="piece 2 .* is damaged in `u`"):
        stored[2]
    before = (tmp_path / "records.zarr/y/c/0/0/0").stat().st_mtime_ns
    again = stream(*arguments, Options(**BATCH), store=stored.address, chunk=40)
    np.testing.assert_array_equal(records(again), whole.y)
    assert (tmp_path / "records.zarr/y/c/0/0/0").stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (dict(design=hj.multisine(experiments=COUNT, seed=1)), "design"),
        (dict(design=DESIGN.inputs(84), discard=20), "design"),
        (dict(outputs="yM"), "data.outputs"),
        (dict(outputs=("yM", hj.Output("vM", lambda t, q, u: -q[1], "m/s"))), "outputs"),
        (dict(sections=hj.ClockPhase(32, anchor=hj.Crossing("vM", "rising"))), "family"),
        (dict(chunk=7), "batch"),
        (dict(discard=1), "cycles"),
        (dict(accuracy=1e-8), "accuracy"),
        (dict(process_noise=hj.experiments.ProcessNoise(1e-3)), "process_noise"),
        (dict(execution=hj.Execution(batch=8)), "batch"),
    ],
)
def test_other_experiments_are_refused(made, arguments, change, what):
    names = ("cycle", "sections", "design", "outputs")
    call = dict(zip(names, arguments, strict=True)) | dict(chunk=40) | BATCH | change
    options = {name: call.pop(name) for name in [*call] if hasattr(Options, name)}
    with pytest.raises(hj.DefinitionError, match=f"holds other results: .*`{what}"):
        stream(**call, options=Options(**options), store=made.address)


def test_another_system_is_refused(made, arguments):
    _, placed, design, outputs = arguments
    other = eqx.tree_at(lambda p: p.cycle.system.k, placed, jnp.asarray(10.001, float))
    with pytest.raises(hj.DefinitionError, match="`model.numbers.k` is 10.0, not 10.001"):
        call = other.cycle, other, design, outputs
        stream(*call, Options(**BATCH), store=made.address, chunk=40)


@pytest.mark.parametrize("start", ["cycle", "periodic", "steady"])
def test_another_process_can_run_a_piece(hopper_cycle, placed_isochrons, start):
    """It gets all but what is compiled, and gives the same records."""
    cloudpickle = pytest.importorskip("cloudpickle")
    design = hj.Design.from_lines([[0.25], [0.75]], n_sections=32, periods=4)
    options = Options(start=start)
    job = experiment_job(hopper_cycle, placed_isochrons, design, OUTPUTS, options, 2)
    _, layout = job.begin()
    sent = cloudpickle.loads(cloudpickle.dumps(job.resume(layout, job.arrays())))
    here, there = job.run(0, None), sent.run(0, 1)
    assert here.keys() == there.keys()
    for name, values in here.items():
        np.testing.assert_array_equal(there[name], values)


def test_what_is_no_store(tmp_path, arguments):
    with pytest.raises(hj.DefinitionError, match="holds no experiments"):
        StoredExperiments(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(hj.DefinitionError, match="file"):
        stream(*arguments, store=tmp_path / "file")
