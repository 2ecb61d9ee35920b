"""Sentences that several tables of this folder use, and libraries whose names lead to one."""

CONTROL = (
    "`hj.convert.to_control(model)` is a system of python-control, for its functions"
)
HELD_OUT = (
    "`hj.validate(fit, other_data)` tries a fit on other data, and "
    "`hj.recordings.hold_out(result.data, order)` on cycles that were held out"
)
AT_TIMES = "`charts, states = trajectory.at(times)` interpolates"
SIGNAL = (
    "`scipy.signal` has it, for arrays such as `recording[name]`; `bandwidth`, an argument of "
    "`hj.identify_recording`, smooths signals"
)
SOLVER = (
    "`hj.simulate(system, guess, duration)` integrates, and "
    "`hj.orbits.Settings(solver=diffrax.Tsit5(), rtol=1e-9)` sets solver and accuracy"
)
DECAY = (
    "it follows from the modulus: a deviation is halved after `np.log(0.5) / "
    "np.log(max(result.modulus))` cycles"
)
EXPONENT = (
    "it follows from the multipliers: `np.log(max(result.modulus)) / period`; of a recording, "
    "`hj.identify_recording(recording, ...)` or `hj.recordings.natural_multipliers(data)` "
    "estimates them"
)
RESIDUALS = "`validation.residuals` has them, of `validation = hj.validate(fit, data)`"
MADE_OF_FUNCTIONS = (
    "`hj.HybridSystem.from_functions(('x', 'v'), field, events, {'k': 1.0})` makes a system of "
    "functions (t, q, u, p), with parameters `p.k`; `events` are [(name, guard, reset)]"
)
COMPARE = "`fit.compare(other)` tests the difference from another fit or a truth"

LIBRARIES = {
    "Plot": {
        "matplotlib.axes.Axes": "`plot.axes[0, 0]` is an `Axes` of matplotlib, which has it",
        "matplotlib.figure.Figure": "`plot.figure` is a `Figure` of matplotlib, which has it",
    },
    "Showable": {
        "pandas.DataFrame": "`result.to_pandas()` is a table of pandas, which has it",
    },
    "": {
        "control": CONTROL,
        "scipy.signal": SIGNAL,
        "diffrax": SOLVER,
        "numpy": "numpy has it: results hold arrays",
    },
}
"""Libraries, and their classes, whose names lead to them: on objects of a class, and in the
namespaces of this package."""
