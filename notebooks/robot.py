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
# # A walking robot: five strides per run
#
# A robot with two legs and real impacts walked twelve times, ten steps each, with its motor driven
# by feedback and iterative learning (I. Manchester; `data/README.md` has source and license). The
# input was recorded. This page shows which conclusions these data do *not* support.

# %%
from pathlib import Path

import numpy as np

import hybridjax as hj


hj.enable_x64()
# (Run this in the repository, or in its folder notebooks.)
folder = Path(
    "data" if Path("data/compass_gait_robot.npz").exists() else "notebooks/data"
)
data = dict(np.load(folder / "compass_gait_robot.npz"))

# %%
runs = []
for run in np.unique(data["run"]):
    rows = data["run"] == run
    time, outer = data["time"][rows], data["outer"][rows].astype(int)
    before = np.append(1 - outer[0], outer[:-1])
    strides, steps = time[outer > before], time[outer != before]
    signals = {
        name: data[name][rows].astype(float) for name in ("voltage", "hip", "stance")
    }
    events = {
        "stride": np.append(strides, time[-1]),
        "step": np.append(steps, time[-1]),
    }
    runs.append(hj.Recording(time, signals, events=events, name=f"run {run}"))
recording = hj.Recording.join(runs)
phase = hj.recordings.estimate_phase(recording, hj.AtEvent("stride"))
print(phase)

# %% [markdown]
# ## The legs differ
#
# Steps alternate between long and short, so that the cycle is two steps: a stride.

# %%
steps = [np.diff(trial.events["step"]) for trial in recording.trials]
print(np.round(1000 * np.array([s[0::2].mean() - s[1::2].mean() for s in steps])), "ms")

# %% [markdown]
# ## The input depends on the cycle
#
# At the change of legs, angles are relabeled and jump. Nothing is smoothed across the jumps, and no
# section lies there (`bandwidth=np.inf`).

# %%
strides = hj.recordings.sample_sections(
    recording,
    phase,
    inputs="voltage",
    outputs=("hip", "stance"),
    n_sections=5,
    bandwidth=np.inf,
)
print(strides)
looked = hj.recordings.check_recording(
    recording, inputs="voltage", outputs=("hip", "stance"), phase=phase, data=strides
)
print(looked.findings[-1])
figure = strides.plot()

# %% [markdown]
# ## There are too few strides for a fit
#
# Each run has an unknown initial state and an unknown mean. They cost two fifths of the run, before
# anything else is estimated. The fit raises an error with the number of missing cycles.

# %%
try:
    hj.fit_series(strides, order=1)
except hj.errors.DefinitionError as error:
    print(error)

# %% [markdown]
# ## The closed loop
#
# The part of a deviation that remains after one stride can be estimated without an input. The
# result concerns the robot *and* its controller. The interval, from resampling of whole runs, is
# very wide.

# %%
angles = hj.recordings.sample_sections(
    recording,
    phase,
    inputs=(),
    outputs=("hip", "stance"),
    n_sections=7,
    bandwidth=np.inf,
)
natural = hj.recordings.natural_multipliers(angles)
natural
