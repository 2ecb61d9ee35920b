"""Limit cycles of rhythmic hybrid systems, and how fast they recover from a small push.

From equations, simulators or recordings to Floquet multipliers, transfer functions and their
confidence regions. `hj.find_limit_cycle`, `hj.linearize`, `hj.run_experiments`,
`hj.estimate_htf` and `hj.fit_multipliers` are steps of one path; `hj.identify_recording` and
`hj.identify_model` take all steps at once. `dir(hj)` lists the names of a first day, and each
namespace (`dir(hj.plot)`, ...) the others.
"""

from ._core.public import attach


# The public names stand in `__init__.pyi`; each is imported when it is first used (PEP 562).
__getattr__, __dir__, __all__ = attach(__name__, __file__)

__version__ = "0.2.0.dev0"
