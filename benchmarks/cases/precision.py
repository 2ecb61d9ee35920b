"""Experiments in single precision beside those in double: seconds, true errors, reported errors.

`speedup` is the time of double precision at the same accuracy divided by that of single precision.
"""

import functools as ft
from typing import NamedTuple

from .honesty import show_honesty
from .problems import HOPPER, first_and_later, problem


class Size(NamedTuple):
    experiments: int
    cycles: int


SIZES = (Size(80, 84), Size(1000, 84), Size(10_000, 10))
RUNS = (("double", 1e-9), ("double", 1e-4), ("single", 1e-4))


def run(show, options) -> None:
    for model, family in HOPPER:
        task = problem(model, family, options.quick)
        task.exact  # noqa: B018 (once, for parts of it)
        for size in [Size(16, 24)] if options.quick else SIZES:
            part, seconds = task.part(*size), {}
            for precision, accuracy in RUNS:
                work = ft.partial(part.run, accuracy, precision=precision)
                data, compiling, seconds[precision] = first_and_later(work, options.repeat)
                name = f"{task.label}.experiments_{size.experiments}.{precision}_{accuracy:.0e}"
                show(f"{name}.compile", compiling)
                show(f"{name}.cpu", seconds[precision].cpu)
                show_honesty(part, data, accuracy, name, show)
            name = f"{task.label}.experiments_{size.experiments}"
            show(f"{name}.speedup", seconds["double"].cpu / seconds["single"].cpu)
