"""Short forms of arguments: what they return is that of the long ones."""

import copy
import functools
import pathlib
import pickle

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

import hybridjax as hj
from hybridjax.errors import DefinitionError

from .conftest import APEX, OUTPUTS
from .toys import Field, toy


STATE = (2.0, 0.0, 1.0, 0.0)
BY_NAME = {"ym": 1.0, "vm": 0.0, "yM": 2.0, "vM": 0.0}


@pytest.fixture(scope="module")
def hopper():
    return hj.models.VerticalHopper()


@pytest.fixture(scope="module")
def cycle(hopper):
    return hj.find_limit_cycle(hopper)


@pytest.fixture(scope="module")
def walk(cycle):
    """A recording whose cycles begin at the event "apex"."""
    force = 0.01 * np.random.default_rng(0).normal(size=(1, 3000, 1))
    made = hj.testing.simulate_recording(cycle, force, OUTPUTS, rate=50)
    return made.mark("apex", APEX)


def identified(recording, sections=APEX):
    found = hj.identify_recording(
        recording, sections, "u", OUTPUTS, n_sections=8, order=2
    )
    return found.multipliers


@pytest.mark.parametrize("start", [STATE, list(STATE), np.array(STATE), BY_NAME])
def test_a_state_is_that_of_the_only_chart_that_it_fits(hopper, start):
    guess = hj.Guess("flight", STATE)
    long = hj.simulate(hopper, guess, 0.5)
    assert_array_equal(hj.simulate(hopper, start, 0.5).after, long.after)
    end = hj.flow(hopper, guess, 0.5).state
    assert_array_equal(hj.flow(hopper, start, 0.5).state, end)


def test_a_state_is_a_guess_for_a_cycle(hopper):
    long = hj.find_limit_cycle(hopper, hj.Guess("flight", STATE))
    for guess in (STATE, BY_NAME):
        short = hj.find_limit_cycle(hopper, guess)
        assert_array_equal(short.multipliers, long.multipliers)


def test_a_state_begins_at_the_time_that_is_given(hopper):
    long = hj.simulate(hopper, "flight", STATE, 0.5, time=0.2)
    short = hj.simulate(hopper, BY_NAME, 0.5, time=0.2)
    by_names = hj.simulate(hopper, state=STATE, duration=0.5, time=0.2)
    assert_array_equal(short.t, long.t)
    assert_array_equal(by_names.after, long.after)


def test_a_simulation_begins_at_the_guess_of_the_model(hopper):
    long = hj.simulate(hopper, hopper.guess(), 0.5)
    assert_array_equal(hj.simulate(hopper, duration=0.5).after, long.after)


def test_a_state_that_fits_two_charts_needs_the_name_of_one():
    charts = {name: Field(("x",), lambda t, q, u: -q) for name in ("left", "right")}
    for state in ((1.0,), {"x": 1.0}):
        with pytest.raises(
            hj.errors.DefinitionError, match=r"hj.Guess\('left', state\)"
        ):
            hj.simulate(toy(charts), state, 0.1)


def test_a_flow_begins_on_a_cycle(hopper, cycle):
    (t,) = cycle.anchor.t
    guess = hj.Guess("stance", tuple(cycle.state.values()), t)
    long = hj.flow(hopper, guess, 1.0)
    assert_array_equal(hj.flow(hopper, cycle, 1.0).state, long.state)


@pytest.mark.slow
def test_a_flow_has_its_states_by_name(hopper):
    at_end = hj.flow(hopper, STATE, 0.3)
    names = hopper.charts()["flight"].states
    assert [float(at_end[x]) for x in names] == at_end.state.tolist()
    in_stance = hj.flow(hopper, STATE, "touchdown", within=2.0)
    assert in_stance["vM"] == in_stance.state[1]
    assert np.isnan(in_stance["ym"])
    many = hj.flow(hopper, hj.Guess("flight", [STATE, (2.1, 0.0, 1.0, 0.0)]), 0.3)
    assert_array_equal(many["ym"], many.state[:, 2])


@pytest.mark.slow
def test_a_state_by_name_has_derivatives(hopper):
    def height(k, pick):
        return pick(hj.flow(hopper.replace(k=k), STATE, 0.5))

    short = jax.grad(height)(10.0, lambda end: end["yM"])
    long = jax.grad(height)(10.0, lambda end: end.state[0])
    assert short == long != 0

    def foot(mass):
        landed = hj.flow(hopper.replace(m=mass), STATE, "touchdown", within=2.0)
        return landed["ym"]

    # In stance, the foot has no state: neither a value nor a derivative.
    assert np.isnan(jax.value_and_grad(foot)(1.0)).all()


def test_one_time_needs_no_list(hopper):
    path = hj.simulate(hopper, STATE, 0.5)
    charts, states = path.at([0.3])
    assert path.at(0.3)[0] == charts[0]
    assert_array_equal(path.at(0.3)[1], states[0])
    end = hj.flow(hopper, STATE, 0.5)
    charts, states = end.at([0.3])
    assert end.at(0.3)[0] == charts[0]
    assert_array_equal(end.at(0.3)[1], states[0])


@pytest.mark.slow
def test_parameters_of_a_sweep_are_keywords(hopper, cycle):
    values = {"k": [9.9, 10.0], "b": [5.0]}
    long = hj.sweep(hopper, values, guess=cycle)
    assert hj.sweep(hopper, guess=cycle, **values).identical(long)
    assert hj.sweep(hopper, {"k": [9.9, 10.0]}, guess=cycle, b=5.0).identical(long)


@pytest.mark.slow
def test_the_parameter_of_a_continuation_is_a_keyword(cycle):
    long = hj.continuation(cycle, "k", (9.95, 10.05), step=1.0)
    short = hj.continuation(cycle, k=(9.95, 10.05), step=1.0)
    assert_array_equal(short.values, long.values)
    assert short.parameter == "k"


def test_an_event_is_a_section_by_its_name(hopper, cycle):
    long = hj.linearize(cycle, hj.AtEvent("touchdown"))
    assert_array_equal(hj.linearize(cycle, "touchdown").A, long.A)
    both = hj.linearize(cycle, [hj.AtEvent("touchdown"), APEX])
    assert_array_equal(hj.linearize(cycle, ["touchdown", APEX]).A, both.A)
    assert hj.sections.SectionList(["a"]).items == (hj.AtEvent("a"),)


def test_an_event_of_a_recording_is_the_beginning_by_its_name(walk):
    long = identified(walk, hj.AtEvent("apex"))
    assert_array_equal(identified(walk, "apex"), long)
    with pytest.raises(hj.errors.DefinitionError, match="hj.Crossing"):
        identified(walk, "vM")


@pytest.mark.slow
def test_a_recording_is_read_from_its_file(tmp_path, walk):
    path = tmp_path / "walk.csv"
    walk.to_pandas().to_csv(path, index=False)
    long = identified(hj.read_recording(path))
    assert_array_equal(identified(path), long)
    assert_array_equal(identified(str(path)), long)


@pytest.mark.slow
def test_a_recording_is_made_of_a_table(walk):
    table = walk.to_pandas()
    long = identified(hj.Recording.from_frame(table))
    columns = {name: table[name].to_numpy() for name in table}
    for given in (table, columns, hj.Recording(table), hj.Recording(columns)):
        assert_array_equal(identified(given), long)


def test_every_step_takes_a_table(walk):
    table = walk.to_pandas()
    recording = hj.Recording.from_frame(table)
    checked = hj.recordings.check_recording(table, inputs="u", outputs=OUTPUTS)
    assert_array_equal(checked.recording.time, recording.time)
    long = hj.recordings.estimate_phase(recording, APEX)
    assert hj.recordings.estimate_phase(table, APEX).period == long.period
    names = dict(inputs="u", outputs=OUTPUTS, n_sections=8)
    sampled = hj.recordings.sample_sections(table, APEX, **names)
    expected = hj.recordings.sample_sections(recording, APEX, **names)
    assert_array_equal(sampled.records[0].y, expected.records[0].y)
    noisy = hj.testing.add_artifacts(table, "yM", noise=1e-3)
    assert_array_equal(
        noisy["yM"], hj.testing.add_artifacts(recording, "yM", noise=1e-3)["yM"]
    )


def test_events_and_units_stand_beside_a_table(walk):
    table = {"time (ms)": 1e3 * walk.time, "u": walk["u"], "yM (m)": walk["yM"]}
    made = hj.Recording(table, units={"u": "N"}, events={"heel": [1.0, 2.0]})
    assert made.units == ("N", "m")
    assert_array_equal(made.trials[0].events["heel"], [1.0, 2.0])


def test_a_result_has_what_its_fit_has(cycle, walk):
    result = hj.identify_recording(walk, APEX, "u", OUTPUTS, n_sections=8, order=2)
    assert_array_equal(result.interval(0.9), result.fit.interval(0.9))
    assert_array_equal(result.standard_errors, result.fit.standard_errors)
    assert_array_equal(result.contains(cycle), result.fit.contains(cycle))
    assert result.compare(cycle).p_value == result.fit.compare(cycle).p_value


def test_a_field_is_the_system_of_one_chart():
    def field(t, q):
        return (q[1], (1 - q[0] ** 2) * q[1] - q[0])

    system = hj.HybridSystem.from_functions(("x", "v"), field)
    start = (2.0, 0.0)
    long = hj.find_limit_cycle(system, start)
    unnamed = hj.find_limit_cycle(field, start)
    assert list(unnamed.state) == ["x0", "x1"]
    assert_array_equal(unnamed.multipliers, long.multipliers)
    path = hj.simulate(field, start, 1.0)
    assert_array_equal(path.after, hj.simulate(system, start, 1.0).after)
    assert hj.flow(field, start, 1.0)["x1"] == hj.flow(system, start, 1.0)["v"]


@pytest.mark.parametrize(
    "call, message",
    [
        # JAX sorts the names of a dictionary, so that their order means nothing.
        (lambda: hj.flow(lambda t, q: -q, {"x": 1.0, "v": 0.0}, 1.0), "in order"),
        (lambda: hj.flow(lambda y, t: -y, (1.0,), 1.0), "the time first"),
        (lambda: hj.flow(lambda t, y, k: -k * y, (1.0,), 1.0), r"not \(t, y, k\)"),
        (
            lambda: hj.recordings.Population.from_fits({"S1": 0}, ["S2"]),
            "fits by name stand for the table|must be",
        ),
    ],
)
def test_what_has_two_meanings_is_refused(call, message):
    with pytest.raises(DefinitionError, match=message):
        call()


def test_arguments_that_would_be_dropped_are_refused(hopper, cycle):
    guess = hj.Guess("flight", (2.0, 0.0, 1.0, 0.0))
    with pytest.raises(DefinitionError, match="its own time"):
        hj.simulate(hopper, guess, 0.5, time=0.2)
    with pytest.raises(DefinitionError, match="the duration alone"):
        hj.simulate(hopper, guess, 0.5, 1.0)
    with pytest.raises(DefinitionError, match="stands for both"):
        hj.continuation(cycle, range=(1.0, 50.0), k=(9.95, 10.05))

    def field(t, q, u, p):
        return (q[1], p.step * q[1] - p.k * q[0] - q[1] ** 3)

    numbers = {"step": 1.0, "k": 1.0}
    system = hj.HybridSystem.from_functions(("x", "v"), field, (), numbers)
    found = hj.find_limit_cycle(system, (1.0, 0.0))
    with pytest.raises(DefinitionError, match="both an option"):
        hj.continuation(found, k=(0.9, 1.1), step=0.6)


def test_functions_of_a_system_leave_out_last_arguments():
    def field(t, q):
        return (q[1], (1 - q[0] ** 2) * q[1] - q[0])

    short = hj.HybridSystem.from_functions(("x", "v"), field)
    long = hj.HybridSystem.from_functions(("x", "v"), lambda t, q, u, p: field(t, q))
    start = {"x": 2.0, "v": 0.0}
    assert_array_equal(
        hj.find_limit_cycle(short, start).multipliers,
        hj.find_limit_cycle(long, start).multipliers,
    )
    pushed = hj.HybridSystem.from_functions(
        ("v",),
        lambda t, q, u, drag=2.0: (u[0] - drag * q[0],),
        [("stop", lambda t, q: q[0], lambda t, q, u, p: (p.back,))],
        {"back": 0.5},
    )
    path = hj.simulate(pushed, (1.0,), 2.0, input=-1.0)
    # v = -1/2 + 3/2 exp(-2 t) reaches 0 at t = ln(3) / 2, then begins at 1/2: t = ln(2) / 2 later.
    events = [event.time for event in path.events]
    assert np.allclose(events[:2], [np.log(3) / 2, np.log(6) / 2], atol=1e-8)


def test_subjects_are_named_in_a_list_or_with_their_fits(cycle, walk):
    other = hj.testing.add_artifacts(walk, OUTPUTS, noise=1e-4)
    a, b = (
        hj.identify_recording(x, APEX, "u", OUTPUTS, n_sections=8, order=2)
        for x in (walk, other)
    )
    people = hj.recordings.Population
    long = people.from_fits([a.fit, b.fit], {"subject": ["S1", "S2"]}).to_pandas()
    assert people.from_fits([a, b], ["S1", "S2"]).to_pandas().equals(long)
    assert people.from_fits({"S1": a, "S2": b}).to_pandas().equals(long)


def test_all_signals_but_the_inputs_are_checked(walk):
    broken = hj.testing.add_artifacts(walk, "vM", spikes=0.01)
    long = hj.recordings.check_recording(broken, inputs="u", outputs=OUTPUTS)
    short = hj.recordings.check_recording(broken, inputs="u")
    assert short.findings == long.findings


@pytest.mark.slow
def test_a_study_takes_a_table_and_the_options_of_each_recording(
    tmp_path, monkeypatch, walk
):
    monkeypatch.chdir(tmp_path)
    walk.to_pandas().to_csv("S1.csv", index=False)
    pathlib.Path("subjects.csv").write_text("file,subject\nS1.csv,S1\n")
    options = dict(sections=APEX, inputs="u", outputs=OUTPUTS, n_sections=8, order=2)
    identify = functools.partial(hj.identify_recording, **options)
    long = hj.identify_subjects("subjects.csv", "long", identify)
    table = {"file": ["S1.csv"], "subject": ["S1"]}
    short = hj.identify_subjects(table, "short", **options)
    assert_array_equal(short.fits[0].multipliers, long.fits[0].multipliers)
    assert list(short.population.table["subject"]) == ["S1"]


def test_the_own_guess_of_a_model_holds_under_an_input_of_time():
    oscillator = hj.models.VanDerPol()
    plain = hj.simulate(oscillator, duration=0.2)
    driven = hj.simulate(oscillator, duration=0.2, input=lambda t: 0.0 * t)
    np.testing.assert_allclose(driven.after[-1], plain.after[-1], rtol=1e-9)


def test_tables_with_columns_alone_are_read():
    """As those of polars, which have no `keys`."""

    class Table:
        columns = ("time", "x")

        def __getitem__(self, name):
            return {"time": np.arange(5.0), "x": np.ones(5)}[name]

    assert hj.Recording(Table()).signals == ("x",)


def test_a_field_that_is_no_parameter_says_how_to_make_it_one():
    class Plain(hj.models.VanDerPol):
        gain: float = 2.0

    with pytest.raises(DefinitionError, match="`gain: hj.Parameter"):
        hj.sweep(Plain(), gain=[1.0, 2.0])


@pytest.mark.slow
def test_a_state_of_a_cycle_begins_at_its_time(hopper, cycle):
    """A hopper has a clock: from the same state at time 0 it would leave the cycle."""
    (t,) = cycle.anchor.t
    assert t > 0
    path = hj.simulate(hopper, cycle.state, 3.0)
    assert path.t[0] == t
    np.testing.assert_allclose(path.after[-1], path.after[0], atol=1e-10)
    at_end = hj.flow(hopper, cycle.state, t + 3.0)
    assert at_end["yM"] == pytest.approx(cycle.state["yM"], abs=1e-10)
    assert hj.simulate(hopper, cycle.state, 0.1, time=0.2).t[0] == 0.2
    pushed = hj.simulate(hopper, cycle.state | {"vM": 2.0}, 0.1)
    assert (pushed.t[0], pushed.after[0, 1]) == (t, 2.0)
    event = path.events[0]
    assert hj.simulate(hopper, event.after, 0.1).t[0] == event.time
    same = (
        copy.copy(cycle.state),
        cycle.state.copy(),
        {"yM": 2.0} | cycle.state,
        pickle.loads(pickle.dumps(cycle.state)),
        jax.tree_util.tree_map(lambda x: x + 1e-3, cycle.state),
        jax.jit(lambda state: state)(cycle.state),
    )
    for state in same:
        assert hj.simulate(hopper, state, 0.1).t[0] == t
    numbers, _ = jax.flatten_util.ravel_pytree(cycle.state)
    assert len(numbers) == len(cycle.state), "the time counts as a state"


def test_a_state_of_another_system_does_not_bring_its_time(cycle):
    field = Field(("yM", "vM"), lambda t, q, u: (q[1], -q[0]))
    other = toy({"other": field})
    assert hj.simulate(other, cycle.state, 0.1).t[0] == 0.0


def test_a_state_of_a_cycle_has_derivatives(hopper, cycle):
    (t,) = cycle.anchor.t

    def height(v, start):
        return hj.flow(hopper, start(v), t + 0.5)["yM"]

    state = cycle.state
    short = jax.grad(height)(state["vM"], lambda v: state | {"vM": v})
    guess = jax.grad(height)(
        state["vM"], lambda v: hj.Guess("stance", (state["yM"], v), t)
    )
    assert short == guess != 0
    whole = jax.grad(lambda x: hj.flow(hopper, x, t + 0.5)["yM"])(state)
    assert whole["vM"] == guess


def test_a_state_of_a_cycle_knows_its_chart():
    def decay(t, q, u):
        return (jnp.cos(2 * jnp.pi * t) - q[0],)

    charts = {name: Field(("x",), decay) for name in ("left", "right")}
    system = toy(charts, period=1.0)
    cycle = hj.find_limit_cycle(system, hj.Guess("right", (0.1,)))
    path = hj.simulate(system, cycle.state, 1.0)
    assert path.structure.names[path.chart[0]] == "right"
