"""Sections on a cycle: of every kind, and every way in which they can be wrong."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj
from hybridjax._core.memo import Recent
from hybridjax.engine.events import belongs
from hybridjax.sections import locate

from ..conftest import APEX
from ..engine.test_executors import slow_but


AtEvent = hj.AtEvent
Crossing = hj.Crossing
LAMBDA = -0.248983334735609 + 0.699333251798004j
VDP = 8.59695063603805e-4


@pytest.mark.slow
def test_a_list_of_sections_of_every_kind(hopper_cycle):
    """State-based, on events, and in one chart only; the monodromy is that of the cycle."""
    table = [
        (Crossing("ym", "rising", value=0.1), 0.69638656, ("t", "yM", "vM", "vm")),
        (APEX, 0.72334235, ("t", "yM", "ym", "vm")),
        (Crossing("ym", "falling", value=0.1), 1.32666602, ("t", "yM", "vM", "vm")),
        (AtEvent("touchdown"), 1.35098179, ("t", "yM", "vM")),
        (Crossing("yM", "rising", value=1.9), 1.46563862, ("t", "vM")),
        (AtEvent("liftoff"), 1.51631443, ("t", "yM", "vM", "ym", "vm")),
    ]
    sections, times, coordinates = zip(*table, strict=True)
    placed = hj.sections.place_sections(hopper_cycle, sections)
    assert_allclose(placed.lanes.t, times, atol=1e-8)

    ldtp = hj.linearize(hopper_cycle, placed, ("yM", "vM"))
    assert ldtp.coordinates == coordinates
    assert_array_equal(ldtp.dims, [4, 4, 4, 3, 2, 5])
    assert_allclose(ldtp.multipliers, [LAMBDA, np.conj(LAMBDA)], atol=1e-9)
    ranks = [ldtp.rank(i) for i in range(6)]
    assert ranks == [2, 2, 2, 2, 2, 2]


def test_a_number_as_the_anchor(hopper_cycle):
    # By rounding, this is before the cycle begins.
    first = np.nextafter(hopper_cycle.anchor.t[0], 0.0)
    clock = hj.sections.place_sections(hopper_cycle, hj.ClockPhase(3, anchor=first))
    expected = (first + np.arange(3) / 3) % 1
    assert_allclose(clock.lanes.t % 1, expected, atol=1e-12)


def test_the_anchor_lies_on_its_own_section_up_to_rounding(hopper_cycle):
    """On which side of it is no matter; it was taken for a section that is touched."""
    family = hj.KinematicPhase(4, "yM", "vM", (1.9, -0.3), (0.3, 1.9), anchor=APEX)
    placed = hj.sections.place_sections(hopper_cycle, family)
    assert_allclose(np.sum(placed.duration), 1.0, atol=1e-12)
    assert abs(placed.lanes.q[1, 0]) < 1e-12


def test_an_angle_as_the_anchor(hopper_cycle):
    family = hj.KinematicPhase(4, "yM", "vM", (1.9, 0.0), (0.3, 1.9), anchor=0.3)
    placed = hj.sections.place_sections(hopper_cycle, family)
    states = np.asarray(placed.lanes.q)
    height, speed = states[:2]
    height_in_sizes = (height - 1.9) / 0.3
    angle = np.unwrap(np.arctan2(speed / 1.9, height_in_sizes))
    quarters = np.pi / 2 * np.arange(4)
    expected = 0.3 - quarters
    assert_allclose(angle, expected, atol=1e-10)


def test_equal_steps_of_time_on_an_autonomous_cycle(vanderpol_cycle):
    """Time has no origin there: a multiplier of 1 beside the true one."""
    top = Crossing("v", "falling")
    clock = hj.ClockPhase(8, anchor=top)
    ldtp = hj.linearize(vanderpol_cycle, clock)
    assert ldtp.outputs == ("x", "v")
    assert ldtp.coordinates[0] == ("x", "v")
    assert_allclose(ldtp.multipliers, [1.0, VDP], rtol=1e-9)

    angle = hj.KinematicPhase(8, position="x", velocity="v", anchor=top)
    ldtp = hj.linearize(vanderpol_cycle, angle, "x")
    assert_array_equal(ldtp.dims, np.ones(8))
    assert_allclose(ldtp.multipliers, [VDP], rtol=1e-9)


TOP = Crossing("v", "falling")


def test_a_list_of_sections_is_sorted(vanderpol_cycle):
    """From the top of x on: v is lowest on the way down, x rises through 0 last."""
    left = Crossing("v", "rising")
    up = Crossing("x", "rising")
    down = Crossing("x", "falling")
    given = [TOP, up, left, down]
    placed = hj.sections.place_sections(vanderpol_cycle, given)
    names = [str(item) for item in placed.family.items]
    assert names == ["v falling", "x falling", "v rising", "x rising"]
    in_order = hj.sections.place_sections(vanderpol_cycle, [TOP, down, left, up])
    assert_allclose(placed.duration, in_order.duration, rtol=1e-12)
    assert_allclose(np.sum(placed.duration), vanderpol_cycle.period, rtol=1e-12)
    model = hj.linearize(vanderpol_cycle, hj.sections.SectionList(given))
    assert_allclose(model.multipliers, [VDP], rtol=1e-9)
    # (The second call has the sections of the first.)
    assert hj.sections.place_sections(vanderpol_cycle, given) is placed


@pytest.mark.parametrize(
    "sections, message",
    [
        (
            [TOP, Crossing("x", "rising", value=2.00861986)],
            r"section 1 \(x rising\) is tangent",
        ),
        (
            [TOP, Crossing(hj.Output("xv", lambda t, q, u: q[0] * q[1]), "falling")],
            r"1 \(xv falling\) is crossed more than once .*, at t = \S+ .* and t = \S+ in osc",
        ),
        (
            hj.ClockPhase(4, Crossing(lambda t, q: q[0] * q[1], "falling")),
            "lies at .* once in one",
        ),
        (
            [Crossing(lambda t, q: jnp.cos(2 * jnp.pi * t / 6.6633), "falling")],
            "depends on time",
        ),
        (
            hj.ClockPhase(4, Crossing("x", "rising", 9.0)),
            "on the cycle: from -2.009 to 2.009",
        ),
        (
            [TOP, Crossing("x", "rising"), TOP],
            r"section 2 \(v falling\) coincides with section 0",
        ),
        (
            hj.KinematicPhase(8, "x", "v", (5.0, 0.0)),
            r"turn about the `center` \(5.0, 0.0\)",
        ),
    ],
)
@pytest.mark.slow
def test_what_is_wrong_with_a_section_is_said(sections, message, vanderpol_cycle):
    with pytest.raises(hj.errors.ComputationError, match=message):
        hj.sections.place_sections(vanderpol_cycle, sections)


def test_a_section_that_is_crossed_again_after_a_jump(hopper_cycle):
    def twice(t, q):
        return jnp.sin(4 * jnp.pi * t)

    with pytest.raises(
        hj.errors.ComputationError,
        match=r"section 0 \(twice falling\) is crossed more than once in one period, "
        "at t = 0.75 in flight and t = 1.25 in flight",
    ):
        hj.sections.place_sections(hopper_cycle, Crossing(twice, "falling"))


def test_a_section_takes_the_time_and_the_state(hopper_cycle):
    def level(t, q, u):
        return q[0]

    with pytest.raises(
        hj.errors.DefinitionError, match=r"'level falling' .*`Crossing`.* \(t, q\)"
    ):
        hj.sections.place_sections(hopper_cycle, Crossing(level, "falling"))


@pytest.mark.slow
def test_sections_out_of_order_have_no_matrices_in_programs(vanderpol_cycle):
    """Their round takes two periods, and would give squares of multipliers."""

    def levels(x):
        return [Crossing("x", "rising", y) for y in (0.2, 0.4, x)]

    A = jax.jit(lambda x: hj.linearize(vanderpol_cycle, levels(x)).A)
    assert np.isfinite(A(0.6)).all()
    assert np.isnan(A(0.3)).all()


@pytest.mark.slow
def test_sections_of_another_cycle(placed_isochrons, lossy_cycle):
    with pytest.raises(hj.errors.DefinitionError, match="placed on another cycle"):
        hj.linearize(lossy_cycle, placed_isochrons)


def test_equal_sections_are_located_once(hopper_cycle):
    def at(phase):
        return hj.sections.place_sections(hopper_cycle, hj.ClockPhase(2, phase))

    assert at(0.3) is at(0.3)
    assert at(0.4) is not at(0.3)


def test_an_output_that_a_chart_does_not_define(hopper_cycle, placed_isochrons):
    foot = hj.Output("foot", {"flight": lambda t, q, u: q[2]})
    with pytest.raises(
        hj.errors.DefinitionError, match="'foot' is not defined in chart 'stance'"
    ):
        hj.linearize(hopper_cycle, placed_isochrons, foot)


def test_outputs_of_any_kind_and_feedthrough(
    hopper_cycle, placed_isochrons, isochron_ldtp
):
    def acceleration(t, q, u):
        foot = q[2] if q.shape[0] == 4 else 0.0
        spring = 10.0 * (2.0 - (q[0] - foot))
        motor = 20.0 * jnp.sin(2 * jnp.pi * t)
        return (spring + motor + u[0]) / 2.0 - 2.0

    outputs = ["vM", hj.Output("aM", acceleration)]
    ldtp = hj.linearize(hopper_cycle, placed_isochrons, outputs)
    found = ldtp.C[:, 0]
    assert_array_equal(found, isochron_ldtp.C[:, 1])
    in_flight = np.asarray(ldtp.dims) == 4
    for section in range(32):
        direct = ldtp.D[section, :, 0]
        assert_allclose(direct, [0.0, 0.5], atol=1e-15)
        by_foot = 5.0 if in_flight[section] else 0.0
        expected = [-5.0, 0.0, by_foot, 0.0]
        assert_allclose(ldtp.C[section, 1], expected)


def test_ways_that_take_too_many_steps(hopper_cycle, monkeypatch):
    monkeypatch.setattr("hybridjax.sections.locate.PATIENCE", 3)
    settings = hj.orbits.Settings(1e-12, 1e-12, 3, hopper_cycle.settings.scale)
    with pytest.raises(
        hj.errors.ComputationError,
        match="max_steps.* Give them to the search for the cy",
    ):
        hj.sections.place_sections(
            dataclasses.replace(hopper_cycle, settings=settings), hj.ClockPhase(2)
        )


def families_of(cycle):
    """Sections of each kind on a cycle."""
    structure = cycle.structure
    (_, _, q) = cycle.trajectory().dense()
    names = structure.states_everywhere()[:2]
    families = [hj.ClockPhase(7)]
    for transition in sorted(set(cycle.event_sequence)):
        families.append([AtEvent(structure.transitions[transition].name)])
    for state in names:
        place = structure.charts[0].states.index(state)
        values = q[:, place]
        level = 0.53 * values.min() + 0.47 * values.max()
        rising = Crossing(state, "rising", level)
        falling = Crossing(state, "falling", level)
        families.append([rising, falling])
        families.append(hj.ClockPhase(5, falling))
        curve = hj.sections.ArcLength(5, names[:1], rising)
        families.append(curve)
    if len(names) == 2:
        center = q[:, :2].mean(axis=0)
        families.append(hj.KinematicPhase(9, *names, center=center))
    return families


def place_or_say(cycle, family, monkeypatch):
    """The sections, or the message if there are none."""
    monkeypatch.setattr(locate, "_recent", Recent(1))
    try:
        return hj.sections.place_sections(cycle, family)
    except hj.errors.ComputationError as error:
        return str(error)


@pytest.mark.parametrize("name", slow_but(hj.models.__all__, ("VerticalHopper",)))
@pytest.mark.slow
def test_sections_from_the_recorded_turn_are_those_of_the_flow(name, monkeypatch):
    """The same places, steps and errors as one section after the other."""
    system = getattr(hj.models, name)()
    if system.guess() is None:
        pytest.skip("has no guess")
    if name in ("SLIPRunner", "TrottingQuadruped"):
        pytest.skip("a family of cycles, or events that rounding puts in order")
    cycle = hj.find_limit_cycle(system)
    structure = cycle.structure
    families = families_of(cycle)
    flow_along = locate.flow_along
    used_the_turn = []

    def spy(*arguments):
        flow = flow_along(*arguments)
        used_the_turn.append(flow is not None)
        return flow

    monkeypatch.setattr(locate, "flow_along", spy)
    from_turn = [place_or_say(cycle, family, monkeypatch) for family in families]
    monkeypatch.setattr(locate, "last_turn", lambda cycle: None)
    from_flow = [place_or_say(cycle, family, monkeypatch) for family in families]

    charts = range(len(structure.charts))
    if not any(structure.method(a).implicit for a in charts):
        assert sum(used_the_turn) > 1
        assert all(used_the_turn) or name != "VerticalHopper"
    for turn, flow in zip(from_turn, from_flow, strict=True):
        if isinstance(turn, str) or isinstance(flow, str):
            assert turn == flow
            continue
        assert_array_equal(turn.drop, flow.drop)
        ours, theirs = jax.device_get((turn.lanes, flow.lanes))
        here = belongs(structure, theirs.chart)[:-1]
        scale = np.asarray(cycle.settings.scale)[theirs.chart].T
        our_states = ours.q / scale
        their_states = theirs.q / scale
        assert_allclose(our_states, their_states, rtol=0, atol=1e-12)
        assert_allclose(ours.t, theirs.t, rtol=1e-12)
        assert_array_equal(ours.chart, theirs.chart)
        assert_array_equal(ours.events, theirs.events)
        assert_array_equal(ours.armed & here, theirs.armed & here)
        numbers = [*turn.flow_jacobians, states_of(turn.tape)]
        exact = [*flow.flow_jacobians, states_of(flow.tape)]
        for x, y in zip(numbers, exact, strict=True):
            tolerance = 1e-10 * np.abs(y).max(initial=1e-300)
            assert_allclose(x, y, atol=tolerance)


def states_of(tape):
    """The states before each step of a tape, without the entries that were not needed."""
    states = np.asarray(tape.before).transpose(2, 0, 1)
    return states[np.asarray(tape.code).T >= 0]


def test_a_section_at_the_time_of_an_event_is_refused():
    wheel = hj.find_limit_cycle(hj.models.RimlessWheel())
    (impact, *_) = wheel.trajectory().events
    phase = float(impact.time / wheel.period)
    at_impact = hj.ClockPhase(2, anchor=phase)
    with pytest.raises(
        hj.errors.ComputationError, match="section coincides with an event"
    ):
        hj.sections.place_sections(wheel, at_impact)
    with pytest.raises(hj.errors.ComputationError, match="does not reach section 0"):
        hj.sections.place_sections(wheel, hj.Crossing("th", "rising", 1.0))

    # Section 2 is half a flight after the apex, at the impact.
    apex = hj.ClockPhase(4, anchor=hj.Crossing("v", "falling"))
    for amplitude in (0.16, 0.160001):
        juggling = hj.find_limit_cycle(hj.models.PaddleJuggler(A=amplitude))
        with pytest.raises(
            hj.errors.ComputationError, match="section 2 .*coincides with an event"
        ):
            hj.sections.place_sections(juggling, apex)
    A = jax.jit(lambda cycle: hj.linearize(cycle, apex).A)(juggling)
    assert np.isnan(A).any()
