"""Whether the error that each experiment reports (`data.error`) bounds its true one, and how far.

True errors are those of the recorded outputs against the closed form, relative to the sizes of the
states on the cycle as the reported ones are, but not below 1e-13.
"""

import numpy as np

from hybridjax.experiments.run import RunOptions, prepare

from .problems import ALL, N, Problem, problem, record


# Of the inputs, relative to the paper's 0.01.
FACTORS = (1, 10)
ACCURACIES = (1e-7, 1e-9, 1e-11)
FLOOR = 1e-13


def run(show, options) -> None:
    for model, family in ALL:
        for factor in FACTORS:
            task = problem(model, family, options.quick).scaled(factor)
            for accuracy in ACCURACIES:
                name = (
                    f"{task.label}.amplitude_{0.01 * factor:g}.accuracy_{accuracy:.0e}"
                )
                _honest(task, accuracy, name, show)


def _honest(task: Problem, accuracy: float, name: str, show) -> None:
    show_honesty(task, task.run(accuracy), accuracy, name, show)


def show_honesty(task: Problem, data, accuracy: float, name: str, show) -> None:
    """The share of experiments that ran well, and the errors of these."""
    campaign = prepare(
        task.cycle, task.placed, task.u, task.outputs, RunOptions(discard=0)
    )
    scale = campaign.stepping.scales[:, 1:3]
    scale = np.resize(scale, task.exact.shape[1:])
    assert scale.shape[0] % N == 0
    true = np.abs(record(data) - task.exact) / scale
    true = np.maximum(true.max(axis=(1, 2)), FLOOR)[data.ok]
    estimate = data.error[data.ok]
    show(f"{name}.ok", float(data.ok.mean()))
    if not len(true):
        return
    show(f"{name}.true_error", float(true.max()))
    show(f"{name}.bounded", float((true <= estimate).mean()))
    show(f"{name}.met", float((true <= accuracy).mean()))
    show(f"{name}.median_ratio", float(np.median(estimate / true)))
