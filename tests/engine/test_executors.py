"""One source, two executors: the host and XLA agree, and the host compiles users' functions."""

import threading

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj
from hybridjax._core import compilation
from hybridjax._core.compilation import quick_jit
from hybridjax._core.executor import from_host, on_host, to_host
from hybridjax.engine.lanes import IDLE, MOVE, side_by_side, start_lanes
from hybridjax.engine.move import Options, move
from hybridjax.engine.settings import Settings
from hybridjax.engine.target import until
from hybridjax.orbits import newton, shooting
from hybridjax.orbits.shooting import fixed_point, travel
from hybridjax.systems.structure import Structure

from ..conftest import unchecked_host
from ..fuzz.drawing import STRUCTURES, draw
from ..fuzz.structures import Random
from ..toys import Field, toy


# Systems of which both executors are compiled in every run of the tests; those of others are slow.
FEW = ("PaddleJuggler",)


def slow_but(names, few):
    return [
        n if n in few else pytest.param(n, marks=pytest.mark.slow)
        for n in sorted(names)
    ]


def flow(system, t, chart, q, u, end, settings, at_once=False):
    """A recorded flow of one lane (of either executor's arrays)."""
    s = Structure(system)
    lanes = start_lanes(s, t, chart, q)
    return move(
        s, lanes, u, until(end), settings, options=Options(tape=True, at_once=at_once)
    )


compiled_flow = quick_jit(flow)


class AtOnce(threading.Thread):
    """A thread that is done when it starts."""

    def start(self):
        self.run()


def agree(system, chart, state, u, begin, duration):
    """Both executors decide the same, and their tapes are the same to rounding."""
    s = Structure(system)
    q = np.zeros((s.d, 1))
    q[: len(state), 0] = state
    t = np.array([begin], float)
    inputs = np.reshape(u, (s.nu, 1))
    settings = Settings(1e-9, 1e-9, max_steps=400)
    charts = np.array([chart], np.int32)
    arguments = (t, charts, q, inputs, t + duration, settings)
    with unchecked_host():
        host = flow(system, *to_host(arguments))
        whole = flow(system, *to_host(arguments), at_once=True)
    xla = compiled_flow(system, *from_host(arguments))
    for leaf in jax.tree_util.tree_leaves(host):
        assert on_host(leaf)
    assert np.sum(host.tape.code != IDLE) > 2, "there are a few steps"

    # Steps amplify the rounding errors of their error estimates.
    size = 1 + np.abs(xla.moved.lanes.q)
    for other in (whole, xla):
        assert_array_equal(host.moved.result, other.moved.result)
        assert_array_equal(host.tape.code, other.tape.code)
        assert_array_equal(host.tape.chart, other.tape.chart)
        ours = host.moved.lanes
        theirs = other.moved.lanes
        assert_allclose(ours.t, theirs.t, rtol=1e-12)
        assert_allclose(ours.q / size, theirs.q / size, atol=1e-9)
    moved = host.tape.code[:, 0] != IDLE
    found_times = whole.tape.t[moved]
    assert_allclose(found_times, host.tape.t[moved], rtol=1e-9)
    found_states = whole.tape.before[moved]
    assert_allclose(found_states, host.tape.before[moved], atol=1e-7)


@pytest.mark.parametrize("name", slow_but(hj.models.__all__, FEW))
def test_both_agree_on_the_gallery(name):
    system = getattr(hj.models, name)()
    guess = system.guess()
    if guess is None:
        pytest.skip("has no guess of its own")
    period = system.period()
    duration = 2.0 if period is None else 1.5 * float(period)
    chart = Structure(system).chart_index(guess.chart)
    state = np.asarray(guess.state)
    if name == "TrottingQuadruped":
        # The pitch of a level trot consists of rounding errors, which would decide on the steps.
        state = state + 0.01
    inputs = np.zeros(len(system.inputs))
    agree(system, chart, state, inputs, float(guess.time), duration)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(STRUCTURES))
def test_both_agree_on_random_systems(name):
    plan = STRUCTURES[name][0]
    for number in range(2):
        sample = jax.tree_util.tree_map(np.asarray, draw(name, number))
        start = sample.start
        system = from_host(Random(plan, sample.charts, sample.arrows))
        agree(system, 0, start.q, start.u, start.t, 2.0)


def events_of(turn):
    codes = np.ravel(turn.codes)
    return codes[codes >= 0]


def wrong_moves(map, expected):
    """A gap before a move, another first time, and an event (not the last) overlooked."""
    third = np.arange(len(expected.t)) == 2
    gap = 1e-6 * third * map.scale[expected.chart].T
    yield expected._replace(q=expected.q + gap)
    is_first = expected.order + expected.lane == 0
    sooner = 1e-6 * map.expected * is_first
    yield expected._replace(t=expected.t - sooner)
    is_event = expected.code >= 0
    if is_event[:-1].any():
        is_first_event = is_event & (np.cumsum(is_event) == 1)
        yield expected._replace(code=np.where(is_first_event, MOVE, expected.code))


@pytest.mark.parametrize(
    "name", slow_but(hj.models.__all__, ("FitzHughNagumo", "VerticalHopper"))
)
@pytest.mark.slow
def test_a_turn_with_its_moves_side_by_side(name, monkeypatch):
    """The same moves, with the same derivatives, as one after the other."""
    system = getattr(hj.models, name)()
    if system.guess() is None:
        pytest.skip("has no guess of its own")
    if name in ("BuckConverter", "SLIPRunner", "TrottingQuadruped"):
        pytest.skip("a family of cycles, or events at one instant")
    with unchecked_host():
        cycle = hj.find_limit_cycle(system)
        map = to_host(cycle.return_map)
        q = map.anchor.q[:, 0]
        sizes = map.sizes
        turn = map.turn_with_jacobian(q)
        recorded = (turn.pieces, side_by_side(turn.tapes))
        x, expected = fixed_point(map, recorded, q / sizes)
        if name == "VerticalHopper":  # (moves arm later ones)
            monkeypatch.setattr(shooting, "arm", lambda s, lanes, *_: lanes)
        travelled = travel(map, x * sizes, expected)
        assert travelled is not None
        again = map.turn_with_jacobian(x * sizes, travelled=travelled)
        for other in wrong_moves(map, expected):
            assert travel(map, x * sizes, other) is None
    assert int(cycle.iterations) < 8, "gaps between moves keep no search from ending"
    if name == "VerticalHopper":
        assert cycle.residual > 0, "where only gaps are left, they count"

    assert_array_equal(events_of(again), events_of(turn))
    s = map.structure
    sources = [s.chart_index(transition.source) for transition in s.transitions]
    for pieces in (again.pieces, turn.pieces):
        source_column = np.array(sources, int)[:, None]
        of_other_charts = source_column != pieces.chart
        pieces.armed[of_other_charts] = False
    assert_array_equal(again.pieces.armed, turn.pieces.armed)
    assert_array_equal(again.pieces.chart, turn.pieces.chart)
    assert_array_equal(again.pieces.events, turn.pieces.events)
    # (Gaps between moves may be as large as the errors of 300 steps, each of 1e-12, which add up; a
    # neuron jumps by 100 sizes of its states in a unit of time.)
    scale = map.scale[turn.pieces.chart].T
    found = again.pieces.q / scale
    usual = turn.pieces.q / scale
    assert_allclose(found, usual, rtol=0, atol=1e-8)
    assert_allclose(again.period, turn.period, rtol=3e-10)
    size = np.abs(turn.factors).max(axis=0)
    factors = again.factors / size
    usual_factors = turn.factors / size
    assert_allclose(factors, usual_factors, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", slow_but(hj.models.__all__, ("PaddleJuggler",)))
def test_searches_with_moves_side_by_side_end_at_the_same_cycle(name, monkeypatch):
    """As without; from the model's guess, and from the cycle of other parameters."""
    system = getattr(hj.models, name)()
    if system.guess() is None or name == "SLIPRunner":
        pytest.skip("has no guess of its own, or a family of cycles")
    rng = np.random.default_rng(5)

    def move(x):
        if not eqx.is_inexact_array(x):
            return x
        change = 0.01 * rng.uniform(-1, 1)
        return x * (1 + change)

    guess = hj.find_limit_cycle(system)
    moved = jax.tree_util.tree_map(move, system)
    cycles = [hj.find_limit_cycle(moved), hj.find_limit_cycle(moved, guess)]
    monkeypatch.setattr(newton, "fixed_point", lambda map, turn, x: (x, None))
    cycles += [hj.find_limit_cycle(moved), hj.find_limit_cycle(moved, guess)]
    for cycle in cycles[:2]:
        assert cycle.event_sequence == cycles[2].event_sequence
        assert_allclose(cycle.period, cycles[2].period, rtol=1e-11)
        assert_allclose(cycle.multipliers, cycles[2].multipliers, rtol=1e-9, atol=1e-10)


def test_a_function_of_the_host_is_compiled_once_it_is_worth_it(monkeypatch):
    monkeypatch.setattr(threading, "Thread", AtOnce)
    seen = []

    def function(x):
        seen.append(on_host(x))
        return 2 * x

    call = compilation.host_first(function)
    monkeypatch.setattr(compilation, "WORTH_COMPILING", 1e-9)
    numbers = np.arange(3.0)
    results = [call(from_host(numbers)) for _ in range(3)]
    assert seen == [True, False]  # on the host, then traced, then no more
    assert_array_equal(results, [[0.0, 2.0, 4.0]] * 3)
    with jax.default_matmul_precision("highest"):
        call(from_host(np.arange(3.0)))
    assert seen == [True, False] * 2  # (as a program of its own)


def test_gaps_between_moves_end_no_search_for_an_unstable_cycle():
    """Its multiplier of 2.9e5 makes Newton steps small where gaps are not."""
    with unchecked_host():

        def rates(t, q, u):
            return (2 * q[0] - jnp.cos(t),)

        grow = toy(
            {"x": Field(("x",), rates)},
            period=2 * np.pi,
        )
        unstable = hj.find_limit_cycle(grow, hj.Guess("x", (0.4,)))
        map = to_host(unstable.return_map)
        q = map.anchor.q[:, 0]
        turn = map.turn_with_jacobian(q)
        recorded = (turn.pieces, side_by_side(turn.tapes))
        x, moves = fixed_point(map, recorded, q / map.sizes)
        for gap, steps in ((8e-13, 1), (1e-9, 2)):
            end, _, taken = newton._newton(map, x + gap, moves, 0, 9)
            assert taken == steps
            assert abs(end / map.sizes - x) < 1e-12
