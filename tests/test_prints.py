"""What objects print: values with units, briefly, also where JAX hides values or adds axes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj
from hybridjax._core.text import p_value
from hybridjax.experiments.data import Simulated
from hybridjax.systems.system import own_fields

from .conftest import KINEMATIC, OUTPUTS


@pytest.fixture(scope="module")
def hopper_data(kinematic_ldtp):
    design = hj.multisine(periods=16, band=(0, 4.0))
    return hj.experiments.simulate_experiments(kinematic_ldtp, design, start="periodic")


@pytest.mark.parametrize("name", hj.models.__all__)
def test_systems_print_values_with_units(name):
    system = getattr(hj.models, name)()
    head, *lines = repr(system).splitlines()
    assert head == name and len(lines) <= 16
    for field, line in zip(own_fields(system), lines, strict=True):
        number = f"{float(getattr(system, field.name)):.6g} {field.metadata['unit']}".rstrip()
        assert line.split() == [field.name, *number.split(), *field.metadata["doc"].split()]


def test_many_systems_print_their_number_and_range():
    hoppers = eqx.filter_vmap(lambda k: hj.models.VerticalHopper(k=k))(jnp.linspace(8.0, 13.0, 100))
    text = " ".join(repr(hoppers).split())
    assert "k 100 numbers, 8 to 13 N/m" in text and "M 100 numbers, all 2 kg" in text


def test_prints_under_transformations():
    seen = []

    @jax.jit
    def look(k):
        seen.append(repr(hj.models.VerticalHopper(k=k)))
        seen.append(repr(hj.Settings(rtol=k)))
        seen.append(repr(hj.Guess("stance", (k, 0.0), k)))
        seen.append(repr(hj.ClockPhase(8, anchor=k)))
        return k

    look(1.0)
    assert all("traced float64[" in text for text in seen)


def test_definitions_print_as_they_are_written():
    written = [
        "ClockPhase(n_sections=8, anchor=0.25)",
        "Crossing(function='vM', direction='falling', value=0)",
        "AtEvent(name='touchdown')",
        "Guess(chart='stance', state=(2, 1.9), time=0.5)",
        "Settings(rtol=1e-09, atol=1e-12, max_steps=99)",
        "Scheduled(period=2, offset=0.5)",
    ]
    for text in written:
        assert repr(eval(f"hj.{text}")) == text
    network = eqx.nn.MLP(2, 1, 8, 1, key=jax.random.key(0))

    class Learned(hj.models.VerticalHopper):
        term: eqx.nn.MLP = None

    assert repr(Learned(term=network)).splitlines()[-1].split() == ["term", "MLP(33", "numbers)"]


def test_results_print_briefly(hopper_cycle, placed_kinematic, kinematic_ldtp, hopper_data):
    response = hj.response_function(hopper_cycle, placed_kinematic, OUTPUTS)
    htf = kinematic_ldtp.htf([0.1, 0.2])
    things = [
        hopper_cycle, hopper_cycle.trajectory(), placed_kinematic, kinematic_ldtp, htf,
        hopper_data, KINEMATIC, response, hj.section_map(hopper_cycle, placed_kinematic, 0, 5),
        hj.ObservedHTF(htf, KINEMATIC), hj.ObservedSeries(hopper_data, KINEMATIC),
        hj.ObservedCycle(KINEMATIC, period=1.0), Simulated(np.zeros(3, int)),
    ]  # fmt: skip
    for thing in things:
        text = repr(thing)
        assert text.startswith(type(thing).__name__ + "(") and len(text.splitlines()) <= 12
        assert "f64[" not in text and "array(" not in text
    assert "period       1 s" in repr(hopper_cycle) and "yM = 1.96504037 m, " in repr(hopper_cycle)
    assert "u (N) -> yM (m), vM (m/s)" in repr(hopper_data)
    assert "27 in flight, 5 in stance; dimension 2 to 4" in repr(placed_kinematic)


def test_p_values_have_few_digits():
    given = {4e-11: "p < 0.001", 0.001: "p = 0.001", 0.0314: "p = 0.031", 0.997: "p > 0.99"}
    assert {p: p_value(p) for p in given} == given
