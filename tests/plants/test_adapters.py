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
    return [20 * math.sin(2 * math.pi * data.time), 0.0]


class Environment(gymnasium.Env):
    """The circle, with steps of 0.02 s."""

    observation_space = gymnasium.spaces.Box(-9, 9, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-9, 9, (1,), np.float64)

    def reset(self, seed=None, options=None):
        self.circle = Circle()
        return np.array([*self.circle.reset(seed).values()]), {}

    def step(self, action):
        z = np.array([*self.circle.step(action, 0.02).values()])
        return z, 0.0, bool(np.hypot(*z) > 1.5), False, {}


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


def test_an_fmu_settles_where_the_equations_do_and_runs_in_processes(fmu):
    plant = hj.plants.FMUPlant(fmu, "u", ("x", "v"), dt=0.02)
    cycle = hj.plants.settle(plant, SECTIONS, "x", cycles=8)
    exact = hj.find_limit_cycle(hj.models.VanDerPol(mu=2.0))
    assert (
        abs(cycle.period - exact.period) < 0.2 * plant.dt**2
    )  # (linear interpolation)
    u = 0.05 * np.random.default_rng(0).standard_normal((2, 80, 1))
    data = cycle.run_experiments(u, discard=0, processes=0)
    again = cycle.run_experiments(u, discard=0, processes=1)
    assert np.array_equal(data.y, again.y)
    assert data.ok.all()
    assert np.abs(data.y).max() > 1e-3
    with pytest.raises(hj.DefinitionError, match="whose state can be set"):
        cycle.perturbed_returns()
    with pytest.raises(hj.DefinitionError, match="no real variable 'z'"):
        hj.plants.FMUPlant(fmu, "u", ("z",), dt=0.05)


def test_sections_are_interpolated_between_fixed_steps():
    plant = hj.plants.GymnasiumPlant(Environment, "u", ("x", "y"), dt=0.02)
    cycle = hj.plants.settle(plant, hj.KinematicPhase(8, "x", "y"), "x", cycles=10)
    error = abs(cycle.period - 2 * np.pi)
    assert error < 1e-4
    u = 0.05 * np.random.default_rng(0).standard_normal((1, 80, 1))
    data = cycle.run_experiments(u, discard=0, processes=0)
    exact = hj.plants.settle(Circle(), hj.KinematicPhase(8, "x", "y"), "x", cycles=10)
    true = exact.run_experiments(u, discard=0, processes=0)
    error = np.abs(data.y - true.y).max()
    assert error < 0.05 * np.abs(true.y).max()
    assert data.ok.all()
    assert 0.01 < data.simulated.late.max() <= 0.02 * (1 + 1e-9)
    event = hj.plants.settle(plant, hj.Crossing("y", "rising"), ("x", "y"), cycles=10)
    error = abs(event.period - 2 * np.pi)
    assert error < 1e-4
    assert abs(event.cycle_outputs[0, 1]) < 1e-9
    late = event.run_experiments(0.1 * u[:, :8], discard=0, processes=0).simulated.late
    assert (0 <= late).all()
    assert 0.01 < late.max() <= 0.02
    facts = {"dt": np.pi / 40, "period": 2 * np.pi, "fixed_step": True}
    clock = hj.plants.settle(
        type("", (Circle,), facts)(), hj.ClockPhase(8), "x", cycles=10
    )
    assert clock.run_experiments(u, discard=0, processes=0).simulated.late.max() < 1e-9
    fallen = cycle.run_experiments(np.full((1, 80, 1), 4.0), discard=0, processes=0)
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
    return hj.plants.settle(plant, sections, ("yM", "yM_rate"), cycles=32)


def test_mujoco_continues_from_its_state(ground):
    """On soft ground the paper's hopper settles near its cycle on hard ground."""
    hard = hj.find_limit_cycle(hj.models.VerticalHopper())
    at = hj.place_sections(hard, hj.ClockPhase(10, anchor=0.7))
    error = np.abs(ground.cycle_outputs - np.asarray(at.observe(("yM", "vM")))).max()
    assert error < 0.05
    plant = ground.plant
    start = ground.drive.start
    courses = []
    for _ in range(2):
        plant.set_state(start.state)
        courses.append([plant.step([0.1], h) for h in (0.02, 0.0123, 0.5)])
    assert courses[0] == courses[1]
    assert courses[0][-1].keys() == {"yM", "ym", "yM_rate", "ym_rate"}


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


@pytest.mark.slow
def test_a_walker_in_mujoco():
    """Perturbed returns at clock sections and at the touchdown agree with experiments."""
    plant = walker()
    cycle = hj.plants.settle(plant, hj.ClockPhase(8), ("x_rate", "pitch"), cycles=40)
    returns = cycle.perturbed_returns(coordinates(plant))
    design = hj.multisine(n_sections=8, periods=16, amplitude=0.1, lines="odd")
    data = cycle.run_experiments(design, discard=24)
    fit = hj.fit_multipliers(hj.estimate_htf(data), order=2)
    assert fit.contains(returns.multipliers[:2]).all()
    assert (fit.standard_errors < 1e-3).all()
    assert returns.contains(fit.multipliers).all()
    touchdown = hj.Crossing("left_foot[2]", "falling")
    events = hj.plants.settle(plant, touchdown, ("x_rate", "pitch"), cycles=40)
    there = events.perturbed_returns([*coordinates(plant), "time"]).multipliers[:2]
    error = np.abs(there - returns.multipliers[:2]).max()
    assert error < 2e-3
    falls = cycle.trajectory(u=[[0.0], [0.0], [0.0], [-200.0], *[[0.0]] * 40])
    assert falls.result == hj.Result.PLANT_STOPPED
    assert 1 < falls.t[-1] < 3


@pytest.mark.slow
def test_mujoco_returns_and_htfs_agree(ground):
    """Two multipliers are those of hard ground; soft ground adds a third one, near 0.007."""
    returns = ground.perturbed_returns()
    hard = hj.find_limit_cycle(hj.models.VerticalHopper()).multipliers
    error = np.abs(returns.multipliers[:2] - hard).max()
    assert error < 0.01
    assert 0.002 < returns.multipliers[2].real < 0.02
    assert len(returns.multipliers) == 3
    design = hj.multisine(n_sections=10, periods=16, amplitude=0.02)
    fit = hj.fit_multipliers(hj.estimate_htf(ground.run_experiments(design)), order=2)
    assert fit.contains(returns.multipliers[:2]).all()
    assert returns.contains(fit.multipliers).all()
