"""Function names of other libraries that a namespace here does not have, each with the name to use.

Tables for `leads.py`.

A table has for each namespace the advice, and the words that lead to it. If a message gives the
wrong advice for a word, move the word; `sentences.py` has advice that several tables share.

If a word leads nowhere, add it to the words of its advice, or add an advice to its namespace; ""
is the package. A word must stand once for a namespace, and be none of its public names (two that
are parts of names are excepted); calls in an advice must exist. `tests/test_guesses.py` checks all
this.
"""

from .sentences import (
    AT_TIMES,
    COMPARE,
    CONTROL,
    DECAY,
    EXPONENT,
    HELD_OUT,
    MADE_OF_FUNCTIONS,
    RESIDUALS,
    SIGNAL,
    SOLVER,
)


NAMES = {
    "": {
        "use `hj.plot.bode(htf)`": (
            "bode_plot nyquist plot_bode nyquist_plot freqz singular_values_plot"
        ),
        "use `fit.compare(other)`": "compare",
        "use `hj.Recording(time, signals, units=...)`": "create_info",
        "use `hj.validate(fit, data)`": (
            "cross_val_score metrics score r2_score rmse goodness whiteness "
            "mean_squared_error compare_models evaluate"
        ),
        RESIDUALS: "residuals resid",
        "use `hj.find_limit_cycle(system)`": (
            "find_cycle cycle periodic_orbit shooting periodic orbit limitcycle steady_state "
            "find_orbit bvp solve_bvp collocation"
        ),
        "use `hj.testing.simulate_recording(cycle, inputs, outputs, rate)`": (
            "datasets synthetic fake_data example_data"
        ),
        "use `hj.simulate(system, state, duration)`": (
            "diffeqsolve integrate odeint ode45 solve_ivp trajectory solve ode ivp simulation "
            "integrator"
        ),
        "use `model.simulate(u)`": "dlsim forced_response lsim forced",
        "use `cycle.multipliers`, or those of a model or a fit": (
            "eigenvalues eig eigvals pole"
        ),
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
        "use `model.htf(frequencies)`, of `model = hj.linearize(cycle, sections)`, or of a fit": (
            "freqresp frequency_response tf transfer_function htf transfer"
        ),
        "`hj.ClockPhase(n)` is a family of n sections, and `hj.Crossing('y', 'falling')` a single "
        "one": ("clock_sections section clock kinematic_sections event_sections"),
        "`hj.identify_recording(recording, sections, outputs=names)` needs no inputs": (
            "identify_unperturbed unperturbed identify_natural variability"
        ),
        "use `hj.identify_recording(recording, ...)`": (
            "identify_subject identify_trial identify_gait analyze analyse analysis gait "
            "gait_stability"
        ),
        "use `model.impulse_response(n_lags)`": "impulse_response impulse",
        "use `model.simulate(u, x0)`": "initial_response",
        "`hj.read_recording(path)` reads files of signals, and `hj.load(path)` those of "
        "`hj.save`": (
            "load_dataset load_recording read_c3d read_csv read_mat read_raw read mot sto trc c3d "
            "csv edf bdf open import load_data parquet excel loadmat file io load"
        ),
        "use `hj.linearize(cycle, sections)`, and its `monodromy()`": (
            "monodromy linearization jacobian"
        ),
        "use `hj.experiments.add_noise(data, std=...)`": (
            "noise measurement_noise awgn"
        ),
        "use `hj.sections.section_map(cycle, sections, i, j)`; `hj.plot.return_map(cycle)` draws "
        "one": "poincare_map poincare stroboscopic cobweb",
        "`cycle.responses()` has that of a model, and `hj.recordings.phase_response(recording, "
        "sections, input)` estimates one": (
            "prc phase_response phase_response_curve ipr adjoint sta spike_triggered "
            "spike_triggered_average phase_resetting phase_resetting_curve"
        ),
        "use `cycle.asymptotic_phase(chart, state)`": "isochron asymptotic_phase",
        "use `hj.recordings.estimate_phase(recording, sections)`": (
            "phase phase_angle instantaneous_phase"
        ),
        "`cycle.sensitivity(parameter)` has derivatives of a cycle, and `jax.grad` those of any "
        "number": "sensitivity sensitivities parameter_sensitivity",
        "use `result.write_report(folder)`": "report write_report make_report",
        "`hj.optimal_design(model)` and `hj.multisine(n_sections)` make designs": (
            "design design_experiment experiment_design optimal_input doe"
        ),
        "`hj.simulate(system, chart, state, duration)` shows where a state goes, and "
        "`hj.flow(system, start, duration)` where many go": (
            "basin basin_of_attraction attractor viability"
        ),
        "`hj.multisine(n_sections)` makes a periodic input, "
        "`hj.experiments.random_input(duration, rate, bandwidth)` a random one, and "
        "`hj.run_experiments` also takes an array": (
            "random_walk chirp prbs prbs_signal input excitation square sawtooth sweep_signal "
            "signal gausspulse white whitenoise swept_sine step_signal perturbation pushes push "
            "sine multisines crested random_phase stimulus schroeder"
        ),
        "use `hj.Recording(time, signals)`": "RawArray from_arrays dataframe raw",
        "use `hj.linear.LDTP(A, B, C, D)`": "StateSpace ss dlti lti",
        "use `hj.run_experiments(cycle, sections, design, outputs)`": (
            "run experiment perturb collect"
        ),
        "use `hj.find_limit_cycle(system).is_stable`": "stability stable is_stable",
        "use `model.simulate(np.ones((n, nu)))`": (
            "step_response step_info step dstep"
        ),
        "use `hj.scale.enable_progress()`": (
            "progress tqdmprogressmeter verbose set_log_level"
        ),
        "use `hj.identify_subjects(table, folder)`": "subjects population study",
        "`hj.recordings.Population.from_fits(fits, {'subject': names, 'group': groups})"
        ".difference('modulus', a, b)` compares two groups of fits": (
            "group compare_groups group_difference compare_populations compare_subjects"
        ),
        HELD_OUT: (
            "train_test_split kfold cross_validate cross_val cv holdout split validation "
            "leave_one_out"
        ),
        CONTROL: (
            "damp damping margin gramian gram ctrb obsv controllability observability balred "
            "balanced balanced_reduction minreal hinf h2 hinfsyn lqr dlqr lqe kalman place acker "
            "pid dcgain c2d d2c zpk ss2tf tf2ss tf2zpk rlocus root_locus nichols hsvd "
            "nichols_plot locus sisotool interconnect series parallel append "
            "reachable care dare lyap dlyap norm lead_lag gain_margin disk_margins h2syn"
        ),
        "use `model.feedback(controller)`, of a model or an HTF": (
            "feedback closed_loop loop"
        ),
        "use `hj.identify.fit_rational(htf)`": (
            "zeros vectfit rational vector_fit tfest invfreqz"
        ),
        "use `hj.plot.poles_zeros(fit)`": (
            "pzmap pole_zero_plot zplane pole_zero_map pole_zero"
        ),
        "`hj.estimate_htf(data)` estimates responses by frequency, with `htf.variance`; "
        "`scipy.signal.welch(recording[name], recording.rate)` returns a spectrum": (
            "psd welch spectrogram periodogram csd cpsd coherence cohere mscohere spectrum "
            "spectra spectral fft rfft stft tfe tfestimate etfe spa frequency"
        ),
        SIGNAL: (
            "butter filter filtfilt sosfilt lfilter resample detrend decimate savgol "
            "savgol_filter notch lowpass highpass bandpass firwin hilbert hann convolve correlate "
            "smooth smoothing medfilt interpolate"
        ),
        "use `hj.recordings.sample_sections(recording, sections, inputs=..., outputs=...)`": (
            "epochs epoching time_normalize normalize segment fixed_length gait_cycles cut stride"
        ),
        "`data.cycle_outputs` is the average cycle": (
            "evoked average grand_average ensemble_average"
        ),
        "use `hj.Recording.join(recordings)`": (
            "concatenate concat concatenate_raws concatenate_recordings append_recordings combine "
            "merge"
        ),
        EXPONENT: (
            "lyapunov lyapunov_exponent exponent maxfm mfm lle rosenstein divergence "
            "local_dynamic_stability orbital_stability"
        ),
        DECAY: "half_life time_constant settling_time decay",
        AT_TIMES: "saveat t_eval subsaveat",
        SOLVER: (
            "odeterm term odesolver solver tsit5 dopri5 dopri8 kvaerno5 kvaerno3 stepsize "
            "stepsize_controller pid_controller stepto constantstepsize euler heun rk45 lsoda "
            "options tolerances rtol integratoroptions settings"
        ),
        "derivatives need no options: `jax.grad` and `jax.jacfwd` differentiate": (
            "adjoint_method recursivecheckpointadjoint backsolveadjoint directadjoint grad jacfwd "
            "gradient"
        ),
        "`hj.Transition(name, source, target, guard, reset)` is an event of a system": (
            "reset guard discreteterminatingevent impact discrete_event terminal switch jump"
        ),
        MADE_OF_FUNCTIONS: (
            "system model module odesystem hybrid_automaton vectorfield dynamical_system nlsys "
            "nonlinearsystem automaton mode domain iosys"
        ),
        "joint angles come from other programs: `hj.read_recording(path)` reads them": (
            "inverse kinematics inverse_dynamics muscle moco scale_model osim opensim marker "
            "forceplate"
        ),
        "use `hj.continuation(cycle, parameter, (low, high))`": (
            "bifurcation bifurcation_diagram continue_cycle branch auto follow"
        ),
        "use `branch.bifurcations`, of `hj.continuation(cycle, parameter, (low, high))`": (
            "hopf hopf_points period_doubling fold limit_point neimark_sacker bifurcation_points"
        ),
        "equations are written as fields: `hj.HybridSystem.from_functions(states, field, "
        "events)`": (
            "sbml read_sbml load_sbml antimony tellurium cellml xppaut read_ode sympy"
        ),
        "equations are given, not discovered: `hj.fit_model(system, observations, parameters)` "
        "fits their parameters, and `hj.fit_series(data, order)` a linear model": (
            "sindy pysindy discover symbolic_regression dmd edmd koopman"
        ),
        "use `hj.sweep(system, {'k': values})`": (
            "grid_search gridsearchcv grid param_grid scan parameter_sweep ensemble montecarlo"
        ),
        "use `hj.fit_model(system, observations, parameters)`": (
            "least_squares curve_fit minimize optimize optimise calibrate parameter_estimation "
            "estimate_parameters fit_parameters lmfit optimizer"
        ),
        COMPARE + "; `hj.recordings.Population` compares groups": (
            "permutation permutation_test bootstrap ttest ttest_ind anova pvalue wilcoxon "
            "cluster_test mixedlm statistics stats significance"
        ),
        "`result.diagnosis.expected` and `plan.cycles_for(standard_error)` predict the number of "
        "cycles": (
            "learning_curve power_analysis sample_size power n_strides how_many duration "
            "required_duration how_long trial_length"
        ),
        "use `cycle.plot(x, y)`": (
            "phase_portrait phase_plane portrait phaseplot streamplot"
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
            "confidence_interval confint interval standard_error error_bars"
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
        "use `hj.models.PaddleJuggler()`": "juggler",
        "use `hj.models.BouncingBall()`": "ball",
        MADE_OF_FUNCTIONS: (
            "relay thermostat feedback oscillator loop system mode relay_feedback"
        ),
    },
    "plot": {
        "use `hj.plot.bode(htf)`": (
            "nyquist freqz frequency_response bode_plot nichols magnitude transfer_function "
            "margins"
        ),
        "use `hj.plot.multipliers(fit)`": (
            "poles eigenvalues unit_circle rlocus floquet"
        ),
        "use `hj.plot.poles_zeros(fit)`": "pzmap pole_zero zplane zeros",
        "use `recording.plot()`": "time_series raw recording signals",
        "use `cycle.plot(x, y)`": (
            "phase_portrait limit_cycle portrait orbit phase_plane"
        ),
        "use `cycle.plot()` or `trajectory.plot()`": (
            "trajectory states simulation solution"
        ),
        "use `validation.plot()`": "residuals prediction fit qq",
        "use `hj.plot.spectrum(plan, model)`, or `design.plot()`": (
            "psd spectra periodogram design"
        ),
        "use `hj.plot.branch(branch)`": (
            "bifurcation bifurcation_diagram continuation"
        ),
        "use `hj.plot.animate(cycle)`": "animation movie",
        "use `hj.plot.return_map(cycle)`": (
            "cobweb poincare poincare_map poincare_section first_return stroboscopic"
        ),
        "use `plot.show()`": "show",
    },
}
"""What to do instead of a name that a namespace has not; those of the package, "", also stand for
those of a namespace."""

IN_NAMESPACES = {
    "convert": "`to_xarray`, `to_scipy`, `to_control` and `result.to_pandas()` convert, and "
    "`result.H` and other fields are arrays",
    "hybridjax": "`dir(hj)` lists its names, and those of the page of each namespace, such as "
    "`hj.recordings`, are one level below",
    "models": "`dir(hj.models)` lists its names; `hj.HybridSystem.from_functions(states, field, "
    "events)`, or a subclass of `hj.HybridSystem`, is a model of your own",
    "plot": "`result.plot()` draws a result, and `dir(hj.plot)` lists all figures",
}
"""Where a name is none of a namespace's, and close to no other one; `dir` in the others."""

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
