"""The events of many lanes, as a log of fixed size."""

import jax
import jax.numpy as jnp
import numpy as np

import hybridjax as hj
from hybridjax.engine.lanes import start_lanes
from hybridjax.engine.move import move
from hybridjax.engine.settings import Settings
from hybridjax.engine.target import until
from hybridjax.systems.structure import Structure


SYSTEM = hj.models.VerticalHopper()
STATES = np.array([[2.0, 1.9], [1.9, 1.5]])
DURATION = 2.5


def flow(states, size, duration=DURATION):
    """Lanes that begin on the ground, and the log of `size` events of each."""
    s, L = Structure(SYSTEM), len(states)
    q = jnp.zeros((s.d, L)).at[:2].set(states.T)
    lanes = start_lanes(s, jnp.zeros(L), jnp.full(L, 1, jnp.int32), q)
    u, end = jnp.zeros((1, L)), until(jnp.full(L, duration))
    settings = Settings(1e-12, 1e-12, scale=np.ones((len(s.charts), s.d)))
    return move(s, lanes, u, end, settings, event_log=size)


def truth(state):
    found = hj.simulate(SYSTEM, "stance", state, DURATION, settings=hj.Settings(1e-12, 1e-12))
    return [event.time for event in found.events], [event.name for event in found.events]


def assert_logged(log, lane, state):
    times, names = truth(state)
    count = int(log.count[lane])
    assert count == len(times) and names[:2] == ["liftoff", "touchdown"]
    np.testing.assert_allclose(log.time[:count, lane], times, rtol=1e-10)
    logged = [SYSTEM.transitions()[k].name for k in np.asarray(log.event)[:count, lane]]
    assert logged == names
    assert np.isnan(log.time[count:, lane]).all() and (log.event[count:, lane] == -1).all()


def test_times_and_transitions_in_order():
    moved = jax.jit(lambda states: flow(states, 8))(STATES)
    for lane, state in enumerate(STATES):
        assert_logged(moved.log, lane, state)


def test_under_vmap_and_forward_mode():
    """Each mapped flow has its own log; derivatives of the states do not disturb it."""
    one = lambda state: flow(state[None], 8)  # noqa: E731
    push = lambda state: jax.jvp(  # noqa: E731
        lambda state: (lambda m: (m.lanes.q, m.log))(one(state)), (state,), (jnp.ones(2),)
    )
    (_, log), (tangent, _) = jax.jit(jax.vmap(push))(STATES)
    assert np.isfinite(tangent).all() and np.any(tangent)
    for k, state in enumerate(STATES):
        assert_logged(jax.tree_util.tree_map(lambda x, k=k: x[k], log), 0, state)


def test_a_log_that_is_too_short_keeps_the_first_events():
    log, full = (jax.jit(lambda states, K=K: flow(states, K).log)(STATES) for K in (2, 8))
    np.testing.assert_array_equal(log.count, full.count)
    np.testing.assert_array_equal(log.time, full.time[:2])
    np.testing.assert_array_equal(log.event, full.event[:2])


def test_lanes_that_fail():
    """A ball that comes to rest in finite time, and one that is not a number, beside a good one."""
    system = hj.models.BouncingBall(restitution=0.5)
    s = Structure(system)
    q = jnp.array([[1.0, jnp.nan, 100.0], [0.0, 0.0, 0.0]])
    lanes = start_lanes(s, jnp.zeros(3), jnp.zeros(3, jnp.int32), q)
    moved = jax.jit(
        lambda lanes: move(
            s,
            lanes,
            jnp.zeros((1, 3)),
            until(jnp.full(3, 5.0)),
            Settings(1e-10, 1e-10),
            event_log=4,
        )
    )(lanes)
    assert moved.result.tolist() == [hj.Result.ZENO, hj.Result.BAD_INPUT, hj.Result.OK]
    fall = np.sqrt(2 / 9.81)
    np.testing.assert_allclose(moved.log.time[:, 0], fall * (3 - 2 * 0.5 ** np.arange(4)))
    assert moved.log.count[0] > 4 and moved.log.count[1] == 0 and moved.log.count[2] == 1
    np.testing.assert_array_equal(moved.log.count, moved.lanes.events)


def test_no_log_unless_it_is_asked_for():
    assert flow(STATES, 0, 0.1).log is None
