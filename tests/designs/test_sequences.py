"""Random inputs with the spectrum of a design."""

import numpy as np
import pytest

import hybridjax as hj
from hybridjax.designs.sequences import random_sequence

from .two_inputs import NOISE, model as model, usual as usual


@pytest.fixture(scope="module")
def plan(model, usual):
    return hj.optimal_design(
        model, usual, noise=NOISE,
        goal=hj.designs.Multipliers(harmonics=(-2, -1, 0, 1, 2)), limit={"u0": 0.1, "u1": 0.1},
    )  # fmt: skip


def measured(u, channel, plan):
    """Mean squares around each line, from the discrete Fourier transform."""
    cycles = len(u) // 6
    power = 2 * np.abs(np.fft.rfft(u[:, channel]) / len(u)) ** 2
    line = np.rint(np.arange(len(power)) * 32 / cycles).astype(int)
    return np.bincount(line, power)[np.rint(plan.frequencies * 32).astype(int)]


@pytest.mark.parametrize("kind", ["gaussian", "binary"])
def test_the_spectrum_is_as_said(plan, kind):
    """Over 40 sequences of 320 cycles, within five standard errors of chi square: each line has 10
    frequencies."""
    made = [plan.sequence(320, kind, seed) for seed in range(40)]
    for channel in (0, 1):
        here = plan.channels == channel
        found = np.mean([measured(one.u, channel, plan)[here] for one in made], axis=0)
        said = made[0].power[here]
        error = 5 * said / np.sqrt(40 * 10) + 1e-3 * said.max()
        assert (np.abs(found - said) < error).all()
    assert made[0].power.sum() == pytest.approx(plan.power.sum(), rel=0.1)


def test_the_arcsine_law():
    """A binary sequence has a smooth spectrum as it is wanted; 0.2 would be missed without the
    law."""
    f = np.arange(1, 96) / 32
    power = 1 / (1 + f**2)
    shape = (6, 32, 320, 1)
    made = random_sequence(np.arange(1, 96), np.zeros(95, int), power, shape, "binary", 0)
    assert np.abs(made.power - power).sum() < 0.05 * power.sum()


@pytest.mark.parametrize("cycles", [1, 16, 31])
def test_sequences_that_do_not_tell_lines_apart(plan, cycles):
    with pytest.raises(hj.DefinitionError, match=f"{cycles} cycles do not tell lines apart"):
        plan.sequence(cycles)


def test_two_values(plan):
    u = plan.sequence(64, "binary").u
    np.testing.assert_allclose(np.abs(u), np.full(u.shape, 0.1), rtol=1e-3)
    assert np.abs(u.mean(axis=0)).max() < 0.05
    assert (plan.sequence(64, "binary", seed=1).u != u).any()


def test_an_odd_number_of_samples_is_refused():
    model = hj.LDTP(np.full((3, 1, 1), 0.8), np.ones((3, 1, 1)), np.ones((3, 1, 1)))
    plan = hj.optimal_design(
        model, hj.multisine(3, 32, band=(0, 1.5)), goal=hj.designs.Multipliers(harmonics=0)
    )
    with pytest.raises(hj.DefinitionError, match="odd number of samples"):
        plan.sequence(33)


@pytest.mark.slow
def test_fits_of_series_gain_what_is_promised(model):
    """Errors of `fit_series` with the optimal spectrum against white noise of the same rms: the
    ratio of the variances is that of the designs, within four standard errors."""
    usual = hj.multisine(6, 32, band=(0, 3), inputs=model.inputs)
    plan = hj.optimal_design(
        model, usual, noise=NOISE, limit={"u0": 0.1, "u1": 0.1},
        goal=hj.designs.Multipliers(harmonics=(-2, -1, 0, 1, 2)),
    )  # fmt: skip
    rng, draws, square = np.random.default_rng(0), 60, []
    for white in (True, False):
        errors = []
        for seed in range(draws):
            u = plan.sequence(320, seed=seed).u
            if white:
                u = 0.1 * rng.normal(size=u.shape)
            y = np.asarray(model.simulate(u))
            y = y + rng.normal(size=y.shape) * list(NOISE.values())
            fit = hj.fit_series(hj.Record(u, y, n_sections=6), 2, check=False)
            errors.append(np.abs(fit.multipliers - model.multipliers)[0])
        square.append(np.mean(np.square(errors)))
    spread = 4 * np.sqrt(2 * 2 / draws)
    assert square[0] / square[1] == pytest.approx(plan.saved, rel=spread)
    assert square[0] > square[1]
