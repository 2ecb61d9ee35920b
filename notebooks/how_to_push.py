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
# A hopper has a steady rhythm. An actuator applies forces of at most 1 mN (rms), and the budget is
# 4000 strides. The goal is a standard error of 5e-5 of the Floquet multipliers, the factors by
# which a disturbance changes from one stride to the next. All that is known is that there are two
# of them.
#
# The hopper is a model here, so that the result can be compared with the truth. The study uses only
# the records.

# %%
import pathlib
import tempfile

import numpy as np

import hybridjax as hj


hj.enable_x64()
budget, asked, force = 4000, 5e-5, 0.001
outputs = ("yM", "vM")
cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
sections = hj.ClockPhase(
    32, anchor=hj.Crossing("vM", "falling")
)  # 32 instants per stride
rng = np.random.default_rng(1)


def laboratory(design):
    """What comes back: the responses, and noise that nobody told us the size of."""
    data = hj.run_experiments(cycle, sections, design, outputs, start="periodic")
    return hj.experiments.add_noise(
        data, std=(6e-6, 1.2e-5), seed=int(rng.integers(1000))
    )


# %% [markdown]
# ## The first block: equal amplitudes
#
# A sixth of the budget is spent to learn which frequencies matter. With odd lines only (a line is
# an excited frequency), even-order nonlinear distortion does not fall on the measured lines.

# %%
first = hj.multisine(32, periods=32, lines="odd").scaled(rms=force)
study = hj.designs.SequentialDesign(first, order=2, standard_error=asked)
study

# %%
study = study.add(laboratory(study.design))
study

# %% [markdown]
# ## Which limit applies?
#
# The first fit is a rough model. It predicts the gain of a better design: large if the force is
# limited, none if the deviation from the cycle is limited (for safety, comfort or linearity). Check
# which limit applies before the next block.

# %%
print(study.plan.advice)
print(hj.optimal_design(study.fit, first, limit="output").advice)

# %% [markdown]
# The optimal design concentrates power at the resonance. This moves the body more; the printed plan
# shows how far.

# %%
hj.plot.spectrum(study.plan, study.fit)
study.plan

# %% [markdown]
# ## Block by block
#
# Each block is designed from all earlier data. The study ends as soon as the interval is as narrow
# as requested, or the budget is spent.

# %%
while not study.done and study.cycles[-1] + study.design.cycles(0) <= budget:
    study = study.add(laboratory(study.design))
study

# %%
hj.plot.standard_errors(study.plan, {"this study": study})

# %% [markdown]
# ## Comparison with the truth
#
# The data determined when the study stopped. The region still contains the true multipliers in 95 %
# of studies (`docs/experiments.md`); `study.fit.contains(cycle.multipliers)` tests one of them. A
# single study shows little: signs and phases of a design depend on rounding, so that another
# machine has other blocks and errors.

# %%
study.fit.compare(cycle.multipliers)

# %% [markdown]
# ## For the hardware
#
# A block is written as a table: against time for hardware that plays samples, or with one row per
# section for hardware that triggers on phase. Check the peak first: here only the rms force is
# limited (`hj.designs.Limits(rms={"u": 0.001}, peak={"u": 0.003})` limits both).

# %%
block = study.design
u = block.signals()
print(
    f"{len(u)} experiments of {block.periods} strides, rms {np.sqrt(np.mean(u**2)):.2g} N,"
)
print(f"peak {np.abs(u).max():.2g} N")
folder = pathlib.Path(tempfile.mkdtemp())
block.write(folder / "time.csv", period=float(cycle.period), rate=1000)
block.write(folder / "phase.csv")
for name in ("time.csv", "phase.csv"):
    with open(folder / name) as file:
        print(name, *(next(file).strip() for _ in range(4)), sep="\n  ")

# %% [markdown]
# The hardware returns a recording. `sample_sections(...).experiments(block.periods)` converts it to
# the argument of `study.add` (see the notebook `recording`). A study depends only on its arguments
# and blocks, so that it can be reconstructed from stored data on another day.
