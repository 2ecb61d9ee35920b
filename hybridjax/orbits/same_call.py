"""The memory of `find_limit_cycle`: a call with the arguments of an earlier one is not searched.

A cell of a notebook is often run again, also one that defines the system. `once` therefore compares
what a system computes (`_core/meaning.py`), and not its class; numbers are compared to the last
bit. Whatever the search depends on must be among its arguments.

If a call returns a cycle that has changed since, something is missing in `asked` of `once`, or a
condition under which nothing is remembered; if a call searches again without need, compare `asked`
of both calls.
"""

import dataclasses
import threading
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from .._core import jax_compat
from .._core.compilation import computation
from .._core.executor import is_inside_program
from .._core.meaning import is_all_program
from .._core.results import Result
from ..systems.system import HybridSystem, copies_of
from .cycle import LimitCycle
from .linear_flow import remembering
from .verdict import keep_verdict


# Number of cycles that searches from states have found, and that calls with the same arguments are
# given. More: memory. Fewer: cells of a notebook that are run again search again.
_REMEMBERED = 16
_found: dict[tuple, LimitCycle] = {}
_one_at_a_time = threading.Lock()


def once(
    system: HybridSystem, arguments: tuple, search: Callable[[], LimitCycle]
) -> LimitCycle:
    """The cycle that a search finds. If it has found one for an equal system and equal arguments,
    that cycle is returned.

    Systems are equal if they compute the same, also if they are of a class that was defined again,
    as by a cell of a notebook that is run again (see `_core/meaning.py`). Systems with callbacks
    are searched always, since what a callback reads may have changed.
    """
    debugs = not jax_compat.runs_programs_as_they_are()
    if debugs or is_inside_program() or not is_all_program(system):
        return search()
    settings = jax_compat.settings_of_programs()
    asked = settings, *computation((system, arguments))
    with _one_at_a_time:
        found = _found.pop(asked, None)
    if found is None:
        cycle = search()
        if int(cycle.result) != Result.OK:
            return cycle
        found = _copy(cycle, system)
    else:
        cycle = _copy(found, system)
    with _one_at_a_time:
        _found[asked] = found
        if len(_found) > _REMEMBERED:
            oldest = next(iter(_found))
            del _found[oldest]
    return cycle


def _copy(cycle: LimitCycle, system: HybridSystem) -> LimitCycle:
    """The cycle with arrays of its own, since users may let JAX write over those that they have; of
    a system that computes the same (its outputs and drawings may be others)."""

    def copied(x: Any) -> Any:
        if isinstance(x, jax.Array):
            return jax.device_put(np.array(x))
        return np.array(x) if isinstance(x, np.ndarray) else x

    # (The arrays of the other system may have been written over.)
    other = dataclasses.replace(cycle, system=system, numbers=copies_of(system))
    other = jax.tree_util.tree_map(copied, other)
    keep_verdict(other, cycle)
    return remembering(other, cycle)
