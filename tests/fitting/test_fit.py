"""Parameters come back from data, with errors that are what they are said to be."""

import equinox as eqx
import numpy as np
import pytest

import hybridjax as hj
from hybridjax.fitting import problem

from ..conftest import OUTPUTS, no_compilation
from .conftest import HOPPER, SECTIONS, Oscillator


PHASES = hj.ClockPhase(4, anchor=hj.Crossing("v", "falling"))
STD = {"std": 1e-3, "period_std": 1e-3}


def observed(cycle, noise=0.0):
    """Outputs at four phases, and the period."""
    observed = hj.fitting.ObservedCycle.of(cycle, PHASES, ("x", "v"))
    values, _, period = observed.measured
    drawn = noise * np.random.default_rng(0).normal(size=9)
    values = values + drawn[:8].reshape(4, 2)
    return hj.fitting.ObservedCycle(
        PHASES, ("x", "v"), values, period=period + drawn[8], **STD
    )


def test_a_fit_that_stops_where_cycles_end_has_not_converged():
    """Steps toward 3 are rejected beyond 1, where there is no cycle, until they are tiny."""

    def evaluate(problem, x, guess):
        residual = np.where(x < 1, x - 3, np.inf)
        return residual, np.eye(1), guess

    start = np.zeros(1)
    *_, steps, converged = problem.descend(None, start, None, evaluate)
    assert steps < problem.MAX_STEPS
    assert not converged


def test_the_unit_of_residuals_does_not_count():
    def evaluate(scale, x, guess):  # two residuals that no x removes
        return (
            scale * np.append(np.exp(x) - 3, x),
            scale * np.stack([np.exp(x), [1.0]]),
            guess,
        )

    start = np.array([4.0])
    x, *_, steps, _ = problem.descend(1.0, start, None, evaluate)
    x_small, *_, steps_small, _ = problem.descend(1e-3, start, None, evaluate)
    assert x_small == pytest.approx(x, rel=1e-3)
    assert steps_small <= steps


@pytest.mark.slow
def test_errors_that_no_residual_shows_are_unknown():
    juggler = hj.models.PaddleJuggler()
    impact = [hj.AtEvent("impact")]
    cycle = hj.fitting.ObservedCycle(impact, times=[0.15])
    fit = hj.fit_model(juggler, cycle, "A")
    assert fit.result == hj.errors.Result.OK
    assert np.isnan(fit.standard_errors).all()
    with pytest.raises(hj.errors.DefinitionError, match="no residual is left"):
        fit.contains({"A": 0.2})
    speed = hj.fitting.ObservedCycle(
        impact, "v", [[-3.0]]
    )  # which is g T / 2 for any amplitude
    fit = hj.fit_model(juggler, speed, "A")
    assert fit.result == hj.errors.Result.OK
    assert fit.identifiability.rank == 0
    assert fit.contains({"A": 0.2})
    with pytest.raises(hj.errors.DefinitionError, match="of all data, or of none"):
        hj.fitting.identifiability(
            juggler,
            [speed, hj.fitting.ObservedCycle(impact, period=1, period_std=1)],
            "A",
        )


def juggled(noise=0.0, std=1e-3, **change):
    """Heights and speeds of a juggled ball at five phases, with drawn errors."""
    cycle = hj.find_limit_cycle(hj.models.PaddleJuggler(**change))
    where = hj.ClockPhase(5, anchor=hj.Crossing("v", "falling"))
    exact = hj.fitting.ObservedCycle.of(cycle, where, ("y", "v"))
    values = np.asarray(exact.measured[0])
    drawn = noise * np.random.default_rng(0).normal(size=values.shape)
    return hj.fitting.ObservedCycle(where, ("y", "v"), values + drawn, std=std)


def causes(fit):
    return [finding.cause for finding in fit.findings]


@pytest.mark.slow
def test_a_model_that_does_not_fit_says_that_its_errors_do_not_hold():
    """Another gravity changes speeds, which no amplitude of the paddle does."""
    data = juggled(noise=1e-3)
    wrong = hj.models.PaddleJuggler(g=9.7)
    with pytest.warns(hj.errors.FindingWarning, match="Misfit: residuals are"):
        fit = hj.fit_model(wrong, data, "A")
    assert fit.chi2_per_dof > 5
    (found,) = fit.findings
    assert found.cause == "misfit"
    assert "standard errors do not hold" in found.text
    assert "`guesses`" in found.text
    size = np.sqrt(fit.chi2_per_dof)
    assert f"{size:.2g} times" in found.text
    assert str(found).splitlines()[0] in repr(fit)
    assert "standard errors do not hold" in fit._repr_html_()
    assert causes(fit.estimate) == ["misfit"]
    assert "Misfit" in repr(fit.estimate)
    assert causes(hj.fit_model(wrong, data, ("A", "g"))) == []


@pytest.mark.slow
def test_data_without_noise_are_no_misfit_whatever_their_errors_are_said_to_be():
    for std in (1e-3, 1e-10):
        fit = hj.fit_model(hj.models.PaddleJuggler(A=0.17), juggled(std=std), "A")
        assert causes(fit) == []


def test_a_right_model_is_called_a_misfit_in_one_of_a_thousand_draws():
    """Of variances that are known, and of those that are estimated from a few realizations."""
    rng = np.random.default_rng(0)
    draws = 20_000
    lines = 30
    for realizations in (np.inf, 4, 9):
        errors = rng.normal(size=(draws, lines, 2))
        most = 1.0
        if np.isfinite(realizations):
            most = realizations / (realizations - 1)
            drawn = rng.chisquare(2 * realizations, (draws, lines, 1))
            errors /= np.sqrt(drawn / (2 * realizations))
        cost = (errors**2).sum(axis=(1, 2))
        p = problem.tail_of(cost, 2.0 * lines, most)
        alarms = np.mean(p < problem.FALSE_ALARMS)
        assert 2e-4 < alarms < (2e-3 if most == 1 else 5e-3)


@pytest.mark.slow
def test_times_of_autonomous_cycles_count_from_any_moment():
    position = hj.Crossing("x", "rising")
    where = [position, hj.Crossing("v", "rising")]
    systems = [hj.models.VanDerPol(mu=mu) for mu in (1.1, 1.101)]
    cycles = [hj.find_limit_cycle(system) for system in systems]
    (gap,), (other,) = (
        np.diff(hj.sections.place_sections(x, where).lanes.t) for x in cycles
    )
    # The standard error of a difference of two times.
    error = np.sqrt(2) * 0.1 / abs(other - gap) * 1e-3
    rough = []
    for begin in (0.0, 9.0):
        data = hj.fitting.ObservedCycle(
            where, times=[begin, begin + gap], times_std=0.1
        )
        fit = hj.fit_model(hj.models.VanDerPol(), data, "mu")
        assert fit.dof == 0
        assert fit.values == pytest.approx(1.1, rel=1e-9)
        assert fit.standard_errors == pytest.approx(error, rel=0.01)
        data = hj.fitting.ObservedCycle(
            where, "x", [[0.1], [-2.0]], times=[begin, begin + gap]
        )
        oscillator = hj.models.VanDerPol()
        bounds = {"mu": (0.0, np.inf)}
        rough.append(hj.fit_model(oscillator, data, bounds))
    first_values = rough[0].values
    assert first_values == pytest.approx(rough[1].values, rel=1e-6)
    assert rough[0].result == 0
    assert "mu reaches its bound 0 within its error" in repr(rough[0])
    with pytest.raises(
        hj.errors.DefinitionError, match="another 'mass', which was not fitted"
    ):
        rough[0].chi_square({"mu": 1.1, "mass": 1.0})


@pytest.mark.slow
def test_an_oscillator_comes_back_up_to_what_cannot_be_seen(oscillation):
    wrong = Oscillator(p=0.6, q=2.1, w=0.9)
    data = observed(oscillation)
    fit = hj.fit_model(wrong, data, ("p", "q", "w"), guess=oscillation)
    assert fit.result == hj.errors.Result.OK
    assert fit.cost < 1e-12
    assert fit.system.w == pytest.approx(1.0, rel=1e-9)
    product = fit.system.p * fit.system.q
    assert product == pytest.approx(1.0, rel=1e-9)
    assert fit.system.p / fit.system.q == pytest.approx(
        0.6 / 2.1, rel=1e-6
    )  # it did not move
    assert fit.identifiability.descriptions() == ["p and q apart, only their product"]
    unknown = np.isinf(fit.standard_errors)
    assert unknown.tolist() == [True, True, False]
    period = float(fit.cycle.period)
    true_period = float(oscillation.period)
    assert period == pytest.approx(true_period, rel=1e-9)
    (lost,) = fit.findings
    assert lost.cause == "not identified"
    assert lost.text.startswith("p and q apart")
    assert repr(lost) in repr(fit)
    assert "1 of 1 guesses" in repr(fit)
    np.testing.assert_allclose(fit.multipliers, oscillation.multipliers, atol=1e-8)
    assert isinstance(fit, hj.identify.Fit)


@pytest.mark.slow
def test_errors_are_as_large_as_they_are_said_to_be(oscillation):
    data = observed(oscillation, noise=1e-3)
    rough_guess = Oscillator(w=1.02)
    fit = hj.fit_model(rough_guess, data, ("p", "q", "w"), guess=oscillation)
    assert fit.weighted
    assert fit.dof == 7
    assert fit.result == hj.errors.Result.OK
    assert 0 < fit.chi_square(oscillation.system) < 13.8  # 0.1 %
    assert fit.contains({"p": 0.5, "q": 2.0, "w": 1.0}, level=0.999)
    assert not fit.contains({"p": 0.5, "q": 2.0, "w": 1.1})
    assert abs(fit.chi_square(fit.system)) < 1e-6

    def numbers(**change):
        cycle = hj.find_limit_cycle(Oscillator(**change), oscillation)
        return (
            np.concatenate([np.ravel(x) for x in observed(cycle).measured]) / STD["std"]
        )

    usual = numbers()
    by_p = numbers(p=0.501) - usual
    by_w = numbers(w=1.001) - usual
    J = np.stack([by_p, by_w], axis=1) / 1e-3
    covariance = np.linalg.inv(J.T @ J)
    errors = np.sqrt(np.diag(covariance))
    error_of_w = fit.standard_errors[2]
    assert error_of_w == pytest.approx(errors[1], rel=0.02)
    with pytest.raises(hj.errors.DefinitionError, match="the other values lack 'w'"):
        fit.contains({"p": 0.5, "q": 2.0})
    no_values = np.nan * data.measured[1]
    unseen = eqx.tree_at(lambda o: o.measured[1], data, no_values)
    with pytest.raises(hj.errors.ComputationError, match="residuals are not finite"):
        hj.fit_model(oscillation.system, unseen, ("p", "q", "w"), guess=oscillation)


@pytest.mark.slow
def test_advice_about_searches_names_their_function(oscillation):
    still = Oscillator(w=0.0)
    data = observed(oscillation)
    far = hj.Guess("charge", (9e9, 0.0))
    free = ("p",)
    for call in (
        lambda: hj.fit_model(still, data, free, guess=far),
        lambda: hj.fitting.identifiability(still, data, free, guess=oscillation),
        lambda: hj.sweep(still, {"p": [1.0, 2.0]}),
        lambda: hj.explore(still, "p"),
    ):
        with pytest.raises(
            hj.errors.ComputationError,
            match=r"\(These arguments .*`find_limit_cycle`: ",
        ):
            call()


@pytest.mark.slow
def test_more_guesses_are_tried_only_where_they_are_needed(oscillation):
    nothing_fits = hj.fitting.ObservedCycle(
        PHASES,
        ("x", "v"),
        np.arange(8.0).reshape(4, 2) - 3.0,
        period=oscillation.period,
        **STD,
    )
    free = ("p", "q", "w")
    several = hj.fit_model(
        oscillation.system, nothing_fits, free, guess=oscillation, guesses=2
    )
    assert len(several.guesses) == 2
    assert several.cost == min(g.cost for g in several.guesses)
    reached = [g.values[0] for g in several.guesses]
    assert np.ptp(reached) > 0
    one = hj.fit_model(
        oscillation.system, observed(oscillation), free, guess=oscillation, guesses=2
    )
    assert len(one.guesses) == 1


@pytest.mark.slow
def test_data_of_the_hopper_do_not_see_all_parameters(seen_in_htf, seen_in_cycle):
    assert seen_in_htf.rank == 5
    assert seen_in_cycle.rank == 6
    assert sorted(seen_in_htf.descriptions()) == [
        "a common factor of (a, g), only a/g",
        "l0",
    ]
    assert seen_in_cycle.descriptions() == ["a common factor of (m, M, k, b, a)"]


@pytest.mark.slow
def test_the_hopper_comes_back_from_its_htfs_and_from_experiments(
    hopper_cycle, hopper_htf
):
    rng = np.random.default_rng(0)
    pushes = rng.normal(size=(2, 8 * SECTIONS.n_sections, 1))
    u = 0.05 * pushes
    data = hj.run_experiments(
        hopper_cycle, SECTIONS, u, OUTPUTS, start="cycle", discard=0
    )
    wrong = hj.models.VerticalHopper(
        m=1.1,
        M=1.8,
        k=11.0,
        b=4.2,
        l0=2.2,
        a=18.0,
        g=2.2,
    )
    true = np.array([getattr(hopper_cycle.system, name) for name in HOPPER])
    observed = (
        hj.fitting.ObservedHTF(hopper_htf, SECTIONS),
        hj.fitting.ObservedSeries(data, SECTIONS),
    )
    by_htf, by_series = (
        hj.fit_model(wrong, x, HOPPER, guess=hopper_cycle, guesses=4) for x in observed
    )
    np.testing.assert_allclose(by_htf.values[:4], true[:4], rtol=1e-9)  # (not l0)
    ratio = by_htf.values[5] / by_htf.values[6]
    assert ratio == pytest.approx(10.0, rel=1e-9)
    assert by_series.identifiability.complete
    np.testing.assert_allclose(by_series.values, true, rtol=1e-6)


@pytest.fixture(scope="module")
def fitted(hopper_cycle):
    """A fit of a stiffness and both delays, which begins near the cycle of another stiffness."""
    lines = np.arange(1, 33) / 16 + 0.01
    delayed = hj.linearize(hopper_cycle, SECTIONS, OUTPUTS, delay=(0.037, 0.081))
    htf = delayed.htf(lines)
    data = hj.fitting.ObservedHTF(
        htf, SECTIONS, delay=(0.0625, 0.0625)
    )  # (together a whole section)
    free = "k", "input_delay", "output_delay"
    return lambda near: hj.fit_model(near.system, data, free, guess=near)


@pytest.mark.slow
def test_both_delays_come_back(hopper_cycle, hopper_htf, fitted):
    fit = fitted(hj.find_limit_cycle(hj.models.VerticalHopper(k=10.3)))
    np.testing.assert_allclose(fit.values, (10.0, 0.037, 0.081), rtol=1e-8)
    # (Without noise, a region is as small as rounding errors, which are not independent.)
    assert not fit.contains({"k": 10.0, "input_delay": 0.037, "output_delay": 0.082})
    with pytest.raises(hj.errors.DefinitionError, match="lack 'input_delay'"):
        fit.contains(hopper_cycle.system)
    with pytest.raises(hj.errors.DefinitionError, match="no data have a delay"):
        hj.fit_model(
            hopper_cycle.system,
            hj.fitting.ObservedHTF(hopper_htf, SECTIONS),
            "input_delay",
        )


@pytest.mark.slow
def test_other_values_compile_nothing(fitted):
    """A cycle, a gradient and a fit (programs of whole turns aside)."""

    def work(k):
        near = hj.find_limit_cycle(hj.models.VerticalHopper(k=k))

        def trace(system):
            model = hj.linearize(hj.find_limit_cycle(system, near), SECTIONS)
            return model.characteristic_polynomial()[1]

        eqx.filter_grad(trace)(near.system)
        fitted(near)

    with no_compilation(after=lambda: work(10.3)):
        work(10.7)
