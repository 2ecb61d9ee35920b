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
# # Spikes under a known current: a phase response curve
#
# A neuron of the mouse's globus pallidus fires spontaneously, about fifty times a second. A sine
# current of 20 pA was injected, with a different frequency in each trial of 10 s (Olivares, Wilson
# and Goldberg; `data/README.md` has source and license). Only the times of the spikes are used. The
# phase runs from 0 at one spike to 1 at the next, $\dot\varphi = w + Z(\varphi)\,I(t)$; Z is the
# phase response curve.

# %%
from pathlib import Path

import numpy as np

import hybridjax as hj


hj.enable_x64()
# (Run this in the repository, or in its folder notebooks.)
folder = Path(
    "data" if Path("data/pacemaker_neurons.npz").exists() else "notebooks/data"
)
data = dict(np.load(folder / "pacemaker_neurons.npz"))

# %% [markdown]
# ## A recording of events
#
# The recording has one trial for each frequency; every tenth trial is used, to save time.

# %%
time = np.arange(0, 10.0002, 2e-4)
spikes = np.split(
    data["cell8_steps"].astype(int), np.cumsum(data["cell8_counts"], dtype=int)[:-1]
)
trials = []
for f in range(5, 101, 10):
    current = 20 * np.sin(2 * np.pi * f * time)
    trials.append(
        hj.Recording(
            time,
            {"current": current},
            events={"spike": np.cumsum(spikes[f - 1]) / 1e4},
            units={"current": "pA"},
            name=f"{f} Hz",
        )
    )
recording = hj.Recording.join(trials)
phase = hj.recordings.estimate_phase(recording, hj.AtEvent("spike"))
print(phase)

# %% [markdown]
# The current changes intervals by half. A limit at 1.5 median intervals would count the long ones
# as missed spikes; therefore the limits are gaps in the distribution of intervals.

# %%
figure = phase.plot()

# %% [markdown]
# ## The curve
#
# The result lists the limits of the data. R2 is the predicted fraction of the variance of intervals
# within trials, for blocks of intervals that were left out of the fit.

# %%
found = hj.recordings.phase_response(recording, phase, input="current")
found

# %%
figure = hj.plot.phase_response(found)
panel = figure.ax
panel.plot(
    data["published_phase"],
    data["cell8_published"],
    color="black",
    lw=1,
    label="published",
)
panel.errorbar(
    data["measured_phase"],
    data["cell8_measured"],
    data["cell8_measured_error"],
    fmt=".",
    ms=3,
    lw=0.5,
    color="gray",
    label="with noise currents",
)
legend = panel.legend(fontsize="x-small")

# %% [markdown]
# The published curve was estimated from stimulation with noise currents. Near the spike our curve
# is negative, and the published one is not (`docs/real-data.md`). The smoothness of our curve is
# determined by the data (marginal likelihood). The residuals of neighboring intervals are
# correlated, so that the phase alone is not the complete state of the neuron. The confidence
# intervals are valid only for the phase model.
#
# ## Predictions of the next spike
#
# Each block of intervals is predicted by a curve that was fitted to the others, and by a flat
# curve.

# %%
print(
    f"R2 of intervals left out: {found.left_out:.3f}; of a flat curve: {found.left_out_flat:.3f}"
)

# %% [markdown]
# ## A simulated check
#
# The same protocol is applied to a phase model with the estimated rate and jitter, and a known
# curve.

# %%
x = np.arange(400) / 400
true = 1 - 0.5 * np.cos(2 * np.pi * x) - 0.2 * np.cos(4 * np.pi * x)
force = np.stack([trial.values[::5, 0] for trial in recording.trials])
made = hj.testing.simulate_beats(
    true, force, rate=1000, rhythm=52.0, jitter=found.jitter, seed=1
)
again = hj.recordings.phase_response(made, hj.AtEvent("beat"), input="u")
low, high = again.interval(x)
again

# %%
print(
    f"the band holds the true curve at {100 * np.mean((low <= true) & (true <= high)):.0f} %"
    " of the phases"
)
