"""Starts in the periodic response of the nonlinear system, and process noise."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj
from hybridjax.experiments import start as steady

from ..conftest import no_compilation


SECTIONS = hj.KinematicPhase(4, position="x", velocity="v")
DESIGN = hj.multisine(4, 3, (0, 1.2), 0.05, seed=1)
ALONE = hj.Execution(workers=1)


@pytest.fixture(scope="module")
def response(vanderpol_cycle):
    return hj.response_function(vanderpol_cycle, SECTIONS, ("x", "v"))


@pytest.fixture(scope="module")
def settled(response):
    @eqx.filter_jit
    def run(u, system):
        start = response.steady_start(u, system)
        return response(jnp.concatenate([u, u], axis=1), start, system).y

    return run


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
    run(1)
    with no_compilation():
        run(2)


def test_a_steady_start_that_is_not_there_is_named(vanderpol_cycle, monkeypatch):
    monkeypatch.setattr(steady, "MOST_STEPS", 1)
    u = np.tile(DESIGN.inputs()[:1], (3, 1, 1)) * np.array([0.0, 1.0, 0.0])[:, None, None]
    with pytest.raises(hj.ComputationError, match="experiment 1: no periodic response was found"):
        hj.run_experiments(vanderpol_cycle, SECTIONS, u, "x", start="steady", execution=ALONE)


@pytest.mark.slow
def test_the_response_repeats_from_the_first_sample_on(vanderpol_cycle, settled):
    u = DESIGN.inputs()
    y = settled(u, vanderpol_cycle.system)
    n = u.shape[1]
    np.testing.assert_allclose(y[:, :n], y[:, n:], atol=1e-8)
    data = hj.run_experiments(
        vanderpol_cycle, SECTIONS, DESIGN, ("x", "v"), start="steady", discard=3, execution=ALONE
    )
    np.testing.assert_allclose(data.y + np.tile(data.cycle_outputs, (6, 1)), y, atol=1e-8)


@pytest.mark.slow
def test_the_root_has_exact_derivatives(vanderpol_cycle, settled):
    u = jnp.asarray(DESIGN.inputs())
    system = vanderpol_cycle.system

    def last(c):
        bent = eqx.tree_at(lambda s: s.mu, system, system.mu + c)
        return settled(u * (1 + c), bent)[0, -3:, 0]

    _, slope = jax.jvp(last, (0.0,), (1.0,))
    h = 1e-4
    np.testing.assert_allclose(slope, (last(h) - last(-h)) / (2 * h), rtol=1e-5, atol=1e-9)


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
