"""Limit cycles of many systems, and branches, as `xarray.Dataset`."""

from typing import Any

import equinox as eqx
import jax
import numpy as np

from .._core.arguments import package
from ..orbits.branch import Branch
from ..orbits.limit_cycles import LimitCycles
from ..systems.system import unit_of_parameter


def from_limit_cycles(cycles: LimitCycles, dimension: str = "system") -> Any:
    """Parameters as coordinates of what is known of each cycle."""
    variables: dict[str, Any] = {
        name: (dimension, np.asarray(getattr(cycles, name)))
        for name in ("period", "residual", "iterations", "result")
    }
    variables["multipliers"] = (dimension, "multiplier"), cycles.multipliers
    return package("xarray").Dataset(variables, _parameters(cycles, dimension))


def from_branch(branch: Branch) -> Any:
    """As of limit cycles; what points are marked as, "" for most, and which cycles are stable."""
    dataset = from_limit_cycles(branch.cycles, "point")
    kinds = np.full(len(branch), "", dtype="U16")
    for point in branch.points:
        kinds[point.index] = point.kind
    return dataset.assign(
        multipliers=(("point", "multiplier"), branch.multipliers),
        stable=("point", branch.stable),
        kind=("point", kinds),
    )


def _parameters(cycles: LimitCycles, dimension: str) -> dict[str, Any]:
    """Numbers of the systems by name, that of a part of a part by a path with dots."""
    found = {}
    leaves = jax.tree_util.tree_flatten_with_path(eqx.filter(cycles.systems, eqx.is_array))[0]
    for path, leaf in leaves:
        name = ".".join(str(getattr(x, "name", x)) for x in path)
        if leaf.shape == (len(cycles),):
            unit = unit_of_parameter(cycles.systems, name)
            found[name] = dimension, np.asarray(leaf), {"units": unit} if unit else {}
    return found
