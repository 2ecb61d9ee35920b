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
# # A walking robot: what five strides a run can tell
#
# A robot with two legs and real impacts walked twelve times, ten steps each, its motor driven by
# feedback and iterative learning (I. Manchester; `data/README.md` has source and license). The
# input was recorded. This is a page about what must *not* be concluded.

# %%
from pathlib import Path

import numpy as np

import hybridjax as hj


hj.enable_x64()
files = [folder / "compass_gait_robot.npz" for folder in (Path("data"), Path("notebooks/data"))]
data = np.load(next(path for path in files if path.exists()))

# %%
runs = []
for run in np.unique(data["run"]):
    rows = data["run"] == run
    time, outer = data["time"][rows], data["outer"][rows].astype(int)
    before = np.append(1 - outer[0], outer[:-1])
    strides, steps = time[outer > before], time[outer != before]
    signals = {name: data[name][rows].astype(float) for name in ("voltage", "hip", "stance")}
    events = {"stride": np.append(strides, time[-1]), "step": np.append(steps, time[-1])}
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
# ## The input is made from the rhythm
#
# Where the legs change, angles are relabeled, and jump: nothing is smoothed across that, and no
# section lies there (`bandwidth=np.inf`).

# %%
strides = hj.recordings.section_data(
    recording,
    phase,
    inputs="voltage",
    outputs=("hip", "stance"),
    n_sections=5,
    bandwidth=np.inf,
)
print(strides)
looked = hj.recordings.inspect(
    recording, inputs="voltage", outputs=("hip", "stance"), phase=phase, data=strides
)
print(looked.findings[-1])
figure = hj.plot.section_data(strides)

# %% [markdown]
# ## There are too few strides for a fit
#
# Each run begins in an unknown state, and has a mean of its own: two fifths of it are used up
# before anything is learned. The fit is refused, with the number that is missing.

# %%
try:
    hj.fit_series(strides, order=1)
except hj.DefinitionError as error:
    print(error)

# %% [markdown]
# ## The closed loop, with its input a part of it
#
# How deviations go on into the next stride can be asked without an input. The answer is about robot
# *and* controller, and the interval, from resampling whole runs, is as wide as it has to be.

# %%
angles = hj.recordings.section_data(
    recording, phase, inputs=(), outputs=("hip", "stance"), n_sections=7, bandwidth=np.inf
)
natural = hj.recordings.natural_multipliers(angles)
natural
