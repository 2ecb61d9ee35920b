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
# # Unperturbed walking: multipliers from variability
#
# A person walks on a treadmill at 0.8 m/s (Moore, Hnat and van den Bogert 2015, PeerJ 3:e918, CC BY
# 4.0; `data/README.md`), without perturbations. The part of a deviation that remains one stride
# later can still be estimated: the Floquet analysis of gait (Hurmuzlu and Basdogan 1994).
# Measurement noise biases the usual regression towards zero, and the number of strides is small;
# Dingwell and Cusumano (2000) discuss the risks.

# %%
from pathlib import Path

import numpy as np
from IPython.display import display

import hybridjax as hj


hj.enable_x64()
# (Run this in the repository, or in its folder notebooks.)
folder = Path("data" if Path("data/human_walk.npz").exists() else "notebooks/data")
data = dict(np.load(folder / "human_walk.npz"))

# %%
trials = []
for segment, (first, last) in enumerate([(6, 61), (1, 54)]):
    time, strikes = data[f"time{segment}"].astype(float), data[f"left{segment}"]
    rows = (time >= first) & (time <= last)
    angles = np.where(data[f"gap{segment}"][:, None], np.nan, data[f"angles{segment}"])[
        rows
    ]
    signals = dict(zip(map(str, data["names"]), angles.T.astype(float), strict=True))
    events = {"strike": strikes[(strikes >= first) & (strikes <= last)]}
    units = dict.fromkeys(signals, "rad")
    trials.append(
        hj.Recording(
            time[rows], signals, events=events, units=units, name=f"segment {segment}"
        )
    )
recording = hj.Recording.join(trials)
phase = hj.recordings.estimate_phase(recording, hj.AtEvent("strike"))
strides = hj.recordings.sample_sections(
    recording, phase, inputs=(), outputs=recording.signals, n_sections=16
)
print(phase)
strides

# %%
figure = phase.plot()

# %% [markdown]
# ## Multipliers
#
# The multipliers are estimated by instruments (states earlier in the same stride, which are
# independent of the noise), and by the usual least squares on the return map. Intervals are
# computed by resampling blocks of strides.

# %%
for order in (1, 2, 3):
    display(hj.recordings.natural_multipliers(strides, order))

# %% [markdown]
# Only results that do not depend on the order are reliable: deviations of joint angles mostly
# vanish within one stride. 77 pairs of strides do not support a more precise statement than the
# intervals.
#
# ## The effect of noise in a simulation
#
# The simulated linear system has a multiplier of 0.6, 300 strides, and white noise on each of three
# signals.


# %%
def variable(noise, strides=300, sections=8, seed=0):
    rng = np.random.default_rng(seed)
    gains, x, y = np.random.default_rng(5).normal(size=(sections, 3)), 0.0, []
    for n in range(strides * sections):
        y.append(gains[n % sections] * x)
        x = 0.6 ** (1 / sections) * x + rng.normal()
    y = np.array(y)
    y += noise * y.std(axis=0) * rng.normal(size=y.shape)
    time = np.arange(len(y)) / sections
    made = hj.Recording(
        time, {f"y{i}": v for i, v in enumerate(y.T)}, events={"e": np.arange(strides)}
    )
    return hj.recordings.sample_sections(
        made,
        hj.AtEvent("e"),
        inputs=(),
        outputs=made.signals,
        n_sections=sections,
        bandwidth=np.inf,
    )


for noise in (0.0, 0.5):
    known = hj.recordings.natural_multipliers(variable(noise))
    print(
        f"noise of {noise}:",
        np.round(np.abs([known.multipliers[0], known.plain[0]]), 3),
    )
