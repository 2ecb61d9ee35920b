"""Flows from any state: ends, events, codes, and derivatives against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import solve_ivp

import hybridjax as hj
from hybridjax.errors import ComputationError, DefinitionError, Result


def ball(**numbers):
    """A bouncing ball."""

    def fall(t, q, u, p):
        return q[1], -p.g

    def height(t, q, u, p):
        return q[0]

    def bounce(t, q, u, p):
        return q[0], -p.e * q[1]

    own = {"g": 9.81, "e": 0.7}
    events = [("bounce", height, bounce)]
    names = ("y", "v")
    system = hj.HybridSystem.from_functions(names, fall, events, own, inputs=())
    return system.replace(**numbers)


DROP = hj.Guess("main", (1.0, 0.0))
FIRST = np.sqrt(2 / 9.81)
SECOND = FIRST * (1 + 2 * 0.7)


def test_ends_at_a_time_an_event_a_number_of_events_and_a_section():
    until = hj.flow(ball(), DROP, 1.0)
    left = 1.0 - FIRST
    speed = 0.7 * 9.81 * FIRST
    fallen = 9.81 * left**2 / 2
    height = speed * left - fallen
    state = height, speed - 9.81 * left
    assert_allclose(until.state, state, rtol=1e-12)
    assert [x.name for x in until.events] == ["bounce"]

    bounce = hj.flow(ball(), DROP, "bounce", within=3.0)
    assert_allclose(bounce.t, FIRST, rtol=1e-13)
    assert_allclose(bounce.state, (0.0, speed), atol=1e-12)

    second = hj.flow(ball(), DROP, events=2, within=3.0)
    assert_allclose(second.event_times[:2], (FIRST, SECOND), rtol=1e-12)
    assert second.count == 2
    assert np.isnan(second.event_times[2:]).all()

    top = hj.Crossing("v", "falling")
    apex = hj.flow(ball(), DROP, top, within=3.0)
    assert_allclose(apex.t, FIRST * 1.7, rtol=1e-12)
    assert_allclose(apex.state[0], 0.49, rtol=1e-12)

    # One goes on where the other has ended.
    third = hj.flow(ball(), second, "bounce", within=3.0)
    expected = FIRST * (1 + 1.4 + 0.98)
    assert_allclose(third.t, expected, rtol=1e-12)
    assert third.count == 1


@pytest.mark.slow
def test_figures_and_tables_are_those_of_its_steps():
    found = hj.flow(ball(), DROP, 1.0)
    assert found.plot().axes.shape == (2, 1)
    heights = found.to_pandas()["y"]
    assert heights.iloc[-1] == found.state[0]
    starts = hj.Guess("main", jnp.ones((2, 2)))
    many = hj.flow(ball(), starts, 0.1)
    with pytest.raises(DefinitionError, match="only a single flow"):
        many.plot()


def test_what_goes_on_from_a_flow():
    """Its input goes on, too, as a function of time; nothing goes on from a flow that failed."""

    def pushed(t, q, u, p):
        return (u[0],)

    mass = hj.HybridSystem.from_functions(("x",), pushed)
    start = hj.Guess("main", (0.0,))
    first = hj.flow(mass, start, 1.0, input=lambda t: jnp.stack([jnp.cos(t)]))
    onward = hj.flow(mass, first, 2.0)
    assert_allclose(onward.state, [np.sin(2.0)], rtol=1e-11)
    constant = hj.flow(mass, first, 2.0, input=3.0)
    expected = [np.sin(1.0) + 3.0]
    assert_allclose(constant.state, expected, rtol=1e-11)

    rests = hj.flow(ball(), DROP, 5.0, throw=False)
    with pytest.raises(DefinitionError, match=r"`start` failed \(events accum"):
        hj.flow(ball(), rests, 6.0)
    with pytest.raises(DefinitionError, match="other charts"):
        hj.flow(ball(), first, 6.0)

    @jax.jit
    def program(height):
        begin = hj.Guess("main", jnp.stack([height, 0.0]))
        first = hj.flow(ball(), begin, 2.0)
        return hj.flow(ball(), first, 2.1)

    assert program(0.1).result == Result.ZENO
    assert program(1.0).result == Result.OK


@pytest.mark.slow
def test_events_are_counted_from_each_start():
    @jax.jit
    def program(height):
        begin = hj.Guess("main", jnp.stack([height, 0.0]))
        second = hj.flow(ball(), begin, events=2, within=3.0)
        return hj.flow(ball(), second, events=2, within=3.0)

    fourth = program(1.0)
    times = 1 + 2 * (0.7 + 0.49 + 0.343)
    assert_allclose(fourth.t, FIRST * times, rtol=1e-12)
    assert fourth.count == 2


def test_an_event_that_another_has_caused_at_once_happens_after_a_break():
    """The first reset leads across the guard of the second event."""

    def sink(t, q, u, p):
        return -1.0, -1.0

    events = [
        ("first", lambda t, q, u, p: q[0], lambda t, q, u, p: (3.0, -1.0)),
        ("second", lambda t, q, u, p: q[1], lambda t, q, u, p: (q[0], 10.0)),
    ]
    system = hj.HybridSystem.from_functions(("y", "z"), sink, events)
    start = hj.Guess("main", (1.0, 5.0))
    whole = hj.flow(system, start, 1.5)
    assert [event.name for event in whole.events] == ["first", "second"]
    first = hj.flow(system, start, "first", within=2.0)
    broken = hj.flow(system, first, 1.5)
    assert_allclose(broken.state, whole.state, rtol=1e-12)
    assert_allclose(broken.state, (2.5, 9.5), rtol=1e-12)


def test_states_at_times_between():
    times = np.array([0.2, FIRST + 0.1, 1.0])
    fall = hj.flow(ball(), DROP, 1.0)
    charts, states = fall.at(times)
    since = times - np.where(times > FIRST, FIRST, 0.0)
    rebound = 0.7 * 9.81 * FIRST
    speed = np.where(times > FIRST, rebound, 0.0)
    begin = np.where(times > FIRST, 0.0, 1.0)
    assert_allclose(
        states[:, 0], begin + speed * since - 9.81 * since**2 / 2, rtol=1e-12
    )
    late = hj.flow(ball(), DROP, 1.0).at([1.1])
    assert np.isnan(late[1]).all()


def test_a_sample_at_an_event_is_the_state_after_it():
    found = hj.flow(ball(), DROP, 1.0)
    first = found.event_times[:1]
    _, states = found.at(first)
    rebound = 0.7 * 9.81 * FIRST
    assert_allclose(states[0, 1], rebound, rtol=1e-12)
    assert isinstance(states, jax.Array)  # as all arrays of a flow


class Thermostat(hj.HybridSystem):
    """Heats from 18 to 22 degrees, and cools down again."""

    inputs = ()

    def charts(self):
        class On(hj.Chart):
            states = ("T",)

            def field(self, t, q, u):
                return (30.0 - q[0],)

        class Off(hj.Chart):
            states = ("T",)

            def field(self, t, q, u):
                return (-q[0],)

        return {"on": On(), "off": Off()}

    def transitions(self):
        return [
            hj.Transition("hot", "on", "off", lambda t, q, u: 22.0 - q[0]),
            hj.Transition("cold", "off", "on", lambda t, q, u: q[0] - 18.0),
        ]


def test_samples_are_those_of_their_charts():
    start = hj.Guess("on", (18.0,))
    found = hj.flow(Thermostat(), start, 0.7)
    hot = np.log(12 / 8)
    cold = hot + np.log(22 / 18)
    assert_allclose(found.event_times[:2], [hot, cold], rtol=1e-11)
    times = [hot - 0.1, hot + 0.1, cold + 0.05]
    charts, states = found.at(times)
    assert charts.tolist() == [0, 1, 0]
    expected = [
        30 - 12 * np.exp(0.1 - hot),
        22 * np.exp(-0.1),
        30 - 12 * np.exp(-0.05),
    ]
    assert_allclose(states[:, 0], expected, rtol=1e-11)


def third_bounce(height, g, e):
    start = hj.Guess("main", jnp.stack([height, 0.0]))
    found = hj.flow(ball(g=g, e=e), start, events=3, within=9.0)
    speed = found.before[2, 1]
    return jnp.stack([found.t, speed, found.event_times[1]])


def third_bounce_exactly(height, g, e):
    first = jnp.sqrt(2 * height / g)
    fall = jnp.sqrt(2 * height * g)
    speed = -(e**2) * fall
    twice = 2 * e**2
    bounces = 1 + 2 * e + twice
    third = first * bounces
    second = first * (1 + 2 * e)
    return jnp.stack([third, speed, second])


def test_derivatives_through_events_are_those_of_the_closed_form():
    point = 1.0, 9.81, 0.7
    every = 0, 1, 2

    def orders(function):
        def twice(*point):
            first = jax.jacrev(function, every)(*point)
            return first, first

        # (Reverse mode is computed once for both of its orders.)
        second, reverse = jax.jacfwd(twice, every, has_aux=True)(*point)
        forward = jax.jacfwd(function, every)(*point)
        return function(*point), forward, reverse, second

    own = jax.jit(lambda: orders(third_bounce))()
    true = orders(third_bounce_exactly)
    leaves = jax.tree_util.tree_leaves
    for x, y in zip(leaves(own), leaves(true), strict=True):
        assert_allclose(x, y, rtol=1e-11, atol=1e-11)


@pytest.mark.slow
def test_derivatives_by_the_end_the_section_the_input_and_times_between():
    """Each alone is traced, beside a start that is not."""

    def pushed(t, q, u, p):
        return q[1], u[0]

    mass = hj.HybridSystem.from_functions(("x", "v"), pushed)
    start = hj.Guess("main", (0.0, 1.0))

    def by_end(t):
        return hj.flow(mass, start, t, input=2.0).state[0]

    def by_input(u):
        return hj.flow(mass, start, 3.0, input=u).state[0]

    def by_section(x):
        section = hj.Crossing("x", "rising", x)
        return hj.flow(mass, start, section, within=9.0, input=2.0).t

    def by_time(t):
        path = hj.flow(mass, start, 3.0, input=2.0)
        _, states = path.at(jnp.stack([t]))
        return states[0, 0]

    # x = t + t^2, or t + u t^2 / 2.
    assert_allclose(jax.grad(by_end)(3.0), 7.0, rtol=1e-12)
    assert_allclose(jax.grad(by_input)(2.0), 4.5, rtol=1e-12)
    slope = jax.grad(by_section)(12.0)
    assert_allclose(slope, 1 / 7.0, rtol=1e-11)
    assert_allclose(jax.grad(by_time)(1.5), 4.0, rtol=1e-12)


@pytest.mark.slow
def test_derivatives_at_a_state_of_rest():
    """Its own error would allow any step, but that of the derivative does not."""

    def field(t, q, u, p):
        stiffness = 1 + p.a * jnp.cos(t)
        return q[1], -stiffness * q[0]

    mathieu = hj.HybridSystem.from_functions(
        ("x", "v"), field, parameters={"a": 0.5}, period=2 * np.pi, inputs=()
    )

    def end(q):
        return hj.flow(mathieu, hj.Guess("main", q), 7.0).state

    def rates(t, columns):
        x = columns[:2]
        v = columns[2:]
        stiffness = 1 + 0.5 * np.cos(t)
        return np.concatenate([v, -stiffness * x])

    true = solve_ivp(
        rates, (0, 7), np.eye(2).ravel(), method="DOP853", rtol=1e-12, atol=1e-14
    )
    slope = jax.jit(jax.jacfwd(end))
    own = slope(jnp.zeros(2))
    at_end = true.y[:, -1]
    expected = at_end.reshape(2, 2)
    assert_allclose(own, expected, rtol=1e-9)


@pytest.mark.slow
def test_derivatives_where_states_are_small_for_a_moment():
    """The foot of the hopper rests on the ground, and leaves it slowly."""
    hopper = hj.models.VerticalHopper()
    start = hj.Guess("flight", (2.0, 1.0, 0.0, 0.0))

    def height(k):
        changed = hopper.replace(k=k)
        return hj.flow(changed, start, 3.0).state[0]

    slope = jax.grad(height)(10.0)
    step = 1e-5
    higher = height(10.0 + step)
    change = higher - height(10.0 - step)
    difference = change / (2 * step)
    assert_allclose(slope, difference, rtol=1e-7)


@pytest.mark.slow
def test_many_flows_one_of_which_fails():
    """A ball that comes to rest before the end has NaN, and the others are untouched."""
    states = jnp.array(
        [
            [1.0, 0.0],
            [1e-6, 0.0],
            [2.0, 1.0],
        ]
    )
    guesses = hj.Guess("main", states)
    found = hj.flow(ball(), guesses, 0.9, throw=False)
    codes = [Result.OK, Result.ZENO, Result.OK]
    assert found.result.tolist() == codes
    assert np.isnan(found.state[1]).all()
    for k in (0, 2):
        guess = hj.Guess("main", states[k])
        alone = hj.flow(ball(), guess, 0.9)
        assert_allclose(found.state[k], alone.state, rtol=1e-11)
        assert_allclose(found.event_times[k], alone.event_times, rtol=1e-11)
    with pytest.raises(ComputationError, match="1 of 3 flows .* start 1: events accum"):
        hj.flow(ball(), hj.Guess("main", states), 0.9)

    def height(x):
        start = hj.Guess("main", x)
        end = hj.flow(ball(), start, 0.9)
        return end.state[0]

    slopes = jax.vmap(jax.grad(height))(states)
    assert np.isnan(slopes[1]).all()
    by_one = jax.grad(height)(states[0])
    assert_allclose(slopes[0], by_one, rtol=1e-11)


@pytest.mark.slow
def test_a_flow_that_fails_leaves_the_gradient_of_the_others():
    """They share the parameters. What uses the flow that failed has no derivative."""
    starts = jnp.array(
        [
            [1.0, 0.0],
            [1e-6, 0.0],
            [2.0, 1.0],
        ]
    )
    times = jnp.array([0.4, 0.8])

    def of_batch(g):
        guesses = hj.Guess("main", starts)
        found = hj.flow(ball(g=g), guesses, 0.9, throw=False)
        _, states = found.at(times)
        sums = states[:, :, 0].sum(axis=1)
        return found.result, found.state[:, 0], sums

    def of_each(g):
        def one(start):
            guess = hj.Guess("main", start)
            found = hj.flow(ball(g=g), guess, 0.9)
            _, states = found.at(times)
            of_samples = states[:, 0].sum()
            return found.result, found.state[0], of_samples

        return jax.vmap(one)(starts)

    def heights(g, flows):
        result, *parts = flows(g)
        return sum(jnp.where(result == 0, part, 0.0) for part in parts)

    step = 1e-4
    for flows in (of_batch, of_each):
        ahead = heights(9.81 + step, flows)
        back = heights(9.81 - step, flows)
        by_difference = (ahead - back) / (2 * step)
        for jacobian in (jax.jacrev, jax.jacfwd):
            slopes = jacobian(heights)(9.81, flows)
            assert_allclose(slopes, by_difference, rtol=1e-6)
    total = jax.grad(lambda g: of_batch(g)[1].sum())(9.81)
    assert np.isnan(total)


@pytest.mark.slow
def test_flows_without_events_one_of_which_blows_up():
    def grows(t, q, u, p):
        return (p.a * q[0] ** 2,)

    tower = hj.HybridSystem.from_functions(("x",), grows, parameters={"a": 1.0})
    heights = jnp.array([[0.5], [2.0]])
    starts = hj.Guess("main", heights)

    def total(a):
        found = hj.flow(tower.replace(a=a), starts, 1.0, throw=False)
        height = found.state[:, 0]
        return jnp.where(found.result == 0, height, 0.0).sum()

    # x = 1 / (1 / x(0) - a t)
    assert_allclose(total(1.0), 1.0, rtol=1e-11)
    assert_allclose(jax.grad(total)(1.0), 1.0, rtol=1e-11)


class Wall(hj.HybridSystem):
    """A swing that may hit a wall at 1, and loses half of its speed there."""

    inputs = ()

    def charts(self):
        class Swing(hj.Chart):
            states = ("x", "v")

            def field(self, t, q, u):
                return q[1], -q[0]

        return {"swing": Swing()}

    def transitions(self):
        def distance(t, q, u):
            return 1.0 - q[0]

        def stop(t, q, u):
            return q[0], -0.5 * q[1]

        return [hj.Transition("hit", "swing", "swing", distance, reset=stop)]


@pytest.mark.slow
def test_a_guard_that_is_touched():
    """Rounding decides whether the wall is hit, and would be the derivative."""

    @jax.jit
    def swing(a):
        state = jnp.stack([-a, 0.0])
        start = hj.Guess("swing", state)
        return hj.flow(Wall(), start, 4.0)

    def end(a):
        return swing(a).state[0]

    reverse = jax.jit(jax.grad(end))
    forward = jax.jit(jax.jacfwd(end))
    for a in (1.0, 1.0 + 1e-14, 1.0 + 1e-12):
        assert swing(a).result == Result.GRAZING
        assert np.isnan(reverse(a))
        assert np.isnan(forward(a))
        with pytest.raises(ComputationError, match="tangentially"):
            begin = hj.Guess("swing", (-a, 0.0))
            hj.flow(Wall(), begin, 4.0)

    def exact(a):
        hit = jnp.pi - jnp.arccos(1 / a)
        left = 4.0 - hit
        kick = 0.5 * a * jnp.sin(hit)
        return jnp.cos(left) - kick * jnp.sin(left)

    for a in (1.0 + 1e-6, 1.1):
        assert_allclose(end(a), exact(a), rtol=1e-9)
        found = reverse(a)
        expected = jax.grad(exact)(a)
        assert_allclose(found, expected, rtol=1e-6)
    assert_allclose(reverse(1.0 - 1e-6), -np.cos(4.0), rtol=1e-9)


@pytest.mark.slow
def test_a_guard_that_turns_where_it_is_touched():
    """Guards of time and of state, `1 - cos(t) + off`, that turn at zero, or a few errors of steps
    above or below: the search comes to the touch in steps that shrink."""

    def of_time(t, q, u, p):
        return 1.0 - jnp.cos(t) + p.off

    def of_state(t, q, u, p):
        return q[0] + p.off

    def swing(t, q, u, p):
        return q[1], 1.0 - q[0]

    def turn(t, q, u, p):
        return q[0], -0.5 * q[1]

    off = jnp.array([1e-3, 1e-14, 0.0, -1e-14, -1e-12, -1e-3])
    touched = [False, True, True, True, True, False]
    for guard in (of_time, of_state):
        events = [("touch", guard, turn)]
        system = hj.HybridSystem.from_functions(
            ("y", "v"), swing, events, {"off": 0.0}, inputs=()
        )
        start = hj.Guess("main", (1 - np.cos(1), np.sin(1)), 1.0)

        def first_event(x, system=system, start=start):
            found = hj.flow(system.replace(off=x), start, 9.0)
            return found.event_times[0], found

        each = jax.vmap(jax.value_and_grad(first_event, has_aux=True))
        (times, found), slopes = jax.jit(each)(off)
        assert_array_equal(found.result == Result.GRAZING, touched)
        assert_array_equal(found.count, [0, 0, 0, 0, 0, 1])
        assert np.isnan(times[:-1]).all()
        assert_allclose(times[-1], 2 * np.pi - np.arccos(1 - 1e-3), rtol=1e-12)
        assert_allclose(slopes[-1], 1 / np.sqrt(1 - (1 - 1e-3) ** 2), rtol=1e-9)
        for x, is_touched in zip(off, touched, strict=True):
            alone = hj.flow(system.replace(off=x), start, 9.0, throw=False)
            assert (alone.result == Result.GRAZING) == is_touched
        with pytest.raises(ComputationError, match="tangentially"):
            hj.flow(system, start, 9.0)


def test_a_section_that_turns_where_it_is_touched():
    def swing(t, q, u, p):
        return q[1], 1.0 - q[0]

    system = hj.HybridSystem.from_functions(("y", "v"), swing, inputs=())
    start = hj.Guess("main", (1 - np.cos(1), np.sin(1)), 1.0)
    for value, touched in ((0.0, True), (1e-12, True), (1e-3, False)):
        section = hj.Crossing("y", "falling", value)
        found = hj.flow(system, start, section, within=9.0, throw=False)
        assert (found.result == Result.GRAZING) == touched
    assert_allclose(found.t, 2 * np.pi - np.arccos(1 - 1e-3), rtol=1e-12)


def test_small_values_that_are_no_touch():
    """A decay to a tiny threshold, and a ball that bounces ever lower, cross their guards."""

    def decay(t, q, u, p):
        return (-q[0],)

    def stop(t, q, u, p):
        return (q[0] + 1.0,)

    events = [("stop", lambda t, q, u, p: q[0] - p.low, stop)]
    system = hj.HybridSystem.from_functions(
        ("x",), decay, events, {"low": 1e-12}, inputs=()
    )
    for low in (1e-6, 1e-12):
        found = hj.flow(system.replace(low=low), (1.0,), "stop", within=40.0)
        assert_allclose(found.t, -np.log(low), rtol=1e-10)
    e = 0.1
    found = hj.flow(ball(e=e), DROP, events=5, within=2.0)
    exact = FIRST * (1 + 2 * sum(e**k for k in range(1, 5)))
    assert_allclose(found.t, exact, rtol=1e-12)


@pytest.mark.slow
def test_so_many_flows_that_they_are_computed_part_by_part(monkeypatch):
    """The last part is filled up; reverse mode of a program searches the parts again."""
    monkeypatch.setattr("hybridjax.orbits.flow_program._FEW", 10)
    monkeypatch.setattr("hybridjax.orbits.flow_program._PART_BYTES", 4e5)
    height = np.linspace(0.5, 2.0, 14)

    def times(height):
        states = jnp.stack([height, 0.0 * height], axis=1)
        start = hj.Guess("main", states)
        # (5 to 21 rows of the record: the first 4 do not suffice.)
        return hj.flow(ball(), start, events=2, within=3.0).t

    monkeypatch.setattr("hybridjax.orbits.flow_program._FIRST_ROWS", 4)
    exact = np.sqrt(2 * height / 9.81) * 2.4
    assert_allclose(times(height), exact, rtol=1e-11)
    # Reverse mode keeps the record, or searches again if that is too large.
    for most in (5e8, 0.0):
        monkeypatch.setattr("hybridjax.orbits.flow_program._KEPT_BYTES", most)
        reverse = jax.jit(lambda x: jax.vjp(times, x)[1](jnp.ones(14))[0])
        assert_allclose(reverse(height), exact / (2 * height), rtol=1e-11)


def dragged():
    """A ball with drag."""

    def fall(t, q, u, p):
        drag = 0.1 * q[1]
        return q[1], -9.81 - drag

    def bounce(t, q, u, p):
        return q[0], -0.9 * q[1]

    events = [("bounce", lambda t, q, u, p: q[0], bounce)]
    return hj.HybridSystem.from_functions(("y", "v"), fall, events, inputs=())


@pytest.mark.slow
def test_rounding_does_not_shorten_steps_for_derivatives():
    """The error of a derivative is estimated by a difference. If that was as small as rounding at
    an accuracy of 1e-12, flows with derivatives had three times as many steps."""

    def end(height):
        start = hj.Guess("main", (height, 0.0))
        return hj.flow(dragged(), start, events=10, within=20.0, max_steps=64).t

    found, slope = jax.jit(jax.value_and_grad(end))(1.0)
    assert_allclose(found, end(1.0), rtol=1e-11)
    difference = (end(1.001) - end(0.999)) / 0.002
    assert_allclose(slope, difference, rtol=1e-6)


def test_steps_after_events_are_not_tried_with_the_length_of_the_first_one():
    """That one is a guess, a tenth of the longest duration, and would be rejected each time."""
    few = hj.orbits.Settings(rtol=1e-10, max_steps=40)
    found = hj.flow(
        dragged(),
        DROP,
        events=10,
        within=20.0,
        settings=few,
        max_steps=40,
    )
    assert found.count == 10


@pytest.mark.slow
def test_a_flow_until_its_start_stays_there():
    """It moves on with the end, at the rate of the field."""
    same = hj.flow(ball(), DROP, 0.0)
    assert_allclose(same.state, (1.0, 0.0), rtol=1e-15)
    program = jax.jit(lambda end: hj.flow(ball(), DROP, end).state)
    assert_allclose(program(0.0), (1.0, 0.0), rtol=1e-15)
    slope = jax.jit(jax.jacrev(program))(0.0)
    assert_allclose(slope, (0.0, -9.81), atol=1e-12)


def test_an_end_before_the_start_is_a_code_in_programs():
    program = jax.jit(lambda end: hj.flow(ball(), DROP, end))
    for end in (-1.0, np.nan, np.inf):
        assert program(end).result == Result.BAD_INPUT
    assert program(0.1).result == Result.OK


@pytest.mark.slow
def test_a_flow_that_ends_where_it_starts():
    def end(begin, t):
        start = hj.Guess("main", (1.0, 2.0), begin)
        return hj.flow(ball(), start, t).state

    # (One program has the state and its derivative.)
    program = jax.jit(lambda begin, t: jax.jvp(lambda t: end(begin, t), (t,), (1.0,)))
    for time in (0.0, 5.0):
        start = hj.Guess("main", (1.0, 2.0), time)
        found = hj.flow(ball(), start, time)
        assert found.t == time
        assert found.count == 0
        assert_allclose(found.state, (1.0, 2.0))
        state, slope = program(time, time)
        assert_allclose(state, (1.0, 2.0))
        assert_allclose(slope, (2.0, -9.81))


@pytest.mark.parametrize("transformed", [jax.grad, jax.vmap, jax.jit])
def test_functions_of_values_that_are_traced(transformed):
    """JAX would lose the derivatives by what a function reads otherwise than by its arguments."""

    def pushed(t, q, u, p):
        return q[1], u[0]

    mass = hj.HybridSystem.from_functions(("x", "v"), pushed)
    start = hj.Guess("main", (0.0, 1.0))

    def by_section(x):
        def distance(t, q):
            return q[0] - x

        section = hj.Crossing(distance, "rising")
        return hj.flow(mass, start, section, within=9.0, input=2.0).t

    def by_input(k):
        def growing(t):
            return k * t

        return hj.flow(mass, start, 3.0, input=growing).t

    def by_field(k):
        def field(t, q, u, p):
            return q[1], k * q[0]

        system = hj.HybridSystem.from_functions(("x", "v"), field)
        return hj.flow(system, start, 3.0).t

    value = jnp.ones(3) if transformed is jax.vmap else 1.0
    every = {by_section: "distance", by_input: "growing", by_field: "field"}
    for function, name in every.items():
        for program in (transformed(function), jax.jit(transformed(function))):
            with pytest.raises(
                DefinitionError, match=f"{name}` reads a value that JAX"
            ):
                program(value)


GRAVITY = 9.81


def test_states_between_of_a_system_that_has_changed(monkeypatch):
    def fall(t, q, u, p):
        return q[1], -GRAVITY

    stone = hj.HybridSystem.from_functions(("y", "v"), fall)
    found = hj.flow(stone, DROP, 1.0)
    sampled = found.at([1.0])[1][0]
    assert_allclose(sampled, found.state)
    monkeypatch.setitem(globals(), "GRAVITY", 1.62)
    with pytest.raises(DefinitionError, match="has changed since this flow was comp"):
        found.at([1.0])
    end = hj.flow(stone, DROP, 1.0).state
    assert_allclose(end, (1 - 0.81, -1.62))


class Pair(hj.HybridSystem):
    """Two balls, of which each may push the other as it bounces."""

    inputs = ()
    push: hj.Parameter = hj.parameter(0.0)

    def charts(self):
        class Air(hj.Chart):
            states = ("y", "v", "z", "w")

            def field(self, t, q, u):
                return q[1], -1.0, q[3], -1.0

        return {"air": Air()}

    def transitions(self):
        def left(t, q, u):
            push = self.push * q[1]
            second = q[3] + push
            left_rate = -0.5 * q[1]
            return q[0], left_rate, q[2], second

        def right(t, q, u):
            push = self.push * q[3]
            first = q[1] + push
            right_rate = -0.5 * q[3]
            return q[0], first, q[2], right_rate

        return [
            hj.Transition("left", "air", "air", lambda t, q, u: q[0], reset=left),
            hj.Transition("right", "air", "air", lambda t, q, u: q[2], reset=right),
        ]


def test_events_that_coincide():
    """They have a derivative if their orders lead to the same, and are refused otherwise."""
    together = hj.Guess("air", (1.0, 0.0, 1.0, 0.0))
    found = hj.flow(Pair(), together, 2.0)
    left = found.state[:2]
    assert_allclose(left, found.state[2:], rtol=1e-12)
    with pytest.raises(ComputationError, match="coincide.* depend on the order"):
        hj.flow(Pair(push=0.3), together, 2.0)
    # (Programs do not compare the orders.)
    program = jax.jit(lambda x: hj.flow(Pair(), hj.Guess("air", x), 2.0))
    assert program(together.state).result == Result.SIMULTANEOUS
    late = program(together.state).at([1.9])[1]
    assert np.isnan(late).all()
    assert np.isfinite(found.at([1.9])[1]).all()
    apart = program(jnp.array([1.0, 0.0, 1.1, 0.0]))
    assert apart.result == Result.OK


def counters(n):
    """n counters, all of which add the clock's time at the same time."""

    def count(k):
        return (
            f"count {k}",
            lambda t, q, u, p: p.at - q[-1],
            lambda t, q, u, p: q.at[k].add(q[-1]),
        )

    return hj.HybridSystem.from_functions(
        (*(f"x{k}" for k in range(n)), "clock"),
        lambda t, q, u, p: jnp.zeros(n + 1).at[-1].set(1.0),
        [count(k) for k in range(n)],
        {"at": 0.5},
    )


@pytest.mark.parametrize("n", [3, pytest.param(5, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_each_of_several_events_that_coincide_happens_once(n):
    """None is due again after the others, also where a flow ends right after them."""
    start = hj.Guess("main", jnp.zeros(n + 1))
    once_each = [*range(n), -1]
    at_a_time = dict(until=1.0)
    at_the_last = dict(events=n, within=1.0)
    for end in (at_a_time, at_the_last):
        found = hj.flow(counters(n), start, **end)
        indices = found.event_index[: n + 1].tolist()
        assert indices == once_each
        assert_allclose(found.state[:n], 0.5, rtol=1e-12)

    @jax.jit
    def program(state):
        return hj.flow(counters(n), hj.Guess("main", state), 1.0)

    found = program(start.state)
    indices = found.event_index[: n + 1].tolist()
    assert indices == once_each
    assert found.result == Result.SIMULTANEOUS


@pytest.mark.slow
def test_many_events_that_coincide_are_not_called_zeno():
    """Their orders are too many to compare."""
    start = hj.Guess("main", jnp.zeros(14))
    with pytest.raises(ComputationError, match="coincide.* depend on the order"):
        hj.flow(counters(13), start, 1.0)


def test_events_at_the_start_and_at_the_end():
    """Findings say that rounding decides whether they happen, and that they do not."""
    for end in (FIRST, FIRST * (1 - 1e-15), FIRST * (1 + 1e-15)):
        ends = hj.flow(ball(), DROP, end)
        assert [x.cause for x in ends.findings] == ["ends at an event"]
    shortly_before = hj.flow(ball(), DROP, FIRST * 0.999)
    assert shortly_before.findings == ()
    start = hj.Guess("main", (0.0, -1.0))
    rolls = hj.flow(ball(), start, 1.0)
    assert [x.cause for x in rolls.findings] == ["on a guard"]
    up = hj.Guess("main", (0.0, 1.0))
    thrown = hj.flow(ball(), up, 0.1)
    assert thrown.findings == ()
    # A throw that lasts a small part of the whole time is no rest.
    thrown_again = [("floor", lambda t, q: q[0], lambda t, q: (q[0], 1.0))]
    fountain = hj.HybridSystem.from_functions(
        ("y", "v"), lambda t, q: (q[1], -9.81), thrown_again
    )
    low = hj.flow(fountain, (0.0, 1e-7), 1.0)
    assert low.findings == ()
    assert low.count == 5
    rests = hj.Guess("main", (0.0, 0.0))
    for unit in (1.0, 1e-9):
        falls = hj.flow(ball(g=9.81 * unit), rests, 0.1)
        assert [x.cause for x in falls.findings] == ["on a guard"]
        assert "needs a chart of its own" in falls.findings[0].text
    rises = hj.flow(ball(g=-9.81), rests, 0.1)
    assert rises.findings == ()


@pytest.mark.parametrize("power", [3, 4, 5])
def test_a_start_at_rest_that_falls_with_a_power_of_time(power):
    """Through a chain of integrators, of which the first is the guard."""

    def rates(t, q, u, p):
        return (*q[1:], p.push)

    events = [("floor", lambda t, q: q[0], lambda t, q: q)]
    names = tuple(f"x{k}" for k in range(power))
    for push, causes in ((-1.0, ["on a guard"]), (1.0, [])):
        system = hj.HybridSystem.from_functions(names, rates, events, {"push": push})
        moved = hj.flow(system, np.zeros(power), 1.0, throw=False)
        assert [x.cause for x in moved.findings] == causes


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: hj.flow(ball(), DROP), "one end: `until`"),
        (lambda: hj.flow(ball(), DROP, 1.0, events=2), "one end: `until`"),
        (lambda: hj.flow(ball(), DROP, "bounce"), "longest duration .* `within=10.0`"),
        (lambda: hj.flow(ball(), DROP, 1.0, within=2.0), "`within` is for ends that"),
        (
            lambda: hj.flow(ball(), DROP, -1.0),
            "ends at t = -1, before its start at t = 0",
        ),
        (lambda: hj.flow(ball(), DROP, "bonce", within=1.0), "no event 'bonce'"),
        (lambda: hj.flow(ball(), DROP, "1.0"), "no event '1.0'"),
        (lambda: hj.flow(ball(), hj.Guess("air", (1.0,)), 1.0), "no chart 'air'"),
        (
            lambda: hj.flow(ball(), hj.Guess("main", (1.0,)), 1.0),
            "2 states y, v of chart",
        ),
        (
            lambda: hj.flow(ball(), hj.Guess("main", jnp.ones((3, 1))), 1.0),
            r"2 states y, v of chart .* shape \(3, 1\)",
        ),
        (
            lambda: hj.flow(ball(), hj.Guess("main", jnp.ones((0, 2))), 1.0),
            "`start` has no states",
        ),
        (lambda: hj.flow(ball(), "main", 1.0), "`start` must be a Guess, a Flow"),
    ],
)
def test_bad_arguments(call, message):
    with pytest.raises(DefinitionError, match=message):
        call()


def test_a_longest_duration_that_is_far_too_long():
    """The advice helps."""
    with pytest.raises(ComputationError, match=r"duration \(1e\+09\).* shorter"):
        hj.flow(ball(), DROP, "bounce", within=1e9)
    first = hj.flow(ball(), DROP, "bounce", within=1e3)
    assert_allclose(first.t, FIRST, rtol=1e-12)


@pytest.mark.slow
def test_ends_that_are_not_reached():
    """Errors name the end, and a guard that the start lies beyond."""
    high = hj.Crossing("y", "rising", 3.0)
    with pytest.raises(ComputationError, match="section was not crossed within 1: "):
        hj.flow(ball(), DROP, high, within=1.0)
    with pytest.raises(ComputationError, match="1 of 3 events happened within 0.5"):
        hj.flow(ball(), DROP, events=3, within=0.5)
    with pytest.raises(ComputationError, match="'bounce' did not happen within 0.2"):
        hj.flow(ball(), DROP, "bounce", within=0.2)
    states = jnp.array([(0.1, 0.0), (1.0, 0.0)])
    starts = hj.Guess("main", states)
    with pytest.raises(ComputationError, match="start 1: the event 'bounce' did not"):
        hj.flow(ball(), starts, "bounce", within=0.2)
    below = hj.Guess("main", (-0.1, 0.0))
    with pytest.raises(ComputationError, match="beyond the guard of 'bounce'"):
        hj.flow(ball(), below, "bounce", within=1.0)


@pytest.mark.parametrize(
    "end, time",
    [
        ({"until": "bounce"}, FIRST),
        ({"events": 2}, SECOND),
        ({"until": hj.Crossing("v", "falling", -3.0)}, 3.0 / 9.81),
    ],
)
@pytest.mark.slow
def test_no_end_later_than_within(end, time):
    """The last step may go on beyond `within`."""

    early = 0.999 * time
    found = hj.flow(ball(), DROP, **end, within=early, throw=False)
    assert found.result == Result.SECTION_MISSED
    assert np.isnan(found.t)
    ended = hj.flow(ball(), DROP, **end, within=time)
    assert_allclose(ended.t, time, rtol=1e-12)
    starts = hj.Guess("main", jnp.array([DROP.state]))
    for within, code in ((early, Result.SECTION_MISSED), (time, Result.OK)):
        program = hj.flow(ball(), starts, **end, within=within, throw=False)
        assert program.result == code


def test_a_flow_that_failed_does_not_end_at_an_event():
    rests = hj.flow(ball(), DROP, 5.0, throw=False)
    assert rests.result == Result.ZENO
    assert rests.findings == ()


def _of_constants(height):
    """A function of `height` that computes other things from constants alone."""
    reference = hj.flow(ball(), DROP, 0.6)
    start = hj.Guess("main", (height, 0.0))
    return jnp.sum((hj.flow(ball(), start, 0.6).state - reference.state) ** 2)


def _at_times(t):
    """The height of a ball whose flow is a constant, at a time that is not."""
    _, states = hj.flow(ball(), DROP, 0.6).at(t[None])
    return states[0, 0]


@pytest.mark.parametrize("function", [_of_constants, _at_times])
@pytest.mark.slow
def test_what_is_constant_in_a_program_has_values(function):
    """What no traced number enters is computed while a program is traced, as it is outside."""
    value, slope = jax.value_and_grad(function)(0.55)
    programs = jax.jit(jax.value_and_grad(function))
    assert_allclose(programs(0.55), (value, slope), rtol=1e-11)
    both = jax.lax.map(function, jnp.array([0.55, 0.55]))
    assert_allclose(both, value, rtol=1e-11)


class Sampled(hj.HybridSystem):
    """A clock's time since its last tick."""

    inputs = ()

    def charts(self):
        return {"on": Rising()}

    def transitions(self):
        def restart(t, q, u):
            return 0.0 * q

        every = hj.systems.Scheduled(1.0, offset=0.25)
        return [hj.Transition("sample", "on", "on", guard=every, reset=restart)]


class Rising(hj.Chart):
    states = ("x",)

    def field(self, t, q, u):
        return (1.0 + 0.0 * q[0],)


def test_a_start_at_the_time_of_a_scheduled_event_lies_after_its_reset():
    at_time = hj.flow(Sampled(), hj.Guess("on", (0.0,), 1.25), 2.5)
    assert at_time.findings == ()
    assert_allclose(at_time.event_times[0], 2.25)
    assert at_time.count == 1
    later = hj.flow(Sampled(), hj.Guess("on", (0.0,), 1.5), "sample", within=2.0)
    goes_on = hj.flow(Sampled(), later, 2.5)
    assert goes_on.count == 0


def test_the_limit_on_steps_is_the_one_that_is_given():
    fall = ball()
    with pytest.raises(ComputationError, match="3 steps did not suffice.*`max_steps`"):
        hj.flow(fall, DROP, 1.0, max_steps=3)
    large = hj.orbits.Settings(max_steps=5000)
    assert hj.flow(fall, DROP, 1.0, settings=large).request.settings.max_steps == 5000


class Air(hj.Chart):
    states = ("x", "v")

    def field(self, t, q, u):
        return q[1], u[0]


class Cart(hj.HybridSystem):
    inputs = ("force",)

    def charts(self):
        return {"air": Air()}

    def transitions(self):
        return []


def test_a_driven_system_prints_the_name_of_its_class():
    start = hj.Guess("air", (0.0, 0.0))
    moved = hj.flow(Cart(), start, 1.0, input=jnp.sin)
    assert repr(moved).startswith("Flow(Cart: ")
    assert repr(moved.trajectory).startswith("Trajectory(Cart: ")
