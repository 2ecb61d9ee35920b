"""Single trajectories, against formulas."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import solve_ivp

import hybridjax as hj

from ..toys import Field, Toys, toy


G = 9.81
FALL = np.sqrt(2 / G)  # time to fall from height 1


def ball(restitution, duration=60.0, **options):
    system = hj.models.BouncingBall(restitution=restitution)
    return hj.simulate(system, "fall", (1.0, 0.0), duration, **options)


def times(trajectory, name=None):
    named = [e.time for e in trajectory.events if name in (None, e.name)]
    return np.array(named)


def ceiling(height):
    """A ball thrown up under gravity 1 against a ceiling."""

    def hit(t, q, u):
        return q[0] - height

    def back(t, q, u):
        return (q[0], -q[1])

    def air_rates(t, q, u):
        return (q[1], -1.0)

    charts = {"air": Field(("y", "v"), air_rates)}
    return charts, (hj.Transition("hit", "air", "air", hit, "rising", back),)


def turning(low, high):
    """A point on the unit circle that turns at rate 1, and counts in the state `n` where it passes:
    where x falls through `low` and `high`, and once where y falls through zero."""

    def turn_rates(t, q, u):
        return -q[1], q[0], 0.0

    def count(t, q, u):
        return q[0], q[1], q[2] + 1

    def above_low(t, q, u):
        return q[0] - low

    def above_high(t, q, u):
        return q[0] - high

    def height(t, q, u):
        return q[1]

    def is_first(t, q, u):
        return q[2] < 1.0

    return {"turn": Field(("x", "y", "n"), turn_rates)}, [
        hj.Transition("low", "turn", "turn", above_low, reset=count),
        hj.Transition("high", "turn", "turn", above_high, reset=count),
        hj.Transition("gated", "turn", "turn", height, reset=count, enabled=is_first),
    ]


def close(gap, k):
    """A point on the unit circle and two guards on x that fall a `gap` apart. The second one is so
    far from a cubic that its crossing is first estimated wrongly."""

    def plain(t, q, u):
        return q[0] - 0.5

    def curved(t, q, u):
        above = q[0] - 0.5 - gap
        return jnp.exp(k * above) - 1

    transitions = (
        hj.Transition("plain", "turn", "turn", plain),
        hj.Transition("curved", "turn", "turn", curved),
    )

    def turn_rates(t, q, u):
        return (-q[1], q[0])

    return {"turn": Field(("x", "y"), turn_rates)}, transitions


def dip(depth):
    """y = (t - 1)^2 - depth as a state: below zero for 2 sqrt(depth), then back."""

    def mark(t, q, u):
        return (q[0], q[1] + 1.0)

    def dip_rates(t, q, u):
        return (2 * (t - 1.0), 0.0)

    charts = {"dip": Field(("y", "n"), dip_rates)}

    def dip_guard(t, q, u):
        return q[0] - 0.0

    return charts, [hj.Transition("dip", "dip", "dip", dip_guard, reset=mark)]


# infinite at t = 1 / x(0)
def x_rates(t, q, u):
    return q**2


BLOWUP = toy({"x": Field(("x",), x_rates)})


def test_a_hundred_bounces():
    bounces = ball(1.0, 200 * FALL)
    expected = FALL * np.arange(1, 200, 2)
    assert_allclose(times(bounces), expected, rtol=1e-11)
    first = bounces.events[0]
    assert first.name == "bounce"
    assert first.source == "fall"
    assert first.target == "fall"
    speeds = [-first.before["v"], first.after["v"]]
    assert_allclose(speeds, np.sqrt(2 * G), rtol=1e-13)


@pytest.mark.parametrize("e", [0.1, 0.9])
def test_zeno_is_seen_before_its_limit(e):
    found = ball(e, throw=False)
    limit = FALL * (1 + e) / (1 - e)
    assert found.result == hj.errors.Result.ZENO
    shortest = limit * (1 - 1e-3)
    assert shortest < found.t[-1] < limit
    powers = e ** np.arange(len(found.events))
    bounces = 2 * e * (1 - powers) / (1 - e)
    expected = FALL * (1 + bounces)
    assert_allclose(times(found), expected, rtol=1e-10)
    with pytest.raises(
        hj.errors.ComputationError, match=r"in chart 'fall': events accumulate .*Zeno"
    ):
        ball(e)


@pytest.mark.parametrize("gap", [1e-12, -1e-12, 1e-9, -1e-9])
def test_grazing(gap):
    """A ball that would rise to 1 + 1e-16, under a ceiling at 1 + gap."""
    system = Toys(ceiling, [1 + gap])
    start = (0.0, np.sqrt(2.0))
    found = hj.simulate(system, "air", start, 2.0, throw=False)
    left = np.sqrt(max(-2 * gap, 0.0))
    hit = np.sqrt(2.0) - left
    if abs(gap) < 1e-10:
        assert found.result == hj.errors.Result.GRAZING
        errors = np.abs(times(found) - hit)
        assert np.all(errors < 1e-6)
    else:
        assert found.result == hj.errors.Result.OK
        expected = [hit] if gap < 0 else []
        assert_allclose(times(found), expected, atol=1e-10)


@settings(max_examples=10)
@given(exponent=st.floats(-9.0, -1.0))
def test_a_guard_that_dips_within_a_step_fires(exponent):
    depth = 10**exponent
    system = Toys(dip, [depth])
    found = hj.simulate(system, "dip", (1.0 - depth, 0.0), 3.0)
    touches = [1 - np.sqrt(depth)]
    assert_allclose(times(found), touches, atol=1e-11)
    dips = Toys(dip, [-depth])
    above = hj.simulate(dips, "dip", (1.0 + depth, 0.0), 3.0)
    assert not above.events
    assert above.result == hj.errors.Result.OK


def test_blow_up():
    found = hj.simulate(BLOWUP, "x", (1.0,), 2.0, throw=False)
    assert found.result == hj.errors.Result.BLOW_UP
    error = abs(found.t[-1] - 1.0)
    assert error < 1e-6
    with pytest.raises(hj.errors.ComputationError, match="the state left all bounds"):
        hj.simulate(BLOWUP, "x", (1.0,), 2.0)
    decay = hj.simulate(BLOWUP, "x", (-1.0,), 2.0)
    expected = [-1 / 3]
    assert_allclose(decay.after[-1], expected, rtol=1e-10)


@pytest.mark.parametrize(
    "low, high, first",
    [(0.4999999, 0.5, "high"), (0.5, 0.4999999, "low"), (0.5, 0.5, "low")],
)
def test_events_come_in_order_of_time_and_ties_in_order_of_listing(low, high, first):
    system = Toys(turning, [low, high])
    start = (0.0, -1.0, 0.0)
    turn = 2 * np.pi
    found = hj.simulate(system, "turn", start, turn)
    names = [e.name for e in found.events if e.name != "gated"]
    assert names[0] == first
    assert sorted(names) == ["high", "low"]
    for name, level in (("low", low), ("high", high)):
        expected = np.pi / 2 + np.arccos(level)
        assert_allclose(times(found, name), [expected], atol=1e-12)
    number = len(found.events)
    assert found.after[-1, 2] == number


@settings(max_examples=10)
@example(
    gap=2e-12, sign=1, k=1.0
)  # the later one is found first, then the other is behind
@given(
    gap=st.floats(-12.0, -2.0).map(lambda x: 10**x),
    sign=st.sampled_from([-1, 1]),
    k=st.sampled_from([1.0, 5.0, 20.0]),
)
def test_close_crossings_of_different_shape(gap, sign, k):
    distance = sign * gap
    system = Toys(close, [distance, k])
    start = (0.0, -1.0)
    turn = 2 * np.pi
    found = hj.simulate(system, "turn", start, turn)
    quarter = np.pi / 2
    plain = quarter + np.arccos(0.5)
    curved = quarter + np.arccos(0.5 + distance)
    assert_allclose(times(found, "plain"), [plain], atol=1e-11)
    assert_allclose(times(found, "curved"), [curved], atol=1e-11)
    if gap <= 1e-11:  # they are at the same instant, up to rounding
        return
    names = [event.name for event in found.events]
    if plain < curved:
        in_order = ["plain", "curved"]
    else:
        in_order = ["curved", "plain"]
    assert names == in_order


def tick_reset(t, q, u):
    return q + 1


COUNT = hj.Transition("tick", "a", "a", hj.systems.Scheduled(0.1), reset=tick_reset)


def a_rates(t, q, u):
    return (0.0,)


TICK = toy({"a": Field(("n",), a_rates)}, [COUNT])


@settings(max_examples=5)
@given(k=st.integers(1, 40), pieces=st.integers(2, 7))
def test_a_tick_at_the_end_of_a_piece_happens_once(k, pieces):
    """Times such as 0.3 and 3 * 0.1 differ by rounding; the tick between is counted once."""
    chart = "a"
    state = (0.0,)
    time = 0.0
    ends = np.linspace(0.0, k * 0.1, pieces + 1)
    for end in ends[1:]:
        run = hj.simulate(TICK, chart, state, end - time, time=time)
        state = run.after[-1]
        time = float(run.t[-1])
    assert state[0] == k


def test_an_input_that_varies_in_time():
    system = hj.models.BouncingBall()
    found = hj.simulate(
        system, "fall", (5.0, 0.0), 1.0, input=lambda t: jnp.sin(3 * t) + G
    )
    t, y = found("y")
    expected_end = 5 + 1 / 3 - np.sin(3.0) / 9
    assert_allclose(y[-1], expected_end, rtol=1e-10)
    # between steps too
    wave = np.sin(3 * t) / 9
    expected = 5 + t / 3 - wave
    assert_allclose(y, expected, atol=2e-5)
    constant = hj.simulate(system, "fall", (5.0, 0.0), 1.0, input=G)
    assert_allclose(constant.after[-1], [5.0, 0.0], atol=1e-14)


def test_feet_that_land_together():
    """The bar dropped flat: both feet touch the table at the same instant, and both land."""
    system = hj.models.TwoLeggedBar(A=0.0)
    found = hj.simulate(system, "air", (1.5, 0.0, 0.0, 0.0), 0.4)
    assert [e.name for e in found.events] == ["hind lands (air)", "front lands (hind)"]
    fall = np.sqrt(2 * 0.5 / 10.0)
    assert_allclose(times(found), [fall, fall], rtol=1e-14)
    speed = -10.0 * fall
    rotation = 0.0
    J = 0.2
    for s in (-0.5, 0.55):  # two impulses, one after the other
        mass = 1 + s**2 / J
        impulse = -0.2 * (speed + s * rotation) / mass
        speed = speed + impulse
        rotation = rotation + s * impulse / J
    after = found.events[-1].after
    found_rates = [after["v"], after["p"]]
    assert_allclose(found_rates, [speed, rotation], rtol=1e-12)


def test_samples_between_steps(reference, hopper_cycle):
    """Both sides of an event appear; values are NaN where a chart does not define an output."""
    data = reference("limit_cycle")
    orbit = hopper_cycle.trajectory()
    t, chart, q = orbit.dense(per_step=4)
    assert np.all(np.diff(t) >= 0)
    for event in orbit.events:
        assert np.sum(t == event.time) == 2
    clock = np.round(t % 1, 12)
    times = data["orbit_clock"]
    states = data["orbit_q"][:, 0]
    expected = np.interp(clock, times, states, period=1.0)
    assert_allclose(q[:, 0], expected, atol=2e-5)
    t2, yM, ym = orbit("yM", "ym", per_step=4)
    assert_array_equal(t2, t)
    assert_allclose(yM, q[:, 0], rtol=1e-15)
    assert_array_equal(ym[chart == 1], 0.0)


def line_rates(t, q, u):
    return (1.0,)


LINE = {"line": Field(("x",), line_rates)}


def test_every_turn_of_a_fast_guard_is_seen():
    """Many, while the state hardly changes."""

    def guard(t, q, u):
        return jnp.sin(61.0 * q[0])

    fall = hj.Transition("fall", "line", "line", guard)
    fast = toy(LINE, [fall])
    run = hj.simulate(fast, "line", (0.1,), 3.0)
    odd = 2 * np.arange(1000) + 1
    falls = odd * np.pi / 61.0 - 0.1
    expected = falls[(falls > 0) & (falls < 3.0)]
    assert_allclose(times(run), expected, atol=1e-12)


def test_an_event_at_a_tick():
    """Where x falls to zero, and starts again from 1: both happen once; n and m count them."""
    again = jnp.array([1.0, 0.0, 1.0])
    count = jnp.array([0.0, 1.0, 0.0])

    def fall_guard(t, q, u):
        return q[0]

    def fall_reset(t, q, u):
        return q + again

    fall = hj.Transition("fall", "a", "a", fall_guard, reset=fall_reset)

    def tick_reset(t, q, u):
        return q + count

    tick = hj.Transition("tick", "a", "a", hj.systems.Scheduled(1.0), reset=tick_reset)

    def rates(t, q, u):
        return (-1.0, 0.0, 0.0)

    charts = {"a": Field(("x", "n", "m"), rates)}
    system = toy(charts, (fall, tick))
    run = hj.simulate(system, "a", (1.0, 0.0, 0.0), 3.5)
    end = [0.5, 3.0, 3.0]
    assert_allclose(run.after[-1], end, atol=1e-12)
    expected_times = [1.0, 1.0, 2.0, 2.0, 3.0, 3.0]
    assert_allclose(times(run), expected_times, atol=1e-12)


@pytest.mark.parametrize("duration", [80.0, 200.0])
def test_a_first_step_that_is_far_too_long_is_rejected(duration):
    """A tenth of the time makes 1e34 of 1, and even more of rounding errors."""

    def duffing(t, q, cos):
        cubic = q[0] ** 3
        spring = -0.3 * q[1] - q[0] - cubic
        push = 0.3 * cos(1.2 * t)
        return q[1], spring + push

    def rates(t, q, u):
        return duffing(t, q, jnp.cos)

    def scipy_rates(t, q):
        return duffing(t, q, np.cos)

    system = toy({"all": Field(("x", "v"), rates)})
    found = hj.simulate(system, "all", (1.0, 0.0), duration)
    path = solve_ivp(
        scipy_rates, (0, duration), [1.0, 0.0], method="DOP853", rtol=1e-12, atol=1e-13
    )
    expected = path.y[:, -1]
    assert_allclose(found.after[-1], expected, rtol=0, atol=1e-9)
