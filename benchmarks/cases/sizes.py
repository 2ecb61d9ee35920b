"""Microseconds per section map in batches of several sizes, beside C and heyoka.

`run` is the whole call of `run_experiments`, `program` the compiled part, which is called for
batches of at most the size that `run_experiments` takes.
"""

import functools as ft
import math

import numpy as np
from peers import contest

from hybridjax.experiments.run import divide

from .problems import HOPPER, Problem, first_and_later, problem, program


COUNTS = (1, 8, 80, 1000, 10_000)
CYCLES = 4


def run(show, options) -> None:
    for model, family in HOPPER:
        task = problem(model, family, options.quick)
        counts = COUNTS[:3] if options.quick else COUNTS
        exact = task.part(len(task.u), CYCLES).exact
        for count in counts:
            repeat = max(math.ceil(1000 / count), 3)
            _ours(task, exact, count, 3 if options.quick else repeat, show)
        contest.sizes(task.job, exact, show, counts, CYCLES)


def _ours(task: Problem, exact, count: int, repeat: int, show) -> None:
    part = task.part(count, CYCLES)
    exact = exact[np.arange(count) % len(exact)]
    name = f"{task.label}.size_{count}.run"
    data, _, seconds = first_and_later(part.run, min(repeat, 100))
    show(f"{name}.microseconds", 1e6 * seconds.cpu / part.u.size)
    part.__dict__["exact"] = exact
    show(f"{name}.error", part.error(data))
    size = divide(count, hj.scale.Execution(workers=1)).batch
    some = task.part(size, CYCLES)
    name = f"{task.label}.size_{count}.program"
    y, _, seconds = first_and_later(ft.partial(program, *some.response()), repeat)
    show(f"{name}.microseconds", 1e6 * seconds.cpu / some.u.size)
    some.__dict__["exact"] = exact[np.arange(size) % count]
    show(f"{name}.error", some.distance(y))
