"""Sections on a cycle: of every kind, and every way in which they can be wrong."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj
from hybridjax.engine.events import belongs
from hybridjax.sections import place

from ..conftest import APEX
from ..engine.test_executors import slow_but


AtEvent = hj.AtEvent
Crossing = hj.Crossing
LAMBDA = -0.248983334735609 + 0.699333251798004j
VDP = 8.59695063603805e-4


def test_a_list_of_sections_of_every_kind(hopper_cycle):
    """State-based, on events, and in one chart only; the monodromy is that of the cycle."""
    sections, times, names = zip(
        (Crossing("ym", "rising", value=0.1), 0.69638656, "t yM vM vm"),
        (APEX, 0.72334235, "t yM ym vm"),
        (Crossing("ym", "falling", value=0.1), 1.32666602, "t yM vM vm"),
        (AtEvent("touchdown"), 1.35098179, "t yM vM"),
        (Crossing("yM", "rising", value=1.9), 1.46563862, "t vM"),
        (AtEvent("liftoff"), 1.51631443, "t yM vM ym vm"),
        strict=True,
    )
    placed = hj.place_sections(hopper_cycle, sections)
    assert_allclose(placed.lanes.t, times, atol=1e-8)
    ldtp = hj.linearize(hopper_cycle, placed, ("yM", "vM"))
    assert tuple(" ".join(x) for x in ldtp.coordinates) == names
    assert_array_equal(ldtp.dims, [len(names) for names in ldtp.coordinates])
    assert_allclose(ldtp.multipliers, [LAMBDA, np.conj(LAMBDA)], atol=1e-9)
    assert [ldtp.rank(i) for i in range(6)] == [2] * 6


def test_a_number_as_the_anchor(hopper_cycle):
    first = np.nextafter(
        hopper_cycle.anchor.t[0], 0.0
    )  # by rounding before the cycle begins
    clock = hj.place_sections(hopper_cycle, hj.ClockPhase(3, anchor=first))
    expected = (first + np.arange(3) / 3) % 1
    assert_allclose(clock.lanes.t % 1, expected, atol=1e-12)
    family = hj.KinematicPhase(4, "yM", "vM", (1.9, 0.0), (0.3, 1.9), anchor=0.3)
    q = np.asarray(hj.place_sections(hopper_cycle, family).lanes.q)
    angle = np.unwrap(np.angle((q[0] - 1.9) / 0.3 + 1j * q[1] / 1.9))
    assert_allclose(angle, 0.3 - np.pi / 2 * np.arange(4), atol=1e-10)


def test_the_anchor_lies_on_its_own_section_up_to_rounding(hopper_cycle):
    """On which side of it is no matter; it was taken for a section that is touched."""
    family = hj.KinematicPhase(4, "yM", "vM", (1.9, -0.3), (0.3, 1.9), anchor=APEX)
    placed = hj.place_sections(hopper_cycle, family)
    assert_allclose(np.sum(placed.duration), 1.0, atol=1e-12)
    assert abs(placed.lanes.q[1, 0]) < 1e-12


def test_equal_steps_of_time_on_an_autonomous_cycle(vanderpol_cycle):
    """Time has no origin there: a multiplier of 1 beside the true one."""
    sections = hj.ClockPhase(8, anchor=Crossing("v", "falling"))
    ldtp = hj.linearize(vanderpol_cycle, sections)
    assert ldtp.outputs == ("x", "v")
    assert ldtp.coordinates[0] == ("x", "v")
    assert_allclose(ldtp.multipliers, [1.0, VDP], rtol=1e-9)
    family = hj.KinematicPhase(
        8, position="x", velocity="v", anchor=Crossing("v", "falling")
    )
    ldtp = hj.linearize(vanderpol_cycle, family, "x")
    assert_array_equal(ldtp.dims, np.ones(8))
    assert_allclose(ldtp.multipliers, [VDP], rtol=1e-9)


TOP = Crossing("v", "falling")


@pytest.mark.parametrize(
    "sections, message",
    [
        (
            [TOP, Crossing("x", "rising"), Crossing("x", "falling")],
            r"out of order: section \d \(x",
        ),
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
def test_what_is_wrong_with_a_section_is_said(sections, message, vanderpol_cycle):
    with pytest.raises(hj.ComputationError, match=message):
        hj.place_sections(vanderpol_cycle, sections)


def test_a_section_that_is_crossed_again_after_a_jump(hopper_cycle):
    text = "is crossed more than once in one period, at t = 0.75 in flight and t = 1.25 in flight"
    with pytest.raises(
        hj.ComputationError, match=rf"section 0 \(function falling\) {text}"
    ):

        def twice(t, q):
            return jnp.sin(4 * jnp.pi * t)

        hj.place_sections(hopper_cycle, Crossing(twice, "falling"))
    with pytest.raises(
        hj.DefinitionError, match=r"'function falling' .*`Crossing`.* \(t, q\)"
    ):
        hj.place_sections(hopper_cycle, Crossing(lambda t, q, u: q[0], "falling"))


def test_sections_out_of_order_have_no_matrices_in_programs(vanderpol_cycle):
    """Their round takes two periods, and would give squares of multipliers."""

    def levels(x):
        return [Crossing("x", "rising", y) for y in (0.2, 0.4, x)]

    A = jax.jit(lambda x: hj.linearize(vanderpol_cycle, levels(x)).A)
    assert np.isfinite(A(0.6)).all()
    assert np.isnan(A(0.3)).all()


@pytest.mark.slow
def test_sections_of_another_cycle(placed_isochrons, lossy_cycle):
    with pytest.raises(hj.DefinitionError, match="placed on another cycle"):
        hj.linearize(lossy_cycle, placed_isochrons)


def test_equal_sections_are_located_once(hopper_cycle):
    def at(phase):
        return hj.place_sections(hopper_cycle, hj.ClockPhase(2, phase))

    assert at(0.3) is at(0.3)
    assert at(0.4) is not at(0.3)


def test_an_output_that_a_chart_does_not_define(hopper_cycle, placed_isochrons):
    foot = hj.Output("foot", {"flight": lambda t, q, u: q[2]})
    with pytest.raises(
        hj.DefinitionError, match="'foot' is not defined in chart 'stance'"
    ):
        hj.linearize(hopper_cycle, placed_isochrons, foot)


def test_outputs_of_any_kind_and_feedthrough(
    hopper_cycle, placed_isochrons, isochron_ldtp
):
    def acceleration(t, q, u):
        leg = 10.0 * (2.0 - (q[0] - (q[2] if q.shape[0] == 4 else 0.0)))
        return (leg + 20.0 * jnp.sin(2 * jnp.pi * t) + u[0]) / 2.0 - 2.0

    ldtp = hj.linearize(
        hopper_cycle, placed_isochrons, ["vM", hj.Output("aM", acceleration)]
    )
    expected = np.tile([0.0, 0.5], (32, 1))
    assert_allclose(ldtp.D[:, :, 0], expected, atol=1e-15)
    assert_array_equal(ldtp.C[:, 0], isochron_ldtp.C[:, 1])
    flight = np.asarray(ldtp.dims) == 4
    expected = [[-5.0, 0.0, 5.0, 0.0]] * flight.sum()
    assert_allclose(ldtp.C[flight, 1], expected)
    expected = [[-5.0, 0.0, 0.0, 0.0]] * (~flight).sum()
    assert_allclose(ldtp.C[~flight, 1], expected)


def test_ways_that_take_too_many_steps(hopper_cycle, monkeypatch):
    monkeypatch.setattr("hybridjax.sections.place.PATIENCE", 3)
    settings = hj.Settings(1e-12, 1e-12, 3, hopper_cycle.settings.scale)
    with pytest.raises(
        hj.ComputationError, match="max_steps.* Give them to the search for the cy"
    ):
        hj.place_sections(
            dataclasses.replace(hopper_cycle, settings=settings), hj.ClockPhase(2)
        )


@pytest.mark.parametrize("name", slow_but(hj.models.__all__, ("VerticalHopper",)))
def test_sections_from_the_recorded_turn_are_those_of_the_flow(name, monkeypatch):
    """The same places, steps and errors as one section after the other."""
    system = getattr(hj.models, name)()
    if system.guess() is None or name in ("SLIPRunner", "TrottingQuadruped"):
        pytest.skip(
            "has no guess, a family of cycles, or events that rounding puts in order"
        )
    cycle = hj.find_limit_cycle(system)
    s = cycle.structure
    (_, _, q) = cycle.trajectory().dense()
    names = s.states_everywhere()[:2]
    kept = []
    families = [hj.ClockPhase(7)]
    families += [
        [AtEvent(s.transitions[g].name)] for g in sorted(set(cycle.event_sequence))
    ]
    for state in names:
        k = s.charts[0].states.index(state)
        level = 0.53 * q[:, k].min() + 0.47 * q[:, k].max()
        crossings = [Crossing(state, way, level) for way in ("rising", "falling")]
        families += [crossings, hj.ClockPhase(5, crossings[1])]
        families.append(hj.ArcLength(5, names[:1], crossings[0]))
    if len(names) == 2:
        sections = hj.KinematicPhase(9, *names, center=q[:, :2].mean(axis=0))
        families.append(sections)

    def spy(*arguments, plain=place.flow_along):
        kept.append((flow := plain(*arguments)) is not None)
        return flow

    def attempt(family):
        place._recent.clear()
        try:
            return hj.place_sections(cycle, family)
        except hj.ComputationError as error:
            return str(error)

    monkeypatch.setattr(place, "flow_along", spy)
    from_turn = list(map(attempt, families))
    monkeypatch.setattr(place, "last_turn", lambda cycle: None)
    for family, placed in zip(families, from_turn, strict=True):
        if isinstance(other := attempt(family), str) or isinstance(placed, str):
            assert placed == other
            continue
        both = [(x.lanes, x.flow_jacobians, x.tape) for x in (placed, other)]
        (own, A, *tapes), (their, B, tape) = jax.device_get(both)
        own, their = (
            x._replace(armed=x.armed & belongs(s, x.chart)[:-1]) for x in (own, their)
        )
        scale = np.asarray(cycle.settings.scale)[their.chart].T
        assert np.abs((own.q - their.q) / scale).max() < 1e-12
        assert_allclose(own.t, their.t, rtol=1e-12)
        for field in ("chart", "events", "armed"):
            assert_array_equal(getattr(own, field), getattr(their, field))
        before = (x.before.transpose(2, 0, 1)[x.code.T >= 0] for x in (*tapes, tape))
        for x, y in zip([*A, next(before)], [*B, next(before)], strict=True):
            tolerance = 1e-10 * np.abs(y).max(initial=1e-300)
            assert_allclose(x, y, atol=tolerance)
        assert_array_equal(placed.drop, other.drop)
    implicit = any(s.method(a).implicit for a in range(len(s.charts)))
    assert implicit or (all(kept) if name == "VerticalHopper" else sum(kept) > 1)


def test_a_section_at_the_time_of_an_event_is_refused():
    wheel = hj.find_limit_cycle(hj.models.RimlessWheel())
    impact = float(wheel.trajectory().events[0].time / wheel.period)
    # (half a flight before the impact)
    section = hj.Crossing("v", "falling")
    apex = hj.ClockPhase(4, anchor=section)
    juggling = [
        hj.find_limit_cycle(hj.models.PaddleJuggler(A=A)) for A in (0.16, 0.160001)
    ]
    pairs = (
        (wheel, hj.ClockPhase(2, anchor=impact), ""),
        *((x, apex, " 2 .*") for x in juggling),
    )
    for cycle, family, which in pairs:
        with pytest.raises(
            hj.ComputationError, match=f"section{which} coincides with an event"
        ):
            hj.place_sections(cycle, family)
    assert np.isnan(jax.jit(lambda c: hj.linearize(c, apex).A)(juggling[0])).any()
    with pytest.raises(hj.ComputationError, match="does not reach section 0"):
        hj.place_sections(wheel, hj.Crossing("th", "rising", 1.0))
