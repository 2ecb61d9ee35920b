"""Cycles modulo a symmetry: the walker in full, with two legs that have names and a place."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj
from hybridjax.models.walkers import _heelstrike
from hybridjax.systems.chart import FieldChart
from hybridjax.systems.quotient import check_symmetry


hj.enable_x64()
LONG_GAIT = -0.190099841065888 + 0.557598776682068j


class Stands(hj.Chart):
    """Angles of both legs from the normal of the slope, and how far the walker has come."""

    states = ("left", "right", "left_rate", "right_rate", "x")
    walker: hj.models.SimplestWalker
    leg: int
    drag: float = 0.0

    def field(self, t, q, u):
        step = self.walker.charts()["step"]
        state = seen(q, self.leg)
        a, b, w, v = step.field(t, state, u)
        cosine = jnp.cos(q[self.leg])
        swing = cosine * q[2 + self.leg]
        rate = swing - self.drag * q[4]
        return told(self.leg, a, b, w, v, rate)


def seen(q, leg):
    """As the model has it: the stance leg, and the angle between both."""
    other = 1 - leg
    angle = q[leg] - q[other]
    rate = q[2 + leg] - q[2 + other]
    return q[leg], angle, q[2 + leg], rate


def told(leg, th, phi, w, p, x):
    pairs = [(th, w), (th - phi, w - p)]
    (a, va), (b, vb) = pairs if leg == 0 else pairs[::-1]
    return a, b, va, vb, x


class Full(hj.HybridSystem):  # Nothing is relabeled in the resets.
    drag: hj.Parameter = hj.parameter(0.0)
    skew: hj.Parameter = hj.parameter(0.0)
    early: hj.Parameter = hj.parameter(0.0)

    def charts(self):
        slopes = enumerate([("left", 0.009), ("right", 0.009 + self.skew)])
        walker = hj.models.SimplestWalker
        return {
            f"{x} stands": Stands(walker(slope=y), k, self.drag) for k, (x, y) in slopes
        }

    def transitions(self):
        for leg, (name, other) in enumerate([("left", "right"), ("right", "left")]):
            yield hj.Transition(
                f"{other} lands",
                f"{name} stands",
                f"{other} stands",
                guard=lambda t, q, u, leg=leg: q[leg] + q[1 - leg] + leg * self.early,
                reset=lambda t, q, u, k=leg, x=leg * self.early: told(
                    1 - k, *_heelstrike(t, seen(q, k), u), q[4] + x
                ),
                enabled=lambda t, q, u, leg=leg: q[leg] < 0,
            )

    def guess(self):
        th, phi, w, p = hj.models.SimplestWalker().guess().state
        state = told(0, th, phi, w, p, 0.0)
        return hj.Guess("left stands", state)


class OneSided(Full):
    """Legs land under different conditions."""

    def transitions(self):
        left, right = super().transitions()
        yield left
        yield dataclasses.replace(right, enabled=lambda t, q, u: q[1] > 0)


FAR = hj.Output("far", {"left stands": lambda t, q, u: q[4] + q[0]})
PLACED = type("Placed", (Full,), {"outputs": lambda self: [FAR]})()
PARTNERS = {"left": "right", "left_rate": "right_rate"}
MIRROR = {"swap": {"left stands": "right stands"}, "relabel": PARTNERS}
ODD = {"flipped": ("x", "v"), "half_period": True}
SIZES = np.r_[1, 1, 1, 1, 1e-9]
STRIDE = pytest.param(2, {}, hj.Crossing("left", "falling"), marks=pytest.mark.slow)


@pytest.mark.parametrize(
    "steps, symmetry, section", [(1, MIRROR, hj.AtEvent("right lands")), STRIDE]
)
@pytest.mark.slow
def test_a_step_modulo_the_symmetry_and_a_stride_of_two(steps, symmetry, section):
    walker = hj.systems.Symmetric(Full(), **symmetry, translation=("x",))
    cycle = hj.find_limit_cycle(walker, section=section)
    assert_allclose(cycle.period, steps * 3.88246375285137, rtol=1e-10)
    pair = np.array([LONG_GAIT, np.conj(LONG_GAIT)])
    expected = np.sort_complex(pair**steps)
    assert_allclose(np.sort_complex(cycle.multipliers), expected, rtol=1e-9)


@pytest.mark.parametrize(
    "system, symmetry, message",
    [
        (
            Full(drag=0.1),
            {**MIRROR, "translation": ("x",)},
            "field of chart 'left stands' changes",
        ),
        (Full(skew=0.1), MIRROR, "chart 'right stands' is not the mirror image"),
        (PLACED, {"translation": ("x",)}, "output 'far' changes under the translation"),
        (
            Full(early=0.1),
            MIRROR,
            "'left lands' is not the mirror image of .* 'right lands'",
        ),
        (
            OneSided(),
            MIRROR,
            "`enabled` of transition 'left lands' is not the mirror image",
        ),
    ],
)
def test_what_is_no_symmetry_is_refused(system, symmetry, message):
    for use in (
        hj.find_limit_cycle,
        lambda q: hj.simulate(q, "left stands", q.guess().state, 1),
    ):
        with pytest.raises(hj.errors.DefinitionError, match=message):
            use(hj.systems.Symmetric(system, **symmetry))


def test_messages_name_the_system_that_the_user_wrote():
    def field(t, q):
        return q[1], -(q[0] ** 3)

    mine = hj.HybridSystem.from_functions(("x", "v"), field, name="Mine")
    folded = hj.systems.Symmetric(mine, flipped=("x", "v"), half_period="x")
    with pytest.raises(hj.errors.DefinitionError, match="Mine has no guess"):
        hj.find_limit_cycle(folded)


def test_an_odd_oscillator_closes_after_half_a_period():
    pol = hj.models.VanDerPol()
    duffing = hj.models.Duffing()
    at = hj.AtEvent("half period")
    whole = hj.find_limit_cycle(pol, section=hj.Crossing("x", "falling"))
    folded = hj.systems.Symmetric(pol, flipped=("x", "v"), half_period="x")
    guess = hj.Guess("oscillation", (0.0, -1.9))
    half = hj.find_limit_cycle(folded, guess, section=at)
    assert_allclose(2 * half.period, whole.period, rtol=1e-11)
    assert_allclose(half.multipliers**2, whole.multipliers, rtol=1e-9)
    with pytest.raises(
        hj.errors.DefinitionError, match="must be True if a clock drives the system"
    ):
        hj.systems.Symmetric(duffing, flipped=("x", "v"), half_period="x")


class Biased(hj.models.Duffing):
    bias: hj.Parameter = hj.parameter(0.0)

    def _line(self, t, q, u):
        return super()._line(t, q, u + self.bias)


@pytest.mark.slow
def test_the_symmetry_is_that_of_all_systems_in_all_units():
    def half(x):
        return hj.systems.Symmetric(Biased(beta=5e16, amplitude=5e-10, bias=x), **ODD)

    cycle = hj.find_limit_cycle(half(0.0), section=hj.AtEvent("half period"))
    seen = hj.fitting.ObservedCycle(cycle.base, period=6.0)
    for use in (
        lambda: hj.find_limit_cycle(half(1e-10), cycle),
        lambda: hj.orbits.find_limit_cycles([half(0.0), half(1e-10)], cycle),
        lambda: cycle.sensitivity("system.bias"),
        lambda: jax.grad(lambda x: hj.find_limit_cycle(half(x), cycle).period)(0.0),
        lambda: hj.fitting.identifiability(
            cycle.system, seen, "system.bias", guess=cycle
        ),
    ):
        with pytest.raises(
            hj.errors.DefinitionError, match="Biased does not have the symmetry"
        ):
            use()
    cycle.sensitivity("system.beta")
    check_symmetry(hj.systems.Symmetric(hj.models.Duffing(rate=1e16), **ODD))
    with pytest.raises(
        hj.errors.DefinitionError, match="'left lands' is not the mirror image"
    ):
        check_symmetry(
            hj.systems.Symmetric(Full(early=1e-10), **MIRROR), {"left stands": SIZES}
        )


class Inverter(
    hj.HybridSystem
):  # A coil between the poles of a supply, exchanged by switches.
    early: float = 0.125

    def charts(self):
        return {
            name: FieldChart(lambda t, q, u, v=v: (v - q[0] - 0.3 * q[0] ** 3,), ("i",))
            for name, v in (("plus", 1.0), ("minus", -1.0))
        }

    def transitions(self):
        yield hj.Transition(
            "down", "plus", "minus", hj.systems.Scheduled(2.0, self.early)
        )
        yield hj.Transition(
            "up", "minus", "plus", hj.systems.Scheduled(2.0, 1 + self.early)
        )

    def period(self):
        return 2.0

    def guess(self):
        return hj.Guess("plus", (0.1,))


@pytest.mark.slow
def test_scheduled_switches_close_after_half_a_period():
    symmetry = dict(swap={"plus": "minus"}, flipped="i", half_period=True)
    half = hj.systems.Symmetric(Inverter(), **symmetry)
    half = hj.find_limit_cycle(half, section=hj.AtEvent("half period (minus)"))
    whole = hj.find_limit_cycle(Inverter())
    assert_allclose(2 * half.period, whole.period, rtol=1e-12)
    assert_allclose(half.state["i"], whole.state["i"], rtol=1e-11)
    square = half.multipliers[0] ** 2
    assert_allclose(square, whole.multipliers[0], rtol=1e-10)
    assert [half.structure.transitions[g].name for g in half.event_sequence][
        0
    ] == "down"
    with pytest.raises(
        hj.errors.DefinitionError, match="transition 'up' is not the mirror image"
    ):
        hj.find_limit_cycle(
            hj.systems.Symmetric(Inverter(), swap={"plus": "minus"}, flipped="i")
        )
    with pytest.raises(
        hj.errors.DefinitionError, match="'down' must not be scheduled at t = 0"
    ):
        hj.systems.Symmetric(Inverter(early=0.0), **symmetry)


class Shaken(hj.HybridSystem):
    """A block on a floor that is shaken: its picture moves with the block."""

    def charts(self):
        return {"slides": FieldChart(self.field, ("x", "v"))}

    def field(self, t, q, u):
        return q[1] + jnp.cos(2 * jnp.pi * t), -q[1] + jnp.sin(2 * jnp.pi * t)

    def period(self):
        return 1.0

    def draw(self, chart, t, q):
        return hj.systems.Drawing({"ground": [(-1.0, 0.0), (1.0, 0.0)]})


def test_a_picture_of_half_a_period_moves_by_the_clock_of_its_half():
    halved = hj.systems.Symmetric(
        Shaken(), flipped=("x", "v"), translation=("x",), half_period=True
    )
    state = {"v": jnp.asarray(0.3), "clock": jnp.asarray(0.1)}
    for t in (0.1, 0.6):  # the same state in the first and the second half
        drawing = halved.draw("slides", jnp.asarray(t), state)
        speed = 0.3 + np.cos(2 * np.pi * 0.1)
        assert_allclose(drawing.velocity, [speed, 0.0], rtol=1e-12)
