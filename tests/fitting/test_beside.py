"""Fits whose residuals are one program beside a known cycle."""

import numpy as np
import pytest

import hybridjax as hj
from hybridjax.fitting import beside


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
    htf = hj.linearize(cycle, SECTIONS, OUTPUTS).htf(lines, (-1, 0, 1))
    data = hj.fitting.ObservedHTF(htf, SECTIONS)
    start = hj.models.VerticalHopper(k=1.08 * TRUE.k, b=0.95 * TRUE.b)
    expected = hj.fit_model(start, data, ("k", "b"))

    def no_search(*_):
        raise AssertionError("the fit has left its program")

    monkeypatch.setattr(beside, "WORTH_COMPILING", 0)
    monkeypatch.setattr(beside, "evaluate", no_search)
    fit = hj.fit_model(start, data, ("k", "b"))
    assert fit.result == hj.errors.Result.OK
    np.testing.assert_allclose(fit.values, [TRUE.k, TRUE.b], rtol=1e-8)
    np.testing.assert_allclose(fit.values, expected.values, rtol=1e-8)
    # (The Jacobian, by relative changes of the parameters.)
    found, known = (x.identifiability.sensitivity for x in (fit, expected))
    np.testing.assert_allclose(found, known, rtol=0, atol=1e-6 * np.abs(known).max())
