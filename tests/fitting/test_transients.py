"""Fits to trajectories that are no cycles: drops of a ball with drag."""

import re

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import solve_ivp

import hybridjax as hj
from hybridjax.errors import ComputationError, DefinitionError


def ball(**numbers):
    def fall(t, q, u, p):
        size = jnp.abs(q[1])
        drag = p.drag * size * q[1]
        return q[1], -p.g - drag

    def bounce(t, q, u, p):
        return q[0], -p.e * q[1]

    own = {"g": 9.81, "e": 0.7, "drag": 0.05}
    events = [("bounce", lambda t, q, u, p: q[0], bounce)]
    system = hj.HybridSystem.from_functions(("y", "v"), fall, events, own, inputs=())
    return system.replace(**numbers)


TIMES = np.arange(1, 60) / 50
TRUE = {"e": 0.78, "drag": 0.12}


def drop(height):
    """Heights at TIMES and times of two bounces, by scipy."""

    def fall(t, q):
        size = abs(q[1])
        drag = TRUE["drag"] * size * q[1]
        return q[1], -9.81 - drag

    def ground(t, q):
        return q[0]

    ground.terminal = True
    ground.direction = -1
    t = 0.0
    q = np.array([height, 0.0])
    heights = []
    bounces = []
    while t < TIMES[-1]:
        options = dict(
            rtol=1e-12,
            atol=1e-14,
            method="DOP853",
            dense_output=True,
        )
        found = solve_ivp(fall, (t, 1.5), q, events=ground, **options)
        is_later = TIMES > t
        has_come = TIMES <= found.t[-1]
        own = TIMES[is_later & has_come]
        heights.append(found.sol(own)[0])
        t = found.t[-1]
        before = found.y[1, -1]
        speed = -TRUE["e"] * before
        q = np.array([0.0, speed])
        bounces.append(t)
    return np.concatenate(heights), bounces[:2]


def observed(height, seed=None, **options):
    y, bounces = drop(height)
    y = y[:, None].copy()
    if seed is not None:
        draws = np.random.default_rng(seed).normal(size=y.shape)
        y += 0.003 * draws
        options["std"] = 0.003
    y[7] = np.nan  # (a frame without the ball)
    begin = hj.Guess("main", (height + 0.02, 0.1))
    options.setdefault("unknown_states", ("y", "v"))
    return hj.fitting.ObservedTrajectory(begin, TIMES, "y", y, **options)


def test_parameters_and_starts_of_two_drops_are_those_of_scipy():
    data = [observed(1.0), observed(1.5)]
    fit = hj.fit_model(ball(), data, ("e", "drag"))
    assert fit.names[2:] == (
        "y at start 1",
        "v at start 1",
        "y at start 2",
        "v at start 2",
    )
    expected = (*TRUE.values(), 1.0, 0.0, 1.5, 0.0)
    assert_allclose(fit.values, expected, atol=1e-6)
    measured = 2 * (len(TIMES) - 1)
    assert len(fit.residuals) == measured
    assert fit.cycle is None
    assert_allclose(float(fit.system.e), TRUE["e"], atol=1e-6)


@pytest.mark.slow
def test_times_of_events_alone_identify_the_restitution():
    _, bounces = drop(1.0)
    begin = hj.Guess("main", (1.0, 0.0))
    data = hj.fitting.ObservedTrajectory(begin, events={"bounce": bounces})
    fit = hj.fit_model(ball(drag=TRUE["drag"]), data, "e")
    assert_allclose(fit.values, TRUE["e"], atol=1e-7)
    seen = hj.fitting.identifiability(ball(), data, ("e", "drag", "g"))
    assert seen.rank == 2


def test_values_of_one_output_need_no_second_axis():
    begin = hj.Guess("main", (1.0, 0.0))
    y = np.linspace(1.0, 0.5, 4)
    row = hj.fitting.ObservedTrajectory(begin, (0.1, 0.2, 0.3, 0.4), "y", y)
    column = hj.fitting.ObservedTrajectory(begin, (0.1, 0.2, 0.3, 0.4), "y", y[:, None])
    assert_array_equal(row.values, column.values)
    with pytest.raises(hj.errors.DefinitionError, match=r"of shape \(4 times, 2 outp"):
        hj.fitting.ObservedTrajectory(begin, (0.1, 0.2, 0.3, 0.4), ("y", "v"), y)


@pytest.mark.slow
def test_prints_have_the_digits_that_errors_leave():
    data = observed(1.0, seed=0)
    assert " known=" not in repr(data)  # (It would list the place of each sample.)
    fit_of_ball = hj.fit_model(ball(), data, ("e", "drag"))
    table = repr(fit_of_ball)
    assert re.search(r"e  +0\.\d{4} +± 0\.00\d\d\n", table)


@pytest.mark.slow
def test_standard_errors_are_those_of_many_draws():
    errors = []
    for seed in range(60):
        data = observed(1.0, seed)
        fit = hj.fit_model(ball(), data, ("e", "drag"))
        size = fit.standard_errors[:2]
        true = tuple(TRUE.values())
        errors.append((fit.values[:2] - true) / size)
    spread = np.std(errors, axis=0)
    assert (0.75 < spread).all()
    assert (spread < 1.3).all()


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda d: d(hj.Guess("main", (1.0, 0.0))), "give samples"),
        (lambda d: d(hj.Guess("main", (1.0, 0.0)), TIMES), "together"),
        (
            lambda d: d(hj.Guess("main", (1.0, 0.0)), [0.2, 0.1], "y", [[1.0], [1.0]]),
            "must increase",
        ),
        (
            lambda d: d(hj.Guess("main", (1.0, 0.0), 0.5), [0.2], "y", [[1.0]]),
            "0.2, comes before the start at 0.5",
        ),
        (
            lambda d: d(hj.Guess("main", (1.0, 0.0), 2.0), [0.2], "y", [[1.0]]),
            "0.2, comes before the start at 2",
        ),
        (
            lambda d: d(hj.Guess("main", ((1.0, 0.0), (2.0, 0.0))), [0.2], "y", [[1]]),
            "`start` must have one state",
        ),
        (
            lambda d: d(hj.Guess("main", (1.0, 0.0)), [0.2], "y", [[np.nan]], std=0.1),
            "are all missing",
        ),
        (
            lambda d: d(hj.Guess("main", (1.0, 0.0)), [0.2], "y", [[1]], std=(1, 2)),
            r"`std` must be one number, or one for each of 1 outputs, .* \(2,\)",
        ),
        *[
            (
                lambda d, times=times: d(
                    hj.Guess("main", (1.0, 0.0)), events={"bounce": times}
                ),
                message,
            )
            for times, message in (
                ((0.4, np.nan), r"`events\['bounce'\]` must be finite, but is nan"),
                ("late", r"`events\['bounce'\]` must be "),
                ((), r"`events\['bounce'\]` must be one time or more"),
                (((0.4, 0.8),), r"one time or more, not of shape \(1, 2\)"),
            )
        ],
        (
            lambda d: d(
                hj.Guess("main", (1.0, 0.0)),
                events={"bounce": (0.4, 0.8)},
                events_std=(0.1, 0.2),
            ),
            "`events_std` must be one number",
        ),
    ],
)
def test_bad_measurements(call, message):
    with pytest.raises(DefinitionError, match=message):
        call(hj.fitting.ObservedTrajectory)


@pytest.mark.slow
def test_bad_fits():
    with pytest.raises(
        DefinitionError, match="`unknown_states` has 'x', which is no state"
    ):
        hj.fit_model(ball(), observed(1.0, unknown_states="x"), "e")
    late = hj.fitting.ObservedTrajectory(
        hj.Guess("main", (1.0, 0.0)), events={"bounce": (0.01, 0.02, 0.03)}
    )
    with pytest.raises(ComputationError, match="trajectory 1: it lacks a measured ev"):
        hj.fit_model(ball(), late, "e")


@pytest.mark.slow
def test_a_push_with_kinks_needs_more_steps_and_the_error_says_so():
    """The parameter of an oscillator that was pushed, from the samples of a recording."""
    oscillator = hj.models.VanDerPol(mu=1.0)
    times = np.linspace(0.0, 6.0, 301)
    rng = np.random.default_rng(0)
    kicks = jnp.asarray(0.3 * rng.normal(size=len(times)))

    def push(t):
        return jnp.interp(t, times, kicks)[None]

    start = hj.Guess("oscillation", (2.0, 0.0))
    coarse = hj.orbits.Settings(rtol=1e-8, atol=1e-8, max_steps=8192)
    path = hj.flow(oscillator, start, 6.0, input=push, settings=coarse)
    values = np.asarray(path.at(times)[1])

    def samples(settings):
        return hj.fitting.ObservedTrajectory(
            start, times, ("x", "v"), values, input=push, settings=settings
        )

    other = hj.models.VanDerPol(mu=0.8)
    with pytest.raises(ComputationError, match="limit on steps .*larger `rtol`"):
        hj.fit_model(other, samples(None), "mu")
    fit = hj.fit_model(other, samples(coarse), "mu")
    assert float(fit.system.mu) == pytest.approx(1.0, abs=1e-5)
