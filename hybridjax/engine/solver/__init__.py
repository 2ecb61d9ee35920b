"""Runge-Kutta methods, explicit (`step.py`) and implicit (`implicit.py`).

Which one a chart is integrated by is said in its definition (`systems/solver.py`); `tableau.py` has
the default. A method is called in two places, by the search (`search/attempt.py`) and by the replay
(`replay.py: _advance`), which differentiates it; on the host in `kernels.py`, where `chain.py` asks
for its derivatives. `short_step` lands on crossings, and is right to order 4 whatever the method.
"""

from .implicit import implicit_step
from .step import Step, explicit_step


def take_step(method, field, t, q, h, unroll=False, still=None) -> Step:
    """One step of a method (see `explicit_step` and `implicit_step`)."""
    if method.implicit:
        return implicit_step(method, field, t, q, h, still)
    return explicit_step(method, field, t, q, h, unroll)
