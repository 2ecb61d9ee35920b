"""Starts in the periodic response of the nonlinear system, and process noise."""

import numpy as np
import pytest

import hybridjax as hj
from hybridjax.experiments import start as steady

from ..conftest import no_compilation


SECTIONS = hj.KinematicPhase(4, position="x", velocity="v")
DESIGN = hj.multisine(4, 3, (0, 1.2), 0.05, seed=1)
ALONE = hj.Execution(workers=1)


def test_experiments_start_in_their_periodic_response(vanderpol_cycle):
    n = DESIGN.inputs().shape[1]
    for start, least, most in (("periodic", 1e-5, 1e-2), ("steady", 0, 1e-8)):
        data = hj.run_experiments(
            vanderpol_cycle, SECTIONS, DESIGN, ("x", "v"), start=start, discard=3, execution=ALONE
        )
        transient = np.abs(data.y[:, :n] - data.y[:, n:]).max()
        assert least <= transient < most


@pytest.mark.parametrize("start", ["periodic", "steady"])
def test_calls_that_are_repeated_compile_nothing(vanderpol_cycle, start):
    def run(seed):
        design = hj.multisine(4, 3, (0, 1.2), 0.05, seed)
        call = vanderpol_cycle, placed, design, ("x", "v")
        return hj.run_experiments(*call, start=start, execution=ALONE)

    placed = hj.place_sections(vanderpol_cycle, SECTIONS)
    with no_compilation(after=lambda: run(1)):
        run(2)


def test_a_steady_start_that_is_not_there_is_named(vanderpol_cycle, monkeypatch):
    monkeypatch.setattr(steady, "MOST_STEPS", 1)
    u = np.tile(DESIGN.inputs()[:1], (3, 1, 1)) * np.array([0.0, 1.0, 0.0])[:, None, None]
    with pytest.raises(hj.ComputationError, match="experiment 1: no periodic response was found"):
        hj.run_experiments(vanderpol_cycle, SECTIONS, u, "x", start="steady", execution=ALONE)


def test_process_noise_acts_but_is_not_recorded(vanderpol_cycle):
    def run(noise):
        return hj.run_experiments(
            vanderpol_cycle, SECTIONS, DESIGN, ("x", "v"), start="periodic", discard=3,
            process_noise=None if noise is None else hj.experiments.ProcessNoise(noise),
            execution=ALONE,
        )  # fmt: skip

    still, noisy, again = run(None), run(1e-3), run(1e-3)
    np.testing.assert_array_equal(noisy.u, DESIGN.inputs(6))
    np.testing.assert_array_equal(noisy.y, again.y)
    change = np.std(noisy.y - still.y)
    assert 1e-5 < change < 1e-2
    half = run(5e-4)
    np.testing.assert_allclose(np.std(half.y - still.y), change / 2, rtol=0.02)
