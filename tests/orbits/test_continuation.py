"""Continuation against closed forms, numbers from elsewhere, and scipy.

The paddle juggler's multipliers solve lambda^2 - (1 + a^2 + (1 + a)^2 s / g) lambda + a^2 = 0, with
s the paddle's acceleration at the impact (Holmes 1982): all three kinds of points follow.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import Phase, given, settings, strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import expm
from scipy.optimize import brentq

import hybridjax as hj
from hybridjax.orbits.curve import Curve

from ..toys import Field, Switched


m = hj.models


@pytest.fixture(scope="module")
def juggling():
    return hj.find_limit_cycle(m.PaddleJuggler())


@pytest.fixture(scope="module")
def by_amplitude(juggling):
    return hj.continuation(juggling, "A", (0.1, 0.2, 0.35))


@pytest.mark.slow
def test_fold_and_flip_of_the_juggler(juggling, by_amplitude):
    """Small amplitudes of the paddle end in a fold, large ones in a flip."""
    juggler = juggling.system
    a = float(juggler.restitution)
    g = float(juggler.g)
    impact_speed = g * float(juggler.T) / 2
    paddle_speed = (1 - a) * impact_speed / (1 + a)
    fold = paddle_speed / (2 * np.pi)  # the paddle just reaches the speed: s = 0
    square = (1 + a) ** 2
    factor = 2 * (1 + a**2) / square
    s = factor * g
    weight = s / (2 * np.pi) ** 2
    flip = np.hypot(paddle_speed / (2 * np.pi), weight)

    branch = by_amplitude
    at_fold, at_flip = branch.bifurcations
    assert at_fold.kind == "fold"
    assert at_flip.kind == "flip"
    assert_allclose(at_fold.value, fold, rtol=1e-11)
    assert_allclose(at_flip.value, flip, rtol=1e-11)
    assert_allclose(at_fold.multipliers, [1, a**2], atol=2e-6)
    expected = [-1, -(a**2)]
    assert_allclose(at_flip.multipliers, expected, rtol=1e-9)
    for end in branch.ends:
        assert end.message == "end of the parameter range"

    # From the fold on, two cycles, one of them unstable: the branch begins with this one.
    at = np.flatnonzero(branch.values == 0.2)
    assert list(branch.stable[at]) == [False, True]
    for k in at:
        cycle = branch[k]
        (impact,) = cycle.trajectory().events
        rate = 2 * np.pi
        acceleration = -(rate**2) * impact.before["y"]
        by_table = (1 + a) ** 2 * acceleration / g
        trace = 1 + a**2 + by_table
        assert_allclose(np.sum(cycle.multipliers).real, trace, rtol=1e-9)
        again = hj.find_limit_cycle(cycle.system, cycle)
        assert_allclose(again.anchor.q, cycle.anchor.q, rtol=1e-11)


@pytest.mark.slow
def test_neimark_sacker_of_the_juggler(juggling):
    """The product of the multipliers is the restitution's square: 1 where nothing is lost."""
    branch = hj.continuation(juggling, "restitution", (0.7, 1.1))
    (point,) = branch.bifurcations
    assert_allclose(point.value, 1.0, rtol=1e-11)
    assert_allclose(np.abs(point.multipliers), 1, rtol=1e-9)
    assert point.kind == "Neimark-Sacker"
    assert branch.stable[: point.index].all()
    assert not branch.stable[point.index + 1 :].any()
    assert str(branch[point.index]).startswith(
        "LimitCycle(PaddleJuggler: ok)"
    )  # neutral
    assert "Neimark-Sacker at restitution = 1 (multipliers" in repr(branch)


@pytest.mark.slow
def test_a_branch_is_drawn_in_pieces_of_one_stability(by_amplitude):
    branch = by_amplitude
    ax = hj.plot.branch(branch, output="v").ax
    assert ax.get_xlabel() == "A (m)"
    assert ax.get_ylabel() == "largest v (m/s)"
    lines = [line for line in ax.get_lines() if len(line.get_xdata()) > 1]
    styles = [line.get_linestyle() for line in lines]
    assert styles == ["--", "-", "--"], "unstable, stable, unstable"
    fold, flip = (point.index for point in branch.bifurcations)
    drawn = [line.get_xdata() for line in lines]
    before_fold = branch.values[: fold + 1]
    assert_array_equal(drawn[0], before_fold)
    between = branch.values[fold : flip + 1]
    assert_array_equal(drawn[1], between)
    assert_array_equal(drawn[2], branch.values[flip:])


@pytest.mark.slow
def test_a_branch_becomes_a_dataset_and_a_table(by_amplitude):
    pytest.importorskip("xarray")
    pytest.importorskip("pandas")
    branch = by_amplitude
    dataset = hj.convert.to_xarray(branch)
    assert_array_equal(dataset["A"], branch.values)
    assert_array_equal(dataset["multipliers"], branch.multipliers)
    table = branch.to_pandas()
    rows_of_points = table[table["kind"] != ""].index
    assert list(rows_of_points) == [point.index for point in branch.bifurcations]


@settings(max_examples=3, phases=(Phase.generate,))
@given(
    st.sampled_from(["A", "restitution", "g", "T"]),
    st.floats(0.75, 0.95) | st.floats(1.05, 1.3),
    st.floats(0.02, 0.3),
)
@pytest.mark.slow
def test_the_closed_form_holds_at_both_ends(juggling, parameter, factor, step):
    """Any parameter, either way, in long steps and short ones; with T the clock changes, too."""
    given = float(getattr(juggling.system, parameter))
    limits = np.sort([given, given * factor])
    branch = hj.continuation(juggling, parameter, limits, step=step)
    last = len(branch) - 1
    for end in (branch[0], branch[last]):
        a = float(end.system.restitution)
        g = float(end.system.g)
        T = float(end.system.T)
        (bounce,) = end.trajectory().events
        speed = g * T / 2
        assert_allclose(bounce.after["v"], speed, rtol=1e-9)
        stiffness = (2 * np.pi / T) ** 2
        acceleration = -stiffness * bounce.before["y"]
        by_table = (1 + a) ** 2 * acceleration / g
        trace = 1 + a**2 + by_table
        assert_allclose(np.sum(end.multipliers), trace, atol=1e-7)
        assert_allclose(np.prod(end.multipliers), a**2, rtol=1e-9)


@pytest.mark.parametrize(
    "system, parameter",
    [(m.PaddleJuggler, "T"), (m.BuckConverter, "T"), (Switched, "duty")],
)
@pytest.mark.slow
def test_derivatives_of_a_turn_by_a_clock_are_differences(system, parameter):
    cycle = hj.find_limit_cycle(system())
    curve = Curve(cycle, parameter, 1.0)
    point = np.append(curve.map.anchor.q, curve.value)
    turn = curve.turn(curve.map, point)
    derivative = turn.jacobian[:, -1]

    h = 1e-5 * curve.value
    step = np.zeros(len(point))
    step[-1] = h
    above = curve.turn(curve.map, point + step).residual
    below = curve.turn(curve.map, point - step).residual
    difference = (above - below) / (2 * h)
    rounding = 1e-12 * np.abs(derivative).max()
    assert_allclose(derivative, difference, rtol=1e-6, atol=rounding)


def test_bad_input(juggling):
    follow = hj.continuation
    for words, values in {
        "ascending": (0.1, 0.3, 0.2),
        "outside of the": (0.2, 0.3),
    }.items():
        with pytest.raises(hj.errors.DefinitionError, match=words):
            follow(juggling, "A", values)
    with pytest.raises(hj.errors.DefinitionError, match="outside of jit"):
        program = eqx.filter_jit(lambda c: follow(c, "A", (0.1, 0.2)).values)
        program(juggling)
    with pytest.raises(hj.errors.DefinitionError, match="has multiplicity 1, not 2"):
        hj.find_limit_cycle(juggling.system, juggling, multiplicity=2)


@pytest.mark.slow
def test_period_2_of_the_buck_converter():
    """It ends in the flip of the cycle of period 1, where the two halves change places."""
    buck = m.BuckConverter(Vin=25.0)
    guess = hj.Guess("open", (12.04, 0.627, 3.8))
    cycle = hj.find_limit_cycle(buck, guess, multiplicity=2)
    assert_allclose(cycle.period, 800e-6)
    assert_allclose(cycle.state["v"], 12.0384992252652, rtol=1e-11)
    assert_allclose(cycle.state["i"], 0.626948841497016, rtol=1e-11)
    pair = 0.613891423607179 + 0.290590765487630j
    assert_allclose(cycle.multipliers, [pair, np.conj(pair)], rtol=1e-9)

    branch = hj.continuation(cycle, "Vin", (24.0, 25.5))
    (point,) = branch.bifurcations
    assert point.kind == "branch point"
    assert_allclose(point.value, 24.5165728285634, rtol=1e-7)
    assert branch.values[0] == 25.5
    assert branch.values[-1] == 25.5
    before = branch.values[1 : point.index]
    after = branch.values[point.index + 1 :]
    assert before.min() > 24.5165
    assert after.min() > 24.5165


@pytest.mark.slow
def test_a_foot_that_stays_on_the_ground(hopper_cycle):
    """Driven less, the hopper stops hopping: the force of the ground, (m + M) g plus a sine of
    amplitude a r / (r - k), r = M w^2, just reaches zero."""
    branch = hj.continuation(hopper_cycle, "a", (1.0, 30.0))
    assert branch.ends[0].result == hj.errors.Result.GRAZING
    r = 2 * (2 * np.pi) ** 2
    expected = 6 * (r - 10) / r
    assert_allclose(branch.ends[0].value, expected, rtol=2e-6)
    # More, and liftoff comes before the phase at which the cycle given begins.
    assert branch.ends[1].message == "end of the parameter range"
    assert not branch.bifurcations
    assert branch.values[-1] == 30.0
    time = float(branch[-1].anchor.t[0])
    assert time != 0.5
    last = branch[-1]
    again = hj.find_limit_cycle(last.system, last)
    assert_allclose(again.multipliers, branch[-1].multipliers, rtol=1e-10)


class Growth(eqx.Module):
    r: hj.Parameter = hj.parameter(1.9)


class Maps(hj.HybridSystem):
    """The logistic map twice, and twice with delay: fixed points are 1 - 1 / r."""

    growth: Growth = eqx.field(default_factory=Growth)

    def charts(self):
        def rates(t, q, u):
            wave = jnp.sin(2 * jnp.pi * t)
            return 0.0 * wave * q

        return {"a": Field(tuple("abcdef"), rates)}

    def transitions(self):
        def step(t, q, u):
            change = jnp.array([0.0, 0.0, 0.0, 0.01])
            r = self.growth.r + change
            others = q[jnp.array([0, 1, 4, 5])]
            growth = r * q[:4] * (1 - others)
            return *growth, q[2], q[3]

        return [
            hj.Transition("step", "a", "a", hj.systems.Scheduled(1.0, 0.5), reset=step)
        ]

    def period(self):
        return 1.0


@pytest.mark.slow
def test_multipliers_that_cross_the_circle_together_or_beside_others():
    """Test functions do not change their signs, or are small. The parameter is that of a part."""
    guess = hj.Guess("a", (0.47,) * 6)
    cycle = hj.find_limit_cycle(Maps(), guess)
    with pytest.raises(
        hj.errors.DefinitionError, match="'growth.c'; parameters are growth.r"
    ):
        hj.continuation(cycle, "growth.c", (1.0, 2.0))
    branch = hj.continuation(cycle, "growth.r", (1.9, 3.1), step=1.0)
    kinds = [point.kind for point in branch.bifurcations]
    assert kinds == ["Neimark-Sacker", "Neimark-Sacker", "flip"]
    critical = [len(point.critical) for point in branch.bifurcations]
    assert critical == [2, 2, 2]
    values = [point.value for point in branch.bifurcations]
    assert_allclose(values, [1.99, 2.0, 3.0], atol=1e-8)


@pytest.mark.slow
def test_a_cycle_that_shrinks_to_an_equilibrium():
    """The circle of Hopf's normal form has the radius sqrt(mu) and the multiplier exp(-2 mu)."""
    cycle = hj.find_limit_cycle(m.HopfOscillator())
    branch = hj.continuation(cycle, "mu", (-0.05, 0.12), step=0.2)
    begin, _ = branch.ends
    assert begin.result == hj.errors.Result.EQUILIBRIUM
    assert "shrinks to an equilibrium" in begin.message
    assert 0 < begin.value < 1e-4
    wide = branch.values > 1e-3
    exact = np.exp(-2 * branch.values[wide])
    assert_allclose(branch.multipliers[wide, 0], exact, rtol=1e-8)


class IntegrateAndFire(hj.HybridSystem):
    """v' = 1.5 - v + a sin(2 pi t / T), reset to 0 at v = 1: one spike in each period."""

    a: hj.Parameter = hj.parameter(0.6)
    T: hj.Parameter = hj.parameter(1.2)

    def charts(self):
        def leak(t, q, u):
            phase = 2 * jnp.pi * t / self.T
            wave = jnp.sin(phase)
            return 1.5 - q + self.a * wave

        return {"leak": Field(("v",), leak)}

    def transitions(self):
        def below(t, q, u):
            return 1 - q[0]

        def to_rest(t, q, u):
            return (0.0,)

        return [hj.Transition("spike", "leak", "leak", below, reset=to_rest)]

    def period(self):
        return self.T

    def guess(self):
        return hj.Guess("leak", (0.3,), 0.0)


@pytest.mark.slow
def test_a_spike_that_an_earlier_maximum_reaches_first():
    """Spikes lock to the sine from a fold on, where it just makes up for the mean. On the unstable
    side the potential has a maximum before each spike, which reaches the threshold, too."""
    period = 1.2
    rate = 2 * np.pi / period
    cycle = hj.find_limit_cycle(IntegrateAndFire())
    branch = hj.continuation(cycle, "a", (0.3, 0.8), step=0.1)
    (fold,) = branch.bifurcations
    charge = 1 / (1 - np.exp(-period))
    mean = charge - 1.5
    expected = abs(mean) * np.hypot(1, rate)
    assert_allclose(fold.value, expected, rtol=1e-9)

    begin, end = branch.ends
    assert end.message == "end of the parameter range"
    assert begin.result == hj.errors.Result.GRAZING
    assert "'spike' is touched tangentially" in begin.message

    # The potential between two spikes of the last cycle, in closed form.
    def steady(t):
        sine = np.sin(rate * t)
        wave = sine - rate * np.cos(rate * t)
        return 1.5 + begin.value * wave / (1 + rate**2)

    (spike,) = branch[0].trajectory().events
    start = float(spike.time) - period
    t = start + np.linspace(1e-9, period - 1e-9, 20001)
    decay = np.exp(-(t - start))
    v = steady(t) - steady(start) * decay
    middle = v[1:-1]
    above_last = middle > v[:-2]
    above_next = middle > v[2:]
    peaks = middle[above_last & above_next]
    assert_allclose(peaks, 1.0, atol=1e-4)


class Boost(hj.HybridSystem):
    """A boost converter: 10 V, 100 uH, 100 uF, a clock of 20 us, the switch closed for one half."""

    R: hj.Parameter = hj.parameter(70.0)

    def charts(self):
        def on(t, q, u):
            return -q[0] / (self.R * 1e-4), 1e5

        def off(t, q, u):
            load = q[0] / self.R
            current = (q[1] - load) / 1e-4
            voltage = (10.0 - q[0]) / 1e-4
            return current, voltage

        def idle(t, q, u):
            return (-q[0] / (self.R * 1e-4),)

        return {
            "on": Field(("v", "i"), on),
            "off": Field(("v", "i"), off),
            "idle": Field(("v",), idle),
        }

    def transitions(self):
        def current(t, q, u):
            return q[1]

        def without(t, q, u):
            return (q[0],)

        def begins(t, q, u):
            return q[0], 0.0

        tick = hj.systems.Scheduled(20e-6)
        return [
            hj.Transition("opens", "on", "off", hj.systems.Scheduled(20e-6, 10e-6)),
            hj.Transition("closes", "off", "on", tick),
            hj.Transition("is empty", "off", "idle", current, reset=without),
            hj.Transition("closes again", "idle", "on", tick, reset=begins),
        ]

    def period(self):
        return 20e-6

    def guess(self):
        return hj.Guess("on", (20.0, 0.3), 5e-6)


def _least_current(R):
    """Of the cycle in continuous conduction, by exponentials of matrices beside a constant 1."""
    load = 1 / (R * 1e-4)
    on = np.array(
        [
            [-load, 0, 0],
            [0, 0, 1e5],
            [0, 0, 0],
        ]
    )
    off = np.array(
        [
            [-load, 1e4, 0],
            [-1e4, 0, 1e5],
            [0, 0, 0],
        ]
    )
    turn_on = expm(on * 10e-6)
    turn = expm(off * 10e-6) @ turn_on
    unit = np.eye(2)
    back = unit - turn[:2, :2]
    forcing = turn[:2, 2]
    return np.linalg.solve(back, forcing)[1]


@pytest.mark.slow
def test_the_border_of_continuous_conduction():
    """There the coil's current vanishes just when the clock closes the switch: on one side it does
    not vanish, on the other side two events come to the same time."""
    border = brentq(_least_current, 50.0, 110.0)
    for R, values, side, words in (
        (70.0, (70.0, 90.0), 1, "'is empty' begins to happen"),
        (90.0, (70.0, 90.0), 0, "'is empty' and 'closes again' come to the same time"),
    ):
        cycle = hj.find_limit_cycle(Boost(R=R))
        end = hj.continuation(cycle, "R", values, step=0.5).ends[side]
        assert end.result == hj.errors.Result.EVENT_ORDER
        assert words in end.message
        assert_allclose(end.value, border, rtol=1e-4)


class Brusselator(hj.HybridSystem):
    """A chemical oscillator, with a Hopf point at b = 2, from which on its cycle grows."""

    b: hj.Parameter = hj.parameter(2.02)

    def charts(self):
        def rates(t, q, u):
            x, y = q
            square = x**2 * y
            first = 1 - (self.b + 1) * x + square
            second = self.b * x - square
            return first, second

        return {"all": Field(("x", "y"), rates)}


@pytest.mark.slow
def test_a_branch_that_its_checks_cut_has_a_cause():
    """A cycle that is smaller than the errors of the checks closes after any time."""
    guess = hj.Guess("all", (1.0, 2.3))
    section = hj.Crossing("x", "rising", 1.0)
    cycle = hj.find_limit_cycle(Brusselator(), guess, section=section)
    branch = hj.continuation(cycle, "b", (1.99, 2.03), step=0.5)
    begin, end = branch.ends
    assert_allclose([begin.value, end.value], [2.0, 2.03], rtol=1e-6)
    assert not branch.bifurcations
    assert "shrinks to an equilibrium" in begin.message
