"""Starts in the periodic response of the nonlinear system, and process noise."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj
from hybridjax.experiments import start as steady

from ..conftest import no_compilation


DESIGN = hj.multisine(4, 3, (0, 1.2), 0.05, seed=1)
ALONE = hj.scale.Execution(workers=1)


@pytest.fixture(scope="module")
def placed(vanderpol_cycle):
    sections = hj.KinematicPhase(4, position="x", velocity="v")
    return hj.sections.place_sections(vanderpol_cycle, sections)


@pytest.fixture(scope="module")
def run(placed):
    """Experiments of six cycles: one program for all tests."""
    usual = dict(discard=3, execution=ALONE)

    def run(design, **options):
        return hj.run_experiments(
            placed.cycle, placed, design, ("x", "v"), **usual | options
        )

    return run


@pytest.mark.parametrize(
    "start, least, most", [("periodic", 1e-5, 1e-2), ("steady", 0, 1e-8)]
)
def test_experiments_start_in_their_periodic_response(run, start, least, most):
    data = run(DESIGN, start=start)
    n = DESIGN.signals().shape[1]
    first = data.y[:, :n]
    second = data.y[:, n:]
    change = np.abs(first - second)
    assert least <= change.max() < most
    with no_compilation(after=lambda: run(DESIGN, start=start)):
        design = hj.multisine(4, 3, (0, 1.2), 0.05, seed=2)
        run(design, start=start)


def test_experiments_from_which_a_steady_start_was_found_are_not_repeated(run):
    whole = run(DESIGN.signals(6), start="steady", discard=0)
    assert_allclose(whole.y, run(DESIGN, start="steady").y, rtol=0, atol=1e-8)


def test_small_inputs_have_the_effect_of_the_linearization(run, placed):
    model = hj.linearize(placed.cycle, placed, ("x", "v"))
    u = 1e-3 * DESIGN.signals(6)
    expected = np.stack([model.simulate(experiment) for experiment in u])
    tolerance = 1e-3 * np.abs(expected).max()
    assert_allclose(run(u, discard=0).y, expected, rtol=0, atol=tolerance)


def test_a_steady_start_that_is_not_there_is_named(run, monkeypatch):
    monkeypatch.setattr(steady, "MOST_STEPS", 1)
    u = (
        np.tile(DESIGN.signals(6)[:1], (3, 1, 1))
        * np.array([0.0, 1.0, 0.0])[:, None, None]
    )
    with pytest.raises(
        hj.errors.ComputationError, match="experiment 1: no periodic response was found"
    ):
        run(u, start="steady")


def test_process_noise_acts_but_is_not_recorded(run):
    def noisy(std):
        return run(
            DESIGN, start="periodic", process_noise=hj.experiments.ProcessNoise(std)
        )

    still = run(DESIGN, start="periodic")
    once = noisy(1e-3)
    assert_array_equal(once.u, DESIGN.signals(6))
    assert_array_equal(once.y, noisy(1e-3).y)
    change = np.std(once.y - still.y)
    assert 1e-5 < change < 1e-2
    noise = np.std(noisy(5e-4).y - still.y)
    assert_allclose(noise, change / 2, rtol=0.02)


def test_small_inputs_of_a_controller_have_the_effect_of_the_linearization(run, placed):
    model = hj.linearize(placed.cycle, placed, ("x", "v"))
    rng = np.random.default_rng(0)
    sizes = ((4, 1, 1), (4, 1, 2), (4, 1, 1), (4, 1, 2))
    A, B, C, D = [0.3 * rng.normal(size=size) for size in sizes]
    controller = hj.linear.LDTP(A, B, C, D, inputs=model.outputs, outputs=model.inputs)
    loop = model.feedback(controller)
    reference = 1e-3 * DESIGN.signals(6)
    data = run(reference, discard=0, feedback=controller)

    y = np.stack([loop.simulate(experiment) for experiment in reference])
    tolerance = 1e-3 * np.abs(y).max()
    assert_allclose(data.y, y, rtol=0, atol=tolerance)
    feedback = np.stack([controller.simulate(output) for output in y])
    u = reference - feedback
    tolerance = 1e-3 * np.abs(u).max()
    expected = np.dstack([u, reference])
    assert_allclose(data.u, expected, rtol=0, atol=tolerance)
