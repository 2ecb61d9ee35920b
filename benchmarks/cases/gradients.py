"""The gradient of a loss over one experiment of 84 cycles by 7 parameters of the hopper.

The loss is the sum of squares of both outputs; sections, start and inputs do not change. Times are
also given as multiples of a plain run of the loss, and memory is what the compiled program asks
for besides its arguments and results.
"""

import dataclasses
import functools as ft

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import truth

from .problems import HOPPER, Problem, first_and_later, problem, responding


PARAMETERS = ("m", "M", "k", "b", "l0", "a", "g")


def run(show, options) -> None:
    for model, family in HOPPER:
        task = problem(model, family, options.quick)
        task = task.part(1, 84)
        loss, theta, arrays = _loss(task)
        exact = _differences(task, theta)
        plain = None
        for name, function in {
            "plain": loss,
            "forward": jax.jacfwd(loss),
            "reverse": jax.grad(loss),
        }.items():
            name = f"{task.label}.{name}"
            ready = {}
            work = ft.partial(_run, ready, function, theta, arrays)
            value, compiling, seconds = first_and_later(work, 4 * options.repeat)
            show(f"{name}.compile", compiling)
            show(f"{name}.cpu", seconds.cpu)
            memory = ready["program"].memory_analysis().temp_size_in_bytes
            show(f"{name}.megabytes", memory / 1e6)
            if plain is None:
                plain = seconds.cpu
                true = float(np.sum(task.exact**2))
                show(f"{name}.error", abs(float(value) - true) / true)
            else:
                show(f"{name}.times_plain", seconds.cpu / plain)
                error = np.max(np.abs(np.asarray(value) - exact)) / np.max(
                    np.abs(exact)
                )
                show(f"{name}.error", float(error))


def _run(ready, function, theta, arrays):
    """Run the program, which is compiled at the first call."""
    if not ready:
        ready["program"] = jax.jit(function).lower(theta, arrays).compile()
    return ready["program"](theta, arrays)


def _loss(task: Problem):
    """A function of (theta (7,), arrays), and both."""
    *others, settings = task.response()
    # As `response_function` has it: derivatives remember this many steps between sections.
    settings = dataclasses.replace(settings, max_steps=32)
    arrays, rest = eqx.partition((*others, settings), eqx.is_array)
    system = task.cycle.system
    theta = jnp.array([getattr(system, name) for name in PARAMETERS])

    def loss(theta, arrays):
        placed, *others = eqx.combine(arrays, rest)
        where = lambda p: [getattr(p.cycle.system, name) for name in PARAMETERS]  # noqa: E731
        placed = eqx.tree_at(where, placed, list(theta))
        return jnp.sum(responding(placed, *others) ** 2)

    return loss, theta, arrays


def _differences(task: Problem, theta) -> np.ndarray:
    """The gradient by central differences of the closed form."""
    gradient = []
    for name, value in zip(PARAMETERS, theta.tolist(), strict=True):
        h = 1e-5 * abs(value)
        up, down = (_exact_loss(task, name, value + s * h) for s in (1, -1))
        gradient.append((up - down) / (2 * h))
    return np.array(gradient)


def _exact_loss(task: Problem, name: str, value: float) -> float:
    job = task.job._replace(parameters=task.job.parameters | {name: value})
    return float(np.sum(truth.experiments(job) ** 2))
