"""Balls that bounce with drag in C, one after the other in one thread: the coefficients of scipy's
DOP853, with steps of its own error estimate."""

import ctypes
import pathlib
import tempfile

import numpy as np

from . import ARRAY, compiled
from .cycles import OPTIONS, tableau


def setup():
    """Compile the loop.

    **Raises:** `Unavailable` without gcc.
    """
    source = pathlib.Path(__file__).with_suffix(".c")
    with tempfile.TemporaryDirectory() as folder:
        pathlib.Path(folder, "tableau.h").write_text(tableau())
        loop = compiled(source, *OPTIONS, f"-I{folder}").bounce
    integer, number = ctypes.c_int, ctypes.c_double
    loop.argtypes = (integer, integer, ARRAY, ARRAY, number, ARRAY, ARRAY)
    loop.restype = ctypes.c_long
    return loop


def run(
    heights: np.ndarray, bounces: int, parameters: tuple, tolerance: float, loop
) -> tuple[np.ndarray, np.ndarray, int]:
    """Times and speeds after some bounces of balls that are dropped from `heights`, by the function
    that `setup` made, and the number of steps.

    **Arguments:** `parameters`: gravity, restitution, drag (by mass and speed).
    """
    times = np.empty(len(heights))
    speeds = np.empty(len(heights))
    numbers = np.array(parameters, float)
    arguments = numbers, np.ascontiguousarray(heights, dtype=float), tolerance
    steps = loop(len(heights), bounces, *arguments, times, speeds)
    return times, speeds, steps
