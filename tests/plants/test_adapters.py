"""Simulators of others against models of this package, and against each other."""

import math
import pathlib
import subprocess
import zipfile

import fmpy
import gymnasium
import numpy as np
import pytest

import hybridjax as hj


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
SECTIONS = hj.KinematicPhase(8, "x", "v", anchor=hj.Crossing("v", "falling"))


def drive(model, data):
    return [20 * math.sin(2 * math.pi * data.time), 0.0]


class VanDerPol(gymnasium.Env):
    """The same oscillator, with fixed steps."""

    observation_space = gymnasium.spaces.Box(-9, 9, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-9, 9, (1,), np.float64)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.q = np.array([0.1, 0.0])
        return self.q, {}

    def step(self, action):
        f = lambda q: np.array([q[1], 2 * (1 - q[0] ** 2) * q[1] - q[0] + action[0]])  # noqa: E731
        h, q = 0.02, self.q
        a = f(q)
        b = f(q + h / 2 * a)
        c = f(q + h / 2 * b)
        self.q = q + h / 6 * (a + 2 * b + 2 * c + f(q + h * c))
        return self.q, 0.0, bool(abs(self.q[0]) > 2.5), False, {}


@pytest.fixture(scope="module")
def fmu(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fmu")
    headers = pathlib.Path(fmpy.__file__).parent / "c-code"
    library = folder / f"vdp{fmpy.sharedLibraryExtension}"
    command = ["cc", "-O2", "-shared", "-fPIC", f"-I{headers}", str(HERE / "vanderpol.c")]
    subprocess.run([*command, "-o", str(library)], check=True)
    with zipfile.ZipFile(folder / "vdp.fmu", "w") as archive:
        archive.writestr("modelDescription.xml", DESCRIPTION)
        archive.write(library, f"binaries/{fmpy.platform}/{library.name}")
    return folder / "vdp.fmu"


@pytest.fixture(scope="module")
def truth():
    """Period and response of scipy's integration, by events."""
    from scipy.integrate import solve_ivp

    def f(t, q, u):
        return [q[1], 2 * (1 - q[0] ** 2) * q[1] - q[0] + u]

    def falling(t, q, u):
        return q[1]

    falling.direction = -1
    out = solve_ivp(
        f, (0, 200), [2, 0], "DOP853", args=(0,), events=falling, rtol=1e-11, atol=1e-11
    )
    times = out.t_events[0]
    return float(np.diff(times)[-10:].mean()), float(out.y_events[0][-1][0])


def test_an_fmu_settles_where_scipy_does_and_runs_in_processes(fmu, truth):
    plant = hj.plants.from_fmu(fmu, "u", ("x", "v"), dt=0.05)
    cycle = hj.plants.settle(plant, SECTIONS, "x", cycles=20)
    assert abs(cycle.period - truth[0]) < 1e-8
    assert abs(cycle.cycle_outputs[0, 0] - truth[1]) < 1e-8
    u = 0.05 * np.random.default_rng(0).standard_normal((3, 80, 1))
    data = cycle.run_experiments(u, discard=0, processes=0)
    again = cycle.run_experiments(u, discard=0, processes=1)
    assert np.array_equal(data.y, again.y) and data.ok.all() and np.abs(data.y).max() > 1e-3
    with pytest.raises(hj.DefinitionError, match="numbers that can be changed"):
        cycle.perturbed_returns()
    with pytest.raises(hj.DefinitionError, match="no real variable 'z'"):
        hj.plants.from_fmu(fmu, "u", ("z",), dt=0.05)

    # The same oscillator as an environment with fixed steps: sections are interpolated.
    def make():
        return VanDerPol()

    other = hj.plants.from_gymnasium(make, "u", ("x", "v"), dt=0.02)
    gym = hj.plants.settle(other, SECTIONS, "x", cycles=10)
    assert abs(gym.period - truth[0]) < 1e-3 and 0 < gym.late <= 0.02 * (1 + 1e-9)
    fixed = gym.run_experiments(u[:1], discard=0, processes=0)
    late = fixed.simulated.late
    assert 0 < late.max() <= 0.02 * (1 + 1e-9)
    assert np.abs(fixed.y - data.y[:1]).max() < 0.05 * np.abs(data.y).max()
    fallen = gym.run_experiments(np.full((1, 80, 1), 4.0), discard=0, processes=0)
    assert "terminated" in fallen.summary()


@pytest.fixture(scope="module")
def ground():
    plant = hj.plants.from_mujoco(
        HERE / "hopper.xml", {"push": "N"}, control=drive, period=1.0, substeps=20
    )
    sections = hj.ClockPhase(10, anchor=0.7)
    return hj.plants.settle(plant, sections, ("yM", "yM_rate"), cycles=32)


def test_mujoco_continues_from_its_state(ground):
    """On soft ground the paper's hopper settles near its cycle on hard ground."""
    hard = hj.find_limit_cycle(hj.models.VerticalHopper())
    at = hj.place_sections(hard, hj.ClockPhase(10, anchor=0.7))
    true = np.asarray(at.observe(("yM", "vM")))
    assert np.abs(ground.cycle_outputs - true).max() < 0.05
    plant = ground.plant
    start = ground.experiment.start
    courses = []
    for _ in range(2):
        plant.set_state(start.state)
        courses.append([plant.step([0.1], h) for h in (0.02, 0.0123, 0.5)])
    assert courses[0] == courses[1]
    assert courses[0][-1].keys() == {"yM", "ym", "yM_rate", "ym_rate"}


@pytest.mark.slow
def test_mujoco_returns_and_htfs_agree(ground):
    """Two multipliers are those of hard ground; soft ground adds a third one, near 0.007."""
    returns = ground.perturbed_returns()
    hard = hj.find_limit_cycle(hj.models.VerticalHopper()).multipliers
    assert np.abs(returns.multipliers[:2] - hard).max() < 0.01
    assert 0.002 < returns.multipliers[2].real < 0.02 and len(returns.multipliers) == 3
    design = hj.multisine(n_sections=10, periods=16, amplitude=0.02)
    fit = hj.fit_multipliers(hj.estimate_htf(ground.run_experiments(design)), order=2)
    assert fit.contains(returns.multipliers[:2]).all()
    assert returns.contains(fit.multipliers).all()
