"""Which call, argument or attribute does what a wrong call means: tables that errors look up.

Users guess with the words of other libraries, and give an object of an earlier step. The tables are
read only where an error is raised.
"""

import dataclasses
import difflib
import inspect
from collections.abc import Collection, Iterable, Sequence
from typing import Any

from ..exceptions import HybridJaxError
from ..public import about_word, place_of
from .values import Kind, with_article


MAKERS = {
    "AbstractSections": "`hj.ClockPhase(32)`, `hj.Crossing('y', 'falling')` or a list of these are "
    "sections",
    "Branch": "`hj.continuation(cycle, parameter, (low, high))` makes one",
    "Crossing": "`hj.Crossing('y', 'falling')` makes one",
    "Design": "`hj.multisine(n_sections)` makes one",
    "ExperimentData": "`hj.run_experiments(cycle, sections, design, outputs)` makes one",
    "Guess": "`hj.Guess(chart, state)` makes one",
    "HTF": "`hj.estimate_htf(data)` or `model.htf(frequencies)` makes one",
    "HybridSystem": "`hj.models` has ready ones, and subclasses of `hj.HybridSystem` are others",
    "HasMultipliers": "limit cycles, models and fits have them",
    "HasRecords": "`hj.run_experiments(cycle, sections, design, outputs)` makes data, and "
    "`hj.identify_recording` those of a recording",
    "LDTP": "`hj.linearize(cycle, sections)` or `hj.fit_ldtp(data, ...)` makes one",
    "LimitCycle": "`hj.find_limit_cycle(system)` makes one",
    "LimitCycles": "`hj.orbits.find_limit_cycles(systems)` makes one",
    "Fit": "`hj.fit_multipliers(htf, order)` or `hj.fit_series(data, order)` makes one",
    "MultiplierFit": "`hj.fit_multipliers(htf, order)` makes one",
    "OptimalDesign": "`hj.optimal_design(model)` makes one",
    "Phase": "`hj.recordings.estimate_phase(recording, sections)` makes one",
    "Plant": "`hj.plants` has ready ones",
    "RationalFit": "`hj.identify.fit_rational(htf)` makes one",
    "SectionSeries": "`data.records` has them",
    "Recording": "`hj.read_recording(path)`, or `hj.Recording(time, signals)` of arrays, makes one",
    "SectionData": "`hj.identify_recording(recording, ...).data` or "
    "`hj.recordings.sample_sections(...)` is one",
    "SeriesFit": "`hj.fit_series(data, order)` makes one",
    "Settings": "`hj.orbits.Settings(rtol=1e-9)` makes one",
    "StructuredFit": "`hj.fit_multipliers(htf, order)` makes one",
    "Validation": "`hj.validate(model, data)` makes one",
}
"""For each type, the call that makes an object of it."""

STEPS = {
    ("HTF", "ExperimentData"): "`hj.estimate_htf(data)` makes one of data",
    ("HTF", "SectionData"): "`hj.fit_series(data, order)` fits data at sections",
    ("HTF", "Recording"): "`hj.identify_recording(recording, ...)` takes recordings",
    ("HTF", "LDTP"): "`model.htf(frequencies)` makes one of a model",
    (
        "HTF",
        "LimitCycle",
    ): "`hj.linearize(cycle, sections).htf(frequencies)` makes one of a cycle",
    ("HTF", "Fit"): "`fit.htf(frequencies)` makes one of a fit",
    ("LDTP", "LimitCycle"): "`hj.linearize(cycle, sections)` makes one of a cycle",
    (
        "LDTP",
        "HybridSystem",
    ): "`hj.linearize(hj.find_limit_cycle(system), sections)` makes one of a system",
    ("LDTP", "HTF"): "`hj.fit_ldtp(htf, ...)` makes one of an HTF",
    (
        "ExperimentData",
        "HTF",
    ): "it takes the data: `hj.fit_multipliers(htf, order)` takes an HTF",
    (
        "ExperimentData",
        "Recording",
    ): "`hj.identify_recording(recording, ...)` takes recordings",
    (
        "ExperimentData",
        "LDTP",
    ): "`hj.experiments.simulate_experiments(model, design)` makes data of a model",
    (
        "HasRecords",
        "HTF",
    ): "it takes the data; `hj.fit_multipliers(htf, order)` takes an HTF",
    (
        "HasRecords",
        "Recording",
    ): "`hj.identify_recording(recording, ...)` takes recordings",
    (
        "HasRecords",
        "LimitCycle",
    ): "`hj.run_experiments(cycle, sections, design, outputs)` makes data",
    ("HasRecords", "LDTP"): "are `model` and `data` in the wrong order?",
    ("ParameterFit", "MultiplierFit"): "`other.compare(fit)` compares multipliers",
    ("Recording", "ExperimentData"): "`hj.fit_series(data, order)` takes such data",
    (
        "LimitCycle",
        "LDTP",
    ): "it needs the cycle that was linearized: `hj.find_limit_cycle(system)`",
    (
        "AbstractObservation",
        "HTF",
    ): "`hj.fitting.ObservedHTF(htf, sections)` makes one of an HTF",
    (
        "AbstractObservation",
        "ExperimentData",
    ): "`hj.fitting.ObservedSeries(data, sections)` makes one of data",
}
"""For a type that is needed, and one that was given, the step between them. A given type also
stands for those derived from it."""

OBJECTS = {
    "estimate_htf.LDTP": "`model.htf(frequencies)` is the exact HTF of a model",
    "fit_series.LDTP": "are the model and the data in the wrong order?",
    "save.LimitCycle": "it contains the code of its system; `cycle.to_pandas()` has its numbers",
    "__getitem__.str": "an index is a number; of an HTF it is the harmonic",
    "multipliers.dict": "`hj.plot.multipliers(true, {'fit': fit})` takes the true ones first",
    "save.HybridSystem": "a system is code: keep the script that makes it",
    "save.Recording": "`recording.to_pandas().to_csv(path)` writes it",
    "save.SectionData": "`data.to_pandas().to_csv(path)` writes it",
    "save.Identification": "save its `fit`, or write `result.write_report(folder)`",
    "bode.StructuredFit": "draw HTFs: `hj.plot.bode(htf, fits=fit)`, or `fit.htf(frequencies)`",
    "to_pandas.HybridSystem": "print the system, or `hj.find_limit_cycle(system).to_pandas()`",
}
"""For a function, and the type of the object that it was given, what to do. A given type also
stands for those derived from it."""

WORDS = {
    "A": ("amplitude",),
    "N": ("n_sections",),
    "T": ("period", "duration"),
    "X": ("data", "htf"),
    "alpha": ("level", "alpha"),
    "amp": ("amplitude",),
    "anchor": ("anchor", "start"),
    "atol": ("accuracy", "settings"),
    "batch_size": ("execution", "chunk"),
    "channels": ("signals", "outputs"),
    "chi2": ("chi2_per_dof", "chi_square", "cost"),
    "ci": ("interval", "level", "alpha"),
    "coef": ("coefficients", "values", "multipliers"),
    "confidence": ("level", "interval"),
    "cov": ("covariance",),
    "cycles": ("cycles", "periods"),
    "d": ("order",),
    "data": ("data", "htf", "recording"),
    "df": ("dof",),
    "doubts": ("findings",),
    "dt": ("settings", "rate"),
    "duration": ("duration",),
    "eigenvalues": ("multipliers",),
    "errors": ("standard_errors", "standard_error", "covariance"),
    "estimates": ("values", "multipliers"),
    "event": ("sections", "section", "events"),
    "file": ("path", "paths", "folder"),
    "free": ("free", "parameter", "parameters"),
    "freq": ("frequencies", "frequency", "range"),
    "fs": ("rate", "time"),
    "guess": ("guess", "initial", "state"),
    "harmonic": ("harmonics", "harmonic"),
    "input": ("inputs", "input", "u"),
    "magnitude": ("H", "modulus"),
    "max_iter": ("settings", "max_steps"),
    "modulus": ("modulus", "multipliers"),
    "n": ("n_sections", "order"),
    "n_experiments": ("experiments", "realizations"),
    "n_jobs": ("execution", "client"),
    "names": ("signals", "outputs", "names", "states"),
    "noise": ("std", "process_noise", "noise"),
    "nperiods": ("periods", "cycles"),
    "order": ("order", "dims"),
    "output": ("outputs", "output", "y"),
    "overlay": ("fits",),
    "params": ("values", "coefficients", "free", "parameters", "parameter", "numbers"),
    "reference": ("references",),
    "period": ("period", "periods"),
    "phase": ("sections", "phase", "anchor"),
    "poles": ("poles", "order", "multipliers"),
    "predict": ("predict", "simulate", "htf"),
    "range": ("range", "values"),
    "residuals": ("residuals", "residual", "noise"),
    "sections": ("sections", "section", "phase"),
    "seed": ("seed",),
    "save": ("save", "to_pandas"),
    "start": ("guess", "anchor", "initial", "state"),
    "n_points": ("n_sections", "max_points", "count"),
    "to_pandas": ("to_pandas",),
    "plot": ("plot",),
    "points": ("points",),
    "signal": ("signal", "signals", "function"),
    "size": ("n_sections", "experiments"),
    "solver": ("settings", "solver"),
    "spectral_radius": ("modulus", "multipliers"),
    "stable": ("stable",),
    "standard_errors": ("standard_errors", "standard_error", "std"),
    "state": ("state", "states", "anchor", "guess"),
    "step": ("settings", "step"),
    "system": ("system", "cycle", "model"),
    "t": ("time", "t", "times"),
    "t_span": ("duration",),
    "tf": ("htf", "duration"),
    "threshold": ("value", "threshold"),
    "time": ("time", "t", "times"),
    "tol": ("accuracy", "settings", "tolerance"),
    "trials": ("trials", "experiments", "repeats"),
    "values": ("values", "H", "y"),
    "window": ("periods", "window"),
    "x": ("x", "inputs", "state", "signals", "data"),
    "x0": ("guess", "initial", "state", "anchor", "start"),
    "y": ("y", "outputs"),
}
"""The words of this package for what others call so, the best one first: arguments of functions
and attributes of objects."""

_ALIKE = """
A: amplitudes ampl
N: M num nsections
T: T0 tau period_time
X: dataset
alpha: significance sig
anchor: origin offset ref reference_section
amp: rms peak height magnitude_in size_in
atol: abs_tol
batch_size: batch
channels: ch_names columns picks channel pick ch chs
chi2: chisq redchi fun loss objective cost misfit chi_square
ci: conf_int confint confidence_interval confidence_intervals intervals bounds conf_interval
coef: coef_ coefs coefficients beta theta popt weights
confidence: conf conf_level cl coverage confidence_level
cov: vcov pcov cov_params cov_x covariance_matrix
cycles: n_cycles ncycles strides turns
d: dim nx n_states n_modes n_multipliers n_poles num_poles model_order degree rank states_number
data: experiments_data measurements records series
df: df_resid nfree ndf freedom degrees_of_freedom
doubts: warnings issues problems doubt messages flags notes message status success converged advice
dt: dt0 h max_step step_size timestep time_step
duration: t_end t1 tmax t_max tfinal t_final tend length total_time
eigenvalues: eigs eigvals eig eigenvalue pole floquet_multipliers multiplier floquet roots lambdas \
characteristic_multipliers poles_ exponents
errors: error stderr se bse std_err std_errors sd uncertainty uncertainties sigma yerr error_bars \
std_error
estimates: estimate result_ results
event: events poincare surface trigger crossing poincare_section
file: filename fname filepath path file_name name_of_file outfile out folder
free: free_parameters vary
freq: freqs frequency omega w fmax fmin freq_range frequencies f band freqrange hz faxis
fs: Fs sfreq srate sampling_rate sample_rate sampling_frequency rate sr sampling_freq
guess: init initial initial_guess p0 initial_values start_values initial_condition ic
harmonic: m n_harmonics harmonics k_harmonics harmonic_numbers
input: inputs u in_names input_names input_name control force stimulus
magnitude: mag gain amplitude_response abs
max_iter: maxiter n_iter iterations max_iterations maxfev niter max_steps
modulus: moduli radius decay
n: n_samples
n_experiments: realizations n_realizations n_trials n_repeats num_experiments nexp
n_jobs: workers n_workers num_workers parallel threads nproc processes
names: labels keys variables signal_names variable_names state_names output_names
noise: noise_std noise_level snr sigma_noise
nperiods: n_periods num_periods
n_points: npoints num_points n_pts
plot: draw figure visualize plot_2d imshow
points: bifurcations special_points bifurcation_points
save: savefig write to_file export dump to_csv
to_pandas: to_data_frame to_dataframe to_df dataframe as_dataframe frame table
order: model_degree dims
output: outputs y_names output_name observable observe measured
overlay: fit model_fit
params: parameters param theta_ params_ best_params_ x_opt p parameter parameter_names
period: periods
phase: phi
predict: forecast sim simulate lsim response fitted_values fittedvalues transform
range: ranges values_range interval_of over grid limits par_range p_range span
residuals: resid residual
sections: section n_sections_or_family poincare_sections slices
seed: random_state rng key random_seed
signal: signals variable
size: shape count
solver: method integrator algorithm stepper
stable: is_stable stability isstable
standard_errors: standard_error
state: q z
states: x_names
step: stepsize ds
system: sys hs plant robot ode
t: times ts t_eval time_points saveat
t_span: tspan time_span
tf: transfer_function freqresp frequency_response frequency_responses evalfr htfs transfer tfs
threshold: level value crossing_value
tol: rtol xtol ftol eps tolerance precision gtol rel_tol
trials: n_trials_ segments
values: array numpy to_numpy
x0: y0 z0 q0 u0 state0 initial_state initial_states
y: ys
"""
for _row in _ALIKE.strip().splitlines():
    _word, _, _others = _row.partition(":")
    for _other in _others.split():
        WORDS.setdefault(_other, WORDS.get(_word, (_word,)))

KEYWORDS = {
    "run_experiments.noise": "`hj.experiments.add_noise(data, std=...)` adds noise to data, and "
    "`process_noise` acts on the system",
    "find_limit_cycle.period": "the period follows from the clock or the search; `max_period` "
    "bounds it",
    "find_limit_cycle.settings": "pass `settings=hj.orbits.Settings(rtol=1e-9, max_steps=1000)`",
    "simulate.events": "events are transitions of the system, as in "
    "`hj.HybridSystem.from_functions(states, field, events)`",
    "simulate.t_eval": "`trajectory.at(times)` has the states at any times",
    "simulate.saveat": "`trajectory.at(times)` has the states at any times",
    "simulate.args": "parameters belong to the system: `system.replace(k=9.0)` changes them",
    "simulate.settings": "steps follow from the accuracy: pass "
    "`settings=hj.orbits.Settings(rtol=1e-9)`; `trajectory.dense()` has values between steps",
    "simulate.guess": "pass the name of a chart and a state there, or a guess: "
    "`hj.simulate(system, guess, duration)`",
    "multisine.amplitude": "pass `amplitude`, of each cosine; `design.scaled(rms)` sets the rms",
    "multisine.realizations": "`design.realizations(4)` repeats a design with new phases",
    "multisine.experiments": "`design.realizations(4)` repeats a design with new phases; "
    "`experiments` is their number for one set of frequencies",
    "Recording.rate": "pass `time`, the times of all samples: `np.arange(n) / rate`",
    "read_recording.time": "the file has a column with times, which `time` names",
    "identify_recording.time": "the recording has its times: `hj.Recording(time, signals)`",
    "continuation.parameter": "pass its name and range: `hj.continuation(cycle, 'k', (low, high))`",
    "sweep.parameter": "pass the values by name: `hj.sweep(system, {'k': values})`",
    "sweep.range": "pass the values by name: `hj.sweep(system, {'k': values})`",
    "linearize.settings": "pass `settings` to `find_limit_cycle`, whose cycle is linearized",
    "run_experiments.execution": "pass `execution=hj.scale.Execution(workers=2)`",
}
"""More than a word for an argument that a function has not: `function.word`, where the word is the
given one, or one of this package that it stands for."""

ATTRIBUTES = {
    "AbstractSections.on": "`hj.sections.place_sections(cycle, sections)` places them",
    "Design.u": "`design.signals(cycles)` returns the inputs, (S, n, nu)",
    "Design.to_numpy": "`design.signals(cycles)` returns the inputs, (S, n, nu)",
    "ExperimentData.duration": "each of the `len(data)` experiments has `data.u.shape[1]` samples",
    "ExperimentData.fs": "samples lie on sections: there are `data.n_sections` in a period",
    "ExperimentData.t": "samples lie on sections: sample i on section `i % data.n_sections`",
    "ExperimentData.shape": "`data.u` is (S, n, nu) and `data.y` is (S, n, ny)",
    "ExperimentData.mean": "`data.y.mean(axis=0)` averages experiments",
    "Fit.aic": "`hj.select_order(htf)` compares orders",
    "Fit.plot_residuals": "`hj.validate(model, data).plot()` shows residuals",
    "Fit.pvalue": "`fit.compare(other)` returns one",
    "Fit.pvalues": "`fit.compare(other)` returns them",
    "Fit.score": "`hj.validate(fit, data)` compares a fit with data",
    "Fit.predict": "`hj.validate(fit, data)` compares it with data, and `fit.htf(frequencies)` is "
    "its response",
    "Fit.fit": "`hj.fit_multipliers`, `hj.fit_series`, `hj.fit_ldtp` and `hj.fit_model` fit",
    "Fit.summary": "`print(fit)` shows a summary",
    "HTF.coherence": "`htf.variance` and `htf.standard_error` have the errors",
    "HTF.magnitude": "`abs(htf.H)` has it, and `hj.plot.bode(htf)` draws it",
    "HTF.phase": "`np.angle(htf.H)` has it, and `hj.plot.bode(htf)` draws it",
    "HTF.harmonic": "`htf.select(0)` is the HTF of one harmonic, and `htf[0]` its values",
    "HTF.gain": "`abs(htf.H)` has it, and `hj.plot.bode(htf)` draws it",
    "HTF.bode": "`hj.plot.bode(htf)` draws it",
    "HTF.shape": "`htf.H` has the shape (harmonics, frequencies, outputs, inputs)",
    "HybridSystem.params": "print the system: its parameters are its attributes",
    "HybridSystem.set": "`system.replace(k=9.0)` returns a system with other parameters",
    "HybridSystem.set_params": "`system.replace(k=9.0)` returns a system with other parameters",
    "HybridSystem.states": "`system.charts()` has the charts, each with its `states`",
    "LDTP.bode": "`hj.plot.bode(model.htf(frequencies))` draws it",
    "LDTP.dt": "a model has `n_sections` samples in a period; time is not part of it",
    "LDTP.n_states": "`model.dims` has the dimension of the state at each section",
    "LDTP.step_response": "`model.simulate(np.ones((n, nu)))` returns it",
    "LimitCycle.simulate": "`cycle.trajectory()` follows the cycle, and "
    "`hj.simulate(system, chart, state, duration)` another state",
    "LimitCycle.step": "`cycle.responses()` has the responses to brief pushes, and "
    "`cycle.sensitivity(parameter)` those to lasting changes",
    "LimitCycle.monodromy": "`cycle.multipliers` has the eigenvalues, and "
    "`hj.sections.section_map(cycle, sections, 0, 0)` the return map between sections",
    "LimitCycle.frequency": "`1 / cycle.period` is the frequency",
    "LimitCycle.freq": "`1 / cycle.period` is the frequency",
    "LimitCycle.events": "`cycle.event_sequence` has the transitions of one period",
    "LimitCycle.parameters": "`cycle.numbers` has the parameters, and `cycle.system` the system",
    "LimitCycle.prc": "`cycle.responses()` has the phase responses",
    "LimitCycle.phase_response": "`cycle.responses()` has the phase responses",
    "LimitCycle.jacobian": "`cycle.multipliers` has the eigenvalues of the return map's Jacobian",
    "LimitCycle.legs": "`cycle.pieces` has the states at the beginnings of the cycle's pieces",
    "LimitCycles.legs": "`cycles.pieces` has the states at the beginnings of the cycles' pieces",
    "LimitCycle.find": "`hj.find_limit_cycle(system)` finds one",
    "Plot.savefig": "`plot.save(path)` writes the figure, and `plot.figure` is that of matplotlib",
    "RationalFit.contains": "it has no covariance; `hj.fit_multipliers(htf, order)` has one",
    "RationalFit.interval": "it has no covariance; `hj.fit_multipliers(htf, order)` has one",
    "RationalFit.standard_errors": "it has no covariance; `hj.fit_multipliers(htf, order)` has one",
    "Recording.crop": "`hj.Recording(time[part], {name: x[part]})` makes a part",
    "Recording.data": "`recording['yM']` has the samples of a signal, `recording.to_pandas()` all "
    "signals",
    "Recording.filter": "`bandwidth`, an argument of `hj.identify_recording`, smooths signals",
    "Recording.get_data": "`recording['yM']` has the samples of a signal, `recording.to_pandas()` "
    "all signals",
    "Recording.info": "`print(recording)` shows signals, units and rates",
    "Recording.head": "`recording.to_pandas().head()` shows the first samples",
    "Recording.pick": "`recording['yM']` has the samples of a signal",
    "Recording.resample": "`hj.identify_recording` takes any rate, also uneven times",
    "Recording.values": "`recording['yM']` has the samples of a signal, `recording.to_pandas()` "
    "all signals",
    "Recording.shape": "`recording.trials` has them, with `time` and `values`",
    "Showable.copy": "results do not change, so that there is no need of a copy",
    "Showable.export": "`hj.save(path, result)` writes it",
    "Showable.save": "`hj.save(path, result)` writes it",
    "Showable.show": "`result.plot().show()` shows the figure",
    "Showable.to_csv": "`result.to_pandas().to_csv(path)` writes it",
    "Showable.to_mat": "`hj.save('name.mat', result)` writes it",
    "Showable.to_xarray": "`hj.convert.to_xarray(result)` returns a dataset",
    "Showable.write": "`hj.save(path, result)` writes it",
    "Trajectory.sol": "`trajectory.dense()` has values between steps",
    "Trajectory.x": "`trajectory.after` has the states (n, d) after each step",
    "Trajectory.y": "`trajectory.after` has the states (n, d) after each step",
    "Trajectory.ys": "`trajectory.after` has the states (n, d) after each step",
    "Trajectory.states": "`trajectory.after` has the states (n, d) after each step",
    "Trajectory.t_events": "`trajectory.events` has events with their `time`",
    "Trajectory.y_events": "`trajectory.events` has events with the states before and after",
}
"""More than a word for an attribute that a class, or one derived from it, has not."""

IN_NAMESPACES = {
    "convert": "`to_pandas`, `to_xarray`, `to_scipy` and `to_control` convert, and `result.H` and "
    "other fields are arrays",
    "models": "`dir(hj.models)` lists them",
    "plot": "`result.plot()` draws a result, and `dir(hj.plot)` lists all figures",
}
"""Where a name is none of a namespace's, and close to no other one."""

CALLED = {
    "identify": "`hj.fit_multipliers(htf, order)`, `hj.fit_series(data, order)` and "
    "`hj.identify_recording(recording, ...)` identify",
    "plot": "`result.plot()` draws a result, and `hj.plot.bode(htf)` an HTF",
    "fitting": "`hj.fit_model(system, observations, parameters)` fits",
    "experiments": "`hj.run_experiments(cycle, sections, design, outputs)` runs some",
    "sections": "`hj.ClockPhase(32)`, or `hj.Crossing('y', 'falling')`, are some",
    "linear": "`hj.linearize(cycle, sections)` linearizes",
    "convert": "`result.to_pandas()` and `hj.convert.to_xarray(result)` convert",
    "models": "`hj.models.VerticalHopper()` is one",
}
"""What does what a call of a namespace means."""

NAMES = {
    "bode_plot": "hj.plot.bode(htf)",
    "compare": "fit.compare(other)",
    "convert.to_numpy": "result.to_pandas().to_numpy()",
    "create_info": "hj.Recording(time, signals, units=...)",
    "cross_val_score": "hj.validate(fit, data)",
    "cycle": "hj.find_limit_cycle(system)",
    "datasets": "hj.testing.simulate_recording(cycle, inputs, outputs, rate)",
    "diffeqsolve": "hj.simulate(system, chart, state, duration)",
    "dlsim": "model.simulate(u)",
    "eigenvalues": "cycle.multipliers",
    "enable_double": "hj.enable_x64()",
    "find_events": "hj.Crossing('y', 'falling')",
    "fit": "hj.fit_multipliers(htf, order) or hj.fit_series(data, order)",
    "floquet": "hj.find_limit_cycle(system).multipliers",
    "floquet_multipliers": "hj.find_limit_cycle(system).multipliers",
    "forced_response": "model.simulate(u)",
    "freqresp": "model.htf(frequencies)",
    "frequency_response": "model.htf(frequencies)",
    "identify_subject": "hj.identify_recording(recording, ...)",
    "impulse_response": "model.impulse_response(n_lags)",
    "initial_response": "model.simulate(u, x0)",
    "integrate": "hj.simulate(system, chart, state, duration)",
    "load_dataset": "hj.read_recording(path)",
    "load_recording": "hj.read_recording(path)",
    "lsim": "model.simulate(u)",
    "metrics": "hj.validate(fit, data)",
    "models.Hopper": "hj.models.VerticalHopper()",
    "models.Walker": "hj.models.CompassGait()",
    "monodromy": "hj.linearize(cycle, sections)",
    "multipliers": "hj.find_limit_cycle(system).multipliers",
    "noise": "hj.experiments.add_noise(data, std=...)",
    "nyquist": "hj.plot.bode(htf)",
    "odeint": "hj.simulate(system, chart, state, duration)",
    "ode45": "hj.simulate(system, chart, state, duration)",
    "periodic_orbit": "hj.find_limit_cycle(system)",
    "plot_bode": "hj.plot.bode(htf)",
    "poincare_map": "hj.sections.section_map(cycle, sections, i, j)",
    "poincare_section": "hj.Crossing('y', 'falling')",
    "pole": "model.multipliers",
    "poles": "model.multipliers",
    "prc": "cycle.responses()",
    "random_walk": "hj.experiments.random_input(duration, rate, bandwidth)",
    "RawArray": "hj.Recording(time, signals)",
    "StateSpace": "hj.linear.LDTP(A, B, C, D)",
    "read_c3d": "hj.read_recording(path)",
    "read_csv": "hj.read_recording(path)",
    "read_mat": "hj.read_recording(path)",
    "read_raw": "hj.read_recording(path)",
    "return_map": "hj.sections.section_map(cycle, sections, i, j)",
    "run": "hj.run_experiments(cycle, sections, design, outputs)",
    "shooting": "hj.find_limit_cycle(system)",
    "solve_ivp": "hj.simulate(system, chart, state, duration)",
    "ss": "hj.linear.LDTP(A, B, C, D)",
    "plot.nyquist": "hj.plot.bode(htf)",
    "plot.time_series": "recording.plot()",
    "plot.trajectory": "cycle.plot()` or `trajectory.plot()",
    "stability": "hj.find_limit_cycle(system).stable",
    "step_response": "model.simulate(np.ones((n, nu)))",
    "subjects": "hj.identify_subjects(table, folder)",
    "tf": "model.htf(frequencies)",
    "transfer_function": "model.htf(frequencies)",
    "train_test_split": "hj.recordings.hold_out(data, order)",
    "trajectory": "hj.simulate(system, chart, state, duration)",
}
"""Names that a module has not, and the call that does what they mean. Those of the package stand
alone, and those of a namespace after its name."""

# Attributes or arguments that a message lists. Fewer: the right one is left out. More: the message
# is longer than a line.
_LISTED = 24


def about_name(package: str, name: str) -> str | None:
    """Return the rest of the sentence about a name that a namespace has not, where a call does what
    it means; None if none is known."""
    namespace = package.rpartition(".")[2]
    key = name if namespace == "hybridjax" else f"{namespace}.{name}"
    call = NAMES.get(key)
    return None if call is None else f"use `{call}`"


def about_namespace(package: str) -> str:
    """Return the rest of the sentence about a name that is close to no other one."""
    return IN_NAMESPACES.get(package.rpartition(".")[2], "")


def about_called(package: str) -> str:
    """Return the sentence about a module that was called like a function."""
    name = package.rpartition(".")[2]
    lead = CALLED.get(name, f"`dir(hj.{name})` lists its names")
    return f"`hj.{name}` is a module: {lead}."


class UnknownAttribute(HybridJaxError, AttributeError):
    """An attribute that an object has not. The sentence is composed when it is read: JAX asks for
    many attributes that are not there."""

    def __init__(self, cls: type, name: str):
        # (With a `name` Python would suggest one again.)
        super().__init__(name="")
        self._of = cls, name

    def __str__(self) -> str:
        return about_attribute(*self._of)

    def __reduce__(self) -> Any:
        # (Processes hand on the sentence: the class may not exist elsewhere.)
        return AttributeError, (str(self),)


def missing_attribute(self: Any, name: str) -> Any:
    """`__getattr__` of public classes: an error that leads on."""
    if name.startswith("_"):
        raise AttributeError(f"{type(self).__name__!r} has no attribute {name!r}")
    if inspect.getattr_static(type(self), name, None) is not None:
        # A property raised an AttributeError, which Python hides: it is raised again.
        return object.__getattribute__(self, name)
    raise UnknownAttribute(type(self), name)


def about_attribute(cls: type, name: str) -> str:
    """Return the sentence about an attribute that a class has not."""
    earlier = about_word(cls.__name__, name)
    if earlier is not None:
        return earlier
    head = f"{with_article(cls.__name__)} has no `{name}`"
    head = head[0].upper() + head[1:]
    attributes = attributes_of(cls)
    for base in cls.__mro__:
        lead = ATTRIBUTES.get(f"{base.__name__}.{name}")
        if lead is not None:
            return f"{head}: {lead}."
    word = closest(name, attributes) or _documented(cls, name)
    if word is not None:
        return f"{head}: use `{word}`."
    part = _attribute_of_part(cls, name)
    if part is not None:
        return f"{head}: use `{part}`."
    function = place_of(name)
    if function is not None:
        return f"{head}: `{function}` is a function that may take it."
    return f"{head}; it has {_some(attributes)}."


def _documented(cls: type, name: str) -> str | None:
    """Return the parameter of a system whose description has this word."""
    if dataclasses.is_dataclass(cls):
        for field in dataclasses.fields(cls):
            if name in field.metadata.get("doc", "").split():
                return field.name
    return None


def _attribute_of_part(cls: type, name: str) -> str | None:
    """Return the attribute of this name of a field, such as `fit.interval`."""
    if not dataclasses.is_dataclass(cls):
        return None
    for field in dataclasses.fields(cls):
        if isinstance(field.type, type) and name in attributes_of(field.type):
            return f"{field.name}.{name}"
    return None


def attributes_of(cls: type) -> list[str]:
    """Return the public attributes of a class, its fields first."""
    fields: list[str] = []
    if dataclasses.is_dataclass(cls):
        fields = [field.name for field in dataclasses.fields(cls) if field.repr]
    names = dict.fromkeys([*fields, *dir(cls)])
    hidden = {"code_digest"}
    return [name for name in names if name[0] != "_" and name not in hidden]


NEEDS = {
    "data": "`hj.run_experiments(cycle, sections, design, outputs)` makes data",
    "order": "the number of multipliers, which `hj.select_order(htf)` helps to find",
    "sections": "`hj.ClockPhase(32)`, or `hj.Crossing('y', 'falling')`, are some",
    "estimate_phase.sections": "an event that happens once a cycle, such as "
    "`hj.Crossing('y', 'falling')` of a signal 'y'",
    "identify_recording.sections": "an event that happens once a cycle, such as "
    "`hj.Crossing('y', 'falling')` of a signal 'y'",
}
"""What a missing argument is, of any function or of one."""


def about_missing(function: str, name: str, kind: Kind | None) -> str:
    """Return the sentence about an argument that a function needs."""
    lead = NEEDS.get(f"{function.rpartition('.')[2]}.{name}", NEEDS.get(name))
    if lead is not None:
        return f"{function} needs `{name}`: {lead}."
    about = "" if kind is None else f" ({kind.allowed})"
    return f"{function} needs `{name}`{about}{about_object(function, kind, None)}."


def about_keyword(
    function: str, name: str, parameters: Sequence[str], first: Any = None
) -> str:
    """Return the sentence about an argument that a function has not.

    **Arguments:** `first`: the first argument; a system may have a parameter of this name.
    """
    earlier = about_word(function, name)
    if earlier is not None:
        return earlier
    short = function.rpartition(".")[2]
    head = f"{function} has no argument `{name}`"
    words = [name, *WORDS.get(name, ())]
    for word in words:
        lead = KEYWORDS.get(f"{short}.{word}")
        if lead is not None:
            return f"{head}: {lead}."
    if hasattr(type(first), "charts") and name in attributes_of(type(first)):
        change = f"`system.replace({name}=...)` returns a system with another `{name}`"
        return f"{head}: {KEYWORDS.get(f'{short}.parameter', change)}."
    word = closest(name, parameters)
    if word is not None:
        return f"{head}: use `{word}`."
    return f"{head}; it has {_some(parameters)}."


def closest(name: str, among: Collection[str]) -> str | None:
    """Return the name that is meant: a word for the same, or one that is spelled alike."""
    for word in WORDS.get(name, ()):
        if word in among:
            return word
    by_case = {word.lower(): word for word in among}
    if name.lower() in by_case:
        return by_case[name.lower()]
    ending = f"_{name}"
    named = [x for x in among if x.endswith(ending) or x.startswith(f"{name}_")]
    alike = difflib.get_close_matches(name, among, n=1, cutoff=0.7)
    for found in (alike, named):
        if found:
            return found[0]
    return None


def about_object(function: str, kind: Kind | None, value: Any) -> str:
    """Return the call that makes what a function needs instead of a value, or the part of it that
    is needed, as the rest of a sentence; "" if none is known."""
    for base in type(value).__mro__:
        lead = OBJECTS.get(f"{function}.{base.__name__}")
        if lead is not None:
            return f": {lead}"
    wanted = list(classes_in(kind))
    for cls in wanted:
        part = _part(value, cls)
        if part is not None:
            return f": pass its `{part}`"
    given = [cls.__name__ for cls in type(value).__mro__]
    for cls in wanted:
        for base in given:
            step = STEPS.get((cls.__name__, base))
            if step is not None:
                return f": {step}"
    makers = [MAKERS[cls.__name__] for cls in wanted if cls.__name__ in MAKERS]
    return f": {makers[0]}" if makers else ""


def classes_in(kind: Kind | None) -> Iterable[type]:
    """Iterate over the classes of which a kind takes objects."""
    cls = getattr(kind, "cls", None)
    if cls is not None:
        yield cls
    item = getattr(kind, "item", None)
    for part in (*getattr(kind, "kinds", ()), *([item] if item else [])):
        yield from classes_in(part)


def _part(value: Any, cls: type) -> str | None:
    """Return the name of the field of an object that holds one of the class."""
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return None
    if getattr(cls, "_is_protocol", False):
        return None
    for field in dataclasses.fields(value):
        part = getattr(value, field.name, None)
        if not field.name.startswith("_") and isinstance(part, cls):
            return field.name
    return None


def _some(names: Collection[str]) -> str:
    """Return a list of names, or the first of many."""
    shown = [f"`{name}`" for name in list(names)[:_LISTED]]
    more = len(names) - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more > 0 else "")
