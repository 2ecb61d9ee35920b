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
# # How to push
#
# Somebody hops at a steady rhythm. An actuator can push, with an rms force of 1 mN and no more, and
# 4000 strides are all that we may ask for. We want the Floquet multipliers, the factors by which a
# disturbance changes from one stride to the next, to 5e-5. Nothing is known but that there are two.
#
# Here the hopper is a model, so that the end can be compared with the truth. The study itself sees
# nothing but records.

# %%
import pathlib
import tempfile

import numpy as np

import hybridjax as hj


hj.enable_x64()
budget, asked, force = 4000, 5e-5, 0.001
outputs = ("yM", "vM")
cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
sections = hj.ClockPhase(32, anchor=hj.Crossing("vM", "falling"))  # 32 instants per stride
rng = np.random.default_rng(1)


def laboratory(design):
    """What comes back: the responses, and noise that nobody told us the size of."""
    data = hj.run_experiments(cycle, sections, design, outputs, start="periodic")
    return hj.experiments.add_noise(data, std=(6e-6, 1.2e-5), seed=int(rng.integers(1000)))


# %% [markdown]
# ## The first block: all frequencies alike
#
# A sixth of the budget goes into learning where to push. Odd lines keep what a nonlinear body adds
# of even order away from what we measure.

# %%
first = hj.multisine(32, periods=32, lines="odd").scaled(rms=force)
study = hj.designs.Study(first, order=2, standard_error=asked)
study

# %%
study = study.add(laboratory(study.design))
study

# %% [markdown]
# ## What is scarce?
#
# The fit is a model, if a poor one. It says what a better design is worth: much where the force is
# the limit, nothing where the way from the cycle is (safety, comfort, linearity). Ask before you
# push.

# %%
print(study.plan.advice)
print(hj.optimal_design(study.fit, first, limit="output").advice)

# %% [markdown]
# The power goes to the resonance. That moves the body more: the print of the plan says how far.

# %%
hj.plot.spectrum(study.plan, study.fit)
study.plan

# %% [markdown]
# ## Push, look, and push again
#
# Each block is designed from all that was measured before, and the study ends as soon as the
# interval is as narrow as was asked, or the budget is spent.

# %%
while not study.done and study.strides[-1] + study.design.cycles(0) <= budget:
    study = study.add(laboratory(study.design))
study

# %%
hj.plot.strides(study.plan, {"this study": study})

# %% [markdown]
# ## Was it right?
#
# The region was computed at a time that the data chose, and is made to hold the true multipliers in
# 95 % of studies (`docs/experiments.md`).

# %%
print("in the region of 95 %:", study.fit.contains(cycle.multipliers))
study.fit.compare(cycle.multipliers)

# %% [markdown]
# ## For the hardware
#
# A block as a table: against time for hardware that plays samples, or one row for each section, for
# hardware that triggers on phase. Look at the peak before you send it: the rms force is limited
# here, not its peak (`hj.designs.Limits(rms={"u": 0.001}, peak={"u": 0.003})` limits both).

# %%
block = study.design
u = block.inputs()
print(f"{len(u)} experiments of {block.periods} strides, rms {np.sqrt(np.mean(u**2)):.2g} N,")
print(f"peak {np.abs(u).max():.2g} N")
folder = pathlib.Path(tempfile.mkdtemp())
hj.recordings.write_design(folder / "time.csv", block, period=float(cycle.period), rate=1000)
hj.recordings.write_design(folder / "phase.csv", block)
for name in ("time.csv", "phase.csv"):
    with open(folder / name) as file:
        print(name, *(next(file).strip() for _ in range(4)), sep="\n  ")

# %% [markdown]
# What comes back is a recording. `section_data(...).experiments(block.periods)` makes of it what
# `study.add` takes (the notebook `recording` shows how); a study can be made again from its
# blocks on another day, since it depends on nothing else.
