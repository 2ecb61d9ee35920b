"""External simulators against models of this package, and against each other."""

import math
import pathlib
import subprocess
import zipfile

import fmpy
import gymnasium
import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj

from .toys import Circle
from .walker import coordinates, walker


HERE = pathlib.Path(__file__).parent
DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="vdp" guid="{vdp}">
  <CoSimulation modelIdentifier="vdp" canHandleVariableCommunicationStepSize="true"
    canGetAndSetFMUstate="true" canSerializeFMUstate="true"/>
  <ModelVariables>
    <ScalarVariable name="x" valueReference="0" causality="output"><Real/></ScalarVariable>
    <ScalarVariable name="v" valueReference="1" causality="output"><Real/></ScalarVariable>
    <ScalarVariable name="u" valueReference="2" causality="input"><Real start="0"/></ScalarVariable>
  </ModelVariables>
  <ModelStructure/>
</fmiModelDescription>"""
SECTIONS = hj.KinematicPhase(8, "x", "v")


def drive(model, data):
    motor = 20 * math.sin(2 * math.pi * data.time)
    return [motor, 0.0]


class Environment(gymnasium.Env):
    """The circle, with steps of 0.02 s."""

    observation_space = gymnasium.spaces.Box(-9, 9, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-9, 9, (1,), np.float64)

    def reset(self, seed=None, options=None):
        self.circle = Circle()
        state = self.circle.reset(seed).values()
        return np.array([*state]), {}

    def step(self, action):
        state = self.circle.step(action, 0.02).values()
        z = np.array([*state])
        has_fallen = bool(np.hypot(*z) > 1.5)
        return z, 0.0, has_fallen, False, {}


@pytest.fixture(scope="module")
def fmu(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fmu")
    headers = pathlib.Path(fmpy.__file__).parent / "c-code"
    library = folder / f"vdp{fmpy.sharedLibraryExtension}"
    command = [
        "cc",
        "-O2",
        "-shared",
        "-fPIC",
        f"-I{headers}",
        str(HERE / "vanderpol.c"),
    ]
    subprocess.run([*command, "-o", str(library)], check=True)
    with zipfile.ZipFile(folder / "vdp.fmu", "w") as archive:
        archive.writestr("modelDescription.xml", DESCRIPTION)
        archive.write(library, f"binaries/{fmpy.platform}/{library.name}")
    return folder / "vdp.fmu"


@pytest.mark.slow
def test_an_fmu_settles_where_the_equations_do_and_runs_in_processes(fmu):
    plant = hj.plants.FMUPlant(fmu, "u", ("x", "v"), dt=0.02)
    cycle = hj.plants.find_cycle(plant, SECTIONS, "x", cycles=8)
    exact = hj.find_limit_cycle(hj.models.VanDerPol(mu=2.0))
    assert (
        abs(cycle.period - exact.period) < 0.2 * plant.dt**2
    )  # (linear interpolation)
    rng = np.random.default_rng(0)
    u = 0.05 * rng.standard_normal((2, 80, 1))
    data = cycle.run_experiments(u, discard=0, processes=0)
    again = cycle.run_experiments(u, discard=0, processes=1)
    assert np.array_equal(data.y, again.y)
    assert data.ok.all()
    assert np.abs(data.y).max() > 1e-3
    with pytest.raises(hj.errors.DefinitionError, match="whose state can be set"):
        cycle.perturbed_returns()
    with pytest.raises(hj.errors.DefinitionError, match="no real variable 'z'"):
        hj.plants.FMUPlant(fmu, "u", ("z",), dt=0.05)


@pytest.fixture(scope="module")
def gymnasium_circle():
    return hj.plants.GymnasiumPlant(Environment, "u", ("x", "y"), dt=0.02)


def test_sections_are_interpolated_between_fixed_steps(gymnasium_circle):
    sections = hj.KinematicPhase(8, "x", "y")
    cycle = hj.plants.find_cycle(gymnasium_circle, sections, "x", cycles=10)
    assert_allclose(cycle.period, 2 * np.pi, rtol=0, atol=1e-4)
    rng = np.random.default_rng(0)
    u = 0.05 * rng.standard_normal((1, 80, 1))
    data = cycle.run_experiments(u, discard=0, processes=0)
    assert data.ok.all()
    latest = data.simulated.late.max()
    assert 0.01 < latest <= 0.02 * (1 + 1e-9)
    exact_cycle = hj.plants.find_cycle(Circle(), sections, "x", cycles=10)
    exact = exact_cycle.run_experiments(u, discard=0, processes=0)
    tolerance = 0.05 * np.abs(exact.y).max()
    assert_allclose(data.y, exact.y, rtol=0, atol=tolerance)

    push = np.full((1, 80, 1), 4.0)
    fallen = cycle.run_experiments(push, discard=0, processes=0)
    assert "terminated" in fallen.summary()


@pytest.fixture(scope="module")
def ground():
    plant = hj.plants.MuJoCoPlant(
        mujoco.MjModel.from_xml_path(str(HERE / "hopper.xml")),
        {"push": "N"},
        control=drive,
        period=1.0,
        substeps=20,
    )
    sections = hj.ClockPhase(10, anchor=0.7)
    return hj.plants.find_cycle(plant, sections, ("yM", "yM_rate"), cycles=32)


def test_mujoco_continues_from_its_state(ground):
    """On soft ground the paper's hopper settles near its cycle on hard ground."""
    hard = hj.find_limit_cycle(hj.models.VerticalHopper())
    at = hj.sections.place_sections(hard, hj.ClockPhase(10, anchor=0.7))
    observed = np.asarray(at.observe(("yM", "vM")))
    error = np.abs(ground.cycle_outputs - observed).max()
    assert error < 0.05
    plant = ground.plant
    start = ground.drive.start
    courses = []
    for _ in range(2):
        plant.set_state(start.state)
        durations = (0.02, 0.0123, 0.5)
        courses.append([plant.step([0.1], h) for h in durations])
    assert courses[0] == courses[1]
    last = courses[0][-1]
    assert last.keys() == {"yM", "ym", "yM_rate", "ym_rate"}


def test_a_controller_may_keep_memory_in_userdata():
    xml = (
        (HERE / "hopper.xml")
        .read_text()
        .replace("<worldbody>", '<size nuserdata="1"/><worldbody>')
    )

    def remember(model, data):
        data.userdata[0] += 1
        return [data.userdata[0] % 7, 0.0]

    plant = hj.plants.MuJoCoPlant(
        mujoco.MjModel.from_xml_string(xml), "push", control=remember
    )
    plant.reset(0)
    plant.step([0.0], 0.0015)
    state = plant.get_state()
    first = plant.step([0.0], 0.01)
    plant.set_state(state)
    assert plant.step([0.0], 0.01) == first
    assert plant.data.userdata[0] == 23


def test_an_event_is_interpolated_between_fixed_steps(gymnasium_circle):
    section = hj.Crossing("y", "rising")
    cycle = hj.plants.find_cycle(gymnasium_circle, section, ("x", "y"), cycles=10)
    assert_allclose(cycle.period, 2 * np.pi, rtol=0, atol=1e-4)
    assert abs(cycle.cycle_outputs[0, 1]) < 1e-9
    rng = np.random.default_rng(0)
    u = 0.005 * rng.standard_normal((1, 8, 1))
    late = cycle.run_experiments(u, discard=0, processes=0).simulated.late
    assert late.min() >= 0
    assert 0.01 < late.max() <= 0.02


class SteppedCircle(Circle):
    """Whose fixed steps end at the sections of a clock."""

    dt = np.pi / 40
    period = 2 * np.pi
    fixed_step = True


def test_no_section_of_a_clock_is_late_where_steps_end():
    cycle = hj.plants.find_cycle(SteppedCircle(), hj.ClockPhase(8), "x", cycles=10)
    rng = np.random.default_rng(0)
    u = 0.05 * rng.standard_normal((1, 80, 1))
    data = cycle.run_experiments(u, discard=0, processes=0)
    assert data.simulated.late.max() < 1e-9


@pytest.mark.slow
def test_a_walker_in_mujoco():
    """Perturbed returns at clock sections and at the touchdown agree with experiments."""
    plant = walker()
    outputs = ("x_rate", "pitch")
    sections = hj.ClockPhase(8)
    cycle = hj.plants.find_cycle(plant, sections, outputs, cycles=40)
    returns = cycle.perturbed_returns(coordinates(plant))
    design = hj.multisine(
        n_sections=8,
        periods=16,
        amplitude=0.1,
        lines="odd",
    )
    data = cycle.run_experiments(design, discard=24)
    fit = hj.fit_multipliers(hj.estimate_htf(data), order=2)
    assert fit.contains(returns.multipliers[:2]).all()
    assert (fit.standard_errors < 1e-3).all()
    assert returns.contains(fit.multipliers).all()

    touchdown = hj.Crossing("left_foot[2]", "falling")
    at_touchdown = hj.plants.find_cycle(plant, touchdown, outputs, cycles=40)
    with_time = [*coordinates(plant), "time"]
    there = at_touchdown.perturbed_returns(with_time).multipliers
    difference = there[:2] - returns.multipliers[:2]
    error = np.abs(difference)
    assert error.max() < 2e-3

    push = np.zeros((44, 1))
    push[3] = -200.0
    falls = cycle.trajectory(u=push)
    assert falls.result == hj.errors.Result.PLANT_STOPPED
    assert 1 < falls.t[-1] < 3


@pytest.mark.slow
def test_mujoco_returns_and_htfs_agree(ground):
    """Two multipliers are those of hard ground; soft ground adds a third one, near 0.007."""
    returns = ground.perturbed_returns()
    hard = hj.find_limit_cycle(hj.models.VerticalHopper()).multipliers
    leading = returns.multipliers[:2]
    error = np.abs(leading - hard).max()
    assert error < 0.01
    assert 0.002 < returns.multipliers[2].real < 0.02
    assert len(returns.multipliers) == 3
    design = hj.multisine(n_sections=10, periods=16, amplitude=0.02)
    measured = hj.estimate_htf(ground.run_experiments(design))
    fit = hj.fit_multipliers(measured, order=2)
    assert fit.contains(returns.multipliers[:2]).all()
    assert returns.contains(fit.multipliers).all()
