"""Attribute names of other libraries that a class here does not have, each with what to use.

Tables for `leads.py`.

A table has for each class the advice, and the words that lead to it. If a message gives the wrong
advice for a word, move the word; `sentences.py` has advice that several tables share.

If a word leads nowhere, add it to the words of its advice, or add an advice to its class; a class
is asked before those that it is derived from. A word must stand once for a class, and be none of
its attributes; calls and attributes in an advice must exist. `tests/test_guesses.py` checks all
this.
"""

from .sentences import (
    COMPARE,
    CONTROL,
    DECAY,
    EXPONENT,
    MADE_OF_FUNCTIONS,
    RESIDUALS,
)


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
    "LimitCycle LDTP Fit Identification ModelIdentification NaturalIdentification "
    "NaturalMultipliers PlantCycle": {
        DECAY: (
            "half_life time_constant decay_rate settling settling_time half_time relaxation"
        ),
        EXPONENT: "lyapunov exponent",
        "`max(result.modulus)` is the largest": (
            "largest dominant leading max_multiplier maxfm max_floquet max_modulus slowest radius"
        ),
    },
    "AbstractSections": {
        "`hj.sections.place_sections(cycle, sections)` places them": (
            "on place bind_to"
        ),
    },
    "Design": {
        "`design.signals(cycles)` returns the inputs, (S, n, nu)": (
            "u to_numpy waveform time_series samples values generate evaluate signal array x"
        ),
        "`hj.run_experiments(cycle, sections, design, outputs)` runs it": (
            "run simulate apply"
        ),
        "`design.write(path)` writes a table": "save to_csv export to_file",
        "`design.scaled(rms)` changes the amplitude": "scale rescale normalize rms",
        "`design.experiments` is the number of experiments, those of all realizations together": (
            "n_experiments n_realizations n_repeats num_realizations"
        ),
    },
    "ExperimentData": {
        "each of the `len(data)` experiments has `data.u.shape[1]` samples": (
            "duration length n_samples"
        ),
        "samples lie on sections: there are `data.n_sections` in a period": "fs",
        "samples lie on sections: sample i on section `i % data.n_sections`": (
            "t time"
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
        RESIDUALS: "residuals resid",
        "`hj.validate(model, data).plot()` shows residuals": (
            "plot_residuals plot_resid plot_diagnostics diagnostics"
        ),
        "`fit.interval(level)` has intervals, which follow from `fit.covariance`": (
            "bootstrap jackknife resample profile_likelihood conf_region"
        ),
        COMPARE: "pvalue tvalues t_test f_test wald_test",
        "`hj.validate(fit, data)` compares a fit with data; `validation.fit` is the share "
        "explained": "score r2 rsquared rmse mse nrmse goodness",
        "`hj.validate(fit, data)` compares it with data, and `fit.htf(frequencies)` is its "
        "response": "predict",
        "`hj.fit_multipliers`, `hj.fit_series`, `hj.fit_ldtp` and `hj.fit_model` fit": (
            "fit refit fit_transform"
        ),
        "`len(fit.multipliers)` is the order": (
            "n_components order n_features n_features_in model_order n_poles n_parameters nstates"
        ),
        "`fit.multipliers` and `fit.coefficients` have the numbers, and a function makes a new "
        "fit": "get_params set_params",
        "`hj.plot.bode(htf, fit)` draws it over an HTF": "bode bode_plot nyquist",
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
        "`htf.magnitude` has it, and `hj.plot.bode(htf)` draws it": (
            "gain mag db dcgain"
        ),
        "`htf.phase` has it in radians, and `hj.plot.bode(htf)` draws it": "angle",
        "`htf['y']` is the HTF of an output": "output get_output sel_output",
        "`htf.select(0)` is the HTF of one harmonic, and `htf[0]` its values": (
            "harmonic eval evaluate evalfr at loc iloc sel isel"
        ),
        "`hj.plot.bode(htf)` draws it": "bode nyquist freqz bode_plot",
        "`htf.H` has the shape (harmonics, frequencies, outputs, inputs)": "shape",
        "`hj.fit_multipliers(htf, order)` estimates multipliers": (
            "fit poles multipliers eigenvalues"
        ),
        "`hj.identify.fit_rational(htf)` has zeros": "zeros",
        "it is the response: `htf.H` at `htf.frequencies`": (
            "freqresp frequency_response response tf freq"
        ),
        "`htf.frequencies` are in cycles per period": "w omega f hz faxis fs",
    },
    "HybridSystem": {
        MADE_OF_FUNCTIONS: (
            "from_function from_field from_equations from_ode from_sympy from_dict from_modes"
        ),
        "print the system: its parameters are its attributes": (
            "params parameters get_params parameter_names"
        ),
        "`system.replace(k=9.0)` returns a system with other parameters": (
            "set set_params update with_parameters copy"
        ),
        "`system.charts()` has the charts, each with its `states`": (
            "states n_states dims state_names modes domains"
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
        "`hj.plot.bode(model)` draws it": "bode nyquist bode_plot",
        "`model.htf(frequencies)` is the response": "freqresp frequency_response",
        "a model has `n_sections` samples in a period; time is not part of it": (
            "dt fs ts"
        ),
        "`model.dims` has the dimension of the state at each section": (
            "n_states order nx shape"
        ),
        "a model is discrete: `model.A[k]` and `model.B[k]` go from section k to the next": (
            "discretize to_discrete c2d sample resample"
        ),
        "`len(model.inputs)` and `len(model.outputs)` are their numbers": (
            "n_inputs n_outputs nu ny"
        ),
        "`model.simulate(np.ones((n, nu)))` returns it": (
            "step_response step step_info"
        ),
        "`model.impulse_response(n_lags)` returns it": "impulse",
        CONTROL: (
            "damp damping dcgain margin gramian gram norm hinf minreal balred ctrb obsv "
            "to_tf to_ss rlocus observability controllability"
        ),
        "`hj.identify.fit_rational(model.htf(frequencies))` has zeros": "zeros",
    },
    "LimitCycle LimitCycles": {
        "`pieces` has the states at the beginnings of the cycle's pieces": "legs",
    },
    "LimitCycle": {
        "`np.ptp(cycle.trajectory()('name')[1])` is that of a signal": (
            "amplitude peak_to_peak max min"
        ),
        "`np.linalg.eig(model.monodromy())`, of `model = hj.linearize(cycle, sections)`, has "
        "them": ("eigenvectors modes floquet_vectors"),
        "`cycle.trajectory()` follows the cycle, and `hj.simulate(system, chart, state, "
        "duration)` another state": "simulate",
        "`cycle.trajectory()` has times `t` and states `after`; `cycle.trajectory()('name')` one "
        "signal": (
            "t time x y ys states q orbit solution points values sol evaluate at sample "
            "interpolate state_at eval"
        ),
        "`cycle.responses()` has the responses to brief pushes, and "
        "`cycle.sensitivity(parameter)` those to lasting changes": (
            "step impulse_response perturb push"
        ),
        "`hj.linearize(cycle, sections).monodromy()` has it, and `cycle.multipliers` its "
        "eigenvalues": "monodromy monodromy_matrix",
        "`hj.sections.section_map(cycle, sections, 0, 0)` is the return map of a section": (
            "poincare_map poincare"
        ),
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
            "prc phase_response isochron adjoint sensitivity_function"
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
            "drop_channels rename rename_channels drop pick_types reorder_channels set_index "
            "select rename_signals add_channels set_units pick_channels add_signal append_signal "
            "assign"
        ),
        "`recording.crop(start, stop)` returns the part between two times": (
            "iloc loc slice truncate cut split trim between sel part"
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
        "`hj.read_recording(path)` reads files": (
            "from_csv from_file read_csv read from_c3d from_mat from_path open from_raw"
        ),
        "`hj.Recording(table)` takes a table, such as a DataFrame": (
            "from_dataframe from_pandas from_df from_table from_polars"
        ),
        "`hj.Recording(time, {'name': samples})` makes one of arrays": (
            "from_arrays from_numpy from_dict"
        ),
        "`print(recording)` shows signals, units and rates": "info describe",
        "`recording.to_pandas().head()` shows the first samples": "head",
        "`recording[name]` has the samples of a signal": (
            "pick get get_signal channel"
        ),
        "`hj.identify_recording` takes any rate, also uneven times": (
            "resample decimate interpolate"
        ),
        "`recording.trials` has them, with `time` and `values`": "shape n_trials",
        "`len(recording.time)` is the number of samples": (
            "n_times n_samples size length"
        ),
        "`len(recording.signals)` is the number of signals": (
            "n_channels nchan n_signals"
        ),
        "`recording.trials[0].events` has the times of events, and `recording.mark(name, "
        "hj.Crossing(signal, 'falling'))` adds some": (
            "annotations events event_id heel_strikes strikes toe_off gait_events find_events "
            "set_annotations markers stim_channel spikes peaks find_peaks onset"
        ),
        "`scipy.signal.welch(recording[name], recording.rate)` returns a spectrum": (
            "psd compute_psd welch spectrum spectrogram fft periodogram"
        ),
        "`hj.recordings.estimate_phase(recording, sections)` has its `periods`": (
            "phase periods cadence stride_time strides n_strides cycles gait_cycle step_time "
            "frequency stride_length step_length normalize_time"
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
            "n_strides strides n_cycles cycles stride_time periods n_trials cadence step_times"
        ),
        "`result.fit.htf(frequencies)` is the HTF": "htf transfer_function",
        "`hj.plot.bode(result)` draws it": "bode bode_plot nyquist",
        "`result.held_out.validation` compares a fit with held-out cycles": (
            "validation score r2 rsquared rmse goodness cross_validation"
        ),
        "`result.fit` is the fit": "model params coef",
        "`hj.validate(result, data)` compares it with data, and `result.fit.htf(frequencies)` is "
        "its response": "predict simulate",
        RESIDUALS: "residuals resid",
        "`hj.save(path, result.fit)` writes the fit, and `result.write_report(folder)` all": (
            "save export to_file dump"
        ),
    },
    "Validation": {
        "`validation.fit` is the share of each output that the model explains, in %": (
            "r2 rsquared score vaf nrmse rmse mse goodness explained_variance accuracy error"
        ),
        "`validation.whiteness` and `validation.independence` have the p values": (
            "pvalue ljung_box"
        ),
    },
    "OrderSelection": {
        "`selection.order` is the order, and the print shows its criteria": (
            "best best_order aic bic best_params scores selected best_estimator best_index"
        ),
    },
    "OptimalDesign": {
        "`plan.design.write(path)` writes a table": "write save export to_csv to_file",
        "`plan.cycles_for(standard_error)` returns the number of cycles": (
            "n_cycles n_strides strides sample_size required power_analysis"
        ),
        "`plan.saved` is the factor against the usual design": (
            "efficiency gain factor ratio d_efficiency"
        ),
    },
    "Flow": {
        "`jax.jacfwd` of a function that returns `hj.flow(...).state` is its Jacobian": (
            "jacobian jac monodromy stm gradient grad derivative sensitivity"
        ),
    },
    "Event": {
        "`event.before` and `event.after` have the states by name": (
            "states q x y values jump"
        ),
    },
    "Trial": {
        "`recording.plot()` draws the signals": "plot",
        "`recording[name]` has the samples of a signal, `trial.values` those of all": (
            "data x y signals get_data"
        ),
    },
    "Trajectory": {
        "`charts, states = trajectory.at(times)` interpolates, and `trajectory.dense()` has "
        "many times": (
            "sol evaluate interpolation interp interpolate dense_output eval sample resample"
        ),
        "`trajectory.after` has the states (n, d) after each step, and `trajectory(name)` a "
        "signal": "x y ys states q values data signals outputs",
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
        "`branch.bifurcations` has them": "hopf folds flips",
    },
    "Population": {
        "`population.difference(quantity, a, b)` tests a difference, with p values": (
            "ttest anova pvalue compare test mixedlm effect"
        ),
        "`population.table` and `population.values` have the numbers": (
            "data df groups subjects"
        ),
    },
}
"""What to do instead of an attribute that is missing in a class and in those derived from it."""
