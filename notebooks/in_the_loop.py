# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A hopper and its controller, apart
#
# A hopper has a controller at work: a force that responds to height and speed, low-passed, one
# section late. Both are estimated from experiments in which forces push the hopper, and offsets are
# added to the measurements of the controller. Unmeasured forces act, too.

# %%
import matplotlib.pyplot as plt
import numpy as np

import hybridjax as hj


hj.enable_x64()
cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
phase = hj.ClockPhase(8, anchor=hj.Crossing("vM", "falling"))
plant = hj.linearize(cycle, phase, ("yM", "vM"))
ones = np.ones((8, 1, 1))
controller = hj.linear.LDTP(
    0.6 * ones,
    ones * [[0.3, 0.8]],
    ones,
    ones * [[0.0, 0.0]],
    inputs=("yM", "vM"),
    outputs="u",
)
closed = plant.feedback(controller)
print(np.abs(plant.multipliers), np.abs(closed.multipliers))

# %% [markdown]
# ## Experiments
#
# The references are a force r and offsets d of both sensors. The controller answers the sensors, so
# that $u = r - F (y + d)$: the hopper is pushed with $r - F d$, and the rest is `feedback`.

# %%
design = hj.multisine(
    8, 16, frequencies=(0, 4), inputs=3, division="orthogonal", amplitude=1e-3, seed=1
).realizations(4)
references = design.signals(36)
references[..., 1:] *= [0.05, 0.2]  # (m and m/s for N)
answers = np.stack([controller.simulate(x) for x in references[..., 1:]])
data = hj.run_experiments(
    cycle,
    phase,
    references[..., :1] - answers,
    ("yM", "vM"),
    feedback=controller,
    process_noise=hj.experiments.ProcessNoise(2e-3),
)
measured = hj.experiments.ExperimentData(
    np.concatenate([data.u[..., :1], references], axis=2),
    data.y + references[..., 1:],
    n_sections=8,
    periods=16,
    inputs=("u", "r", "d0", "d1"),
    outputs=("yM", "vM"),
)

# %% [markdown]
# ## The plant, the controller, and the loop
#
# The broad pale lines are exact, the thin ones are estimates with bands of 95 %.

# %%
loop = hj.identify.estimate_loop(measured, at_input="r", at_output=("d0", "d1"))
figure, axes = plt.subplots(1, 3, figsize=(10, 3), layout="constrained")
f = loop.plant.frequencies
panels = {
    "plant": (loop.plant, plant.htf(f), 1, 0),
    "plant with its controller": (loop.closed, closed.htf(f), 1, 0),
    "controller": (loop.controller, controller.htf(f), 0, 1),
}
for ax, (title, (estimate, exact, output, source)) in zip(
    axes, panels.items(), strict=True
):
    hj.plot.htf(
        estimate, exact, output=output, input=source, harmonics=(0,), decades=2, ax=ax
    )
    ax.set_title(title)

# %% [markdown]
# Multipliers of the plant from its HTFs, and from the same experiments as time series:

# %%
fit = hj.fit_multipliers(loop.plant, 2)
print(cycle.multipliers, fit, sep="\n")
series = hj.fit_series(data, 2, references="r")
print(series)
