"""A sweep in C, written for the vertical hopper: limit cycles and multipliers by Newton's method.

One hopper after the other in one thread, by the coefficients of scipy's DOP853 with steps of its
own error estimate, and variational equations beside the state. Each begins at the cycle of its
neighbor.
"""

import ctypes
import pathlib
import tempfile
from typing import NamedTuple

import numpy as np
from scipy.integrate import DOP853

from . import ARRAY, CHARTS, PARAMETERS, compiled


COUNTS = np.ctypeslib.ndpointer(np.int32, flags="C_CONTIGUOUS")
# Sums may be formed in any order, but what is not a number stays so: such steps are rejected.
OPTIONS = ("-ffast-math", "-fno-finite-math-only")


class Cycles(NamedTuple):
    """Limit cycles of S hoppers, at the clock's phase 0.5.

    **Fields:** `charts` (S,): 0 in flight, 1 in stance, -1 without a cycle; `states` (S, 4), zero
    where a chart has fewer; `multipliers` (S, 2), complex; `turns` (S,): of the return map.
    """

    charts: np.ndarray
    states: np.ndarray
    multipliers: np.ndarray
    turns: np.ndarray


def setup():
    """Compile the sweep.

    **Raises:** `Unavailable` without gcc.
    """
    source = pathlib.Path(__file__).with_suffix(".c")
    with tempfile.TemporaryDirectory() as folder:
        pathlib.Path(folder, "tableau.h").write_text(tableau())
        sweep = compiled(source, *OPTIONS, f"-I{folder}").sweep
    integer, number = ctypes.c_int, ctypes.c_double
    sweep.argtypes = (
        integer,
        integer,
        ARRAY,
        number,
        integer,
        ARRAY,
        COUNTS,
        ARRAY,
        ARRAY,
        COUNTS,
    )
    return sweep


def run(
    parameters: dict[str, np.ndarray],
    chart: str,
    state: np.ndarray,
    sweep,
    tolerance: float = 1e-12,
) -> Cycles:
    """The cycles, by the function that `setup` made.

    **Arguments:** `parameters`: by name, each (rows, columns), on a grid of neighbors; `chart` and
    `state` (4,): near the cycle of the first hopper at phase 0.5; `tolerance`: error of a step,
    relative to one and to each number.
    """
    values = [parameters[name] for name in PARAMETERS["hopper"]]
    numbers = np.stack(np.broadcast_arrays(*values), axis=-1)
    rows, columns, _ = numbers.shape
    count = rows * columns
    charts = np.empty(count, np.int32)
    states = np.zeros((count, 4))
    multipliers = np.full((count, 2, 2), np.nan)
    turns = np.empty(count, np.int32)
    sweep(
        rows,
        columns,
        np.ascontiguousarray(numbers, dtype=float),
        tolerance,
        CHARTS["hopper"].index(chart),
        np.asarray(state, dtype=float),
        charts,
        states,
        multipliers,
        turns,
    )
    return Cycles(charts, states, multipliers.view(complex)[..., 0], turns)


def tableau() -> str:
    """DOP853 as macros for each component of a step: stages, weights, and both error estimates."""
    stages = [
        f"STAGE({i}, {float(DOP853.C[i])!r}, {weighted(DOP853.A[i])})"
        for i in range(1, DOP853.n_stages)
    ]
    lines = {
        "STAGE_COUNT": str(DOP853.n_stages),
        "ORDER": str(float(DOP853.order)),
        "STAGES": " ".join(stages),
        "WEIGHTS": weighted(DOP853.B),
        "ERROR_5": weighted(DOP853.E5),
        "ERROR_3": weighted(DOP853.E3),
    }
    return "".join(f"#define {name} {text}\n" for name, text in lines.items())


def weighted(weights: np.ndarray) -> str:
    """The sum of rates with these weights, as an expression in C, without those that are zero."""
    used = np.flatnonzero(weights)
    return " + ".join(f"{float(weights[i])!r} * RATE({i})" for i in used)
