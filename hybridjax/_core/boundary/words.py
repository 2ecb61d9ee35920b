"""Words of other libraries, and which call, argument or attribute of this package each one means.

`WORDS` has words for the same thing. The other tables hold sentences, each with the words that lead
to it, by the name of their owner: a class, a function or a namespace; "" stands for all. A word
stands for a whole name ("step_info"), or for a part of names: "psd" for `plot_psd` and `psds_`. A
plural stands for its singular, too. Errors read these tables; nothing else does.
"""

import functools
import importlib
import re
from collections.abc import Iterable, Iterator


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

_CONTROL = (
    "`hj.convert.to_control(model)` is a system of python-control, for its functions"
)
_HELD_OUT = (
    "`hj.validate(fit, other_data)` tries a fit on other data, and "
    "`hj.recordings.hold_out(result.data, order)` on cycles that were held out"
)
_AT_TIMES = "`trajectory.at(times)` has the states at any times"
_SIGNAL = (
    "`scipy.signal` has it, for arrays such as `recording[name]`; `bandwidth`, an argument of "
    "`hj.identify_recording`, smooths signals"
)
_SOLVER = (
    "`hj.simulate(system, guess, duration)` integrates, and "
    "`hj.orbits.Settings(solver=diffrax.Tsit5(), rtol=1e-9)` sets solver and accuracy"
)
_DECAY = (
    "it follows from the modulus: a deviation is halved after "
    "`np.log(0.5) / np.log(max(result.modulus))` cycles"
)
_EXPONENT = (
    "it follows from the multipliers: `np.log(max(result.modulus)) / period`; of a recording, "
    "`hj.identify_recording(recording, ...)` or `hj.recordings.natural_multipliers(data)` "
    "estimates them"
)
_COMPARE = "`fit.compare(other)` tests the difference from another fit or a truth"

KEYWORDS = {
    "": {
        _HELD_OUT: (
            "cv kfold n_splits test_size train_size split holdout held_out validation_split "
            "test_data train"
        ),
        "responses are computed from whole periods, without windows; `discard` of "
        "`hj.run_experiments` leaves out the first cycles, and `drift` of "
        "`hj.identify_recording` removes drift": (
            "window nperseg noverlap nfft overlap taper detrend scaling"
        ),
        _AT_TIMES: "t_eval saveat save_at",
        "`jax.grad` and `jax.jacfwd` differentiate, and need no options": (
            "adjoint jac jacobian gradient vectorized jac_sparsity"
        ),
        "all cycles are used: `hj.Recording(time[part], {name: recording[name][part]})` makes a "
        "part of a recording": (
            "tmin tmax crop max_cycles n_strides strides first_cycle last_cycle"
        ),
        "`hj.scale.enable_progress()` shows the progress": (
            "verbose disp progress progressbar progress_bar progress_meter show_progress tqdm "
            "quiet"
        ),
        "`hj.enable_x64()` sets the precision, for all": "dtype precision float64",
        "`jax.default_device(...)` chooses the device": "device gpu backend cpu",
        "results and systems do not change: functions return new ones": (
            "copy inplace copy_x"
        ),
    },
    "bode": {
        "`unit='Hz'` with `period=cycle` draws frequencies in Hz": "hz rad",
        "`log=True` draws decibels over a logarithmic axis": "db decibel logscale",
        "phases are in degrees": "deg degrees",
        "limits are those of matplotlib: `plot.axes[0, 0].set_xlim(low, high)`": (
            "omega_limits range xlim freq_range"
        ),
        "an HTF has its frequencies: `model.htf(frequencies)`": (
            "omega w freq frequencies"
        ),
        _CONTROL: "margins",
    },
    "htf": {
        "`hj.plot.bode(htf, log=True)` draws decibels": "db decibel log logscale phase",
    },
    "plot": {
        "`ax` takes an `Axes` of matplotlib, and `plot.axes[0, 0]` can be changed afterwards": (
            "bins c cmap color colors dpi figsize fontsize grid height hue label labels legend "
            "linestyle linewidth logx logy ls lw marker markersize palette size style title "
            "width xlabel xlim xscale ylabel ylim yscale"
        ),
    },
    "run_experiments": {
        "`hj.experiments.add_noise(data, std=...)` adds noise to data, and `process_noise` acts "
        "on the system": "noise",
        "pass `execution=hj.scale.Execution(workers=2)`": "execution",
        "a design has its length: `hj.multisine(n_sections, periods)`": (
            "cycles periods duration"
        ),
        "`design.realizations(4)` repeats a design with new phases": (
            "realizations trials repeats"
        ),
        "`design.scaled(rms)` changes the amplitude of a design": "amplitude rms",
    },
    "find_limit_cycle": {
        "the period follows from the clock or the search; `max_period` bounds it": (
            "period"
        ),
        "pass `settings=hj.orbits.Settings(rtol=1e-9, max_steps=20_000)`": "settings",
    },
    "simulate": {
        "events are transitions of the system, as in `hj.HybridSystem.from_functions(states, "
        "field, events)`": "events",
        "parameters belong to the system: `system.replace(k=9.0)` changes them": (
            "args"
        ),
        "`trajectory.at(times)` has the states at any times": "t_eval saveat",
        "`time` is that at the beginning, and `duration` how long it lasts": (
            "t0 t_start start t1"
        ),
        "steps follow from the accuracy: pass `settings=hj.orbits.Settings(rtol=1e-9)`; "
        "`trajectory.dense()` has values between steps": (
            "settings stepsize_controller controller"
        ),
        "pass the name of a chart and a state there, or a guess: `hj.simulate(system, guess, "
        "duration)`": "guess",
        "it returns a trajectory always: `trajectory.at(times)`, `trajectory.dense()`": (
            "dense dense_output return_full full_output"
        ),
    },
    "multisine": {
        "pass `amplitude`, of each cosine; `design.scaled(rms)` sets the rms": (
            "amplitude power"
        ),
        "`design.realizations(4)` repeats a design with new phases": "realizations",
        "`design.realizations(4)` repeats a design with new phases; `experiments` is their "
        "number for one set of frequencies": "experiments",
        "`hj.experiments.optimize_phases(design)` makes the peaks small": (
            "phases crest crest_factor schroeder"
        ),
        "samples lie on sections: frequencies are in cycles per period, and `design.write(path, "
        "cycles, period=..., rate=...)` makes samples in time": "rate fs dt",
        "pass `periods`, after which the input repeats": "duration cycles",
    },
    "Recording": {
        "pass `time`, the times of all samples: `np.arange(n) / rate`": "rate",
    },
    "read_recording": {
        "the file has a column with times, which `time` names": "time rate",
        "headers and separators are recognized; `signals` chooses columns, `time` names that of "
        "time": (
            "sep delimiter header skiprows index_col encoding decimal names usecols preload"
        ),
    },
    "identify_recording estimate_phase sample_sections": {
        "the recording has its times: `hj.Recording(time, signals)`": "time",
        "`bandwidth` is the bandwidth of the signals in Hz": (
            "cutoff lowpass l_freq h_freq fc filter smooth smoothing smoothing_factor"
        ),
    },
    "select_order": {
        "it compares orders by two criteria, which `print` shows; `max_order` bounds them": (
            "scoring score criterion metric ic method orders min_order"
        ),
    },
    "validate": {
        "it has the criteria of all kinds: `print(hj.validate(model, data))`": (
            "scoring score metric metrics"
        ),
    },
    "fit_model": {
        "`hj.parameter(1.0, positive=True)` in the system bounds a parameter": (
            "bounds limits constraints"
        ),
        "observations have their weights: `hj.fitting.ObservedHTF(htf, sections)`": (
            "sigma weights"
        ),
    },
    "fit_multipliers fit_series fit_ldtp fit_rational": {
        "`hj.select_order` helps to choose the order; there is no penalty": (
            "alpha ridge regularization penalty lam lambda_ l1 l2"
        ),
        "means are removed before: the average cycle is no part of the fit": (
            "fit_intercept normalize intercept trend"
        ),
    },
    "optimal_design": {
        "`plan.cycles_for(standard_error)` returns the number of cycles for an accuracy": (
            "cycles strides n_cycles budget accuracy standard_error"
        ),
    },
    "parameter": {
        "`positive=True` keeps it positive, and there are no other bounds": (
            "bounds limits constraints range min max lower upper low high"
        ),
    },
    "explore": {
        "pass names: `hj.explore(system, 'k')`, with `ranges={'k': (low, high)}`": (
            "parameter parameters"
        ),
    },
    "continuation": {
        "pass its name and range: `hj.continuation(cycle, 'k', (low, high))`": (
            "parameter"
        ),
    },
    "sweep": {
        "pass the values by name: `hj.sweep(system, {'k': values})`": (
            "parameter range grid"
        ),
    },
    "estimate_htf": {
        "samples lie on sections, and frequencies are in cycles per period": (
            "rate fs dt"
        ),
        "`hj.run_experiments(..., discard=...)` leaves out the first cycles": (
            "discard transient skip"
        ),
    },
    "linearize": {
        "pass `settings` to `find_limit_cycle`, whose cycle is linearized": "settings",
        "derivatives are exact: there is no step": "eps step delta h method",
    },
}
"""What to do instead of an argument that a function has not."""

ATTRIBUTES = {
    "Showable": {
        "results do not change, so that there is no need of a copy": "copy deepcopy",
        "`hj.save(path, result)` writes it": (
            "export save write pickle dump to_file savez to_npz"
        ),
        "`result.plot().show()` shows the figure": "show",
        "`result.to_pandas().to_csv(path)` writes it": "to_csv",
        "`hj.save('name.mat', result)` writes it": "to_mat savemat",
        "`hj.convert.to_xarray(result)` returns a dataset": (
            "to_xarray to_netcdf xarray"
        ),
        "`print(result)` shows a summary": "summary",
        "`result.findings` lists reasons to doubt it": "success converged ok valid",
    },
    "LimitCycle LDTP Fit Identification ModelIdentification NaturalMultipliers PlantCycle": {
        _DECAY: (
            "half_life halflife time_constant decay_rate settling settling_time half_time "
            "relaxation"
        ),
        _EXPONENT: "lyapunov exponent exponents",
        "`max(result.modulus)` is the largest": (
            "largest dominant leading max_multiplier maxfm max_floquet max_modulus slowest "
            "radius"
        ),
    },
    "AbstractSections": {
        "`hj.sections.place_sections(cycle, sections)` places them": (
            "on place bind_to"
        ),
    },
    "Design": {
        "`design.signals(cycles)` returns the inputs, (S, n, nu)": (
            "u to_numpy waveform waveforms time_series timeseries samples values sample "
            "generate evaluate signal array x"
        ),
        "`hj.run_experiments(cycle, sections, design, outputs)` runs it": (
            "run simulate apply"
        ),
        "`design.write(path)` writes a table": "save to_csv export to_file",
        "`design.scaled(rms)` changes the amplitude": "scale rescale normalize rms",
        "`design.experiments` is the number of experiments": "n_experiments",
    },
    "ExperimentData": {
        "each of the `len(data)` experiments has `data.u.shape[1]` samples": (
            "duration length n_samples"
        ),
        "samples lie on sections: there are `data.n_sections` in a period": "fs",
        "samples lie on sections: sample i on section `i % data.n_sections`": (
            "t time times"
        ),
        "`data.u` is (S, n, nu) and `data.y` is (S, n, ny)": "shape ndim dtype",
        "`data.y.mean(axis=0)` averages experiments, and `data.cycle_outputs` is the cycle": (
            "mean average averaged evoked"
        ),
        "`data[name]` has the samples of a signal, and `data.u` and `data.y` all": (
            "values data get_data x X inputs_data"
        ),
        "`hj.estimate_htf(data)` makes an HTF of data": (
            "htf bode frequency_response estimate tfestimate"
        ),
        "`hj.experiments.add_noise(data, std=...)` adds noise": (
            "noise add_noise corrupt"
        ),
        "`data.ok` marks the experiments without failures, and `data.require_ok()` takes no "
        "others": "drop dropna good drop_bad success failures failed",
        "`data.u` and `data.y` are arrays: index them": (
            "crop discard select part iloc loc"
        ),
    },
    "SectionData": {
        "`data.records[0]` has `u` (n, nu) and `y` (n, ny) at the sections of a trial": (
            "u y values shape get_data samples"
        ),
        "`data.cycle_outputs` is the average cycle": "mean average averaged evoked",
        "`hj.fit_series(data, order)` fits data at sections": "fit",
    },
    "Fit": {
        "`hj.select_order(htf)` compares orders, and `print` shows its criteria": (
            "aic bic mdl aicc"
        ),
        "`hj.validate(model, data).plot()` shows residuals": (
            "plot_residuals plot_resid plot_diagnostics diagnostics"
        ),
        _COMPARE: "pvalue pvalues p_value tvalues t_test f_test wald_test ttest",
        "`hj.validate(fit, data)` compares a fit with data; `validation.fit` is the share "
        "explained": "score r2 rsquared rmse mse nrmse goodness",
        "`hj.validate(fit, data)` compares it with data, and `fit.htf(frequencies)` is its "
        "response": "predict",
        "`hj.fit_multipliers`, `hj.fit_series`, `hj.fit_ldtp` and `hj.fit_model` fit": (
            "fit refit fit_transform"
        ),
        "`len(fit.multipliers)` is the order": (
            "n_components order n_features n_features_in model_order n_poles n_parameters "
            "nstates"
        ),
        "`fit.multipliers` and `fit.coefficients` have the numbers, and a function makes a new "
        "fit": "get_params set_params",
        "a fit is made in one go, with the numbers in `fit.chi2_per_dof`": (
            "n_iter nfev n_iterations history"
        ),
    },
    "ParameterFit": {
        "`fit.names`, `fit.values` and `fit.standard_errors` have the parameters": (
            "get_params params best_params best_values best_estimator feature_names coef popt "
            "intercept"
        ),
        "`fit.names` has the names of the parameters": (
            "feature_names_in param_names var_names"
        ),
        "`fit.cycle` is the limit cycle with the fitted parameters": (
            "best_fit fitted limit_cycle"
        ),
    },
    "HTF": {
        "`htf.variance` and `htf.standard_errors` have the errors": (
            "coherence coh mscohere"
        ),
        "`abs(htf.H)` has it, and `hj.plot.bode(htf)` draws it": (
            "magnitude gain mag db"
        ),
        "`np.angle(htf.H)` has it, and `hj.plot.bode(htf)` draws it": "phase angle",
        "`htf.select(0)` is the HTF of one harmonic, and `htf[0]` its values": (
            "harmonic eval evaluate evalfr at loc iloc sel isel"
        ),
        "`hj.plot.bode(htf)` draws it": "bode nyquist freqz",
        "`htf.H` has the shape (harmonics, frequencies, outputs, inputs)": "shape",
        "`hj.fit_multipliers(htf, order)` estimates multipliers": (
            "fit poles pole multipliers eigenvalues zeros"
        ),
        "`htf.frequencies` are in cycles per period": "w omega f hz faxis fs",
    },
    "HybridSystem": {
        "print the system: its parameters are its attributes": (
            "params parameters get_params parameter_names"
        ),
        "`system.replace(k=9.0)` returns a system with other parameters": (
            "set set_params update with_parameters copy"
        ),
        "`system.charts()` has the charts, each with its `states`": (
            "states n_states nstates dims state_names modes domains"
        ),
        "`system.transitions()` has the events": (
            "events guards resets impacts switches"
        ),
        "`hj.simulate(system, guess, duration)` simulates it": (
            "simulate run integrate solve"
        ),
        "`hj.find_limit_cycle(system)` finds it": (
            "limit_cycle cycle find_limit_cycle periodic_orbit steady_state gait"
        ),
        "`system.charts()[name].field` is the vector field": (
            "field f rhs dynamics vector_field dydt derivative"
        ),
        "`hj.linearize(hj.find_limit_cycle(system), sections)` linearizes about the cycle": (
            "linearize jacobian multipliers eigenvalues"
        ),
    },
    "LDTP": {
        "`hj.plot.bode(model.htf(frequencies))` draws it": (
            "bode nyquist freqresp bode_plot frequency_response"
        ),
        "a model has `n_sections` samples in a period; time is not part of it": (
            "dt fs ts"
        ),
        "`model.dims` has the dimension of the state at each section": (
            "n_states nstates order nx n_x shape"
        ),
        "`len(model.inputs)` and `len(model.outputs)` are their numbers": (
            "n_inputs ninputs n_outputs noutputs nu ny"
        ),
        "`model.simulate(np.ones((n, nu)))` returns it": (
            "step_response step step_info"
        ),
        "`model.impulse_response(n_lags)` returns it": "impulse",
        _CONTROL: (
            "damp damping dcgain margin gramian gram norm hinf minreal balred ctrb obsv zero "
            "sample to_tf to_ss c2d nyquist rlocus"
        ),
        "`hj.identify.fit_rational(model.htf(frequencies))` has zeros": "zeros",
    },
    "LimitCycle LimitCycles": {
        "`pieces` has the states at the beginnings of the cycle's pieces": "legs",
    },
    "LimitCycle": {
        "`cycle.trajectory()` follows the cycle, and `hj.simulate(system, chart, state, "
        "duration)` another state": "simulate",
        "`cycle.trajectory()` has times `t` and states `after`; `cycle.trajectory()('name')` "
        "one signal": "t time x y ys states q orbit solution points values sol",
        "`cycle.responses()` has the responses to brief pushes, and "
        "`cycle.sensitivity(parameter)` those to lasting changes": (
            "step impulse_response perturb push"
        ),
        "`cycle.multipliers` has the eigenvalues, and `hj.sections.section_map(cycle, sections, "
        "0, 0)` the return map between sections": "monodromy poincare_map poincare",
        "`1 / cycle.period` is the frequency": (
            "frequency freq rate cadence omega speed_of_rhythm"
        ),
        "`cycle.event_sequence` has the transitions of one period, and "
        "`cycle.trajectory().events` their times": (
            "events duty_factor duty stance swing stance_time swing_time stance_duration "
            "heel_strike contact transitions flight event_times durations"
        ),
        "`cycle.numbers` has the parameters, and `cycle.system` the system": (
            "parameters params"
        ),
        "`cycle.responses()` has the phase responses": (
            "prc phase_response isochron isochrons adjoint sensitivity_function"
        ),
        "`cycle.multipliers` has the eigenvalues of the return map's Jacobian": (
            "jacobian"
        ),
        "`hj.find_limit_cycle(system)` finds one": "find fit solve",
        "`hj.linearize(cycle, sections)` linearizes about it": (
            "linearize linearization ss ldtp to_ss model"
        ),
        "`hj.continuation(cycle, parameter, (low, high))` continues it": (
            "continue continuation bifurcation"
        ),
        "`hj.plot.animate(cycle)` moves it": "animate animation movie",
    },
    "Plot": {
        "`plot.save(path)` writes the figure, and `plot.figure` is that of matplotlib": (
            "savefig fig write export to_file"
        ),
    },
    "RationalFit": {
        "it has no covariance; `hj.fit_multipliers(htf, order)` has one": (
            "contains interval standard_errors"
        ),
        "`fit.numerator[:, 0]` and `fit.htf(frequencies)` have the gain": (
            "gain k dcgain"
        ),
    },
    "Recording": {
        "`hj.Recording(time[part], {name: recording[name][part]})` makes a recording of some "
        "signals or samples": (
            "crop iloc loc drop_channels rename rename_channels drop pick_types "
            "reorder_channels set_index select slice truncate cut split rename_signals "
            "add_channels set_units pick_channels add_signal append_signal assign"
        ),
        "`recording[name]` has the samples of a signal, `recording.to_pandas()` all signals": (
            "data get_data values x samples_array to_numpy"
        ),
        "`bandwidth`, an argument of `hj.identify_recording`, smooths signals; `scipy.signal` "
        "filters arrays": (
            "filter notch_filter notch lowpass highpass bandpass smooth savgol detrend butter "
            "velocity derivative differentiate gradient normalize baseline rereference "
            "set_eeg_reference interpolate_bads"
        ),
        "`print(recording)` shows signals, units and rates": "info describe",
        "`recording.to_pandas().head()` shows the first samples": "head",
        "`recording[name]` has the samples of a signal": "pick get get_signal channel",
        "`hj.identify_recording` takes any rate, also uneven times": (
            "resample decimate interpolate"
        ),
        "`recording.trials` has them, with `time` and `values`": (
            "shape n_trials ntrials"
        ),
        "`len(recording.time)` is the number of samples": (
            "n_times n_samples nsamples size length"
        ),
        "`len(recording.signals)` is the number of signals": (
            "n_channels nchan nchannels n_signals"
        ),
        "`recording.trials[0].events` has the times of events, and `recording.mark(name, "
        "hj.Crossing(signal, 'falling'))` adds some": (
            "annotations events event_id heel_strikes heel_strike strikes strike toe_off "
            "gait_events find_events set_annotations markers event stim_channel spikes peaks "
            "find_peaks onset"
        ),
        "`scipy.signal.welch(recording[name], recording.rate)` returns a spectrum": (
            "psd compute_psd welch spectrum spectrogram fft periodogram"
        ),
        "`hj.recordings.estimate_phase(recording, sections)` has its `periods`": (
            "phase periods cadence stride_time stride_times strides n_strides cycles period "
            "stride gait_cycle step_time frequency stride_length step_length normalize_time"
        ),
        "`hj.identify_recording` takes signals as `inputs` and `outputs`": (
            "ch_types set_channel_types channel_types kinds inputs outputs set_inputs u y"
        ),
        "`hj.Recording.join(recordings)` combines trials, and `hj.Recording.beside(recordings)` "
        "signals": "append concat concatenate add extend merge combine stack",
        "it is in memory": "load_data load compute preload",
        "`hj.recordings.check_recording(recording, inputs, outputs)` looks for mistakes": (
            "check validate bads isna isnull dropna fillna quality artifacts plot_bads info_bad "
            "missing"
        ),
        "`hj.identify_recording(recording, sections, inputs=..., outputs=...)` identifies it": (
            "identify fit multipliers fit_series"
        ),
    },
    "Identification": {
        "`result.data.cycles` is the number of cycles, and `result.phase.periods` has their "
        "durations": (
            "n_strides strides n_cycles cycles stride_time stride_times periods period n_trials "
            "cadence step_times"
        ),
        "`result.fit.htf(frequencies)` is the HTF": "htf bode transfer_function",
        "`result.held_out.validation` compares a fit with held-out cycles": (
            "validation score r2 rsquared rmse goodness cross_validation"
        ),
        "`result.fit` is the fit": "model params coef",
    },
    "Validation": {
        "`validation.fit` is the share of each output that the model explains, in %": (
            "r2 rsquared r_squared score vaf nrmse rmse mse goodness explained_variance "
            "accuracy error"
        ),
        "`validation.whiteness` and `validation.independence` have the p values": (
            "pvalue pvalues p_value ljung_box"
        ),
        "residuals are `validation.measured - validation.simulated`": (
            "residuals resid errors residual"
        ),
    },
    "OrderSelection": {
        "`selection.order` is the order, and the print shows its criteria": (
            "best best_order aic bic best_params scores score selected best_estimator "
            "best_index"
        ),
    },
    "OptimalDesign": {
        "`plan.cycles_for(standard_error)` returns the number of cycles": (
            "n_cycles n_strides strides sample_size required power_analysis"
        ),
        "`plan.saved` is the factor against the usual design": (
            "efficiency gain factor ratio d_efficiency"
        ),
    },
    "Trajectory": {
        "`trajectory.at(times)` has the states at any times, `trajectory.dense()` many": (
            "sol evaluate interpolation interp interpolate dense_output eval sample resample"
        ),
        "`trajectory.after` has the states (n, d) after each step, and `trajectory(name)` a "
        "signal": "x y ys states state q values data signals outputs output",
        "`trajectory.events` has events with their `time`": (
            "t_events event_mask event_times"
        ),
        "`trajectory.events` has events with the states before and after": "y_events",
        "`len(trajectory.t)` is the number of steps, and `trajectory.result` how it ended": (
            "stats nfev njev nlu n_steps num_steps status message success converged"
        ),
        "`trajectory.t[-1]` is the last time": "t1 tf end duration t_final",
    },
    "Branch": {
        "`branch.points` has them": "bifurcations special_points hopf folds",
    },
    "Population": {
        "`population.difference(quantity, a, b)` tests a difference, with p values": (
            "ttest anova pvalue pvalues compare test t_test mixedlm effect"
        ),
        "`population.table` and `population.values` have the numbers": (
            "data df groups subjects"
        ),
    },
}
"""What to do instead of an attribute that a class, or one derived from it, has not."""

NAMES = {
    "": {
        "use `hj.plot.bode(htf)`": (
            "bode_plot nyquist plot_bode nyquist_plot freqz singular_values_plot"
        ),
        "use `fit.compare(other)`": "compare",
        "use `hj.Recording(time, signals, units=...)`": "create_info",
        "use `hj.validate(fit, data)`": (
            "cross_val_score metrics score r2_score rmse residuals goodness whiteness "
            "mean_squared_error compare_models evaluate"
        ),
        "use `hj.find_limit_cycle(system)`": (
            "find_cycle cycle periodic_orbit shooting periodic orbit limitcycle steady_state "
            "find_orbit bvp solve_bvp collocation"
        ),
        "use `hj.testing.simulate_recording(cycle, inputs, outputs, rate)`": (
            "datasets synthetic fake_data example_data"
        ),
        "use `hj.simulate(system, chart, state, duration)`": (
            "diffeqsolve integrate odeint ode45 solve_ivp trajectory solve ode ivp simulation "
            "integrator"
        ),
        "use `model.simulate(u)`": "dlsim forced_response lsim forced",
        "use `cycle.multipliers`": "eigenvalues eig eigvals eigenvalue",
        "use `hj.enable_x64()`": "enable_double float64 set_precision config double",
        "use `hj.Crossing('y', 'falling')` of a signal 'y', or `recording.mark(name, crossing)`": (
            "find_events poincare_section event find_peaks heel_strike detect_events "
            "events_from_annotations crossing peaks strikes zero_crossings toe_off"
        ),
        "use `hj.fit_multipliers(htf, order)` or `hj.fit_series(data, order)`": (
            "fit identify regression n4sid arx armax sysid estimate ssest ar var_model "
            "least_squares_fit"
        ),
        "use `hj.find_limit_cycle(system).multipliers`": (
            "floquet floquet_multipliers multipliers characteristic_multipliers"
        ),
        "use `model.htf(frequencies)`": (
            "freqresp frequency_response tf transfer_function htf transfer"
        ),
        "use `hj.identify_recording(recording, ...)`": (
            "identify_subject identify_trial identify_gait analyze analyse analysis"
        ),
        "use `model.impulse_response(n_lags)`": "impulse_response impulse",
        "use `model.simulate(u, x0)`": "initial_response",
        "`hj.read_recording(path)` reads files of signals, and `hj.load(path)` those of "
        "`hj.save`": (
            "load_dataset load_recording read_c3d read_csv read_mat read_raw read mot sto trc "
            "c3d csv edf bdf open import load_data parquet excel loadmat file io load"
        ),
        "use `hj.linearize(cycle, sections)`": "monodromy linearization jacobian",
        "use `hj.experiments.add_noise(data, std=...)`": (
            "noise measurement_noise awgn"
        ),
        "use `hj.sections.section_map(cycle, sections, i, j)`; `hj.plot.return_map(cycle)` draws "
        "one": "poincare_map poincare stroboscopic cobweb",
        "use `model.multipliers`": "pole poles",
        "use `cycle.responses()`": (
            "prc phase_response_curve isochron isochrons ipr adjoint"
        ),
        "`hj.multisine(n_sections)` makes a periodic input, "
        "`hj.experiments.random_input(duration, rate, bandwidth)` a random one, and "
        "`hj.run_experiments` also takes an array": (
            "random_walk chirp prbs prbs_signal input excitation square sawtooth sweep_signal "
            "signal gausspulse white whitenoise swept_sine step_signal perturbation pushes push "
            "sine multisines crested random_phase stimulus schroeder"
        ),
        "use `hj.Recording(time, signals)`": "RawArray from_arrays dataframe raw",
        "use `hj.linear.LDTP(A, B, C, D)`": "StateSpace ss statespace dlti lti",
        "use `hj.run_experiments(cycle, sections, design, outputs)`": (
            "run experiment experiments perturb collect"
        ),
        "use `hj.find_limit_cycle(system).stable`": "stability stable is_stable",
        "use `model.simulate(np.ones((n, nu)))`": "step_response step_info step dstep",
        "use `hj.scale.enable_progress()`": (
            "progress tqdmprogressmeter verbose set_log_level"
        ),
        "use `hj.identify_subjects(table, folder)`": (
            "subjects group population groups study"
        ),
        _HELD_OUT: (
            "train_test_split kfold cross_validate cross_val cv holdout split validation "
            "leave_one_out"
        ),
        _CONTROL: (
            "damp damping margin margins gramian gram ctrb obsv controllability observability "
            "balred balanced balanced_reduction minreal hinf h2 hinfsyn lqr dlqr lqe kalman "
            "place acker pid dcgain c2d d2c zpk ss2tf tf2ss tf2zpk rlocus root_locus nichols "
            "hsvd nichols_plot locus sisotool sensitivity interconnect series parallel append "
            "reachable care dare lyap dlyap norm lead_lag gain_margin disk_margins h2syn"
        ),
        "use `model.feedback(controller)`, of a model or an HTF": (
            "feedback closed_loop loop"
        ),
        "use `hj.identify.fit_rational(htf)`": (
            "zeros zero vectfit rational vector_fit tfest invfreqz"
        ),
        "use `hj.plot.poles_zeros(fit)`": (
            "pzmap pole_zero_plot zplane pole_zero_map pole_zero"
        ),
        "`hj.estimate_htf(data)` estimates responses by frequency, with `htf.variance`; "
        "`scipy.signal.welch(recording[name], recording.rate)` returns a spectrum": (
            "psd psds welch spectrogram periodogram csd cpsd coherence cohere mscohere spectrum "
            "spectra spectral fft rfft stft tfe tfestimate etfe spa frequency"
        ),
        _SIGNAL: (
            "butter filter filtfilt sosfilt lfilter resample detrend decimate savgol "
            "savgol_filter notch lowpass highpass bandpass firwin hilbert hann convolve "
            "correlate smooth smoothing medfilt interpolate"
        ),
        "use `hj.recordings.sample_sections(recording, sections, inputs=..., outputs=...)`": (
            "epochs epoch epoching time_normalize normalize segment segments fixed_length "
            "gait_cycles cut stride strides"
        ),
        "`data.cycle_outputs` is the average cycle": (
            "evoked average grand_average ensemble_average"
        ),
        "use `hj.Recording.join(recordings)`": (
            "concatenate concat concatenate_raws concatenate_recordings append_recordings "
            "combine merge"
        ),
        _EXPONENT: (
            "lyapunov lyapunov_exponent exponent maxfm mfm lle rosenstein divergence "
            "local_dynamic_stability orbital_stability"
        ),
        _DECAY: "half_life time_constant settling_time decay",
        _AT_TIMES: "saveat t_eval subsaveat",
        _SOLVER: (
            "odeterm term odesolver solver tsit5 dopri5 dopri8 kvaerno5 kvaerno3 stepsize "
            "stepsize_controller pid_controller stepto constantstepsize euler heun rk45 bdf "
            "lsoda options tolerances rtol integratoroptions settings"
        ),
        "derivatives need no options: `jax.grad` and `jax.jacfwd` differentiate": (
            "adjoint_method recursivecheckpointadjoint backsolveadjoint directadjoint grad "
            "jacfwd gradient"
        ),
        "`hj.Transition(name, source, target, guard, reset)` is an event of a system": (
            "reset guard discreteterminatingevent impact discrete_event terminal switch jump"
        ),
        "subclasses of `hj.HybridSystem`, or `hj.HybridSystem.from_functions(states, field, "
        "events)`, are systems": (
            "system model module odesystem hybrid_automaton vectorfield vector_field "
            "dynamical_system nlsys nonlinearsystem automaton mode domain iosys"
        ),
        "joint angles come from other programs: `hj.read_recording(path)` reads them": (
            "inverse kinematics inverse_dynamics muscle moco scale_model osim opensim marker "
            "forceplate"
        ),
        "use `hj.continuation(cycle, parameter, (low, high))`": (
            "bifurcation bifurcations bifurcation_diagram continue_cycle branch auto follow"
        ),
        "use `hj.sweep(system, {'k': values})`": (
            "grid_search gridsearch gridsearchcv grid param_grid scan parameter_sweep ensemble "
            "montecarlo"
        ),
        "use `hj.fit_model(system, observations, parameters)`": (
            "least_squares curve_fit minimize optimize optimise calibrate parameter_estimation "
            "estimate_parameters fit_parameters lmfit optimizer"
        ),
        _COMPARE + "; `hj.recordings.Population` compares groups": (
            "permutation permutation_test bootstrap ttest t_test ttest_ind anova pvalue "
            "wilcoxon cluster_test mixedlm statistics stats significance"
        ),
        "`result.diagnosis.expected` and `plan.cycles_for(standard_error)` predict the number "
        "of cycles": (
            "learning_curve power_analysis sample_size power n_strides how_many"
        ),
        "use `cycle.plot(x, y)`": (
            "phase_portrait phase_plane portrait phaseplot streamplot phase_plot"
        ),
        "use `hj.plot.animate(cycle)`": "animation movie video",
        "`result.to_pandas()` returns a table of pandas": (
            "to_pandas to_csv to_dataframe dataframe_of table export"
        ),
        "use `result.plot()`, or a figure of `hj.plot`": (
            "figure subplots show draw plotting visualize savefig"
        ),
        "`hj.select_order(htf)` compares orders": "aic bic order model_order scree",
        "use `fit.interval()` and `fit.standard_errors`": (
            "confidence_interval confint conf_int interval standard_error error_bars"
        ),
        "use `hj.scale.Execution(workers=2)`": (
            "parallel_map workers n_jobs pool multiprocessing"
        ),
    },
    "convert": {
        "use `result.to_pandas().to_numpy()`": "to_numpy numpy array",
        "use `hj.save('name.mat', result)`": "to_mat to_matlab matlab savemat",
        "use `result.to_pandas().to_csv(path)`": "to_csv csv to_r excel",
        "use `hj.convert.to_control(model)`": "to_ss control to_tf ss",
    },
    "models": {
        "use `hj.models.VerticalHopper()`": (
            "Hopper SpringMass hop bouncing runner slip"
        ),
        "use `hj.models.CompassGait()`": (
            "Walker walking compass biped gait Gait2392 inverted_pendulum"
        ),
        "use `hj.models.PaddleJuggler()`": "bouncing_ball ball juggler",
    },
    "plot": {
        "use `hj.plot.bode(htf)`": (
            "nyquist freqz frequency_response bode_plot nichols magnitude transfer_function "
            "margins"
        ),
        "use `hj.plot.multipliers(fit)`": (
            "poles eigenvalues unit_circle rlocus floquet pole"
        ),
        "use `hj.plot.poles_zeros(fit)`": "pzmap pole_zero zplane zeros",
        "use `recording.plot()`": "time_series timeseries raw recording signals",
        "use `cycle.plot(x, y)`": (
            "phase_portrait limit_cycle portrait orbit phase_plane"
        ),
        "use `cycle.plot()` or `trajectory.plot()`": (
            "trajectory states simulation solution"
        ),
        "use `hj.plot.validation(validation)`": "residuals residual prediction fit qq",
        "use `hj.plot.spectrum(plan, model)`, or `design.plot()`": (
            "psd spectra periodogram design"
        ),
        "use `hj.plot.branch(branch)`": "bifurcation bifurcation_diagram continuation",
        "use `hj.plot.animate(cycle)`": "animation movie",
        "use `hj.plot.return_map(cycle)`": (
            "cobweb poincare poincare_map poincare_section first_return stroboscopic"
        ),
        "use `plot.show()`": "show",
    },
}
"""What to do instead of a name that a namespace has not; those of the package, "", also stand for
those of a namespace."""

LIBRARIES = {
    "Plot": {
        "matplotlib.axes.Axes": "`plot.axes[0, 0]` is an `Axes` of matplotlib, which has it",
        "matplotlib.figure.Figure": "`plot.figure` is a `Figure` of matplotlib, which has it",
    },
    "Showable": {
        "pandas.DataFrame": "`result.to_pandas()` is a table of pandas, which has it",
    },
    "": {
        "control": _CONTROL,
        "scipy.signal": _SIGNAL,
        "diffrax": _SOLVER,
        "numpy": "numpy has it: results hold arrays",
    },
}
"""Libraries, and their classes, whose names lead to them: on objects of a class, and in the
namespaces of this package."""


def lead_of_library(owners: Iterable[str], name: str) -> str | None:
    """Return the sentence of the first library that has a name. (Libraries that are installed are
    imported for that: an error has time.)"""
    for owner in owners:
        for path, sentence in LIBRARIES.get(owner, {}).items():
            if _has(path, name):
                return sentence
    return None


def _has(path: str, name: str) -> bool:
    """Test whether a module, or a class in it, has a name."""
    module, _, cls = path.rpartition(".")
    is_class = cls[:1].isupper()
    try:
        thing = importlib.import_module(module if is_class else path)
    except ImportError:
        return False
    return hasattr(getattr(thing, cls) if is_class else thing, name)


def lead_of(table: dict, owners: Iterable[str], name: str) -> str | None:
    """Return the sentence of the whole name, of the first owner that has it."""
    word = _plain(name)
    for owner in owners:
        sentence = _by_word(table, owner).get(word)
        if sentence is not None:
            return sentence
    return None


def synonyms(name: str) -> tuple[str, ...]:
    """Return the words of this package for a word of others, the best one first."""
    return WORDS.get(name) or _plain_words().get(_plain(name), ())


def parts(name: str) -> Iterator[str]:
    """Iterate over the words in a name, the last one first. (Letters stand for too much.)"""
    found = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)
    for part in reversed(found):
        if len(part) > 2 and len(found) > 1:
            yield part.lower()


def same_word(name: str, among: Iterable[str]) -> str | None:
    """Return the name that differs only in case, underscores and number."""
    by_word = {_plain(other).lower(): other for other in reversed(list(among))}
    return by_word.get(_plain(name).lower())


def with_part(part: str, among: Iterable[str]) -> str | None:
    """Return the first name of which this is a part, or another word for the same."""
    by_part: dict[str, str] = {}
    for name in among:
        for word in (name, *parts(name)):
            by_part.setdefault(_plain(word), name)
    for word in (part, *synonyms(part)):
        if len(word) > 2 and _plain(word) in by_part:
            return by_part[_plain(word)]
    return None


def _plain(word: str) -> str:
    """Return a word without case, underscores and plural. (Single letters differ by case.)"""
    plain = word.replace("_", "")
    if len(plain) < 2:
        return plain
    plain = plain.lower()
    is_plural = len(plain) > 3 and plain.endswith("s") and not plain.endswith("ss")
    return plain[:-1] if is_plural else plain


@functools.cache
def _plain_words() -> dict[str, tuple[str, ...]]:
    found: dict[str, tuple[str, ...]] = {}
    for word, meant in WORDS.items():
        found.setdefault(_plain(word), meant)
    return found


def _by_word(table: dict[str, dict[str, str]], owner: str) -> dict[str, str]:
    """The sentences of an owner by their words. (Only where an error is raised.)"""
    found: dict[str, str] = {}
    for owners, sentences in table.items():
        if owner not in (owners.split() or [""]):
            continue
        for sentence, words in sentences.items():
            for word in words.split():
                found.setdefault(_plain(word), sentence)
    return found
