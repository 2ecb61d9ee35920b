"""Cycles modulo a symmetry: the walker in full, with two legs that have names and a place."""

import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj
from hybridjax.models.walkers import _heelstrike
from hybridjax.systems.chart import FieldChart


hj.enable_x64()
LONG_GAIT = -0.190099841065888 + 0.557598776682068j


class Stands(hj.Chart):
    """Angles of both legs from the normal of the slope, and how far the walker has come."""

    states = ("left", "right", "left_rate", "right_rate", "x")
    walker: hj.models.SimplestWalker
    leg: int
    drag: float = 0.0

    def field(self, t, q, u):
        a, b, w, v, rate = *self.walker.charts()["step"].field(t, seen(q, self.leg), u), 0.0
        rate = jnp.cos(q[self.leg]) * q[2 + self.leg] - self.drag * q[4]
        return told(self.leg, a, b, w, v, rate)


def seen(q, leg):
    """As the model has it: the stance leg, and the angle between both."""
    other = 1 - leg
    return q[leg], q[leg] - q[other], q[2 + leg], q[2 + leg] - q[2 + other]


def told(leg, th, phi, w, p, x):
    pairs = [(th, w), (th - phi, w - p)]
    (a, va), (b, vb) = pairs if leg == 0 else pairs[::-1]
    return a, b, va, vb, x


class Full(hj.HybridSystem):
    """Nothing is relabeled in the resets."""

    drag: hj.Parameter = hj.parameter(0.0)
    skew: hj.Parameter = hj.parameter(0.0)
    early: hj.Parameter = hj.parameter(0.0)

    def charts(self):
        model = hj.models.SimplestWalker()
        leaning = hj.models.SimplestWalker(slope=0.009 + self.skew)
        return {
            "left stands": Stands(model, 0, self.drag),
            "right stands": Stands(leaning, 1, self.drag),
        }

    def transitions(self):
        found = []
        for leg, (name, other) in enumerate([("left", "right"), ("right", "left")]):
            found.append(
                hj.Transition(
                    f"{other} lands", f"{name} stands", f"{other} stands",
                    guard=lambda t, q, u, leg=leg: q[leg] + q[1 - leg] + leg * self.early,
                    reset=lambda t, q, u, leg=leg: told(
                        1 - leg, *_heelstrike(t, seen(q, leg), u), q[4]
                    ),
                    enabled=lambda t, q, u, leg=leg: q[leg] < 0,
                )
            )  # fmt: skip
        return found

    def guess(self):
        th, phi, w, p = hj.models.SimplestWalker().guess().state
        return hj.Guess("left stands", told(0, th, phi, w, p, 0.0))


MIRROR = {
    "swap": {"left stands": "right stands"},
    "relabel": {"left": "right", "left_rate": "right_rate"},
}


def test_a_step_modulo_the_symmetry():
    walker = hj.Quotient(Full(), **MIRROR, translation=("x",))
    step = hj.find_limit_cycle(walker, section=hj.AtEvent("right lands"))
    expected = [LONG_GAIT, np.conj(LONG_GAIT)]
    np.testing.assert_allclose(step.multipliers, expected, rtol=1e-9)
    np.testing.assert_allclose(step.period, 3.88246375285137, rtol=1e-10)


@pytest.mark.slow
def test_a_stride_is_two_steps():
    walker = hj.Quotient(Full(), translation=("x",))
    stride = hj.find_limit_cycle(walker, section=hj.Crossing("left", "falling"))
    np.testing.assert_allclose(stride.period, 2 * 3.88246375285137, rtol=1e-10)
    squares = np.array([LONG_GAIT, np.conj(LONG_GAIT)]) ** 2
    squares, found = (x[np.argsort(x.imag)] for x in (squares, stride.multipliers))
    np.testing.assert_allclose(found, squares, rtol=1e-8)


@pytest.mark.parametrize(
    "system, symmetry, message",
    [
        (Full(drag=0.1), {**MIRROR, "translation": ("x",)}, "field of chart 'left stands' changes"),
        (Full(skew=0.1), MIRROR, "chart 'right stands' is not the mirror image"),
        (
            Full(early=0.1),
            MIRROR,
            "transition 'left lands' is not the mirror image of .* 'right lands'",
        ),
    ],
)
def test_what_is_no_symmetry_is_refused(system, symmetry, message):
    with pytest.raises(hj.DefinitionError, match=message):
        hj.find_limit_cycle(hj.Quotient(system, **symmetry))


def test_an_odd_oscillator_closes_after_half_a_period():
    pol, duffing, at = hj.models.VanDerPol(), hj.models.Duffing(), hj.AtEvent("half period")
    whole = hj.find_limit_cycle(pol, section=hj.Crossing("x", "falling"))
    folded = hj.Quotient(pol, flipped=("x", "v"), half_period="x")
    half = hj.find_limit_cycle(folded, hj.Guess("oscillation", (0.0, -1.9)), section=at)
    np.testing.assert_allclose(2 * half.period, whole.period, rtol=1e-11)
    np.testing.assert_allclose(half.multipliers**2, whole.multipliers, rtol=1e-9)
    with pytest.raises(hj.DefinitionError, match="Duffing does not have the symmetry"):
        hj.find_limit_cycle(hj.Quotient(duffing, flipped="x", half_period=True), section=at)
    with pytest.raises(hj.DefinitionError, match="must be True if a clock drives the system"):
        hj.Quotient(duffing, flipped=("x", "v"), half_period="x")


class Inverter(hj.HybridSystem):
    """A coil between the poles of a supply, which two switches exchange."""

    early: float = 0.125

    def charts(self):
        return {
            name: FieldChart(lambda t, q, u, v=v: (v - q[0] - 0.3 * q[0] ** 3,), ("i",))
            for name, v in (("plus", 1.0), ("minus", -1.0))
        }

    def transitions(self):
        yield hj.Transition("down", "plus", "minus", hj.Scheduled(2.0, self.early))
        yield hj.Transition("up", "minus", "plus", hj.Scheduled(2.0, 1 + self.early))

    def period(self):
        return 2.0

    def guess(self):
        return hj.Guess("plus", (0.1,))


def test_scheduled_switches_close_after_half_a_period():
    symmetry = dict(swap={"plus": "minus"}, flipped="i", half_period=True)
    half = hj.Quotient(Inverter(), **symmetry)
    half = hj.find_limit_cycle(half, section=hj.AtEvent("half period (minus)"))
    whole = hj.find_limit_cycle(Inverter())
    np.testing.assert_allclose(2 * half.period, whole.period, rtol=1e-12)
    np.testing.assert_allclose(half.state["i"], whole.state["i"], rtol=1e-11)
    np.testing.assert_allclose(half.multipliers[0] ** 2, whole.multipliers[0], rtol=1e-10)
    assert [half.structure.transitions[g].name for g in half.event_sequence][0] == "down"
    with pytest.raises(hj.DefinitionError, match="transition 'up' is not the mirror image"):
        hj.find_limit_cycle(hj.Quotient(Inverter(), swap={"plus": "minus"}, flipped="i"))
    with pytest.raises(hj.DefinitionError, match="'down' must not be scheduled at t = 0"):
        hj.Quotient(Inverter(early=0.0), **symmetry)
