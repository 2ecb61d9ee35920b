"""Flow of many lanes (trajectories side by side) to their targets, with the events on the way and
states at given times, differentiable.

`pass_through` is the function that `orbits/flow_program.py` compiles. As in `move.py`, values are
those of a search, and derivatives are those of a replay of the tape (the record of the search's
steps); `_passed_jvp` joins the two. Here, `_events` and `_samples` also read
events and states at given times from the tape. If an event or a sample is wrong and the end of the
flow is right, look in these two; if an end is wrong, in the search or in `replay.py`. The order of
the numbers that `repeat` returns must stay that of `_with_values`, which puts them in their places.
"""

import functools as ft
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from .._core.lanes import lane_jvp
from ..systems.structure import Structure
from .arrays import Array, Index, Inputs, Times
from .events import INSTANT
from .lanes import (
    ARRIVE_TIME,
    IDLE,
    Lanes,
    Tape,
    blank_tape,
    fixed,
    nan_where,
    pace_of,
)
from .move import searched, stride
from .replay import Ways, replay, replayed_ways
from .search.search import initial_step
from .search.state import Moved, Options
from .settings import ROUNDING, Settings
from .target import Target, until


class Events(NamedTuple):
    """The first E events of L lanes. An event that has not happened has the transition -1 and times
    and states of NaN."""

    transition: Int[Array, "E L"]
    t: Float[Array, "E L"]
    before: Float[Array, "E d L"]
    """The state before the reset."""
    after: Float[Array, "E d L"]
    at_once: Bool[Array, "E L"]
    rival: Int[Array, "E L"]
    """Another event at the same time: see `Tape`. `at_once`, too, is as on the `Tape`."""

    @property
    def smooth(self) -> tuple:
        """The fields that have derivatives: times, and states before and after the events."""
        return self.t, self.before, self.after


class Samples(NamedTuple):
    """Charts and states of L lanes at K given times of each lane; NaN before the start and after
    the end of the flow."""

    chart: Int[Array, "K L"]
    q: Float[Array, "K d L"]


class Passage(NamedTuple):
    """Lanes at their targets, the events on the way, and states at given times on the way."""

    moved: Moved
    events: Events
    samples: Samples


def pass_through(
    s: Structure,
    lanes: Lanes,
    u: Inputs,
    target: Target,
    settings: Settings,
    most_events: int,
    new_input: bool,
    times: Float[Array, "K L"],
    result: Index,
) -> Passage:
    """Flow every lane to its target under a constant input, as `move` does. Lanes whose `result` is
    not OK stay where they are.

    Times and states of the end, of the events and at the `times` have exact derivatives of first
    and second order with respect to all floating-point arrays: states, times, inputs, parameters,
    the target.
    """
    options = Options(tape=True, new_input=new_input)
    passage = _passed(
        s, lanes, u, target, times, settings, options, most_events, result
    )
    within = _is_within(times, lanes, passage.moved.lanes.t)
    q = nan_where(~within[:, None], passage.samples.q)
    return passage._replace(samples=passage.samples._replace(q=q))


@eqx.filter_custom_jvp
def _passed(
    s, lanes, u, target, times, settings, options, most_events, result
) -> Passage:
    """The values of `pass_through`: those of a search."""
    moved, tape = _recorded(s, lanes, u, target, settings, options, result)
    ways = Ways(tape.t, tape.before, tape.after)
    samples = _samples(s, lanes, u, tape, ways, times)
    return Passage(moved, _events(tape, ways, most_events), samples)


@_passed.def_jvp
def _passed_jvp(primals, tangents):
    """The same with derivatives: the search carries none, and its tape is replayed with them."""
    s, lanes, u, target, times, settings, options, most_events, result = primals
    still_s, still_lanes, still_u, still_target = fixed((s, lanes, u, target))
    with_tangents = options._replace(tangents=True)
    moved, tape = _recorded(
        still_s, still_lanes, still_u, still_target, settings, with_tangents, result
    )
    target, levels = target.split()

    def repeat(by_lane, common):
        t, q, u, time, times = by_lane
        s, levels = common
        begin = eqx.tree_at(lambda x: (x.t, x.q), lanes, (t, q))
        end = eqx.tree_at(lambda x: x.time, target, time).with_levels(levels)
        ways = replayed_ways(s, begin, u, end, tape)
        events = _events(tape, ways, most_events)
        samples = _samples(s, begin, u, tape, ways, times)
        return ways.t[-1], ways.after[-1], *events.smooth, samples.q

    t_s, t_lanes, t_u, t_target, t_times, *_ = tangents
    point = lanes.t, lanes.q, u, target.time, times
    t_point = t_lanes.t, t_lanes.q, t_u, t_target.time, t_times
    common = (s, levels), (t_s, t_target.levels)
    ends, t_ends = lane_jvp(repeat, (point, t_point), common)

    ways = Ways(tape.t, tape.before, tape.after)
    chart = jnp.zeros(times.shape, jnp.int32)
    if len(times):
        chart = _before(lanes, tape, ways, times).chart.reshape(times.shape)
    samples = Samples(chart, ends[-1])
    events = _events(tape, ways, most_events)
    out = _with_values(Passage(moved, events, samples), ends)
    none = jax.tree_util.tree_map(lambda _: None, out)
    return out, _with_values(none, t_ends)


def _with_values(passage: Passage, values: Any) -> Passage:
    """Replace the differentiable fields of a passage by `values` (or by tangents): times and states
    of the ends, `Events.smooth`, and the states of the samples."""

    def places(passage):
        lanes = passage.moved.lanes
        return lanes.t, lanes.q, *passage.events.smooth, passage.samples.q

    return eqx.tree_at(places, passage, values, is_leaf=lambda x: x is None)


def _samples(
    s: Structure,
    lanes: Lanes,
    u: Inputs,
    tape: Tape,
    ways: Ways,
    times: Float[Array, "K L"],
) -> Samples:
    """The states at `times`, each by one step from the end of the last move before it. States at
    times outside of the flow have no meaning."""
    K, L = times.shape
    if not K:
        no_charts = jnp.zeros((0, L), jnp.int32)
        no_states = jnp.zeros((0, s.d, L))
        return Samples(no_charts, no_states)
    ends = jnp.where(tape.code != IDLE, tape.t, lanes.t)
    last = jnp.max(ends, axis=0)
    within = _is_within(times, lanes, last).ravel()
    begin = _before(lanes, tape, ways, times)
    # (No step is taken to times outside, where a state may leave all bounds.)
    every = jnp.where(within, times.ravel(), begin.t)
    row = blank_tape(1, begin)
    code = jnp.full((1, K * L), ARRIVE_TIME, jnp.int32)
    row = row._replace(code=code)
    inputs = u
    if u.shape[-1] > 1:
        inputs = jnp.tile(u, (1, K))
    _, q = replay(s, begin, inputs, until(every), row)
    by_time = q.reshape(-1, K, L)
    q = jnp.moveaxis(by_time, 1, 0)
    return Samples(begin.chart.reshape(K, L), q)


def _is_within(
    times: Float[Array, "K L"], lanes: Lanes, end: Times
) -> Bool[Array, "K L"]:
    """Test whether times lie between the start and the end of the flow, up to rounding: a time that
    another program has computed may differ by rounding."""
    times, start, end = jax.lax.stop_gradient((times, lanes.t, end))
    duration = end - start
    late = INSTANT * duration + ROUNDING * jnp.abs(end)
    return (times >= start) & (times <= end + late)


def _before(lanes: Lanes, tape: Tape, ways: Ways, times: Float[Array, "K L"]) -> Lanes:
    """For each of the K times of a lane, the state at the beginning of the move in which the time
    lies. The K states of a lane follow each other."""
    rows = jnp.arange(len(tape.code))[:, None]
    is_move = tape.code != IDLE
    # (The last move that ends before each time; -1 for none.)
    fixed_times = jax.lax.stop_gradient(times)[:, None]
    ended = is_move & (tape.t <= fixed_times)
    row = jnp.max(jnp.where(ended, rows, -1), axis=1)
    first = row < 0
    place = jnp.maximum(row, 0)

    def chosen(start, ends):
        last_end = jnp.take_along_axis(ends, place, axis=0)
        return jnp.where(first, start, last_end).ravel()

    states = jnp.take_along_axis(ways.after, place[:, None], axis=0)
    q = jnp.where(first[:, None], lanes.q, states)
    K, d, L = q.shape
    t = chosen(lanes.t, ways.t)
    chart = chosen(lanes.chart, tape.chart)
    by_state = jnp.moveaxis(q, 0, 1)
    q = by_state.reshape(d, K * L)
    armed = jnp.tile(lanes.armed, (1, K))
    no_event = chart * 0
    return Lanes(t, chart, q, armed, no_event, pace_of(no_event))


def _recorded(s, lanes, u, target, settings, options, result) -> tuple[Moved, Tape]:
    """Search from a cautious first step; return the lanes at their targets, and the tape."""
    longest = target.limit - lanes.t
    first = initial_step(s, lanes, u, longest, settings)
    setout = fixed(stride(first))
    recorded = searched(s, lanes, u, target, setout, result, settings, options)
    assert recorded.tape is not None
    return recorded.moved, recorded.tape


def _events(tape: Tape, ways: Ways, most: int) -> Events:
    """The first events on a tape, with times and states from the ends of its moves."""
    number = jnp.arange(1, most + 1, dtype=jnp.int32)
    # The row of the tape in which the number of events reaches 1, 2, and so on.
    first = ft.partial(jnp.searchsorted, v=number)
    row = jax.vmap(first, in_axes=1, out_axes=1)(tape.events)
    row = jnp.minimum(row, len(tape.events) - 1)
    found = jnp.take_along_axis(tape.events, row, axis=0)
    exists = found == number[:, None]

    def times(x):
        return jnp.take_along_axis(x, row, axis=0)

    def states(x):
        return jnp.take_along_axis(x, row[:, None], axis=0)

    return Events(
        jnp.where(exists, times(tape.code), -1),
        jnp.where(exists, times(ways.t), jnp.nan),
        jnp.where(exists[:, None], states(ways.before), jnp.nan),
        jnp.where(exists[:, None], states(ways.after), jnp.nan),
        exists & times(tape.at_once),
        jnp.where(exists, times(tape.rival), -1),
    )
