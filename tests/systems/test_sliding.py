"""Motion along a surface at which the field jumps."""

import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import hybridjax as hj

from ..toys import Field, toy


hj.enable_x64()


@pytest.mark.slow
def test_a_block_on_a_belt_sticks_and_slips():
    """It leaves the belt where the spring is as strong as friction; slipping by DOP853."""
    F = 1.0
    belt = 0.2
    decay = 3.0

    def slip(t, q):
        behind = belt - q[1]
        friction = F / (1 + decay * behind)
        return [q[1], -q[0] + friction]

    def caught(t, q):
        return q[1] - belt

    caught.direction, caught.terminal = 1, True
    options = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-14}
    path = solve_ivp(slip, (0, 0.5), [F, belt], **options)
    begin = path.y[:, -1]
    way = solve_ivp(slip, (0.5, 20), begin, events=caught, **options)
    t = way.t_events[0][0]
    (x, _) = way.y_events[0][0]
    period = t + (F - x) / belt

    section = hj.AtEvent("behind to sticks")
    cycle = hj.find_limit_cycle(hj.models.BeltOscillator(), section=section)
    assert_allclose(cycle.period, period, rtol=1e-9)
    assert_allclose(cycle.state["x"], x, rtol=1e-9)
    assert len(cycle.multipliers) == 0
    assert cycle.is_stable
    names = [x.name for x in hj.models.BeltOscillator().transitions()]
    assert sorted(names[g] for g in cycle.event_sequence) == [
        "behind to sticks",
        "sticks to behind",
    ]


def height(t, q):
    return q[1]


def field(drift, push):
    return Field(("x", "y"), lambda t, q, u: (drift, push))


@pytest.mark.parametrize(
    "push, end, chart",
    [
        (
            3.0,
            (0.5 + (3.0 * 0.5 + 1.0 * 2.0) / 4.0, 0.0),
            2,
        ),  # (b f_a - a f_b) / (b - a)
        (-1.0, (0.5 + 2.0, -1.0), 1),  # carried on
    ],
)
def test_it_slides_or_crosses(push, end, chart):
    parts = hj.systems.filippov(
        {"up": field(0.5, -1.0), "down": field(2.0, push)}, height
    )
    system = toy(parts.charts, parts.transitions)
    way = hj.simulate(system, "up", (0.0, 1.0), 2.0)
    assert_allclose(way.after[-1], end, atol=1e-9)
    assert way.chart[-1] == chart


def test_what_cannot_be_put_together():
    with pytest.raises(hj.errors.DefinitionError, match="two charts"):
        hj.systems.filippov({"up": field(0.0, 1.0)}, height)
