"""The description of a system, by words and digests, that stored results carry."""

import inspect
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._core.pieces.description import IndescribableError, array_digest, digest_of, program_digest
from ..systems.structure import Structure
from ..systems.system import HybridSystem
from ..systems.transition import Scheduled


def describe(system: HybridSystem) -> dict[str, Any]:
    """The class of a system, its numbers, and a digest of each of its functions.

    If a function calls back into Python, the source of the class stands for all functions.
    """
    numbers = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(eqx.filter(system, eqx.is_array)):
        name = ".".join(str(getattr(x, "name", x)) for x in path)
        numbers[name] = float(leaf) if np.ndim(leaf) == 0 else array_digest(leaf)
    functions = _functions(system)
    return {"class": type(system).__qualname__, "numbers": numbers, "functions": functions}


def _functions(system: HybridSystem) -> dict[str, str]:
    arrays, static = eqx.partition(Structure(system), eqx.is_array)
    s, real = eqx.combine(arrays, static), jnp.result_type(float)

    def digest(a: int, function: Callable) -> str:
        """A digest of `function(structure, t, q, u)` at a point of chart a."""
        shapes = [jax.ShapeDtypeStruct(x, real) for x in ((), (s.dims[a],), (s.nu,))]
        run = lambda arrays, *point: function(eqx.combine(arrays, static), *point)  # noqa: E731
        return program_digest(run, arrays, *shapes)

    digests = {}
    try:
        for a, name in enumerate(s.names):
            digests[f"field of {name}"] = digest(a, lambda s, *x, a=a: s.field(a, *x))
        for g, x in enumerate(s.transitions):
            kinds = ["reset"] if x.enabled is None else ["reset", "enabled"]
            if isinstance(x.guard, Scheduled):
                digests[f"schedule of {x.name}"] = digest_of(repr(x.guard))
            else:
                kinds.append("guard")
            for kind in kinds:
                run = lambda s, *point, g=g, kind=kind: getattr(s, kind)(g, *point)  # noqa: E731
                digests[f"{kind} of {x.name}"] = digest(s.chart_index(x.source), run)
    except IndescribableError:
        try:
            return {"source": digest_of(inspect.getsource(type(system)))}
        except OSError:
            return {}
    period = system.period()
    return digests | {"period": "" if period is None else digest_of(repr(float(period)))}
