"""Times of events: from logs between sections to lists, and what is said of them."""

import numpy as np
import pytest

import hybridjax as hj
from hybridjax.experiments.data import Simulated
from hybridjax.experiments.events import EventTimes, in_order
from hybridjax.experiments.flow_batch import IntervalEvents


N, PERIOD = 2, 10.0
CYCLE = np.array([1.0, 7.0])


@pytest.fixture
def events():
    """Two events a cycle of two sections, in the first and the second interval; the second
    experiment ends in its second cycle, and has an event after the section in its first."""
    time = np.array(
        [
            [[1.1, 0.0], [7.2, 0.0], [1.3, 0.0], [7.4, 0.0]],
            [[0.0, 0.0], [5.0, 7.5], [1.0, 0.0], [0.0, 0.0]],
        ]
    )
    count = np.array([[1, 1, 1, 1], [0, 2, 1, 0]])
    event = np.where(time < 6, 0, 1)
    listed = in_order(IntervalEvents(time, event, count), N, PERIOD)
    return EventTimes(
        *listed, CYCLE, np.array([0, 1]), np.array(PERIOD), n_sections=N, names=("up", "down")
    )


def test_events_are_in_order_without_gaps(events):
    np.testing.assert_array_equal(events.count, [4, 3])
    np.testing.assert_allclose(events.time, [[1.1, 7.2, 11.3, 17.4], [5.0, 7.5, 11.0, np.nan]])
    np.testing.assert_array_equal(events.event, [[0, 1, 0, 1], [0, 1, 0, -1]])
    np.testing.assert_array_equal(events.sample, [[0, 1, 2, 3], [1, 1, 2, -1]])


def test_deviations_are_those_from_the_cycle(events):
    np.testing.assert_allclose(
        events.deviations, [[0.1, 0.2, 0.3, 0.4], [4.0, 0.5, 0.0, np.nan]], atol=1e-12
    )


def test_the_events_of_one_experiment_are_named(events):
    *_, last = events.of(1)
    assert (last.name, last.cycle, last.section) == ("up", 1, 0)
    np.testing.assert_allclose([last.time, last.deviation], [11.0, 0.0], atol=1e-12)
    assert [e.name for e in events.of(0)] == ["up", "down"] * 2


def test_events_are_saved_with_the_data(events, tmp_path):
    y = np.zeros((2, 4, 1))
    about = Simulated(np.array([-1, 2]), None, events)
    data = hj.ExperimentData(
        y, y, n_sections=N, periods=1, result=[0, hj.Result.GRAZING], simulated=about
    )
    hj.save(tmp_path / "data.npz", data)
    back = hj.load(tmp_path / "data.npz")
    for name in ("time", "event", "sample", "cycle_time", "cycle_event", "period"):
        np.testing.assert_array_equal(getattr(back.events, name), getattr(events, name))
    assert back.events.names == events.names and np.isnan(back.error).all()
    with np.load(tmp_path / "data.npz") as file:
        assert "simulated.events.time" in file.files


def test_experiments_record_their_events(hopper_cycle, placed_isochrons, tmp_path):
    u = np.zeros((3, 3 * 32, 1))
    u[1] = 0.05 * np.random.default_rng(0).standard_normal(u[1].shape)
    u[2, 32:48] = 60.0
    arguments = hopper_cycle, placed_isochrons, u, "yM"
    data = hj.run_experiments(*arguments, discard=0, record_events=True)
    events = data.events
    assert list(data.ok) == [True, True, False]
    np.testing.assert_array_equal(events.count[:2], 6)
    np.testing.assert_allclose(
        events.cycle_time, [0.35098179 + 0.27665765, 0.51631443 + 0.27665765]
    )
    assert np.abs(events.deviations[0]).max() < 1e-11
    assert 1e-5 < np.abs(events.deviations[1]).max() < 0.1
    assert {e.name for e in events.of(1)} == {"touchdown", "liftoff"}
    options = hj.experiments.Options(discard=0, record_events=True)
    stored = hj.experiments.stream_experiments(*arguments, options, store=tmp_path, chunk=3)
    np.testing.assert_allclose(stored[0].events.time, events.time, atol=1e-11)
    assert stored[0].events.of(1)[0].name == events.of(1)[0].name
