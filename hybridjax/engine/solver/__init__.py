"""The Runge-Kutta method: the only place that knows which one is used.

To use another explicit pair, replace the tableau in `tableau.py` (in the form of diffrax's), and
the order of its error estimate where the step control relies on it: in the lengths of the next step
(`search/outcome.py: _next_step`, an eighth root) and of the first (`search/stride.py`, a seventh).

For a method that is not an explicit pair, or one that differs from chart to chart, write another
`rk_step` (`step.py`): from a field over lanes, (t, q) and h to the `Step`, which holds the state at
t + h, the field at both ends, and an estimate of the error. It is called in two places, by the
search (`search/attempt.py`) and by the replay (`replay.py: _advance`), each with the chart at hand.
Both must use the same method, and the replay differentiates it. `short_step` lands on crossings,
and is right to order 4 whatever the pair.
"""
