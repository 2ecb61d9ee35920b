"""Argument names of other libraries that a function here does not have, each with the name to use;
and what an argument is that a call left out.

Tables for `leads.py`.

A table has for each function ("" for all) the advice, and the words that lead to it. If a message
gives the wrong advice for a word, move the word.

If a word leads nowhere, add it to the words of its advice, or add an advice to its function, which
is asked before "". A word must stand once for a function; calls and their arguments in an advice
must exist (`tests/test_guesses.py` checks this). If the message about an argument that was left out
is wrong, look at `NEEDS`, where `function.argument` is asked before `argument`.
"""

from .sentences import AT_TIMES, CONTROL, HELD_OUT


KEYWORDS = {
    "": {
        HELD_OUT: (
            "cv kfold n_splits test_size train_size split holdout held_out validation_split "
            "test_data train"
        ),
        "responses are computed from whole periods, without windows; `discard` of "
        "`hj.run_experiments` leaves out the first cycles, and `drift` of `hj.identify_recording` "
        "removes drift": "window nperseg noverlap nfft overlap taper detrend scaling",
        AT_TIMES: "t_eval saveat",
        "`jax.grad` and `jax.jacfwd` differentiate, and need no options": (
            "adjoint jac jacobian gradient vectorized jac_sparsity"
        ),
        "`recording.crop(start, stop)` is a part of a recording; of it, all cycles are used": (
            "tmin tmax crop max_cycles n_strides strides first_cycle last_cycle"
        ),
        "`hj.scale.enable_progress()` shows the progress": (
            "verbose disp progress progressbar progress_meter show_progress tqdm quiet"
        ),
        "`hj.enable_x64()` sets the precision, for all": "dtype precision float64",
        "`jax.default_device(...)` chooses the device": "device gpu backend cpu",
        "results and systems do not change: functions return new ones": (
            "copy inplace copy_x"
        ),
        "the same call gives the same numbers always: there is nothing to seed": (
            "seed random_state rng key random_seed"
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
        CONTROL: "margins",
    },
    "htf": {
        "`hj.plot.bode(htf, log=True)` draws decibels": (
            "db decibel log logscale phase"
        ),
    },
    "plot": {
        "`ax` takes an `Axes` of matplotlib, and `plot.axes[0, 0]` can be changed afterwards": (
            "bins c cmap color dpi figsize fontsize grid height hue label legend linestyle "
            "linewidth logx logy ls lw marker markersize palette size style title width xlabel "
            "xlim xscale ylabel ylim yscale"
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
    "flow": {
        "use `until`, the time at the end": (
            "t1 t_end t_final duration t_span t stop tf end length"
        ),
        "a `Guess` has the time at the start: `hj.Guess(chart, state, time)`": (
            "t0 t_start time"
        ),
        "`start` is the chart, the state and the time: `hj.Guess(chart, state, time)`": (
            "chart state"
        ),
    },
    "simulate": {
        "`cycle.trajectory(periods)` follows a cycle": "n_cycles cycles periods",
        "events are transitions of the system, as in `hj.HybridSystem.from_functions(states, "
        "field, events)`": "events",
        "parameters belong to the system: `system.replace(k=9.0)` changes them": (
            "args"
        ),
        AT_TIMES: "t_eval saveat",
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
        "`design.realizations(4)` repeats a design with new phases; `experiments` is their number "
        "for one set of frequencies": "experiments",
        "`design.optimize_phases()` makes the peaks small": (
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
        "`signals` chooses columns, and `hj.identify_recording` takes signals as `inputs` and "
        "`outputs`": "inputs outputs u y channels columns",
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
            "scoring score metric"
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
            "parameter"
        ),
    },
    "continuation": {
        "pass its range by its name: `hj.continuation(cycle, k=(low, high))`": (
            "parameter icp par active_parameter continuation_parameter"
        ),
        "use `range`, (low, high)": (
            "bounds limits interval values par_bounds stop rl0 rl1 p_min p_max"
        ),
        "`max_points` is the largest number of cycles in each direction": (
            "nmx max_steps max_num_points max_iter"
        ),
        "`step` is the longest step, as a part of the range; the shortest follows from the curve": (
            "dsmax dsmin ds0 min_step"
        ),
        "the branch goes to both ends of the range": "direction backward forward bothside",
    },
    "natural_multipliers": {
        "`hj.identify_recording(recording, sections, outputs=...)` takes recordings": (
            "outputs sections n_sections inputs signals bandwidth"
        ),
    },
    "sweep": {
        "pass the values by name: `hj.sweep(system, k=values)`": (
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
        "pass `settings` to `find_limit_cycle`, whose cycle is linearized": (
            "settings"
        ),
        "derivatives are exact: there is no step": "eps step delta h method",
        "a model has no step of time: its samples lie on the sections": (
            "ts dt fs rate sample_time sampling_time"
        ),
    },
}
"""What to do instead of an argument that a function has not."""

NEEDS = {
    "data": "`hj.run_experiments(cycle, sections, design, outputs)` makes data",
    "validate.data": "data to which the model was not fitted: `hj.run_experiments` makes some, and "
    "`hj.identify_recording(recording, ...).data` those of another recording",
    "Population.values": "`hj.recordings.Population.from_fits(fits, subjects)` takes fits",
    "order": "the number of multipliers, which `hj.select_order(htf)` helps to find",
    "sections": "`hj.ClockPhase(32)`, or `hj.Crossing('y', 'falling')`, are some",
    "estimate_phase.sections": "an event that happens once a cycle, such as "
    "`hj.Crossing('y', 'falling')` of a signal 'y'",
    "signals": "`hj.Recording(time, {'name': samples})`, or `hj.Recording.from_frame(table)`",
    "identify_recording.sections": "an event that happens once a cycle, such as "
    "`hj.Crossing('y', 'falling')` of a signal 'y'",
}
"""What a missing argument is, of any function or of one."""
