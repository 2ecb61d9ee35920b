"""Deviations under noise, against closed forms and a simulated million of bounces."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import solve_discrete_lyapunov

import hybridjax as hj

from .test_responses import Juggler, Neuron, StuartLandau


G, TABLE, SPEED = 9.81, 2e-3, 3e-3
NOISE = dict(guards={"impact": TABLE}, resets={"impact": {"v": SPEED}})


def paddle(t):
    return 0.15 * np.sin(2 * np.pi * t)


def slope(t):
    return 0.3 * np.pi * np.cos(2 * np.pi * t)


def bend(t):
    return -0.6 * np.pi**2 * np.sin(2 * np.pi * t)


@pytest.fixture(scope="module")
def juggler():
    return hj.find_limit_cycle(Juggler(), hj.Guess("fall", (0.2, 4.5), time=0.1))


def _at_impact(cycle):
    orbit = cycle.trajectory()
    (impact,) = orbit.events
    return impact.time, float(orbit.after[list(orbit.t).index(impact.time)][1])


@pytest.mark.core
def test_the_jitter_of_integrate_and_fire_neurons_has_its_closed_form():
    cycle = hj.find_limit_cycle(Neuron())
    period = np.log(6)
    threshold = cycle.fluctuations(guards={"spike": 0.01})  # where v' = 0.2
    assert_allclose(threshold.durations(), [[0.05**2]], rtol=1e-12)
    assert_allclose(threshold.diffusion, 0.05**2 / period, rtol=1e-12)
    assert_allclose(threshold.durations(lag=1), 0, rtol=0, atol=1e-17)
    white = cycle.fluctuations(white={"u": 0.01})  # its integral with exp(t) / 1.2
    assert_allclose(white.durations(), [[1e-4 * 35 / 2 / 1.44]], rtol=1e-12)
    assert "standard deviation from spike to spike" in str(white)


@pytest.mark.core
def test_a_noisy_stuart_landau_oscillator_has_its_closed_form():
    section = hj.Crossing("y", "rising")
    guess = hj.Guess("plane", (0.33, 0.0))
    cycle = hj.find_limit_cycle(StuartLandau(), guess, section=section)
    noisy = cycle.fluctuations({"x": 1e-3})
    # Of the amplitude r: r' = -0.2 r + cos(t w) dW; of the phase: see the closed form of Z.
    angle = 2 * np.pi * np.array([0.0, 0.2, 0.7])
    w = 1.0 + 0.4 * 0.1
    wave = 0.4 * np.cos(2 * angle) + 2 * w * np.sin(2 * angle)
    radial = 1e-6 / 2 * (1 / 0.4 + wave / (0.4**2 + 4 * w**2))
    # At equal phases d angle = alpha dr / r.
    along = np.cos(angle) + 0.4 * np.sin(angle), np.sin(angle) - 0.4 * np.cos(angle)
    C, later = (noisy.covariance([0.0, 0.2, 0.7], lag) for lag in (0, 1))
    assert_allclose(C[:, 0, 1], radial * along[0] * along[1], rtol=1e-11)
    decay = np.exp(-0.2 * 2 * np.pi / w)
    expected = decay * radial * along[1] ** 2
    assert_allclose(later[:, 1, 1], expected, rtol=1e-11)
    expected = 1e-6 * (1 + 0.4**2) / 0.2 / w**2
    assert_allclose(noisy.diffusion, expected, rtol=1e-11)
    # Periods are correlated, and over many of them their variance is that of the diffusion.
    both = noisy.durations()[0, 0] + 2 * sum(
        noisy.durations(k)[0, 0] for k in range(1, 40)
    )
    assert_allclose(both, noisy.diffusion * noisy.period, rtol=1e-11)


def test_states_may_have_no_correlation():
    noisy = hj.find_limit_cycle(hj.models.Mathieu(epsilon=0.0)).fluctuations({"u": 0.2})
    assert_allclose(noisy.covariance([0.3])[0], 0.1 * np.eye(2), rtol=0, atol=1e-12)


def test_a_noisy_juggler_has_the_closed_form_of_its_bounces(juggler):
    """The chain of times, heights and speeds (t, y, v) after bounces."""
    noisy = juggler.fluctuations(**NOISE)
    (t, v) = _at_impact(juggler)
    fall = v - G  # the speed with which it lands, after a period of 1
    late = np.array([fall, -1.0, -1.0]) / (fall - slope(t))
    early = late - [1, 0, 0]
    step = np.stack(
        [late, slope(t) * late, 1.7 * bend(t) * late + 0.7 * G * early - [0, 0, 0.7]]
    )
    table = np.array([1.0, slope(t), 1.7 * bend(t) + 0.7 * G]) / (fall - slope(t)) + [
        0,
        1,
        0,
    ]
    noise = TABLE**2 * np.outer(table, table) + np.diag([0, 0, SPEED**2])
    C = solve_discrete_lyapunov(step, noise)
    ago = float(juggler.anchor.t[0]) + 1 - t  # from a bounce to the anchor
    now = np.array([[-(v - G * ago), 1.0, ago], [G, 0.0, 1.0]])
    assert_allclose(noisy.covariance([0.0])[0], now @ C @ now.T, rtol=1e-11)
    measured = noisy.covariance([0.0], 2)[0]
    expected = now @ step @ step @ C @ now.T
    assert_allclose(measured, expected, rtol=1e-11)
    lags = [C[0, 0], *((np.linalg.matrix_power(step, k) @ C)[0, 0] for k in (1, 2))]
    expected = 2 * (lags[0] - lags[1])
    assert_allclose(noisy.durations()[0, 0], expected, rtol=1e-12)
    measured = noisy.durations(1)[0, 0]
    expected = 2 * lags[1] - lags[0] - lags[2]
    assert_allclose(measured, expected, rtol=1e-11)


def test_a_million_simulated_bounces_scatter_as_computed(juggler):
    noisy = juggler.fluctuations(**NOISE)
    (t, v) = _at_impact(juggler)
    rng = np.random.default_rng(0)
    draws = 2000
    t, y, v = np.full(draws, t), np.full(draws, paddle(t)), np.full(draws, v)
    durations = []
    for k in range(560):
        table = TABLE * rng.normal(size=draws)
        tau = np.ones(draws)
        for _ in range(8):
            off = y + v * tau - G / 2 * tau**2 - paddle(t + tau) - table
            tau = tau - off / (v - G * tau - slope(t + tau))
        t = t + tau
        y = paddle(t) + table
        v = 1.7 * slope(t) - 0.7 * (v - G * tau)
        v = v + SPEED * rng.normal(size=draws)
        if k >= 60:
            durations.append(tau - 1)
    x = np.array(durations)
    for lag in (0, 1, 2):
        each = (x[lag:] * x[: len(x) - lag]).mean(
            axis=0
        )  # one for each of independent jugglers
        error = each.std(ddof=1) / np.sqrt(draws)
        assert abs(each.mean() - noisy.durations(lag)[0, 0]) < 3 * error


def test_noise_that_does_not_fit_is_refused(juggler):
    with pytest.raises(
        hj.DefinitionError, match="`white`: there is no state or input 'w'"
    ):
        juggler.fluctuations({"w": 1.0})
    with pytest.raises(
        hj.DefinitionError, match="`guards`: there is no transition 'bounce'"
    ):
        juggler.fluctuations(guards={"bounce": 1.0})
    with pytest.raises(
        hj.DefinitionError, match="`resets`: after 'impact' there is no state 'w'"
    ):
        juggler.fluctuations(resets={"impact": {"w": 1.0}})
    unstable = hj.find_limit_cycle(hj.models.BuckConverter(Vin=26.0))
    with pytest.raises(hj.ComputationError, match="not stable"):
        unstable.fluctuations({"v": 1.0})


class _Adaptive(hj.Chart):
    """An integrate-and-fire neuron, and a state that follows it; the input acts on that alone."""

    states = ("v", "w")

    def field(self, t, q, u):
        return 1.2 - q[0], q[0] - q[1] + u[0]


class _Follower(hj.HybridSystem):
    inputs = ("u", "idle")

    def charts(self):
        return {"sub": _Adaptive()}

    def transitions(self):
        def threshold(t, q, u):
            return 1 - q[0]

        def after(t, q, u):
            return (0.0, q[1] + 1)

        return [hj.Transition("spike", "sub", "sub", guard=threshold, reset=after)]


def test_noise_without_an_effect_gives_zero():
    cycle = hj.find_limit_cycle(_Follower(), hj.Guess("sub", (0.5, 1.0)))
    follower = np.array([[0, 0], [0, 0.2**2 / 2]])  # w' = -w + noise, unless v matters
    for strength, expected in (({"u": 0.2}, follower), ({"idle": 0.2}, 0 * follower)):
        noisy = cycle.fluctuations(white=strength)
        assert noisy.diffusion == 0
        assert np.array_equal(noisy.durations(), [[0]])
        assert np.array_equal(noisy.durations(lag=1), [[0]])
        assert "0: standard deviation from spike to spike" in str(noisy)
        for C in noisy.covariance([0.2, 0.7]):
            assert_allclose(C, expected, rtol=1e-10, atol=0)
