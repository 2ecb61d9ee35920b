"""Fits that wander to cycles that are none."""

import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj
from hybridjax.errors import Result


class Ramp(hj.Chart):
    states = ("v",)
    supply: float
    tau: hj.Parameter

    def field(self, t, q, u):
        rise = self.supply - q[0] + u[0]
        return (rise / self.tau,)


class Trigger(hj.HybridSystem):
    """An RC circuit with a Schmitt trigger, whose thresholds move with a clock."""

    base: hj.Parameter = hj.parameter(6.0)
    tau: hj.Parameter = hj.parameter(1.0)

    def threshold(self, t):
        wave = jnp.sin(2 * jnp.pi * t / 2.2)
        return self.base + 1.4 * wave

    def period(self):
        return 2.2

    def charts(self):
        high = Ramp(12.0, self.tau)
        low = Ramp(-12.0, self.tau)
        return {"high": high, "low": low}

    def transitions(self):
        def top(t, q, u):
            return q[0] - self.threshold(t)

        def bottom(t, q, u):
            return q[0] + self.threshold(t)

        return [
            hj.Transition("top", "high", "low", top, "rising"),
            hj.Transition("bottom", "low", "high", bottom, "falling"),
        ]


@pytest.mark.slow
def test_a_fit_that_ends_at_a_cycle_beyond_a_guard_is_not_ok():
    """An event passes a section between the start and the truth, so that the data jump."""
    guess = hj.Guess("high", (1.0,))
    sections = hj.ClockPhase(3, 0.35)
    true = hj.find_limit_cycle(Trigger(base=6.1, tau=0.99), guess)
    f = np.linspace(0.05, 0.45, 5)
    model = hj.linearize(true, sections, ["v"])
    htf = model.htf(f)
    observed = hj.fitting.ObservedHTF(htf, sections)
    fit = hj.fit_model(Trigger(), observed, ("base", "tau"), guess=guess)
    assert fit.result == fit.cycle.result == Result.GUARD_BEYOND
    assert "no convergence" in [finding.cause for finding in fit.findings]
