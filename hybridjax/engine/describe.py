"""A system in words and digests, by which stored results are known again."""

import inspect
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._core.fingerprint import IndescribableError, program_digest
from .._core.pieces.description import array_digest, digest_of
from ..systems.structure import Structure
from ..systems.system import HybridSystem
from ..systems.transition import Scheduled


def describe(system: HybridSystem) -> dict[str, Any]:
    """The class of a system, its numbers, and a digest of each of its functions.

    If a function calls back into Python, the source of the class stands for all functions.
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
    arrays, static = eqx.partition(system, eqx.is_array)
    numbers, structure = jax.tree_util.tree_flatten(arrays)
    s, real = Structure(system), jnp.result_type(float)

    def digest(a: int, function: Callable) -> str:
        """Of `function(structure, t, q, u)` at a point of chart a."""

        def run(numbers, *point):
            return function(Structure(eqx.combine(structure.unflatten(numbers), static)), *point)

        shapes = [jax.ShapeDtypeStruct(x, real) for x in ((), (s.dims[a],), (s.nu,))]
        return program_digest(run, numbers, *shapes)

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
