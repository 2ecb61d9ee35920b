"""Deviations under noise, against closed forms and a simulated million of bounces."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import solve_discrete_lyapunov

import hybridjax as hj

from .test_responses import Juggler, Neuron, StuartLandau


G = 9.81
TABLE = 2e-3  # standard deviation of the height of the table
SPEED = 3e-3  # and of the speed after a bounce
NOISE = dict(guards={"impact": TABLE}, resets={"impact": {"v": SPEED}})


def paddle(t):
    return 0.15 * np.sin(2 * np.pi * t)


def slope(t):
    phase = 2 * np.pi * t
    return 0.3 * np.pi * np.cos(phase)


def bend(t):
    phase = 2 * np.pi * t
    return -0.6 * np.pi**2 * np.sin(phase)


@pytest.fixture(scope="module")
def juggler():
    guess = hj.Guess("fall", (0.2, 4.5), time=0.1)
    return hj.find_limit_cycle(Juggler(), guess)


def _at_impact(cycle):
    orbit = cycle.trajectory()
    (impact,) = orbit.events
    k = list(orbit.t).index(impact.time)
    return impact.time, float(orbit.after[k][1])


@pytest.mark.core
def test_the_jitter_of_integrate_and_fire_neurons_has_its_closed_form():
    cycle = hj.find_limit_cycle(Neuron())
    period = np.log(6)
    threshold = cycle.fluctuations(guards={"spike": 0.01})  # where v' = 0.2
    assert_allclose(threshold.durations(), [[0.05**2]], rtol=1e-12)
    assert_allclose(threshold.diffusion, 0.05**2 / period, rtol=1e-12)
    assert_allclose(threshold.durations(lag=1), 0, rtol=0, atol=1e-17)
    white = cycle.fluctuations(white={"u": 0.01})  # its integral with exp(t) / 1.2
    expected = 1e-4 * 35 / 2 / 1.44
    assert_allclose(white.durations(), [[expected]], rtol=1e-12)
    assert "standard deviation from spike to spike" in str(white)


@pytest.mark.core
def test_a_noisy_stuart_landau_oscillator_has_its_closed_form():
    mu = 0.1
    alpha = -0.4
    omega = 1.0 - alpha * mu
    strength = 1e-3
    phases = np.array([0.0, 0.2, 0.7])
    angle = 2 * np.pi * phases
    section = hj.Crossing("y", "rising")
    guess = hj.Guess("plane", (0.33, 0.0))
    cycle = hj.find_limit_cycle(StuartLandau(), guess, section=section)
    noisy = cycle.fluctuations({"x": strength})

    # The amplitude r follows r' = -2 mu r + cos(omega t) dW.
    even = 0.4 * np.cos(2 * angle)
    odd = 2 * omega * np.sin(2 * angle)
    double = even + odd
    size = 0.4**2 + 4 * omega**2
    sum_of_rates = 1 / 0.4 + double / size
    variance = strength**2 / 2 * sum_of_rates
    # At equal phases d angle = alpha dr / r, so that deviations have one direction.
    x = np.cos(angle) - alpha * np.sin(angle)
    y = np.sin(angle) + alpha * np.cos(angle)
    now = noisy.covariance(phases)
    expected_now = variance * x * y
    assert_allclose(now[:, 0, 1], expected_now, rtol=1e-11)
    later = noisy.covariance(phases, 1)
    decay = np.exp(-2 * mu * 2 * np.pi / omega)
    expected_later = decay * variance * y**2
    assert_allclose(later[:, 1, 1], expected_later, rtol=1e-11)

    shear = 1 + alpha**2
    relative = strength**2 * shear / (2 * mu)
    diffusion = relative / omega**2
    assert_allclose(noisy.diffusion, diffusion, rtol=1e-11)
    # Periods are correlated, and over many of them their variance is that of the diffusion.
    alone = noisy.durations()[0, 0]
    together = [noisy.durations(lag)[0, 0] for lag in range(1, 40)]
    total = alone + 2 * sum(together)
    assert_allclose(total, noisy.diffusion * noisy.period, rtol=1e-11)


def test_states_may_have_no_correlation():
    cycle = hj.find_limit_cycle(hj.models.Mathieu(epsilon=0.0))
    noisy = cycle.fluctuations({"u": 0.2})
    expected = 0.1 * np.eye(2)
    computed = noisy.covariance([0.3])[0]
    assert_allclose(computed, expected, rtol=0, atol=1e-12)


def test_a_noisy_juggler_has_the_closed_form_of_its_bounces(juggler):
    """The chain of times, heights and speeds (t, y, v) after bounces."""
    noisy = juggler.fluctuations(**NOISE)
    (t, v) = _at_impact(juggler)
    landing = v - G  # the speed after a period of 1
    relative = landing - slope(t)

    # How the next time, height and speed depend on those of this bounce.
    changes = np.array([landing, -1.0, -1.0])
    time = changes / relative
    duration = time - [1, 0, 0]
    height = slope(t) * time
    by_bend = 1.7 * bend(t) * time
    by_fall = 0.7 * G * duration
    speed = by_bend + by_fall - [0, 0, 0.7]
    step = np.stack([time, height, speed])
    # How they depend on a height of the table, and on a speed that is added after the bounce.
    change = 1.7 * bend(t) + 0.7 * G
    by_time = np.array([1.0, slope(t), change])
    by_table = by_time / relative + [0, 1, 0]
    of_table = np.outer(by_table, by_table)
    of_speed = np.diag([0, 0, SPEED**2])
    noise = TABLE**2 * of_table + of_speed
    C = solve_discrete_lyapunov(step, noise)

    since = float(juggler.anchor.t[0]) + 1 - t  # from a bounce to the anchor
    speed_there = v - G * since
    now = np.array([[-speed_there, 1.0, since], [G, 0.0, 1.0]])
    expected = now @ C @ now.T
    assert_allclose(noisy.covariance([0.0])[0], expected, rtol=1e-11)
    expected = now @ step @ step @ C @ now.T
    computed_later = noisy.covariance([0.0], 2)[0]
    assert_allclose(computed_later, expected, rtol=1e-11)

    # A duration is the difference of two times.
    once = step @ C
    twice = step @ step @ C
    times = [C[0, 0], once[0, 0], twice[0, 0]]
    expected = 2 * (times[0] - times[1])
    assert_allclose(noisy.durations()[0, 0], expected, rtol=1e-12)
    expected = 2 * times[1] - times[0] - times[2]
    found = noisy.durations(1)[0, 0]
    assert_allclose(found, expected, rtol=1e-11)


def test_a_million_simulated_bounces_scatter_as_computed(juggler):
    noisy = juggler.fluctuations(**NOISE)
    rng = np.random.default_rng(0)
    jugglers = 2000
    transient = 60
    start, speed = _at_impact(juggler)
    t = np.full(jugglers, start)
    y = np.full(jugglers, paddle(start))
    v = np.full(jugglers, speed)
    deviations = []
    for bounce in range(560):
        table = TABLE * rng.normal(size=jugglers)
        duration = np.ones(jugglers)
        for _ in range(8):  # Newton's method
            fallen = G / 2 * duration**2
            height = y + v * duration - fallen
            gap = height - paddle(t + duration) - table
            rate = v - G * duration - slope(t + duration)
            duration = duration - gap / rate
        t = t + duration
        y = paddle(t) + table
        impact = v - G * duration
        v = 1.7 * slope(t) - 0.7 * impact
        v = v + SPEED * rng.normal(size=jugglers)
        if bounce >= transient:
            deviations.append(duration - 1)
    x = np.array(deviations)
    for lag in (0, 1, 2):
        later = x[lag:]
        earlier = x[: len(x) - lag]
        products = later * earlier
        covariance = products.mean(axis=0)  # of each of the independent jugglers
        standard_error = covariance.std(ddof=1) / np.sqrt(jugglers)
        computed = noisy.durations(lag)[0, 0]
        error = covariance.mean() - computed
        assert abs(error) < 3 * standard_error, f"lag {lag}"


def test_noise_that_does_not_fit_is_refused(juggler):
    with pytest.raises(
        hj.errors.DefinitionError, match="`white`: there is no state or input 'w'"
    ):
        juggler.fluctuations({"w": 1.0})
    with pytest.raises(
        hj.errors.DefinitionError, match="`guards`: there is no transition 'bounce'"
    ):
        juggler.fluctuations(guards={"bounce": 1.0})
    with pytest.raises(
        hj.errors.DefinitionError,
        match="`resets`: after 'impact' there is no state 'w'",
    ):
        juggler.fluctuations(resets={"impact": {"w": 1.0}})
    unstable = hj.find_limit_cycle(hj.models.BuckConverter(Vin=26.0))
    with pytest.raises(hj.errors.ComputationError, match="not stable"):
        unstable.fluctuations({"v": 1.0})


class _Adaptive(hj.Chart):
    """An integrate-and-fire neuron, and a state that follows it; the input acts on that alone."""

    states = ("v", "w")

    def field(self, t, q, u):
        follow = q[0] - q[1] + u[0]
        return 1.2 - q[0], follow


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
    guess = hj.Guess("sub", (0.5, 1.0))
    cycle = hj.find_limit_cycle(_Follower(), guess)
    follower = np.array([[0, 0], [0, 0.2**2 / 2]])  # w' = -w + noise, unless v matters
    for strength, expected in (({"u": 0.2}, follower), ({"idle": 0.2}, 0 * follower)):
        noisy = cycle.fluctuations(white=strength)
        assert noisy.diffusion == 0
        assert np.array_equal(noisy.durations(), [[0]])
        assert np.array_equal(noisy.durations(lag=1), [[0]])
        assert "0: standard deviation from spike to spike" in str(noisy)
        for C in noisy.covariance([0.2, 0.7]):
            assert_allclose(C, expected, rtol=1e-10, atol=0)
