"""Pushes at some sections of the cycle only."""

import numpy as np
import pytest

import hybridjax as hj

from .two_inputs import NOISE, model as model, usual as usual


GOAL = hj.designs.Multipliers(harmonics=(-1, 0, 1))


def test_estimates_are_those_of_the_system_from_the_signal(model, usual):
    """Pushed through the windows by hand; the pushes have the rms of the signal."""
    window = hj.designs.Window([1, 1, 0, 0, 1, 0])
    u = window.pushes(usual)
    assert not u.reshape(-1, 6, 2)[:, [2, 3, 5]].any()
    np.testing.assert_allclose(np.mean(u**2), np.mean(usual.inputs() ** 2), rtol=1e-9)
    x0 = model.periodic_states(u, 32)
    y = np.stack([model.simulate(one, x) for one, x in zip(u, x0, strict=True)])
    data = hj.ExperimentData(u, y, n_sections=6, periods=32, inputs=model.inputs)
    found = hj.estimate_htf(window.with_signal(data, usual))
    exact = window.seen_from_signal(model).htf(found.f, found.harmonics)
    np.testing.assert_allclose(found.H, exact.H, atol=1e-9)


def test_the_best_window_is_the_best_of_all_arcs(model, usual):
    asked = dict(goal=GOAL, noise=NOISE, limit={"u0": 0.1, "u1": 0.05})

    def plan(m):
        return hj.optimal_design(m, usual, **asked)

    choice = hj.designs.choose_window(model, usual, **asked, shortest=3)
    weights = [np.isin(np.arange(6), (first + np.arange(3)) % 6) * 1.0 for first in range(6)]
    every = [plan(hj.designs.Window(w).seen_from_signal(model)).criterion for w in weights]
    assert choice.plan.criterion == pytest.approx(min(every))
    assert choice.saved == pytest.approx(plan(model).criterion / min(every)) and choice.saved > 1
    assert choice.certificate.max() < 1.03
    assert "does the work of" in repr(choice)


def test_windows_are_halved_more_than_once():
    """Of one slow state, what counts is the sum of B in the window, by the root of its length: the
    best half is that from 4 on, and the best two sections lie half before it. (In arcs where a push
    does nothing there is nothing to design.)"""
    push = np.array([0, 0, 0, 0.9, 1, 0.5, 0.5, 0.5])[:, None, None]
    slow = hj.LDTP(np.full((8, 1, 1), 0.99), push, np.ones((8, 1, 1)))
    choice = hj.designs.choose_window(
        slow, hj.multisine(8, 16, band=(0, 2)), noise={"y": 0.01}, limit={"u": 0.1},
        goal=hj.designs.Multipliers(harmonics=0, overhang=0),
    )  # fmt: skip
    assert np.flatnonzero(choice.window.weights).tolist() == [3, 4]
    share = np.array([3.4**2 / 8, 2.5**2 / 4, 1.9**2 / 2, 1.0])
    found = [choice.criterion[choice.length == length].min() for length in (8, 4, 2, 1)]
    np.testing.assert_allclose(found[0] / found, share / share[0], rtol=0.1)


def test_nothing_gained_is_said():
    """The same at all sections."""
    still = hj.LDTP(np.full((4, 1, 1), 0.8), np.ones((4, 1, 1)), np.ones((4, 1, 1)))
    usual = hj.multisine(4, 32, band=(0, 2))

    asked = dict(goal=hj.designs.Multipliers(harmonics=0), noise={"y": 0.01}, limit={"u": 0.1})
    choice = hj.designs.choose_window(still, usual, **asked)
    assert choice.window is None and choice.saved == 1
    assert "nothing is gained" in repr(choice)


def test_bad_windows(model, usual):
    with pytest.raises(hj.DefinitionError, match="different from zero"):
        hj.designs.Window(np.zeros(6))
    with pytest.raises(hj.DefinitionError, match="has 4 sections, the model 6"):
        hj.designs.Window(np.ones(4)).seen_from_signal(model)
    with pytest.raises(hj.DefinitionError, match="has 4 sections, the design 6"):
        hj.designs.Window(np.ones(4)).pushes(usual)
