"""Calls that someone who knows the field tries first: they run, or the error leads on in one line.
Results do what every result does."""

import importlib
import inspect
import pathlib
import re
import types

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats

import hybridjax as hj
from hybridjax._core.boundary import leads
from hybridjax._core.boundary.guesses.attributes import ATTRIBUTES
from hybridjax._core.boundary.guesses.functions import CALLED, IN_NAMESPACES, NAMES
from hybridjax._core.boundary.guesses.keywords import KEYWORDS, NEEDS
from hybridjax._core.boundary.guesses.objects import MAKERS, OBJECTS, STEPS
from hybridjax._core.boundary.guesses.synonyms import ALIKE, WORDS
from hybridjax._core.showable import Showable, WithMultipliers
from hybridjax._core.spelling import plain
from hybridjax.identify.multiplier_estimate import OfFit

from .conftest import APEX, OUTPUTS
from .test_names import all_members


@pytest.fixture(scope="module")
def names():
    """What guesses are about: one hopper with its cycle, data and fits."""
    hopper = hj.models.VerticalHopper()
    cycle = hj.find_limit_cycle(hopper)
    sections = hj.ClockPhase(8, anchor=APEX)
    model = hj.linearize(cycle, sections, OUTPUTS)
    design = hj.multisine(8, periods=16, lines="odd", amplitude=1e-3).realizations(4)
    clean = hj.run_experiments(cycle, sections, design, OUTPUTS, start="periodic")
    data = hj.experiments.add_noise(clean, std=1e-5)
    est = hj.estimate_htf(data, harmonics=(-1, 0, 1))
    whole = hj.estimate_htf(data)
    rng = np.random.default_rng(0)
    force = rng.normal(size=(1, 3000, 1))
    made = hj.testing.simulate_recording(cycle, 0.01 * force, OUTPUTS, rate=50)
    known = dict(
        hj=hj, np=np, hopper=hopper, cycle=cycle, apex=APEX, est=est, data=data
    )
    known |= dict(
        sections=sections,
        model=model,
        design=design,
        whole=whole,
        rec=made,
    )
    known |= dict(
        fit=hj.fit_multipliers(est, order=2),
        ser=hj.fit_series(data, order=2),
        ldtp=hj.fit_ldtp(whole, model.dims),
        phys=hj.fit_model(
            hopper, hj.fitting.ObservedHTF(whole, sections), free=("k", "b")
        ),
        rat=hj.identify.fit_rational(est),
        traj=hj.simulate(hopper, "flight", (2.0, 0.0, 1.0, 0.0), 1.0),
        result=hj.identify_recording(made, APEX, "u", OUTPUTS, n_sections=8, order=2),
    )
    return known


RUN = """
hj.simulate(hopper, hopper.guess(), 0.5)
hopper.replace(k=9.0)
cycle.is_stable
cycle.modulus
cycle.findings
cycle.plot()
cycle.to_pandas()
model.is_stable
model.simulate(np.zeros(16))
model.plot()
model.to_pandas()
hj.run_experiments(cycle, sections, np.zeros((1, 8, 1)), discard=0)["ym"]
design.plot()
data.plot()
data.to_pandas()
data["yM"]
len(data)
est.plot(outputs="yM")
hj.plot.bode([est, model.htf(est.frequencies)])
est.plot().save("bode.pdf")
est.standard_errors
est["yM"].plot()
abs(est["yM"].H)
est["yM"][0]
est.select(0, outputs="yM", inputs="u")
est.magnitude
est.phase
traj.plot()
traj.to_pandas()
rec["yM"]
rec.plot()
rec.rate
rec.duration
rec.crop(10, 50).duration
rec.time
len(rec)
fit.contains(cycle)
fit.compare(ser).p_value
hj.validate(fit, data).residuals
hj.validate(phys, data).plot()
hj.select_order(est).plot()
hj.optimal_design(model, noise=1e-4).plot()
hj.identify_recording(rec, apex, "u", "yM", n_sections=8, order=2)
phys.compare({"k": 10.0, "b": 5.0})
phys.compare(cycle)
phys.contains(hopper)
phys.identifiability.plot()
rat.modulus
hj.linearize(cycle, [apex]).multipliers
hj.linearize(cycle, 32).multipliers
hj.run_experiments(cycle, 8, design)
hj.sections.place_sections(cycle, 8)
hj.run_experiments(cycle, sections, hj.optimal_design(model, noise=1e-4), discard=0)
hj.fit_multipliers(est, hj.select_order(est))
hj.fit_series(result, 2)
hj.select_order(result)
hj.validate(result, result.data)
hj.validate(result, data)
fit.compare(result).p_value
hj.plot.multipliers(result)
hj.plot.multipliers(cycle, fit)
hj.plot.multipliers(cycle, result)
hj.plot.bode(model)
hj.plot.htf([model, model])
hj.plot.bode(result)
hj.plot.bode([model, result])
hj.plot.bode({"exact": model, "fit": result})
hj.plot.bode(est, fit)
hj.plot.bode(ser)
hj.plot.bode(ldtp)
hj.plot.htf(result)
hj.experiments.add_noise(data, 1e-5)
cycle.simultaneous_events()
repr(hj.explore(hopper, "k"))
hj.find_limit_cycle(hopper, (2.0, 0.0, 1.0, 0.0))
hj.simulate(lambda t, y: [y[1], -y[0]], [1.0, 0.0], 6.28)
traj.at(0.5)
hj.find_limit_cycle(hopper, {"yM": 2.0, "vM": 0.0, "ym": 1.0, "vm": 0.0})
hj.simulate(hopper, [2.0, 0.0, 1.0, 0.0], 0.5)
hj.simulate(hj.models.VanDerPol(), {"x": 2.0, "v": 0.0}, 1.0)
hj.simulate(hopper, duration=0.5)
hj.flow(hopper, cycle, 0.5)["yM"]
hj.sweep(hopper, k=10.0)
hj.continuation(cycle, k=(9.99, 10.01))
hj.continuation(cycle, k=(9.99, 10.01)).bifurcations
hj.linearize(cycle, "touchdown").multipliers
hj.identify_recording(rec.to_pandas(), apex, "u", "yM", n_sections=8, order=2)
hj.Recording(rec.to_pandas())
hj.Recording({"time": rec.time, "u": rec["u"]})
result.interval()
result.standard_errors
result.contains(cycle)
result.compare(fit).p_value
hj.recordings.Population.from_fits({"a": result, "b": result})
hj.recordings.check_recording(rec)
"""

LEAD = """
hj.solve_ivp(hopper, (0, 1), (2.0, 0.0))                -> hj.simulate
hj.floquet_multipliers(cycle)                           -> .multipliers
hj.bode(est)                                            -> hj.plot.bode
hj.plot(est)                                            -> result.plot()
hj.identify(data)                                       -> hj.fit_series
hj.find_limit_cycle(cycle)                              -> its `system`
hj.find_limit_cycle(hopper, y0=(1.0,))                  -> `guess`
hj.find_limit_cycle(hopper, rtol=1e-9)                  -> Settings
hj.find_limit_cycle(hopper, k=9.0)                      -> system.replace(k=
hj.simulate(hopper, t_span=(0, 2))                      -> `duration`
hj.simulate(hopper, hopper.guess(), 1.0, t_eval=[0.1])  -> trajectory.at
hj.linearize(hopper, sections)                          -> hj.find_limit_cycle(system)
hj.linearize(cycle, 32.5)                               -> hj.ClockPhase
hj.continuation(cycle, "stiffness", (8, 12))            -> use `k`
hj.sweep(hopper, {"stifness": [8.0]})                   -> use `k`
hj.linearize(cycle, sections, outputs=("YM",))          -> use 'yM'
rec["yn"]                                               -> signals are u, yM, vM
rec["Vm"]                                               -> use 'vM'
cycle.trajectory("yM")                                  -> cycle.trajectory()('yM')
fit.contains(0.5, level=5)                              -> 5 % is 0.05
fit.interval(95)                                        -> 95 % is 0.95
hj.continuation(cycle, "k", (9, 11), step=5)            -> 5 % is 0.05
hj.identify_recording(rec, apex, "u", "yM", random_state=0) -> nothing to seed
fit.bootstrap(1000)                                     -> fit.interval(level)
hj.continuation(cycle, "k", (9.9, 10.1), step=1.0)["k"] -> branch.values
hj.ClockPhase(n=8)                                      -> `n_sections`
hj.multisine(8, input="u")                              -> `inputs`
hj.run_experiments(cycle, design, sections)             -> wrong order
hj.run_experiments(cycle, sections, design, noise=1e-5) -> add_noise
hj.estimate_htf(cycle)                                  -> hj.run_experiments
hj.estimate_htf(model)                                  -> model.htf(
hj.fit_multipliers(data, order=2)                       -> hj.estimate_htf(data)
hj.fit_multipliers(est)                                 -> hj.select_order
hj.fit_multipliers(est, poles=2)                        -> `order`
hj.fit_series(rec, order=2)                             -> hj.identify_recording
hj.fit_model(hopper, est, "k")                          -> ObservedHTF
hj.validate(data, model)                                -> wrong order
hj.save(fit, "fit.npz")                                 -> wrong order
hj.save("cycle.npz", cycle)                             -> cycle.to_pandas()
cycle.T                                                 -> `period`
cycle.stable                                            -> is `is_stable`
model.stable                                            -> is `is_stable`
cycle.stability                                         -> use `is_stable`
hj.continuation(cycle, "k", (9.9, 10.1), step=1.0).is_stable -> use `stable`
cycle.eigenvalues                                       -> `multipliers`
cycle.trajectories                                      -> `trajectory`
model.poles                                             -> `multipliers`
fit.standard_error                                      -> `standard_errors`
fit.conf_int()                                          -> `interval`
fit.coef_                                               -> `coefficients`
fit.save("fit.npz")                                     -> hj.save(path, result)
rat.interval()                                          -> hj.fit_multipliers
rec.ch_names                                            -> `signals`
rec.sfreq                                               -> `rate`
rec.truncate(before=10)                                  -> recording.crop(start, stop)
hj.identify_recording(rec, apex, tmin=10)                -> recording.crop(start, stop)
rec.crop(tmin=10)                                       -> crop(start, stop)
hj.clock_sections(cycle, 8)                             -> hj.ClockPhase(n)
hj.identify_unperturbed(rec, apex)                      -> needs no inputs
rec.pick("yM")                                          -> recording[name]
est.plot().savefig("bode.png")                          -> plot.save(path)
hopper.stiffness                                        -> `k`
model.dcgain()                                          -> to_control
model.nstates                                           -> `model.dims`
hj.pole_zero_map(model)                                 -> poles_zeros
hj.stability_margins(model)                             -> to_control
hj.feedback(model, model)                               -> model.feedback
fit.get_params()                                        -> `fit.coefficients`
fit.n_components                                        -> len(fit.multipliers)
hj.select_order(est, scoring="bic")                     -> `print`
hj.validate(fit, data, cv=5)                            -> hold_out
hj.validate(fit, data).r2                               -> `validation.fit`
hj.KFold(5)                                             -> hold_out
hj.sweep(hopper, param_grid={"k": [8.0]})               -> `values`
hj.sweep(hopper, "k", [8.0, 9.0])                       -> hj.sweep(system, k=values)
rec.plot_psd()                                          -> welch
rec.heel_strikes                                        -> recording.mark
rec.drop_channels("u")                                  -> hj.Recording(time
rec[["u", "yM"]]                                        -> to_pandas()
hj.Epochs(rec, apex)                                    -> sample_sections
hj.concatenate_recordings([rec, rec])                   -> Recording.join
data.groupby("cycle")                                   -> result.to_pandas()
est.to_dict()                                           -> result.to_pandas()
est.plot().set_title("x")                               -> plot.axes[0, 0]
est.plot(title="x")                                     -> plot.axes[0, 0]
traj.stats                                              -> trajectory.result
hj.SaveAt(ts=[0.1])                                     -> trajectory.at
hj.PIDController(rtol=1e-6)                             -> Settings(
hj.simulate(hopper, "flight", (2.0, 0.0, 1.0, 0.0), t0=0.0) -> `time`
hj.estimate_htf(data, nperseg=8)                        -> without windows
hj.coherence(data)                                      -> htf.variance
hj.chirp(8, f0=0.1, f1=2)                               -> hj.multisine
design.waveform()                                       -> design.signals
hj.read_mot("walk.mot")                                 -> hj.read_recording
hj.lyapunov_exponent(rec)                               -> multipliers
fit.half_life                                           -> result.modulus
cycle.stance_duration                                   -> event_sequence
hj.identify_recording(rec, apex, references="yM")       -> name `inputs`, too
hj.identify_recording(rec, apex, inputs="u", outputs="yM", n_strides=9) -> all cycles
hj.identify_recording(rec, "vM", inputs="u", outputs="yM") -> hj.Crossing(
hj.identify_recording(rec, sections, inputs="u", outputs="yM") -> its `anchor`
hj.identify_recording(rec, hj.ClockPhase(8), inputs="u", outputs="yM") -> hj.AtEvent('tick')
hj.read_recording(rec.to_pandas())                      -> from_frame
hj.Recording(rec.time, rec["u"])                        -> {'name': samples}
hj.multisine(sections)                                  -> sections.n_sections
hj.simulate(hopper, cycle, 2.0)                         -> cycle.trajectory
hj.save(fit)                                            -> takes the name first
hj.sosfiltfilt([1.0], rec["u"])                         -> scipy.signal
data.nlargest(3)                                        -> result.to_pandas()
est.plot().set_rasterization_zorder(1)                  -> plot.axes[0, 0]
hj.findLimitCycle(hopper)                               -> hj.find_limit_cycle
fit.Multiplier                                          -> `multipliers`
hj.find_cycle(hopper)                                   -> use `hj.find_limit_cycle(system)`
hj.find_limit_cycle(hj.models.VerticalHopper)           -> `VerticalHopper()`
hj.continuation(cycle, "k")                             -> hj.continuation(cycle, 'k', (0.1, 0.5))
hj.continuation(cycle, "k", 9.0)                        -> (low, high)
hj.continuation(cycle, stifness=(8, 9))                 -> k=(low, high)
hj.continuation(cycle, retentio=(0.1, 0.9))             -> hj.continuation(cycle, retention=
hj.linearize(cycle, "yM")                               -> hj.Crossing('yM', 'falling')
hj.linearize(cycle)                                     -> hj.Crossing('yM', 'falling')
hj.identify_recording(rec, "yM", inputs="u", outputs="yM") -> hj.Crossing('yM', 'falling')
cycle.state.yM                                          -> `['yM']`
cycle.trajectory.t                                      -> `trajectory().t`
cycle.k                                                 -> `.system.k`
cycle.yM                                                -> cycle.trajectory()('yM')
traj.yM                                                 -> trajectory('yM')
rec.yM                                                  -> `['yM']`
traj["yM"]                                              -> t, yM = trajectory('yM')
hopper.replace(stiffness=3)                             -> use `k`
hj.models.VerticalHopper(retentoin=3)                   -> use `retention`
hj.parameter(1.0, bounds=(0, 1))                        -> positive=True
hj.explore(hopper, parameters="k")                      -> hj.explore(system, 'k')
hj.Chart(("y", "v"), lambda t, q, u: q)                 -> def field(self, t, q, u)
hj.HybridSystem()                                       -> hj.HybridSystem.from_functions
hj.Guess("flight", {"yM": 2.0})                         -> in the order of the chart's states
est.zeros()                                             -> fit_rational(htf)
est.freqresp([0.1])                                     -> `htf.frequencies`
est.dcgain()                                            -> htf.magnitude
cycle.amplitude                                         -> np.ptp(
cycle.eigenvectors                                      -> model.monodromy()
model.observability()                                   -> to_control
hj.read_sbml("x.xml")                                   -> from_functions
hj.SINDy()                                              -> hj.fit_model
hj.models.Lorenz()                                      -> from_functions
hj.period_doubling(cycle)                               -> branch.bifurcations
hj.continuation(cycle, "k", (9.9, 10.1), step=1.0).points -> is `bifurcations`
hj.orbits.BranchPoint                                   -> hj.orbits.Bifurcation
hj.continuation(cycle, "k", bounds=(8, 12))             -> use `range`
hj.continuation(cycle, "k", (8, 12), NMX=100)           -> `max_points`
hj.continuation(cycle, "k", (8, 12), ICP=1)             -> its range by its name
hj.linearize(cycle, sections, ts=0.1)                   -> no step of time
hj.identify_recording(rec, apex, sections=16)           -> `n_sections`
hj.plot.bode(est, dB=True)                              -> `log=True`
hj.plot.bode(est, Hz=True)                              -> `unit='Hz'`
hj.plot.bode(est, unit="Hz")                            -> needs the `period`
hj.plot.poincare_map(cycle)                             -> hj.plot.return_map(cycle)
hj.validate(fit, data, held_out=0.2)                    -> hj.recordings.hold_out
hj.poles(cycle)                                         -> `cycle.multipliers`
hj.monodromy(cycle)                                     -> hj.linearize(cycle, sections)
hj.sensitivity(cycle, "k")                              -> cycle.sensitivity(
hj.phase(rec)                                           -> hj.recordings.estimate_phase
hj.phase_response(cycle)                                -> `cycle.responses()`
hj.isochrons(cycle)                                     -> cycle.asymptotic_phase
hj.basin_of_attraction(cycle)                           -> hj.simulate
hj.spike_triggered_average(rec)                         -> hj.recordings.phase_response
hj.read_raw_c3d("walk.c3d")                             -> hj.read_recording
hj.gait_stability(rec)                                  -> hj.identify_recording
hj.design(cycle)                                        -> hj.optimal_design
hj.required_duration(result)                            -> plan.cycles_for
hj.report(result)                                       -> result.write_report
result.predict(rec)                                     -> hj.validate(result, data)
result.confidence_interval()                            -> `interval`
fit.multipliers_ci                                      -> `interval`
fit.std                                                 -> `standard_errors`
cycle.evaluate(0.3)                                     -> cycle.trajectory()
cycle.responses("u")                                    -> responses().curve(
cycle.fluctuations(white=0.01)                          -> white={'yM': 0.01}
hj.simulate(cycle, n_cycles=5)                          -> cycle.trajectory(periods)
hj.plot.bode(fit)                                       -> hj.plot.bode(htf, fit)
hj.plot.bode(cycle)                                     -> hj.linearize(cycle, sections).htf(
hj.plot.multipliers([cycle, fit])                       -> hj.plot.multipliers(true, {'fit': fit})
hj.plot.validation(hj.validate(fit, data))              -> validation.plot()
hj.plot.save("cycle.png", cycle.plot())                 -> plot.save(path)
hj.multisine(model)                                     -> model.n_sections
hj.run_experiments(model, design)                       -> simulate_experiments(model, design)
hj.fit_multipliers(est, order=[1, 2])                   -> hj.select_order(htf)
hj.optimal_design(model, limit=0.01)                    -> limit={'u': 0.01}
hj.identify_recording([rec, rec], apex, "u", "yM")      -> hj.Recording.join
hj.identify_subjects([rec], "out", sections=apex)       -> {'file': files
hj.identify_subjects("a.csv", "out", inputs="u")        -> `sections`
hj.identify_subjects("a.csv", "out", print, inputs="u") -> leave `identify` out
hj.identify_subjects("a.csv", "out", section=apex)      -> use `sections`
hj.recordings.natural_multipliers(rec, apex, outputs="yM") -> hj.identify_recording
hj.recordings.natural_multipliers(rec)                  -> hj.identify_recording
rec.trials[0].plot()                                    -> recording.plot()
traj.events[0].t                                        -> `time`
traj.events[0].state                                    -> `event.before`
hj.validate(result)                                     -> to which the model was not fitted
hj.validate(fit, "trial.csv")                           -> hj.identify_recording
hj.fit_series("trial.csv", order=2)                     -> hj.identify_recording
hj.optimal_design(model, noise=1e-4).write("a.csv")     -> plan.design.write
hj.recordings.Population({"a": result})                 -> Population.from_fits
hj.recordings.Population.from_fits([result, result])    -> ['S1', 'S2']
hj.sweep("VanDerPol", mu=[1.0, 2.0])                    -> hj.models.VerticalHopper()
hj.fit_model(hopper, rec, ["k", "b"])                   -> ObservedTrajectory
hj.simulate(hopper, traj, 1.0)                          -> hj.flow(system, flow, until)
traj(0.5)                                               -> trajectory.at(times)
hj.plot.multipliers(cycle.multipliers, fit.multipliers) -> hj.plot.multipliers(true, fit)
hj.ClockPhase(8, anchor="touchdown")                    -> hj.Crossing(
hj.KinematicPhase(8, ("yM", "vM"))                      -> hj.KinematicPhase(8, 'y', 'v')
hj.Guess("flight", {"yM": 2.0})                         -> hj.find_limit_cycle(system, {'y': 2.0
model.simulate(design)                                  -> simulate_experiments(model, design)
hj.identify_recording(rec, {"vM": "falling"}, "u", "yM") -> hj.Crossing(
hj.identify_recording(rec, ("vM", "falling"), "u", "yM") -> hj.Crossing(
hj.linearize(cycle, ("yM", "falling"))                  -> hj.Crossing('yM', 'falling')
hj.plot.cycle(cycle, ("yM", "vM"))                      -> hj.plot.cycle(cycle, x, y)
hj.recordings.Population([fit, fit])                    -> Population.from_fits
hj.fit_model(hopper, result, "k")                       -> ObservedTrajectory(hj.Guess(
hj.sweep(hopper, stiffness=[9.0, 10.0])                 -> k=values
hj.sweep(hopper)                                        -> hj.sweep(system, m=[0.1, 0.5])
hj.sweep(hopper, {"k": [9.0]}, k=[9.0])                 -> given twice
hj.sweep(hopper, hj.scale.SweepPoints({"k": [9.0]}), b=[5.0]) -> leave out `b`
hj.continuation(cycle, k=(9, 11), b=(4, 5))             -> hj.sweep
hj.continuation(cycle, k=9.0)                           -> (low, high)
hj.find_limit_cycle(hopper, stiffness=9.0)              -> system.replace(k=
hj.find_limit_cycle(hopper, (2.0, 0.0, 1.0))            -> 'flight' has yM, vM, ym, vm
hj.find_limit_cycle(hopper, {"yM": 2.0, "x": 0.0})      -> 'stance' has yM, vM
hj.find_limit_cycle(lambda t, y: y)                     -> hj.HybridSystem.from_functions
hj.find_limit_cycle("VerticalHopper")                   -> hj.models.VerticalHopper()
hj.simulate(hopper, 1.0)                                -> duration=1.0
hj.simulate(hopper, [2.0, 0.0, 1.0, 0.0])               -> give the duration
hj.flow(hopper, cycle, t1=1.0)                          -> `until`
hj.flow(hopper, cycle, "yM", within=1.0)                -> hj.Crossing('yM', 'falling')
hj.flow(hopper, cycle, 0.5).yM                          -> `['yM']`
hj.identify_recording(3, apex, "u", "yM")               -> hj.read_recording
hj.identify_recording("nowhere.csv", apex, "u", "yM")   -> cannot read 'nowhere.csv'
hj.Recording({"times": rec.time, "u": rec["u"]})        -> no column 'time'
hj.Recording(rec.time)                                  -> {'name': samples}
setattr(hopper, "k", 9.0)                               -> system.replace(k=9.0)
setattr(hopper, "stiffness", 9.0)                       -> use `k`
setattr(cycle, "period", 9.0)                           -> hj.find_limit_cycle(system)
setattr(fit, "covariance", 0)                           -> hj.fit_multipliers(htf, order)
setattr(data, "u", 0)                                   -> hj.run_experiments
cycle.state(0.5)                                        -> charts, states = trajectory.at(times)
cycle.monodromy                                         -> hj.linearize(cycle, sections).monodromy()
cycle.poincare_map                                      -> hj.sections.section_map
cycle.responses().plot()                                -> responses.amplitude(0, phase)
hj.simulate(hopper, "stance", cycle.state, 1.0)         -> hj.simulate(system, state, duration)
hj.System(lambda t, x: x)                               -> (t, q, u, p)
hj.HybridSystem(modes={}, guards={}, resets={})         -> [(name, guard, reset)]
hj.HybridSystem.from_sympy("x")                         -> hj.HybridSystem.from_functions
hj.models.RelayFeedback()                               -> hj.HybridSystem.from_functions
model.discretize()                                      -> model.A[k]
est["YM"]                                               -> use 'yM'
est.select("yM")                                        -> htf.select(outputs='y')
est.output("yM")                                        -> `htf['y']`
design.n_realizations                                   -> of all realizations together
ser.residuals                                           -> validation.residuals
result.bode()                                           -> hj.plot.bode(result)
fit.bode()                                              -> hj.plot.bode(htf, fit)
model.bode()                                            -> hj.plot.bode(model)
hj.validate(fit, data).resid                            -> use `residuals`
result.residuals                                        -> validation.residuals
hj.fit_series(data, order=(1, 2, 3))                    -> hj.select_order(data)
hj.fit_multipliers(est, range(1, 4))                    -> hj.select_order(htf)
hj.fit_model(hopper, rec, {"k": 20.0})                  -> ObservedTrajectory(hj.Guess(
hj.fit_model(hopper, hj.fitting.ObservedHTF(est, sections), {"k": 20.0}) -> (5.0, 20.0)
hj.Recording.from_csv("trial.csv")                      -> hj.read_recording(path)
hj.Recording.from_dataframe(rec.to_pandas())            -> hj.Recording(table)
hj.Recording.sfreq                                      -> `rate`
hj.read_recording("trial.csv", inputs="u")              -> `signals` chooses columns
hj.compare_groups([result], [result])                   -> 'group': groups}
"""


@pytest.fixture(autouse=True)
def in_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("matplotlib.pyplot.show", lambda: None)


@pytest.mark.parametrize("call", RUN.strip().splitlines())
def test_a_guess_runs(names, call):
    eval(call, names)


@pytest.mark.parametrize("line", LEAD.strip().splitlines())
def test_the_error_of_a_guess_leads_on(names, line):
    call, _, lead = line.rpartition("-> ")
    with pytest.raises((TypeError, ValueError, AttributeError)) as caught:
        eval(call.strip(), names)
    text = str(caught.value)
    assert lead in text
    assert "\n" not in text


PLACES = {place.rpartition(".")[2]: thing for place, thing in all_members()}
# Objects as the sentences call them, by the classes that they may be of.
VARIABLES = {
    "branch": "Branch",
    "cycle": "LimitCycle",
    "data": "ExperimentData SectionData",
    "design": "Design",
    "fit": "SeriesFit StructuredFit LDTPFit ModelFit ParameterEstimate RationalFit",
    "htf": "HTF",
    "model": "LDTP HTF",
    "other": "SeriesFit",
    "plan": "OptimalDesign",
    "plot": "Plot",
    "recording": "Recording",
    "sections": "ClockPhase",
    "selection": "OrderSelection",
    "system": "HybridSystem",
    "trajectory": "Trajectory",
    "validation": "Validation",
}
# (`result` is a result of any kind.)
VARIABLES["result"] = "Identification LimitCycle SectionData ExperimentData HTF"


def sentences():
    """All sentences of the tables."""
    for table in (ATTRIBUTES, KEYWORDS, NAMES):
        for owned in table.values():
            yield from owned
    for flat in (MAKERS, STEPS, OBJECTS, NEEDS, CALLED, IN_NAMESPACES):
        yield from flat.values()


def thing_at(path):
    thing = types.SimpleNamespace(hj=hj)
    for name in path.split("."):
        thing = getattr(thing, name)
    return thing


def test_errors_name_calls_that_exist():
    for sentence in sentences():
        for path in re.findall(r"hj(?:\.\w+)+", sentence):
            assert thing_at(path) is not None


def test_errors_name_attributes_that_exist():
    for sentence in sentences():
        for owner, name in re.findall(r"(?<![\w.'(/])(\w+)\.(\w+)", sentence):
            classes = [PLACES[x] for x in VARIABLES.get(owner, "").split()]
            attributes = {x for cls in classes for x in leads.attributes_of(cls)}
            assert not classes or name in attributes, sentence


def test_errors_name_arguments_that_exist():
    for sentence in sentences():
        for path, given in re.findall(r"(hj(?:\.\w+)+)\(([^()]*)\)", sentence):
            known = inspect.signature(thing_at(path))
            named = set(re.findall(r"(\w+)=", given))
            takes_any = any(x.kind is x.VAR_KEYWORD for x in known.parameters.values())
            assert takes_any or named <= known.parameters.keys(), sentence


def test_tables_of_words_have_owners_that_exist():
    classes = {
        base.__name__ for x in PLACES.values() for base in getattr(x, "__mro__", ())
    }
    for owners in ATTRIBUTES:
        assert set(owners.split()) <= classes
    for owners in KEYWORDS:
        known = {*PLACES, *hj.__all__}
        assert set(owners.split()) <= known
    for namespace in NAMES:
        assert namespace == "" or namespace in hj.__all__


@pytest.mark.parametrize("table", [ATTRIBUTES, KEYWORDS, NAMES])
def test_a_word_leads_to_one_sentence_of_an_owner(table):
    """Nobody sees the second one."""
    found = {}
    for owners, owned in table.items():
        for owner in owners.split() or [""]:
            for sentence, row in owned.items():
                for word in row.split():
                    first = found.setdefault((owner, plain(word)), word)
                    assert first is word, (owner, first, word, sentence)


def test_words_that_lead_on_are_no_names():
    """Else nobody sees the sentence."""
    for owners, owned in ATTRIBUTES.items():
        for owner in set(owners.split()) & PLACES.keys():
            names = leads.attributes_of(PLACES[owner])
            known = {name for row in owned.values() for name in row.split()}
            assert not known & set(names), owner
    # (These two are parts of names: `identify_walk`, `load_walk`.)
    parts = {"identify", "load"}
    for namespace, owned in NAMES.items():
        names = getattr(hj, namespace).__all__ if namespace else hj.__all__
        known = {name for row in owned.values() for name in row.split()}
        assert not (known - parts) & set(names), namespace


def test_words_stand_for_words_of_this_package():
    known = set()
    for thing in PLACES.values():
        if isinstance(thing, type):
            known |= set(leads.attributes_of(thing))
            things = [
                thing,
                *(
                    getattr(thing, x)
                    for x in leads.attributes_of(thing)
                    if hasattr(thing, x)
                ),
            ]
        else:
            things = [thing]
        for callable_thing in filter(callable, things):
            try:
                known |= inspect.signature(callable_thing).parameters.keys()
            except ValueError:  # (a class of C)
                continue
    for word, meant in WORDS.items():
        assert set(meant) <= known, word
    assert ALIKE.keys() <= WORDS.keys() | known
    twice = [x for row in ALIKE.values() for x in row.split()]
    assert len(twice) == len(set(twice))


def test_an_error_inside_of_a_property_is_not_taken_for_a_missing_attribute():
    class Broken(hj.HybridSystem):
        k: hj.Parameter = hj.parameter(1.0)

        def charts(self):
            return {}

        @property
        def stiffness(self):
            return self.k.mistyped

    with pytest.raises(AttributeError, match="mistyped"):
        Broken().stiffness  # noqa: B018
    with pytest.raises(AttributeError, match="use `k`"):
        Broken().K  # noqa: B018
    assert not hasattr(Broken(), "__jax_array__")


def test_public_objects_do_not_change():
    """The error of who sets an attribute leads on, where that of equinox does not."""
    written_by_users = "Chart", "Abstract", "Drawing"
    parts_of_results = "Finding", "Trial"
    for place, thing in all_members():
        name = place.rpartition(".")[2]
        if isinstance(thing, type) and issubclass(thing, eqx.Module):
            raw = thing.__setattr__ is eqx.Module.__setattr__
            assert not raw or name.startswith(written_by_users + parts_of_results)


def test_a_method_without_its_call_says_how_it_is_called(names):
    cycle = names["cycle"]
    text = repr(cycle.trajectory)
    assert text == "<method of a LimitCycle: call it, as in `.trajectory(periods=1.0)`>"
    assert cycle.trajectory.__doc__.startswith("The orbit from")
    assert list(inspect.signature(cycle.trajectory).parameters) == ["periods"]
    for inherited in (cycle.plot, names["fit"].interval, names["hopper"].replace):
        assert repr(inherited).startswith("<method of a")
    # (As equinox binds methods: JAX takes them as arguments.)
    responses = jax.jit(lambda method: method.__self__.period)(cycle.trajectory)
    assert responses == cycle.period


OSCILLATOR = hj.HybridSystem.from_functions(
    ("x", "v"),
    lambda t, q, u, p: (q[1], -p.damping * q[1] - q[0]),
    parameters={"damping": 1.0},
)


@pytest.mark.slow
def test_the_place_of_rest_prints_no_rounding():
    with pytest.raises(hj.errors.ComputationError, match="x 0, v 0, where nothing"):
        hj.find_limit_cycle(OSCILLATOR, hj.Guess("main", (1.0, 0.0)))


def test_an_error_in_a_field_has_the_hint_that_fits():
    def error_of(field):
        system = hj.HybridSystem.from_functions(("x",), field, (), {"damping": 1.0})
        with pytest.raises(hj.errors.DefinitionError) as caught:
            hj.simulate(system, hj.Guess("main", (1.0,)), 1.0)
        return str(caught.value)

    misspelt = error_of(lambda t, q, u, p: -p.dampin * q[0])
    assert misspelt.endswith("A System has no `dampin`: use `damping`.")
    error = error_of(lambda t, q, u, p: -p["damping"] * q[0])
    assert "write `p.k`" in error
    assert "write `y, v = q`" in error_of(lambda t, q, u, p: -q["x"])
    assert "q and u are arrays" in error_of(lambda t, q, u, p: -q + [1.0])
    assert "from_functions` take (t, q, u, p)" in error_of(lambda t, q, p: -q)


def test_a_namespace_is_no_function_that_may_take_an_object():
    with pytest.raises(AttributeError) as caught:
        print(hj.Crossing("y", "falling").plot)
    assert "may take" not in str(caught.value)


def test_a_misspelt_method_of_a_system_is_refused():
    """Else its events would never happen."""
    with pytest.raises(hj.errors.DefinitionError, match="call it `transitions`"):

        class Ball(hj.HybridSystem):
            def charts(self):
                return {}

            def transition(self):
                return ()


def test_a_chart_without_states_is_refused():
    class Flight(hj.Chart):
        state = ("y", "v")

        def field(self, t, q, u):
            return q[1], -9.81

    with pytest.raises(hj.errors.DefinitionError, match="class Flight.*states = "):
        Flight()


@pytest.mark.parametrize("given", [3, "position", ("y", 2), None])
def test_states_that_are_no_names_are_refused(given):
    class Flight(hj.Chart):
        states = given

        def field(self, t, q, u):
            return q

    with pytest.raises(hj.errors.DefinitionError, match="`states` of Flight must be"):
        Flight()


def test_a_state_of_a_flow_by_name_leads_on(names):
    flow = hj.flow(names["hopper"], hj.Guess("flight", (2.0, 1.0, 0.0, 0.0)), 0.1)
    with pytest.raises(AttributeError, match=r"`\['yM'\]` has the values"):
        flow.yM  # noqa: B018


def test_a_system_without_inputs_is_not_linearized():
    silent = hj.HybridSystem.from_functions(
        ("x",), lambda t, q, u, p: (jnp.cos(t) - q[0],), period=2 * np.pi, inputs=()
    )
    cycle = hj.find_limit_cycle(silent, hj.Guess("main", (0.5,)))
    with pytest.raises(hj.errors.DefinitionError, match="System has no inputs"):
        hj.linearize(cycle, hj.ClockPhase(4))


def test_settings_print_their_accuracy():
    assert "default rtol and atol of each call" in repr(hj.orbits.Settings())
    assert "default atol of each call" in repr(hj.orbits.Settings(rtol=1e-9))
    assert "default" not in repr(hj.orbits.Settings(rtol=1e-9, atol=1e-9))


FITS = "fit", "ser", "ldtp", "phys"


def test_what_leads_name_runs(names):
    """The calls of sentences that other tests hold only by their words."""
    ser, data, est = names["ser"], names["data"], names["est"]
    validation = hj.validate(ser, data)
    residuals = validation.residuals
    assert 0 < np.abs(residuals).max() < np.abs(data.y).max()
    assert_array_equal(est["yM"].H, est.select(outputs="yM").H)
    assert est.plot(outputs="yM").axes.size
    groups = {"subject": list("abcd"), "group": list("xxyy")}
    people = hj.recordings.Population.from_fits([names["result"]] * 4, groups)
    assert people.difference("modulus", "x", "y")["p"].item() > 0.9
    responses = names["cycle"].responses()
    assert responses.amplitude(0, [0.1, 0.2])["u"].shape == (2,)


@pytest.mark.parametrize("name", FITS)
def test_every_fit_does_what_fits_do(names, name):
    fit = names[name]
    assert isinstance(fit, hj.identify.Fit)
    assert isinstance(fit, Showable)
    assert_allclose(fit.modulus, np.abs(fit.multipliers))
    values, errors = fit._estimates()
    low, high = fit.interval(0.9).T
    assert_allclose((low + high) / 2, values)
    assert (high - low > 3 * errors).all()
    is_inside = fit.contains(names["cycle"], level=1 - 1e-9)
    assert np.all(is_inside)
    assert fit.compare(names["cycle"]).p_value > 1e-9
    assert "p " in repr(fit.compare(names["cycle"]))
    assert "true" in repr(fit.compare(names["cycle"]))
    assert "other fit" in repr(fit.compare(fit))
    assert fit.compare(fit).p_value > 0.99
    assert len(fit.to_pandas()) == len(values)
    assert fit.plot().axes.size
    validation = hj.validate(fit, names["data"])
    assert validation.fit.min() > 90


@pytest.mark.parametrize("name", FITS)
def test_every_fit_comes_back_from_a_file(names, name):
    fit = names[name]
    hj.save("fit.npz", fit)
    hj.save("fit.mat", fit)
    back = hj.load("fit.npz")
    dataset = hj.convert.to_xarray(fit)
    for other in (back, hj.convert.from_xarray(dataset)):
        assert_array_equal(other.multipliers, fit.multipliers)
        assert_array_equal(other.interval(), fit.interval())
        assert other.findings == fit.findings
        assert other.to_pandas().equals(fit.to_pandas())
    if name == "ldtp":
        f = np.array([0.1, 0.7])
        stored = back.htf(f).H
        assert_array_equal(stored, fit.htf(f).H)
        variance = back.htf(f).variance
        assert_array_equal(variance, fit.htf(f).variance)
    if name == "phys":
        assert type(back).__name__ == "ParameterEstimate"
        assert back.names == ("k", "b")
        assert back.units == ("N/m", "N s/m")
        assert back.compare(fit).p_value == 1.0
        assert "±" in repr(back)


def test_p_values_are_those_of_the_coefficients(names):
    """All multipliers together are the coefficients of their polynomial."""
    fit = names["fit"]
    other = names["ser"]
    true = names["cycle"].multipliers
    exact = np.poly(true).real[1:]
    missed = fit.coefficients - exact
    distance = missed @ np.linalg.solve(fit.covariance, missed)
    dof = fit.covariance_dof
    ratio = distance * (dof - 1) / (2 * dof)
    expected = stats.f.sf(ratio, 2, dof - 1)
    assert_allclose(fit.compare(true).p_value, expected, rtol=1e-6)
    missed = fit.coefficients - other.coefficients
    covariance = fit.covariance + other.covariance
    distance = missed @ np.linalg.solve(covariance, missed)
    dof = min(dof, other.covariance_dof)
    ratio = distance * (dof - 1) / (2 * dof)
    expected = stats.f.sf(ratio, 2, dof - 1)
    assert_allclose(fit.compare(other).p_value, expected, rtol=1e-6)


def test_p_values_of_parameters_are_those_of_their_covariance(names):
    fit = names["phys"]
    estimate = fit.estimate
    true = {"k": 10.0, "b": 5.0}
    missed = fit.values - [10.0, 5.0]
    distance = missed @ np.linalg.solve(fit.covariance, missed)
    expected = stats.chi2.sf(distance, 2)
    assert_allclose(estimate.compare(true).p_value, expected, rtol=1e-6)
    # By the likelihood, which is nearly a parabola here.
    assert_allclose(fit.compare(true).p_value, expected, rtol=0.1)
    assert_allclose(fit.compare(true).error, missed)


def test_a_fit_of_some_harmonics_says_so_where_it_is_validated(names):
    data = names["data"]
    some = hj.validate(names["fit"], data)
    assert [x.cause for x in some.findings] == ["harmonics"]
    fit = hj.fit_multipliers(names["whole"], order=2)
    whole = hj.validate(fit, data)
    assert not whole.findings
    assert whole.independent
    # As the fit to the series explains the same data.
    expected = hj.validate(names["ser"], data).fit
    assert_allclose(whole.fit, expected, atol=0.3)


def test_tables_hold_the_numbers(names):
    data = names["data"]
    table = data.to_pandas()
    of_cycle = (table.experiment == 3) & (table.cycle == 5)
    row = table[of_cycle & (table.section == 2)]
    expected = data.y[3, 42, 1]
    assert row.vM.item() == expected
    inputs = data.u[:, :, 0]
    assert_array_equal(data["u"], inputs)
    states = names["traj"].to_pandas()
    assert set(states.chart) == {"flight", "stance"}
    assert states[states.chart == "stance"].ym.isna().all()
    end = names["traj"].after[-1, 0]
    assert_allclose(states.yM.iloc[-1], end)
    one = names["cycle"].to_pandas()
    assert one.k.item() == 10.0
    assert_allclose(one["multipliers.0.modulus"], names["cycle"].modulus[0])


@pytest.mark.slow
def test_a_system_from_functions_is_that_of_a_class():
    rate = 2 * jnp.pi
    juggler = hj.HybridSystem.from_functions(
        {"y": "m", "v": "m/s"},
        lambda t, q, u, p: (q[1], u[0] - p.g),
        [
            (
                "impact",
                lambda t, q, u, p: q[0] - p.A * jnp.sin(rate * t),
                lambda t, q, u, p: (
                    q[0],
                    (1 + p.e) * p.A * rate * jnp.cos(rate * t) - p.e * q[1],
                ),
            )
        ],
        {"g": 9.81, "A": 0.15, "e": 0.7},
        period=1.0,
    )
    guess = hj.Guess("main", (0.2, 4.5), time=0.1)
    cycle = hj.find_limit_cycle(juggler, guess)
    *_, exact = hj.models.PaddleJuggler().exact()
    assert_allclose(cycle.multipliers, exact, atol=1e-12)

    def trace(e):
        changed = hj.find_limit_cycle(juggler.replace(e=e), cycle)
        model = hj.linearize(changed, hj.ClockPhase(2))
        return model.characteristic_polynomial()[1]

    def exact_trace(e):
        *_, multipliers = hj.models.PaddleJuggler(restitution=e).exact()
        return -jnp.sum(multipliers).real

    slope = jax.grad(trace)(0.7)
    exact_slope = jax.grad(exact_trace)(0.7)
    assert_allclose(slope, exact_slope, rtol=1e-8)
    with pytest.raises(hj.errors.DefinitionError, match="another attribute 'inputs'"):
        hj.HybridSystem.from_functions("x", lambda t, q, u, p: -q, (), {"inputs": 1.0})


def test_identify_model_finds_the_exact_multipliers(names):
    result = hj.identify_model(names["cycle"], names["sections"], OUTPUTS, noise=1e-6)
    assert result.fit.contains(names["cycle"], level=0.9999).all()
    assert result.comparison.max_error < 1e-3
    assert_allclose(result.model.multipliers, names["cycle"].multipliers, atol=1e-10)
    assert "ModelIdentification(VerticalHopper; 32/32 ok)" in repr(result)


def test_a_result_of_several_steps_compares_as_its_fit(names):
    """Not as a truth without errors."""
    fit = names["fit"]
    result = names["result"]
    by_result = fit.compare(result).p_value
    assert by_result == fit.compare(result.fit).p_value
    by_multipliers = fit.compare(result.multipliers).p_value
    assert fit.compare(result).p_value > by_multipliers
    assert "other fit" in repr(fit.compare(result))


def test_every_result_prints_itself():
    folder = pathlib.Path(hj.__file__).parent
    for file in folder.rglob("*.py"):
        path = file.relative_to(folder.parent).with_suffix("").parts
        if not path[-1].startswith("__"):
            importlib.import_module(".".join(path))
    kinds = [Showable]
    for kind in kinds:
        kinds += kind.__subclasses__()
        if kind not in (Showable, WithMultipliers, OfFit):
            assert kind.__repr__ not in (eqx.Module.__repr__, object.__repr__), kind
