"""The Runge-Kutta method: the only place that knows which one is used.

To use another explicit pair, replace the tableau in `tableau.py` (a `diffrax.ButcherTableau`) and
the order p of its error estimate where the step control relies on it: the power of the next step
(`outcome.py: _next_step`, 8 = p + 1) and of the first (`stride.py: initial_step`, 7). For a method
that is not an explicit pair, or one that differs from chart to chart, write another `rk_step`
(`step.py`): from a field over lanes, (t, q) and h to the `Step`, which holds the state at t + h,
the field at both ends, and an estimate of the error. It is called in two places, by the search
(`attempt.py`) and by the replay (`replay.py: _advance`), each with the chart at hand; both must use
the same method, and it must be differentiable for the replay. `short_step` lands on crossings, and
is right to order 4 whatever the pair.
"""
