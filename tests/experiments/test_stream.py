"""Many experiments: chunks in memory and on disk, shares of processes, threads.

All runs have batches of 40 experiments of 84 cycles, as in `test_run`: one program is compiled.
"""

import contextlib
import json
import subprocess
import sys

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj
from hybridjax.experiments import store
from hybridjax.experiments.batches import divide

from ..conftest import OUTPUTS, no_compilation


COUNT = 100
DESIGN = hj.multisine(experiments=COUNT)
BATCH = dict(execution=hj.Execution(batch=40))


@pytest.fixture(scope="module")
def arguments(hopper_cycle, placed_isochrons):
    return hopper_cycle, placed_isochrons, DESIGN, OUTPUTS


@pytest.fixture(scope="module")
def whole(arguments):
    return hj.run_experiments(*arguments, **BATCH)


def records(parts):
    return np.concatenate([part.y for part in parts])


@pytest.fixture
def stored(arguments, tmp_path):
    return hj.experiments.store_experiments(tmp_path / "runs", *arguments, chunk=40, **BATCH)


def test_parts_of_a_design_have_the_inputs_of_the_whole():
    u = DESIGN.inputs(9)
    parts = [DESIGN.inputs(9, slice(k, k + 30)) for k in range(0, COUNT, 30)]
    np.testing.assert_array_equal(np.concatenate(parts), u)
    for wrong in (slice(3, 3), slice(0, 9, 2), slice(COUNT, None)):
        with pytest.raises(hj.DefinitionError, match="no consecutive experiments"):
            DESIGN.inputs(experiments=wrong)


def test_a_stream_gives_the_records_and_the_estimate_of_the_whole(arguments, whole):
    parts = list(hj.experiments.stream_experiments(*arguments, chunk=40, **BATCH))
    assert [len(part.u) for part in parts] == [40, 40, 20]
    np.testing.assert_array_equal(records(parts), whole.y)
    estimate = hj.estimate_htf(part for part in parts)
    expected = hj.estimate_htf(whole)
    np.testing.assert_array_equal(estimate.f, expected.f)
    np.testing.assert_allclose(estimate.H, expected.H, rtol=1e-12)


def test_inputs_may_lie_on_disk(arguments, whole, tmp_path):
    np.save(tmp_path / "u.npy", whole.u)
    u = np.load(tmp_path / "u.npy", mmap_mode="r")
    cycle, placed, _, outputs = arguments
    parts = hj.experiments.stream_experiments(
        cycle, placed, u, outputs, chunk=80, discard=20, **BATCH
    )
    np.testing.assert_array_equal(records(parts), whole.y)


def test_workers_and_batches_change_nothing(arguments, whole):
    with no_compilation():
        for workers in (1, 3):
            execution = hj.Execution(batch=40, workers=workers)
            data = hj.run_experiments(*arguments, execution=execution)
            np.testing.assert_array_equal(data.y, whole.y)
            np.testing.assert_array_equal(data.error, whole.error)


def test_batches_are_alike_and_keep_all_workers_busy():
    for S in (1, 20, 80, 1000, 1001, 99_999):
        for workers in (1, 2, 7, 64):
            divided = divide(S, hj.Execution(workers=workers))
            size, used = divided.batch, divided.workers
            assert 1 <= used <= workers and 1 <= size <= min(S, 320)
            number = -(-S // size)
            assert used == min(workers, number)
            if S >= 64 * workers:  # every worker has about the same to do
                assert used == workers and number * size < 1.2 * S
    assert divide(1000, hj.Execution(256, 8)) == hj.Execution(256, 4)
    assert divide(80, hj.Execution(workers=2)) == hj.Execution(40, 2)


def test_stored_experiments_are_those_of_the_whole(stored, whole):
    assert len(stored) == 3 and stored.experiments == COUNT and stored.missing() == []
    np.testing.assert_array_equal(records(stored), whole.y)
    np.testing.assert_allclose(hj.estimate_htf(stored).H, hj.estimate_htf(whole).H, rtol=1e-12)
    assert len(hj.identify.missing_frequencies(stored)) == 0
    assert stored.summary() == whole.summary() == "100/100 ok"
    assert "100 experiments, 3 of 3 chunks" in repr(hj.experiments.StoredExperiments(stored.folder))


def test_only_chunks_that_are_missing_are_run(stored, arguments, whole):
    before = [stored.path(k).stat().st_mtime_ns for k in range(3)]
    stored.path(1).unlink()
    assert stored.missing() == [1]
    with pytest.raises(hj.DefinitionError, match="1 of 3 chunks .* missing, the first is 1"):
        hj.estimate_htf(stored)
    with no_compilation():
        hj.experiments.store_experiments(stored.folder, *arguments, chunk=40, **BATCH)
    np.testing.assert_array_equal(records(stored), whole.y)
    after = [stored.path(k).stat().st_mtime_ns for k in range(3)]
    assert [a == b for a, b in zip(after, before, strict=True)] == [True, False, True]


def test_processes_share_the_chunks(arguments, whole, tmp_path):
    for rank in (1, 0):
        stored = hj.experiments.store_experiments(
            tmp_path, *arguments, chunk=40, share=(rank, 2), **BATCH
        )
        assert stored.missing() == ([0, 2] if rank else [])
    np.testing.assert_array_equal(records(stored), whole.y)


def test_an_interruption_leaves_whole_chunks_only(arguments, tmp_path, monkeypatch):
    import hybridjax.experiments.store

    write = hybridjax.experiments.store.write_module

    def interrupted(path, thing, part):
        if "000001" in path.name:
            raise KeyboardInterrupt
        write(path, thing, part)

    monkeypatch.setattr(hybridjax.experiments.store, "write_module", interrupted)
    with pytest.raises(KeyboardInterrupt):
        hj.experiments.store_experiments(tmp_path, *arguments, chunk=40, **BATCH)
    assert hj.experiments.StoredExperiments(tmp_path).missing() == [1, 2]
    assert len(list(tmp_path.iterdir())) == 2  # the manifest and one chunk


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (dict(design=hj.multisine(experiments=COUNT, seed=1)), "design"),
        (dict(design=DESIGN.inputs(84), discard=20), "design"),
        (dict(outputs="yM"), "outputs"),
        (dict(chunk=7), "chunk"),
        (dict(discard=1), "cycles"),
        (dict(accuracy=1e-8), "accuracy"),
        (dict(process_noise=hj.experiments.ProcessNoise(1e-3)), "process_noise"),
        (dict(start="steady"), "cycles"),
    ],
)
def test_another_design_in_the_folder_is_refused(stored, arguments, change, what):
    names = ("cycle", "sections", "design", "outputs")
    call = dict(zip(names, arguments, strict=True)) | dict(chunk=40) | BATCH | change
    with pytest.raises(hj.DefinitionError, match=f"other experiments .its `{what}`"):
        hj.experiments.store_experiments(stored.folder, **call)


def test_another_system_in_the_folder_is_refused(stored, arguments):
    _, placed, design, outputs = arguments
    other = eqx.tree_at(lambda p: p.cycle.system.k, placed, jnp.asarray(10.001, float))
    with pytest.raises(hj.DefinitionError, match="its `parameters` is not the same"):
        hj.experiments.store_experiments(
            stored.folder, other.cycle, other, design, outputs, chunk=40, **BATCH
        )


def test_chunks_that_are_not_whole_or_belong_elsewhere_are_named(stored, arguments):
    chunk = stored.path(2)
    content = chunk.read_bytes()
    chunk.write_bytes(content[:-100])
    with pytest.raises(hj.errors.FileFormatError, match="000002-.* is damaged: delete it"):
        hj.experiments.store_experiments(stored.folder, *arguments, chunk=40, **BATCH)
    chunk.write_bytes(content)
    chunk.rename(stored.folder / "000002-01234567.npz")
    with pytest.raises(hj.DefinitionError, match="000002-01234567.npz' does not belong"):
        hj.experiments.StoredExperiments(stored.folder)


def test_folders_without_experiments(tmp_path, arguments):
    with pytest.raises(hj.DefinitionError, match="there is no experiments.json"):
        hj.experiments.StoredExperiments(tmp_path)
    (tmp_path / "experiments.json").write_text(json.dumps({"format": "something"}))
    with pytest.raises(hj.errors.FileFormatError, match="damaged, or of another version"):
        hj.experiments.StoredExperiments(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(hj.DefinitionError, match="cannot write to"):
        hj.experiments.store_experiments(tmp_path / "file", *arguments, **BATCH)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(chunk=0), "`chunk` must be an integer from 1"),
        (dict(share=(2, 2)), "0 <= rank < size"),
    ],
)
def test_bad_numbers(arguments, tmp_path, change, message):
    with pytest.raises(hj.DefinitionError, match=message):
        hj.experiments.store_experiments(tmp_path, *arguments, **BATCH | change)


def test_arguments_that_do_not_exist(arguments, tmp_path):
    with pytest.raises(
        TypeError, match="stream_experiments has no argument 'stat'; .* chunk, start"
    ):
        hj.experiments.stream_experiments(*arguments, stat="cycle")
    with pytest.raises(TypeError, match="store_experiments has no argument 'works'.* share, start"):
        hj.experiments.store_experiments(tmp_path, *arguments, works=2)


@pytest.mark.parametrize(
    ("part", "entry", "change", "same"),
    [
        ("points", 0, 1e-9, True),
        ("points", 0, 1e-6, False),
        ("points", 2, 1e-9, True),
        ("points", 2, 1e-6, False),
        ("scales", 0, 1e-6, False),
        ("scales", 2, 1.0, True),
        ("scales", 2, 9.0, False),
    ],
)
@pytest.mark.parametrize("unit", [1.0, 1e-9])
def test_each_part_of_a_cycle_is_compared_in_its_own_size(
    tmp_path, part, entry, change, same, unit
):
    """(t, q) and what counts as 1 in each; sizes of states that rest are those of rounding."""
    scales = np.array([[1.0, 2.0, unit], [1.0, 2.0, unit]])
    cycle = {"points": 0.3 * scales, "scales": scales}
    about = {"format": store._FORMAT, "cycle": {k: x.tolist() for k, x in cycle.items()}}
    store._open(tmp_path, about)
    cycle[part] = cycle[part].copy()
    cycle[part][1, entry] += change * scales[1, entry]
    about["cycle"] = {k: x.tolist() for k, x in cycle.items()}
    with (
        contextlib.nullcontext() if same else pytest.raises(hj.DefinitionError, match="its `cycle`")
    ):
        store._open(tmp_path, about)


def test_estimates_of_parts_that_do_not_fit_together(whole):
    other = hj.ExperimentData(whole.u, whole.y, n_sections=32, periods=32)
    with pytest.raises(hj.DefinitionError, match="do not belong together"):
        hj.estimate_htf([whole, other])
    with pytest.raises(hj.DefinitionError, match="no experiments"):
        hj.estimate_htf([])


def test_parts_name_the_experiment_in_which_lines_meet():
    u = np.cos(2 * np.pi * np.arange(64) / 64 * 3)[None, :, None]
    good = hj.ExperimentData(u, u, n_sections=4, periods=16)
    n = np.arange(64)[None, :, None]
    both = np.cos(2 * np.pi * n / 64 * 3) + np.cos(2 * np.pi * n / 64 * 19)
    bad = hj.ExperimentData(both, both, n_sections=4, periods=16)
    with pytest.raises(hj.DefinitionError, match="experiment 2: f = "):
        hj.estimate_htf([good, good, bad])


SCRIPT = """
import sys
import hybridjax as hj
hj.enable_x64()
cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
phase = hj.ClockPhase(4)
design = hj.experiments.single_cosine([0.25, 0.75, 1.25], 4, 4)
share = int(sys.argv[2]), 2
hj.experiments.store_experiments(sys.argv[1], cycle, phase, design, "yM", chunk=1, share=share)
"""


@pytest.mark.slow
def test_two_processes_at_once(tmp_path):
    run = [
        subprocess.Popen([sys.executable, "-c", SCRIPT, str(tmp_path), str(rank)])
        for rank in (0, 1)
    ]
    assert [process.wait() for process in run] == [0, 0]
    assert hj.experiments.StoredExperiments(tmp_path).summary() == "3/3 ok"
