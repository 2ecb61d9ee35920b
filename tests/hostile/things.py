"""Objects of every public kind, each made once, on first use: good arguments for the table."""

import functools as ft
import pathlib

import jax.numpy as jnp
import matplotlib
import numpy as np

import hybridjax as hj
from hybridjax.systems.structure import Structure


NAMES = ("x", "y")
TIME = np.linspace(0.0, 60.0, 2401)
APEX = hj.Crossing("y", "falling")
PHASE = hj.KinematicPhase(4, position="x", velocity="y", anchor=APEX)


class Things:
    """`things.fit` is a `SeriesFit`, and so on: what a name here stands for is computed once."""

    @ft.cached_property
    def system(self):
        return hj.models.HopfOscillator()

    @ft.cached_property
    def cycle(self):
        return hj.find_limit_cycle(self.system)

    @ft.cached_property
    def cycles(self):
        return hj.find_limit_cycles([self.system, hj.models.HopfOscillator(mu=0.2)], self.cycle)

    @ft.cached_property
    def branch(self):
        return hj.continuation(self.cycle, "mu", (0.1, 0.11), step=0.5)

    @ft.cached_property
    def placed(self):
        return hj.place_sections(self.cycle, PHASE)

    @ft.cached_property
    def map(self):
        return hj.section_map(self.cycle, self.placed, 0, 1)

    @ft.cached_property
    def response(self):
        return hj.response_function(self.cycle, self.placed, NAMES)

    @ft.cached_property
    def trajectory(self):
        return self.cycle.trajectory()

    @ft.cached_property
    def structure(self):
        return Structure(self.system)

    @ft.cached_property
    def model(self):
        return hj.testing.synthetic_ldtp()

    @ft.cached_property
    def design(self):
        return hj.multisine(6, 16, band=(0, 3.0), inputs=2)

    @ft.cached_property
    def one_input(self):
        return hj.multisine(4, 16, band=(0, 2.0))

    @ft.cached_property
    def data(self):
        return hj.experiments.simulate_experiments(self.model, self.design, start="periodic")

    @ft.cached_property
    def repeated(self):
        u, y = (np.concatenate([x, x], axis=1) for x in (self.data.u, self.data.y))
        return hj.ExperimentData(u, y, n_sections=6, periods=16, result=self.data.result)

    @ft.cached_property
    def estimate(self):
        return hj.estimate_htf(self.data, (-1, 0, 1))

    @ft.cached_property
    def uncertain(self):
        e = self.estimate
        return hj.HTF(e.f, e.H, e.harmonics, 6, variance=np.full(e.H.shape, 1e-6))

    @ft.cached_property
    def exact(self):
        return self.model.htf(self.estimate.f, (-1, 0, 1))

    @ft.cached_property
    def rational(self):
        return hj.fit_rational(self.estimate, output=0, poles=1, zeros=1)

    @ft.cached_property
    def structured(self):
        return hj.fit_multipliers(self.estimate, 2, overhang=6)

    @ft.cached_property
    def plan(self):
        goal = hj.designs.Multipliers(harmonics=0, overhang=6)
        return hj.optimal_design(self.model, self.design, goal=goal)

    @ft.cached_property
    def decaying(self):
        return hj.LDTP(np.full((4, 1, 1), 0.9), np.ones((4, 1, 1)), np.ones((4, 1, 1)))

    @ft.cached_property
    def block(self):
        data = hj.experiments.simulate_experiments(self.decaying, self.one_input, start="periodic")
        return hj.experiments.add_noise(data, snr=30)

    @ft.cached_property
    def study(self):
        goal = hj.designs.Multipliers(harmonics=0)
        return hj.designs.Study(self.one_input, order=1, standard_error=1e-9, goal=goal)

    @ft.cached_property
    def studied(self):
        return self.study.add(self.block)

    @ft.cached_property
    def information(self):
        goal = hj.designs.Multipliers(harmonics=0)
        return hj.designs.information_map(
            self.decaying, self.one_input, noise={"y": 1.0}, goal=goal
        )

    @ft.cached_property
    def joint(self):
        return hj.fit_ldtp(self.uncertain, self.model)

    @ft.cached_property
    def record(self):
        u = np.random.default_rng(0).normal(size=(300, 2))
        y = np.asarray(self.model.simulate(u))
        return hj.Record(u, y + 1e-3 * np.random.default_rng(1).normal(size=y.shape), n_sections=6)

    @ft.cached_property
    def driven(self):
        return hj.fit_ldtp(self.record, self.model, noise="innovations")

    @ft.cached_property
    def fit(self):
        return hj.fit_series(self.record, 2)

    @ft.cached_property
    def validation(self):
        return hj.validate(self.fit, self.record)

    @ft.cached_property
    def sweep(self):
        return hj.identify.amplitude_sweep(self.run, self.model, self.data.u, [1.0, 2.0])

    def run(self, u):
        y = np.stack([self.model.simulate(one) for one in u])
        noise = 1e-3 * np.random.default_rng(2).normal(size=y.shape)
        return hj.ExperimentData(u, y + noise, n_sections=6, periods=16)

    @ft.cached_property
    def recording(self):
        """Sixty turns that a force disturbs a little, by the law of an oscillator."""
        rng, z, seen = np.random.default_rng(0), 1.0 + 0j, []
        force = rng.normal(size=len(TIME))
        for f in force:
            seen.append(z)
            z = z * np.exp(2j * np.pi * TIME[1] + 0.01 * (1 - abs(z) ** 2)) + 0.002 * f
        seen = np.array(seen)
        signals = {"f": force, "x": seen.real, "v": seen.imag}
        made = hj.Recording(TIME, signals, units={"f": "N"})
        return made.mark("strike", hj.Crossing("x", "rising"))

    @ft.cached_property
    def phase(self):
        return hj.recordings.estimate_phase(self.recording, hj.Crossing("x", "rising"))

    @ft.cached_property
    def section_data(self):
        return hj.recordings.section_data(
            self.recording, self.phase, inputs="f", outputs=("x", "v"), n_sections=2, timing="clock"
        )

    @ft.cached_property
    def variability(self):
        return hj.recordings.section_data(
            self.recording, self.phase, inputs=(), outputs=("x", "v"), n_sections=2
        )

    @ft.cached_property
    def beats(self):
        return hj.recordings.phase_response(self.recording, hj.AtEvent("strike"), input="f")

    @ft.cached_property
    def found(self):
        return hj.identify_recording(
            self.recording, self.phase, inputs="f", outputs=("x",), order=1, n_sections=2
        )

    @ft.cached_property
    def htf(self):
        return hj.linearize(self.cycle, PHASE, NAMES).htf([0.1, 0.2], (0,))

    @ft.cached_property
    def series(self):
        return hj.run_experiments(self.cycle, PHASE, self.one_input, NAMES)

    @ft.cached_property
    def observed(self):
        return hj.ObservedCycle.of(self.cycle, PHASE, NAMES)

    @ft.cached_property
    def free(self):
        return ("mu",)

    @ft.cached_property
    def model_fit(self):
        return hj.fit_model(self.system, self.observed, ("mu",), guess=self.cycle)

    @ft.cached_property
    def plot(self):
        matplotlib.use("agg")
        return hj.plot.multipliers(np.array([0.5]))

    @ft.cached_property
    def folder(self):
        return pathlib.Path("empty")

    @ft.cached_property
    def point(self):
        return jnp.zeros(2)


THINGS = Things()
