"""Many experiments: chunk by chunk, in batches, by threads.

All runs have batches of 40 experiments of 84 cycles, as in `test_run`: one program is compiled.
"""

import numpy as np
import pytest

import hybridjax as hj
from hybridjax.experiments.run import Options, divide

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


def test_parts_of_a_design_have_the_inputs_of_the_whole():
    u = DESIGN.inputs(9)
    parts = [DESIGN.inputs(9, slice(k, k + 30)) for k in range(0, COUNT, 30)]
    np.testing.assert_array_equal(np.concatenate(parts), u)
    for wrong in (slice(3, 3), slice(0, 9, 2), slice(COUNT, None)):
        with pytest.raises(hj.DefinitionError, match="no consecutive experiments"):
            DESIGN.inputs(experiments=wrong)


def test_a_stream_gives_the_records_and_the_estimate_of_the_whole(arguments, whole):
    parts = list(hj.experiments.stream_experiments(*arguments, Options(**BATCH), chunk=40))
    assert [len(part.u) for part in parts] == [40, 40, 20]
    np.testing.assert_array_equal(records(parts), whole.y)
    estimate = hj.estimate_htf(part for part in parts)
    expected = hj.estimate_htf(whole)
    np.testing.assert_array_equal(estimate.f, expected.f)
    np.testing.assert_allclose(estimate.H, expected.H, rtol=1e-12)


def test_process_noise_does_not_depend_on_the_chunks(arguments):
    noise = {"process_noise": hj.experiments.ProcessNoise(1e-3)}
    whole = hj.run_experiments(*arguments, **BATCH, **noise)
    parts = hj.experiments.stream_experiments(*arguments, Options(**BATCH, **noise), chunk=40)
    np.testing.assert_array_equal(records(parts), whole.y)


def test_workers_and_batches_change_nothing(arguments, whole):
    with no_compilation(after=lambda: hj.run_experiments(*arguments, **BATCH)):
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
