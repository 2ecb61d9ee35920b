"""A loop in C, written for these two models: DOPRI5 steps placed by hand, Newton at crossings.

One experiment after the other in one thread, compiled by gcc -O3 -march=native.
"""

import ctypes
import pathlib
import shutil
import subprocess
import tempfile

import numpy as np
from job import Job

from ..errors import Unavailable


# Order of the parameters and charts in the C files.
PARAMETERS = {
    "hopper": ("m", "M", "k", "b", "l0", "a", "g", "omega", "retention"),
    "bar": ("m", "J", "hind", "front", "k", "b", "l0", "g", "rho", "A", "T"),
}
CHARTS = {"hopper": ("flight", "stance"), "bar": ("air", "hind", "front", "both")}


# Steps from a section to the next, coarse to fine.
SETTINGS = (1, 2, 3, 4)
# Corrections of a crossing that are shorter than this (s) go on from where the step landed, by a
# fourth-order step, instead of repeating it: no less exact here, and faster.
NEAR = 1e-2

ARRAY = np.ctypeslib.ndpointer(float, flags="C_CONTIGUOUS")


def compiled(source: pathlib.Path, *options: str) -> ctypes.CDLL:
    """The library that gcc makes of a file.

    **Raises:** `Unavailable` without gcc.
    """
    gcc = shutil.which("gcc")
    if gcc is None:
        raise Unavailable("there is no gcc")
    with tempfile.TemporaryDirectory() as folder:
        library = pathlib.Path(folder, "peer.so")
        shared = ("-O3", "-march=native", "-shared", "-fPIC", "-o", library)
        subprocess.run((gcc, *shared, *options, source, "-lm"), check=True)
        return ctypes.CDLL(str(library))


def setup(job: Job):
    """Compile the loop for the job's model.

    **Raises:** `Unavailable` without gcc.
    """
    source = pathlib.Path(__file__).with_name(f"{job.model}.c")
    loop = compiled(source).run
    integer, number = ctypes.c_int, ctypes.c_double
    loop.argtypes = (
        ARRAY,
        integer,
        integer,
        ARRAY,
        integer,
        integer,
        number,
        ARRAY,
        ARRAY,
        ARRAY,
        integer,
        ARRAY,
        integer,
        number,
        ARRAY,
    )
    return loop


def run(job: Job, loop, steps: int = 2) -> np.ndarray:
    """The record (S, n, 2), by the function that `setup` made. With `steps` = 1 the error is a few
    1e-8 on the hopper, a few 1e-7 on the bar; each more divides it by 30, then 7, then 4."""
    record = np.empty((*job.u.shape, 2))
    lost = loop(
        np.array([job.parameters[name] for name in PARAMETERS[job.model]]),
        *job.u.shape,
        np.ascontiguousarray(job.u),
        job.sections,
        job.clocked,
        job.period,
        job.times,
        job.durations,
        job.planes,
        CHARTS[job.model].index(job.charts[0]),
        np.ascontiguousarray(job.states[0]),
        steps,
        NEAR,
        record,
    )
    if lost >= 0:
        raise RuntimeError(f"experiment {lost} did not come to its next section")
    return record
