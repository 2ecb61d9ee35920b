"""A cycle that is "ok" has passed checks that share no step with its search."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj
from hybridjax._core.results import Result
from hybridjax.errors import ComputationError

from ..toys import Field


class Charging(hj.Chart):
    """The capacitor of an RC circuit whose comparator has an output of +1 or -1."""

    circuit: "SchmittTrigger"
    output: float
    states = ("x",)

    def field(self, t, q, u):
        rise = self.output - q[0] + u[0]
        return (rise / self.circuit.tau,)


class SchmittTrigger(hj.HybridSystem):
    """A relaxation oscillator whose thresholds move with a clock, to which it locks."""

    tau: hj.Parameter = hj.parameter(0.8)
    width: hj.Parameter = hj.parameter(0.3)
    ripple: hj.Parameter = hj.parameter(0.1)

    def threshold(self, t):
        wave = jnp.sin(2 * jnp.pi * t)
        return self.width + self.ripple * wave

    def charts(self):
        return {"up": Charging(self, 1.0), "down": Charging(self, -1.0)}

    def transitions(self):
        def high(t, q, u):
            return q[0] - self.threshold(t)

        def low(t, q, u):
            return q[0] + self.threshold(t)

        return [
            hj.Transition("to down", "up", "down", guard=high, direction="rising"),
            hj.Transition("to up", "down", "up", guard=low),
        ]

    def period(self):
        return 1.0


class Potentials(hj.Chart):
    cells: "TwoCells"
    states = ("v1", "v2")

    def field(self, t, q, u):
        drive = self.cells.drive
        return drive - q[0], drive - q[1]


class TwoCells(hj.HybridSystem):
    """Two leaky integrate-and-fire cells, each of which inhibits the other."""

    drive: hj.Parameter = hj.parameter(1.5)
    inhibition: hj.Parameter = hj.parameter(0.2)

    def charts(self):
        return {"rest": Potentials(self)}

    def transitions(self):
        def first(t, q, u):
            return (0.0, q[1] - self.inhibition)

        def second(t, q, u):
            return (q[0] - self.inhibition, 0.0)

        return [
            hj.Transition(
                f"spike {k + 1}",
                "rest",
                "rest",
                guard=lambda t, q, u, k=k: q[k] - 1.0,
                direction="rising",
                reset=reset,
            )
            for k, reset in enumerate((first, second))
        ]


def spikes_by_hand(state, drive=1.5, inhibition=0.2, count=200):
    """Times of the last two spikes of the first cell, by the closed form of the potentials."""
    v = np.array(state, float)
    t = 0.0
    times = []
    while len(times) < count:
        wait = np.log((drive - v) / (drive - 1.0))
        k = int(np.argmin(wait))
        decay = np.exp(-wait[k])
        v = drive + (v - drive) * decay
        t += wait[k]
        v[1 - k] -= inhibition
        v[k] = 0.0
        if k == 0:
            times.append(t)
    return times[-2:]


@pytest.mark.slow
def test_a_guess_on_the_right_side_of_the_guards_finds_the_rhythm():
    # From between the thresholds Newton's method goes to the rest point beyond one of them.
    for chart, x in (("up", 0.0), ("down", 0.0), ("up", -0.9), ("down", 0.9)):
        guess = hj.Guess(chart, (x,))
        cycle = hj.find_limit_cycle(SchmittTrigger(), guess)
        assert sorted(cycle.event_sequence) == [0, 1]
        assert 0.69 < cycle.multipliers[0].real < 0.70
        assert not cycle.findings
        assert not cycle.not_reached


def test_a_cycle_beyond_a_guard_is_refused_by_name():
    with pytest.raises(ComputationError, match="beyond the guard of 'to down'.*'up'"):
        hj.find_limit_cycle(SchmittTrigger(), hj.Guess("up", (0.7,)))
    section = hj.AtEvent("spike 1")
    with pytest.raises(ComputationError, match="beyond the guard of 'spike 2'"):
        hj.find_limit_cycle(TwoCells(), hj.Guess("rest", (0.0, 1.2)), section=section)
    guess = hj.Guess("rest", (0.0, 1.2))
    ghost = hj.find_limit_cycle(TwoCells(), guess, section=section, throw=False)
    assert ghost.result == Result.GUARD_BEYOND
    with pytest.raises(hj.errors.DefinitionError, match="beyond a guard"):
        hj.linearize(ghost, [section, section])


def test_the_rhythm_of_two_cells_is_that_of_the_closed_form():
    guess = hj.Guess("rest", (0.0, 0.5))
    cycle = hj.find_limit_cycle(TwoCells(), guess, section=hj.AtEvent("spike 1"))
    before, last = spikes_by_hand((0.0, 0.5))
    assert_allclose(cycle.period, last - before, rtol=1e-12)
    assert "checked by" in repr(cycle)
    assert "not reached" not in repr(cycle)


def ghost_beside(cycle):
    """The cycle as if it rested at x = 1, beyond the threshold."""
    found = cycle.anchor
    chart = jnp.zeros_like(found.chart)
    ones = jnp.ones_like(found.q)
    anchor = found._replace(chart=chart, q=ones)
    return dataclasses.replace(cycle, anchor=anchor)


@pytest.mark.slow
def test_sweeps_and_programs_refuse_a_cycle_beyond_a_guard():
    guess = hj.Guess("up", (0.0,))
    cycle = hj.find_limit_cycle(SchmittTrigger(), guess)
    ghost = ghost_beside(cycle)
    widths = jnp.linspace(0.297, 0.303, 4)
    systems = eqx.filter_vmap(lambda w: SchmittTrigger(width=w))(widths)
    cycles = hj.orbits.find_limit_cycles(systems, cycle)
    assert cycles.ok.all()
    assert ((cycles.codes >= 0).sum(axis=1) == 2).all()
    ghosts = hj.orbits.find_limit_cycles(systems, ghost)
    assert (ghosts.result == Result.GUARD_BEYOND).all()
    with pytest.raises(hj.errors.DefinitionError, match="guess is none"):
        hj.sweep(SchmittTrigger(), {"width": np.asarray(widths)}, guess=ghost)

    def state(width):
        found = hj.find_limit_cycle(SchmittTrigger(width=width), ghost)
        return found.anchor.q[0, 0], found.result

    for derived in (jax.grad, lambda f, **options: jax.jit(jax.grad(f, **options))):
        slope, result = derived(state, has_aux=True)(0.3)
        assert int(result) == Result.GUARD_BEYOND
        assert np.isnan(slope), "there is no cycle to differentiate"


@pytest.mark.slow
def test_a_branch_does_not_begin_beyond_a_guard():
    guess = hj.Guess("up", (0.0,))
    cycle = hj.find_limit_cycle(SchmittTrigger(), guess)
    with pytest.raises(hj.errors.DefinitionError, match="none of SchmittTrigger"):
        hj.continuation(ghost_beside(cycle), "width", (0.25, 0.35))


def test_simulate_names_a_guard_beyond_which_it_starts():
    path = hj.simulate(TwoCells(), "rest", (0.0, 1.2), 3.0)
    assert [x.cause for x in path.findings] == ["beyond a guard"]
    assert "'spike 2'" in repr(path)
    assert not hj.simulate(TwoCells(), "rest", (0.0, 0.5), 3.0).findings


class Capacitor(hj.Chart):
    states = ("x",)
    voltage: float

    def field(self, t, q, u):
        return (self.voltage - q[0],)


class Switched(hj.HybridSystem):
    """A capacitor that a clock charges and discharges, by a guard of the time alone."""

    def charts(self):
        return {"up": Capacitor(1.0), "down": Capacitor(-1.0)}

    def transitions(self):
        def clock(t, q, u):
            return jnp.cos(2 * jnp.pi * t)

        def other_half(t, q, u):
            return -jnp.cos(2 * jnp.pi * t)

        return (
            hj.Transition("off", "up", "down", guard=clock),
            hj.Transition("on", "down", "up", guard=other_half),
        )

    def period(self):
        return 1.0


@pytest.mark.slow
def test_an_event_at_the_zero_of_a_guard_of_time_alone_is_none_beside_its_guard():
    guess = hj.Guess("up", (0.0,), time=0.0)
    cycle = hj.find_limit_cycle(Switched(), guess)
    half = np.exp(-0.5)
    since = np.exp(-0.25)
    below = 1 - cycle.anchor.q[0, 0]
    at_switch = 1 - below * since
    exact = (1 - half) / (1 + half)
    assert at_switch == pytest.approx(exact, abs=1e-12)
    expected_multipliers = [np.exp(-1)]
    assert cycle.multipliers == pytest.approx(expected_multipliers, abs=1e-12)


def test_a_failed_cycle_of_a_sweep_says_so_where_its_checks_are_asked_for():
    guess = hj.Guess("up", (0.0,))
    good = hj.find_limit_cycle(SchmittTrigger(), guess)
    cycles = hj.orbits.find_limit_cycles(
        [SchmittTrigger(width=w) for w in (0.3, 0.9)], good
    )
    assert cycles.result[1] == Result.GUARD_BEYOND
    for name in ("findings", "not_reached"):
        assert not getattr(cycles[0], name)
        with pytest.raises(
            hj.errors.DefinitionError, match="the search for this cycle fail"
        ):
            getattr(cycles[1], name)


class Driven(hj.HybridSystem):
    """x' = -x / 10 + cos(t), with a clock that a slip may make too long."""

    turns: int = eqx.field(static=True, default=1)

    def charts(self):
        return {"on": Field(("x",), lambda t, q, u: (jnp.cos(t) - 0.1 * q[0],))}

    def period(self):
        return 2 * np.pi * self.turns

    def guess(self):
        return hj.Guess("on", (0.5,))


@pytest.mark.parametrize("turns", [1, 2, 6])
def test_a_clock_that_is_too_long_is_a_doubt(turns):
    """The multiplier of two periods is the square of that of one: the print says so."""
    cycle = hj.find_limit_cycle(Driven(turns))
    expected = np.exp(-0.2 * np.pi * turns)
    assert cycle.multipliers[0] == pytest.approx(expected, rel=1e-8)
    causes = [finding.cause for finding in cycle.findings]
    assert ("a long clock" in causes) == (turns > 1)
    assert ("shortest period" in repr(cycle)) == (turns == 1)


class Swinging(hj.HybridSystem):
    """A pendulum without friction: each swing is a cycle, of a family, with the multiplier 1."""

    def charts(self):
        return {
            "swing": Field(("angle", "rate"), lambda t, q, u: (q[1], -jnp.sin(q[0])))
        }

    def transitions(self):
        return ()


@pytest.mark.parametrize(
    "below",
    [*(pytest.param(x, marks=pytest.mark.slow) for x in (0.0, 1e-14, 1e-12)), 1e-10],
)
def test_multipliers_that_are_only_rounding_are_refused(below):
    """Beside the separatrix, at the rate 2, deviations grow by more than 1e10, and shrink again:
    the multiplier, which is 1, comes out as -1.1 to 0.999, and the period as any."""
    guess = hj.Guess("swing", (0.0, 2.0 - below))
    with pytest.raises(
        ComputationError, match="rounding errors decide on the multipliers"
    ):
        hj.find_limit_cycle(Swinging(), guess)
