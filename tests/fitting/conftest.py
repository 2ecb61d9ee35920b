import numpy as np
import pytest

import hybridjax as hj

from ..conftest import APEX, OUTPUTS


HOPPER = ("m", "M", "k", "b", "l0", "a", "g")
SECTIONS = hj.ClockPhase(8, anchor=APEX)


class Charge(hj.Chart):
    states = ("x", "v")
    oscillator: "Oscillator"

    def field(self, t, q, u):
        o = self.oscillator
        x, v = q
        negative = o.p * o.q * (1 - x**2)
        damping = negative * v
        spring = o.w**2 * x
        return v, damping - spring + u[0]


class Oscillator(hj.HybridSystem):
    """Van der Pol's, with a damping of which only the product of two factors can be seen."""

    p: hj.Parameter = hj.parameter(0.5)
    q: hj.Parameter = hj.parameter(2.0)
    w: hj.Parameter = hj.parameter(1.0)

    def charts(self):
        return {"charge": Charge(self)}

    def guess(self):
        return hj.Guess("charge", (2.0, 0.0))


@pytest.fixture(scope="session")
def oscillation():
    return hj.find_limit_cycle(Oscillator(), section=hj.Crossing("v", "falling"))


@pytest.fixture(scope="session")
def hopper_htf(hopper_cycle):
    ldtp = hj.linearize(hopper_cycle, SECTIONS, OUTPUTS)
    f = np.arange(0.1, 4, 0.2)
    return ldtp.htf(f, (-1, 0, 1))


@pytest.fixture(scope="session")
def seen_in_htf(hopper_cycle, hopper_htf):
    data = hj.fitting.ObservedHTF(hopper_htf, SECTIONS)
    return hj.fitting.identifiability(
        hopper_cycle.system, data, HOPPER, guess=hopper_cycle
    )


@pytest.fixture(scope="session")
def hopper_observed(hopper_cycle):
    """All that is to be seen of the limit cycle: states at sections, times of events."""
    events = [hj.AtEvent("liftoff"), hj.AtEvent("touchdown")]
    return [
        hj.fitting.ObservedCycle.of(hopper_cycle, SECTIONS, OUTPUTS),
        hj.fitting.ObservedCycle.of(hopper_cycle, events),
    ]


@pytest.fixture(scope="session")
def seen_in_cycle(hopper_cycle, hopper_observed):
    return hj.fitting.identifiability(
        hopper_cycle.system, hopper_observed, HOPPER, guess=hopper_cycle
    )
