"""A system in words and digests, by which stored results are known again."""

import inspect
from typing import Any

import equinox as eqx
import jax
import numpy as np

from .._core.compilation.fingerprint import IndescribableError
from .._core.pieces.description import array_digest, digest_of
from ..systems.system import HybridSystem
from ..systems.transition import Scheduled
from .closed import close


def describe(system: HybridSystem) -> dict[str, Any]:
    """The class of a system, its numbers, and a digest of each of its functions.

    Of functions of which there is no digest (see `_core/compilation/fingerprint.py`), the source of
    the class stands for all.
    """
    return {
        "class": type(system).__qualname__,
        "numbers": _numbers(system),
        "functions": _functions(system),
    }


def _numbers(system: HybridSystem) -> dict[str, Any]:
    leaves = jax.tree_util.tree_flatten_with_path(eqx.filter(system, eqx.is_array))[0]
    return {
        ".".join(str(getattr(x, "name", x)) for x in path): float(leaf)
        if np.ndim(leaf) == 0
        else array_digest(leaf)
        for path, leaf in leaves
    }


def _functions(system: HybridSystem) -> dict[str, str]:
    try:
        closed = close(system, (), None)[0]
    except IndescribableError:
        try:
            return {"source": digest_of(inspect.getsource(type(system)))}
        except OSError:
            return {}
    found = {f"field of {x.name}": x.field.digest for x in closed.closed.charts}
    for x, schedule in zip(closed.closed.events, closed.schedules, strict=True):
        programs = {"guard": x.guard, "reset": x.reset, "enabled": x.enabled}
        for name, program in programs.items():
            if program is not None:
                found[f"{name} of {x.name}"] = program.digest
        if isinstance(schedule, Scheduled):
            found[f"schedule of {x.name}"] = digest_of(repr(schedule))
    for x in closed.closed.outputs:
        found |= {f"output {x.name} in {chart}": p.digest for chart, p in x.functions}
    period = system.period()
    return found | {"period": "" if period is None else digest_of(repr(float(period)))}
