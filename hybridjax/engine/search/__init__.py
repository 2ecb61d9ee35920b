"""The adaptive part of the engine: step sizes, the order of events, failures.

In each iteration every lane takes aim, attempts a step and lands on the zero that it aims at
(`attempt.py`); the step is accepted or rejected (`accept.py`), and events happen (`outcome.py`).
`search.py` is the loop, `state.py` its state.
"""
