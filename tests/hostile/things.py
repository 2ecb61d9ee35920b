"""Objects of every public kind, each made once, on first use: good arguments for the table."""

import dataclasses

import matplotlib
import numpy as np

import hybridjax as hj
from hybridjax.orbits.branches import Branch, BranchEnd

from ..toys import many


NAMES = ("x", "y")
TIME = np.linspace(0.0, 60.0, 2401)
APEX = hj.Crossing("y", "falling")
RISES = hj.Crossing("x", "rising")
PHASE = hj.KinematicPhase(4, position="x", velocity="y", anchor=APEX)
CURVE = hj.designs.MultiplierGoal(harmonics=0, extra_lags=6)
GOAL = hj.designs.MultiplierGoal(harmonics=0)


def repeated(t):
    u = np.concatenate([t.data.u, t.data.u], axis=1)
    y = np.concatenate([t.data.y, t.data.y], axis=1)
    return hj.experiments.ExperimentData(
        u, y, n_sections=6, periods=16, result=t.data.result
    )


def record(t):
    u = np.random.default_rng(0).normal(size=(300, 2))
    y = np.asarray(t.model.simulate(u))
    rng = np.random.default_rng(1)
    return hj.experiments.SectionSeries(
        u, y + 1e-3 * rng.normal(size=y.shape), n_sections=6
    )


def run(t, u):
    y = np.stack([t.model.simulate(x) for x in u])
    draws = np.random.default_rng(2).normal(size=y.shape)
    noise = 1e-3 * draws
    return hj.experiments.ExperimentData(u, y + noise, n_sections=6, periods=16)


def recording(t):
    """Sixty turns that a force disturbs a little, by the law of an oscillator."""
    z = [1.0 + 0j]
    rng = np.random.default_rng(0)
    draws = rng.normal(size=121)
    force = draws.repeat(20)[: len(TIME)]
    for f in force[:-1]:
        z.append(
            z[-1] * np.exp(2j * np.pi * TIME[1] + 0.01 * (1 - abs(z[-1]) ** 2))
            + 0.004 * f
        )
    signals = {"f": force, "x": np.real(z), "v": np.imag(z)}
    return hj.Recording(TIME, signals, units={"f": "N"}).mark("strike", RISES)


def section_data(t, inputs, **options):
    about = dict(inputs=inputs, outputs=("x", "v"), n_sections=2)
    return hj.recordings.sample_sections(t.recording, t.phase, **about, **options)


def branch(t):
    ends = [
        BranchEnd(mu, hj.errors.Result.OK, "end of the parameter range")
        for mu in (0.1, 0.2)
    ]
    values = np.array([0.1, 0.2])
    return Branch("mu", values, t.cycles, (), tuple(ends))


def plot(t):
    matplotlib.use("agg")
    return hj.plot.multipliers(np.array([0.5]))


def population(t):
    table = {
        "subject": list("abcdef"),
        "group": ["old", "new"] * 3,
        "strides": [50.0] * 6,
    }
    moduli = np.array([0.5, 0.6, 0.55, 0.7, 0.52, 0.63])
    values = {"m": moduli}
    errors = np.full(6, 0.01)
    return hj.recordings.Population(table, values, {"m": errors})


def maps(t):
    values = np.random.default_rng(0).normal(size=(6, 5))
    return hj.recordings.PopulationMaps(
        t.population.table, values, {"lag": np.arange(5.0)}
    )


class Turning:
    """A plant that turns by the angle 2 pi t, and is pushed."""

    def reset(self, seed):
        self.state = np.array([0.0, 1.0])
        return self.signals()

    def step(self, u, duration):
        t, x = self.state
        self.state = np.array(
            [t + duration, 1 + (x - 1 + u[0] * duration) * np.exp(-duration)]
        )
        return self.signals()

    def signals(self):
        t, x = self.state
        angle = 2 * np.pi * t
        height = x * np.cos(angle)
        speed = -x * np.sin(angle)
        return {"x": height, "v": speed}

    def get_state(self):
        return self.state

    def set_state(self, x):
        self.state = np.asarray(x)


def plant(t):
    plant = Turning()
    plant.inputs = ("u",)
    plant.period = 1.0
    plant.dt = 0.25
    return plant


MAKE = {
    "population": population,
    "maps": maps,
    "plant": plant,
    "settled": lambda t: hj.plants.find_cycle(t.plant, hj.ClockPhase(4), ("x", "v")),
    "system": lambda t: hj.models.HopfOscillator(),
    "cycle": lambda t: hj.find_limit_cycle(t.system),
    "cycles": lambda t: many(t.cycle, 2),
    "branch": branch,
    "placed": lambda t: hj.sections.place_sections(t.cycle, PHASE),
    "map": lambda t: hj.sections.section_map(t.cycle, t.placed, 0, 1),
    "response": lambda t: hj.experiments.response_function(t.cycle, t.placed, NAMES),
    "trajectory": lambda t: t.cycle.trajectory(),
    "model": lambda t: hj.testing.synthetic_ldtp(),
    "design": lambda t: hj.multisine(6, 16, frequencies=(0, 3.0), inputs=2),
    "one_input": lambda t: hj.multisine(4, 16, frequencies=(0, 2.0)),
    "data": lambda t: hj.experiments.simulate_experiments(
        t.model, t.design, start="periodic"
    ),
    "repeated": repeated,
    "estimate": lambda t: hj.estimate_htf(t.data, (-1, 0, 1)),
    "uncertain": lambda t: dataclasses.replace(
        t.estimate, variance=np.full(t.estimate.H.shape, 1e-6)
    ),
    "exact": lambda t: t.model.htf(t.estimate.frequencies, (-1, 0, 1)),
    "rational": lambda t: hj.identify.fit_rational(
        t.estimate, output=0, poles=1, zeros=1
    ),
    "structured": lambda t: hj.fit_multipliers(t.estimate, 2, extra_lags=6),
    "plan": lambda t: hj.optimal_design(t.model, t.design, goal=CURVE),
    "decaying": lambda t: hj.linear.LDTP(
        np.full((4, 1, 1), 0.9), np.ones((4, 1, 1)), np.ones((4, 1, 1))
    ),
    "block": lambda t: hj.experiments.add_noise(
        hj.experiments.simulate_experiments(t.decaying, t.one_input, start="periodic"),
        snr=30,
    ),
    "study": lambda t: hj.designs.SequentialDesign(
        t.one_input, order=1, standard_error=1e-9, goal=GOAL
    ),
    "studied": lambda t: t.study.add(t.block),
    "joint": lambda t: hj.fit_ldtp(t.uncertain, initial=t.model),
    "record": record,
    "driven": lambda t: hj.fit_ldtp(t.record, initial=t.model, noise="innovations"),
    "fit": lambda t: hj.fit_series(t.record, 2),
    "validation": lambda t: hj.validate(t.fit, t.record),
    "run": lambda t: lambda u: run(t, u),
    "recording": recording,
    "phase": lambda t: hj.recordings.estimate_phase(t.recording, RISES),
    "section_data": lambda t: section_data(t, "f", timing="clock"),
    "variability": lambda t: section_data(t, ()),
    "beats": lambda t: hj.recordings.phase_response(
        t.recording, hj.AtEvent("strike"), input="f"
    ),
    "found": lambda t: hj.identify_recording(
        t.recording, t.phase, inputs="f", outputs=("x",), order=1, n_sections=2
    ),
    "found_without_push": lambda t: hj.identify_recording(
        t.recording, t.phase, outputs=("x",), order=1, n_sections=2
    ),
    "htf": lambda t: hj.linearize(t.cycle, PHASE, NAMES).htf([0.1, 0.2], (0,)),
    "series": lambda t: hj.experiments.simulate_experiments(
        hj.linearize(t.cycle, PHASE, NAMES), t.one_input
    ),
    "observed": lambda t: hj.fitting.ObservedCycle.of(t.cycle, PHASE, NAMES),
    "plot": plot,
}


class Things:
    """`things.fit` is a `SeriesFit`, and so on: what a name here stands for is computed once."""

    def __getattr__(self, name):
        value = MAKE[name](self)
        setattr(self, name, value)
        return value
