"""Fits whose residuals are one program beside a known cycle."""

import numpy as np
import pytest
from jaxtyping import Array, Float

import hybridjax as hj
from hybridjax.fitting import beside
from hybridjax.sections import walk

from ..toys import Field


APEX = hj.Crossing("vM", "falling")
SECTIONS = hj.ClockPhase(8, anchor=APEX)
OUTPUTS = "yM", "vM"
TRUE = hj.models.VerticalHopper()


@pytest.mark.slow
def test_a_program_finds_what_the_search_finds(monkeypatch):
    """Residuals and their Jacobian are those of the search, also where sections and events have
    changed places since the last known cycle."""
    cycle = hj.find_limit_cycle(TRUE)
    lines = np.linspace(0.02, 0.48, 12)
    model = hj.linearize(cycle, SECTIONS, OUTPUTS)
    htf = model.htf(lines, (-1, 0, 1))
    data = hj.fitting.ObservedHTF(htf, SECTIONS)
    start = hj.models.VerticalHopper(k=1.08 * TRUE.k, b=0.95 * TRUE.b)
    expected = hj.fit_model(start, data, ("k", "b"))

    def no_search(*_):
        raise AssertionError("the fit has left its program")

    monkeypatch.setattr(beside, "WORTH_COMPILING", 0)
    monkeypatch.setattr(beside, "evaluate", no_search)
    fit = hj.fit_model(start, data, ("k", "b"))
    assert fit.result == hj.errors.Result.OK
    true = [TRUE.k, TRUE.b]
    np.testing.assert_allclose(fit.values, true, rtol=1e-8)
    np.testing.assert_allclose(fit.values, expected.values, rtol=1e-8)
    # (The Jacobian, by relative changes of the parameters.)
    found, known = (x.identifiability.sensitivity for x in (fit, expected))
    atol = 1e-6 * np.abs(known).max()
    np.testing.assert_allclose(found, known, rtol=0, atol=atol)


@pytest.mark.slow
def test_later_fits_share_what_is_known_but_see_changes(monkeypatch):
    """A second fit of a system searches nothing, and has the result of a first one for its data;
    one after a change of the code has that of the new code."""
    rate = 2.0

    class Decay(hj.HybridSystem):
        """Falls at a rate to 1, and jumps to 2."""

        speed: Float[Array, ""] = hj.parameter(1.0, doc="of the fall")

        def charts(self):
            return {"fall": Field(("x",), lambda t, q, u: (-rate * self.speed * q[0],))}

        def transitions(self):
            jump = dict(guard=lambda t, q, u: q[0] - 1.0, reset=lambda t, q, u: (2.0,))
            return (hj.Transition("jump", "fall", "fall", **jump),)

        def guess(self):
            return hj.Guess("fall", (1.5,))

    def period(speed):
        return np.log(2) / (rate * speed)

    searches = []
    search = beside.find_limit_cycle

    def counted(*arguments, **options):
        searches.append(arguments)
        return search(*arguments, **options)

    monkeypatch.setattr(beside, "WORTH_COMPILING", 0)
    monkeypatch.setattr(beside, "find_limit_cycle", counted)
    system = Decay()
    at_jump = [hj.AtEvent("jump")]

    def fitted(speed):
        data = hj.fitting.ObservedCycle(at_jump, period=period(speed))
        return hj.fit_model(system, data, ["speed"]).values[0]

    assert fitted(1.1) == pytest.approx(1.1, rel=1e-8)
    searches.clear()
    assert fitted(0.95) == pytest.approx(0.95, rel=1e-8)
    assert not searches
    observed = period(0.95)
    rate = 4.0
    data = hj.fitting.ObservedCycle(at_jump, period=observed)
    changed = hj.fit_model(system, data, ["speed"]).values[0]
    assert changed == pytest.approx(0.95 / 2, rel=1e-8)


class Falling(hj.HybridSystem):
    """Falls at a rate to 1, and jumps to 2: the period is log(2) / (factor * speed)."""

    factor: Float[Array, ""] = hj.parameter(2.0, doc="of the rate")
    speed: Float[Array, ""] = hj.parameter(1.0, doc="of the fall")

    def charts(self):
        rate = self.factor * self.speed
        return {"fall": Field(("x",), lambda t, q, u: (-rate * q[0],))}

    def transitions(self):
        jump = dict(guard=lambda t, q, u: q[0] - 1.0, reset=lambda t, q, u: (2.0,))
        return (hj.Transition("jump", "fall", "fall", **jump),)

    def guess(self):
        return hj.Guess("fall", (1.5,))


@pytest.mark.slow
def test_numbers_that_are_not_free_are_those_of_the_fitted_system(monkeypatch):
    """The guess is the cycle of a system with another fixed number: the program uses the fit's."""
    monkeypatch.setattr(beside, "WORTH_COMPILING", 0)
    near = hj.find_limit_cycle(Falling(factor=2.0))
    observed = np.log(2) / (4.0 * 1.1)
    data = hj.fitting.ObservedCycle([hj.AtEvent("jump")], period=observed)
    fit = hj.fit_model(Falling(factor=4.0), data, ["speed"], guess=near)
    assert fit.values[0] == pytest.approx(1.1, rel=1e-8)
    assert float(fit.cycle.period) == pytest.approx(observed, rel=1e-8)


@pytest.mark.slow
def test_families_of_the_same_sections_share_one_walk(monkeypatch):
    """A fit's own copies of its sections are equal, and count as the same."""
    monkeypatch.setattr(beside, "WORTH_COMPILING", 0)
    known = hj.find_limit_cycle(Falling())
    walks = []
    record = walk._walk
    monkeypatch.setattr(walk, "_walk", lambda *x: walks.append(x) or record(*x))
    for speed in (1.0, 1.02, 0.97):
        data = hj.fitting.ObservedCycle(
            [hj.AtEvent("jump")], period=np.log(2) / (2.0 * speed)
        )
        fit = hj.fit_model(Falling(), data, ["speed"], guess=known)
        assert fit.values[0] == pytest.approx(speed, rel=1e-8)
    assert len(walks) == 1
