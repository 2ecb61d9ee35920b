"""Many experiments: chunk by chunk, in batches, by threads, in stores. One program is compiled."""

import json
import pathlib
import shutil

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj
from hybridjax._core.pieces.store import Blocks
from hybridjax.experiments import StoredExperiments
from hybridjax.experiments.run import RunOptions, divide, prepare
from hybridjax.experiments.stored import ExperimentJob

from ..conftest import no_compilation


pytest.importorskip("zarr")

COUNT = 12
DESIGN = hj.multisine(8, 8, (0, 4.0), 0.001, experiments=COUNT)
OUTPUTS = ("x", "v")
BATCH = {"execution": hj.scale.Execution(batch=5)}
NOISE = {"process_noise": hj.experiments.ProcessNoise(1e-3)}


@pytest.fixture(scope="module")
def arguments():
    cycle = hj.find_limit_cycle(hj.models.Duffing())
    family = hj.ClockPhase(8, anchor=hj.Crossing("x", "falling"))
    return cycle, hj.sections.place_sections(cycle, family), DESIGN, OUTPUTS


@pytest.fixture(scope="module")
def whole(arguments):
    return hj.run_experiments(*arguments, **BATCH)


@pytest.fixture(scope="module")
def made(arguments, tmp_path_factory):
    folder = tmp_path_factory.mktemp("stores") / "records.zarr"
    return hj.run_experiments(*arguments, **BATCH, store=folder, chunk=5)


@pytest.fixture
def stored(made, tmp_path):
    """A store of experiments in three chunks, for one test."""
    shutil.copytree(made.address, tmp_path / "records.zarr")
    return StoredExperiments(tmp_path / "records.zarr")


def records(parts):
    return np.concatenate([part.y for part in parts])


def test_parts_of_a_design_have_the_inputs_of_the_whole():
    u = DESIGN.signals(9)
    starts = range(0, COUNT, 5)
    parts = [DESIGN.signals(9, slice(k, k + 5)) for k in starts]
    assert_array_equal(np.concatenate(parts), u)
    for wrong in (slice(3, 3), slice(0, 9, 2), slice(COUNT, None)):
        with pytest.raises(
            hj.errors.DefinitionError, match="a slice of consecutive experiments"
        ):
            DESIGN.signals(experiments=wrong)


def test_a_stream_gives_the_records_and_the_estimate_of_the_whole(arguments, whole):
    parts = list(hj.run_experiments(*arguments, **BATCH, chunk=5))
    lengths = [len(part.u) for part in parts]
    assert lengths == [5, 5, 2]
    assert_array_equal(records(parts), whole.y)
    estimate = hj.estimate_htf(part for part in parts)
    expected = hj.estimate_htf(whole)
    assert_array_equal(estimate.frequencies, expected.frequencies)
    assert_allclose(estimate.H, expected.H, rtol=1e-9)
    noisy = hj.run_experiments(*arguments, **BATCH, **NOISE)
    parts = hj.run_experiments(*arguments, **BATCH, **NOISE, chunk=5)
    assert_array_equal(records(parts), noisy.y)
    assert (noisy.y != whole.y).any()


def test_workers_and_batches_change_nothing(arguments, whole):
    def run(workers=1):
        return hj.run_experiments(
            *arguments, execution=hj.scale.Execution(batch=5, workers=workers)
        )

    with no_compilation(after=run):
        for workers in (1, 3):
            data = run(workers)
            assert_array_equal(data.y, whole.y)
            assert_array_equal(data.error, whole.error)


def test_batches_are_alike_and_keep_all_workers_busy():
    for S in (1, 20, 80, 1000, 1001, 99_999):
        for workers in (1, 2, 7, 64):
            divided = divide(S, hj.scale.Execution(workers=workers))
            size = divided.batch
            used = divided.workers
            assert 1 <= used <= workers
            assert 1 <= size <= min(S, 320)
            number = -(-S // size)
            assert used == min(workers, number)
            if S >= 64 * workers:  # every worker has about the same to do
                assert used == workers
                assert number * size < 1.2 * S
    whole = hj.scale.Execution(256, 8)
    assert divide(1000, whole) == hj.scale.Execution(256, 4)
    halves = divide(80, hj.scale.Execution(workers=2))
    assert halves == hj.scale.Execution(40, 2)


def test_stored_experiments_are_those_of_the_whole(made, whole):
    assert len(made) == 3
    assert made.experiments == COUNT
    assert made.missing() == []
    assert_array_equal(records(made), whole.y)
    inputs = np.concatenate([part.u for part in made])
    assert_array_equal(inputs, whole.u)
    errors = np.concatenate([part.error for part in made])
    assert_array_equal(errors, whole.error)
    assert_array_equal(made[0].cycle_outputs, whole.cycle_outputs)
    assert made[0].outputs[0].unit == "m"
    assert made.summary() == whole.summary() == "12/12 ok"
    assert "12 experiments, 3 of 3 chunks" in repr(StoredExperiments(made.address))
    assert made.dataset.y.dims == ("experiment", "sample", "output")
    stored = made.dataset.y.sel(output="v")
    assert_array_equal(stored, whole.y[..., 1])
    found = hj.estimate_htf(made).H
    expected = hj.estimate_htf(whole).H
    assert_allclose(found, expected, rtol=1e-9)


def test_labels_of_results_name_their_codes(stored):
    """Code 2 is not in use, so that codes after it are not the positions of their names."""
    Result = hj.errors.Result

    def labels():
        flags = StoredExperiments(stored.address).dataset.result.attrs
        return dict(
            zip(flags["flag_meanings"].split(), flags["flag_values"], strict=True)
        )

    expected = {code.name.lower(): int(code) for code in Result}
    assert labels() == expected
    # A store of an earlier version has the positions.
    file = pathlib.Path(stored.address) / "result" / "zarr.json"
    about = json.loads(file.read_text())
    about["attributes"]["flag_values"] = list(range(len(Result)))
    file.write_text(json.dumps(about))
    assert labels() == expected


def test_only_what_is_missing_or_damaged_is_run(stored, arguments, whole, tmp_path):
    (tmp_path / "records.zarr/y/c/1/0/0").unlink()
    assert stored.missing() == [1]
    with pytest.raises(hj.errors.DefinitionError, match="1 of 3 chunks .* are missing"):
        hj.estimate_htf(stored)
    rotten = tmp_path / "records.zarr/u/c/2/0/0"
    content = bytearray(rotten.read_bytes())
    content[100] ^= 1
    rotten.write_bytes(content)
    with pytest.raises(hj.errors.FileFormatError, match="piece 2 .* is damaged in `u`"):
        stored[2]
    before = (tmp_path / "records.zarr/y/c/0/0/0").stat().st_mtime_ns
    again = hj.run_experiments(*arguments, **BATCH, store=stored.address, chunk=5)
    assert_array_equal(records(again), whole.y)
    assert (tmp_path / "records.zarr/y/c/0/0/0").stat().st_mtime_ns == before


@pytest.mark.parametrize("lost", ["cycle_outputs/c/0/0", "start/0"])
def test_a_store_without_what_it_began_with_is_refused(lost, stored, tmp_path):
    """(Zarr reads a chunk that is not there as zeros.)"""
    path = tmp_path / "records.zarr" / lost
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    with pytest.raises(hj.errors.DefinitionError, match="holds no experiments"):
        StoredExperiments(stored.address)


def test_other_experiments_are_refused(made, arguments):
    cycle, placed, _, _ = arguments

    def where(p):
        return (p.cycle.system.damping, p.cycle.numbers["damping"])

    other = eqx.tree_at(where, placed, (jnp.asarray(0.11),) * 2)
    velocity = hj.Output("speed", lambda t, q, u: -q[1], "m/s")
    cases = (
        (
            dict(design=hj.multisine(8, 8, (0, 4.0), experiments=COUNT, seed=1)),
            "`design",
        ),
        (dict(outputs=("x", velocity)), "`data.outputs"),
        (dict(sections=hj.ClockPhase(8, anchor=hj.Crossing("v", "rising"))), "`family"),
        (NOISE, "`process_noise"),
        (
            dict(cycle=other.cycle, sections=other),
            "`model.numbers.damping` is 0.1, not 0.11",
        ),
    )
    names = ("cycle", "sections", "design", "outputs")
    for change, difference in cases:
        call = dict(zip(names, arguments, strict=True))
        call |= dict(chunk=5) | BATCH | change
        with pytest.raises(
            hj.errors.DefinitionError, match=f"holds other results: .*{difference}"
        ):
            hj.run_experiments(**call, store=made.address)


@pytest.mark.parametrize(
    "start", ["periodic", pytest.param("steady", marks=pytest.mark.slow)]
)
def test_another_process_can_run_a_piece(arguments, start):
    """It gets all but what is compiled, and gives the same records."""
    cloudpickle = pytest.importorskip("cloudpickle")
    options = RunOptions(start=start, discard=8)
    plan = prepare(*arguments, options, 2)
    blocks = Blocks((COUNT,), (2,))
    job = ExperimentJob(plan, blocks)
    _, layout = job.begin()
    pickled = cloudpickle.dumps(job.resume(layout, job.arrays()))
    sent = cloudpickle.loads(pickled)
    mine = job.run(0, None)
    theirs = sent.run(0, 1)
    assert mine.keys() == theirs.keys()
    for name, values in mine.items():
        assert_array_equal(theirs[name], values)


def test_parts_that_do_not_fit_together_and_folders_that_are_no_store(
    whole, arguments, tmp_path
):
    other = hj.experiments.ExperimentData(whole.u, whole.y, n_sections=8, periods=4)
    n = np.arange(64)[None, :, None]
    phase = 2 * np.pi * n / 64
    good = np.cos(phase * 3)
    fast = 2 * np.pi * n / 64 * 19
    high = np.cos(fast)
    good, bad = (
        hj.experiments.ExperimentData(u, u, n_sections=4, periods=16)
        for u in (good, good + high)
    )
    for parts, message in (
        ([whole, other], "`data` have different sections, periods or signals"),
        ([], "not an empty list"),
        ([good, good, bad], "experiment 2: f = "),
    ):
        with pytest.raises(hj.errors.DefinitionError, match=message):
            hj.estimate_htf(parts)
    with pytest.raises(hj.errors.DefinitionError, match="holds no experiments"):
        StoredExperiments(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(hj.errors.DefinitionError, match="file"):
        hj.run_experiments(*arguments, store=tmp_path / "file")
