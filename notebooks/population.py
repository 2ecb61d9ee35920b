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
# # Twelve subjects, two groups
#
# Six young and six old hoppers are pushed at random and recorded for 80 to 200 strides. The springs
# of the old are 12 % stiffer. Do their multipliers differ, and at which phase do their responses
# to a push? All subjects are simulated, so that the true values are known. With your own files,
# `hybridjax identify --table subjects.csv` computes the fits.

# %%
import numpy as np

import hybridjax as hj


hj.enable_x64()
rng = np.random.default_rng(0)
apex = hj.Crossing("vM", "falling")

# %% [markdown]
# ## The recordings and their fits
#
# Each subject has its own spring and damper, with a standard deviation of 3 %.

# %%
group = ["young"] * 6 + ["old"] * 6
table = {"subject": [f"S{k}" for k in range(12)], "group": group, "strides": []}
true, fits, responses = [], [], []
for k in range(12):
    spring = 10 * (1.12 if group[k] == "old" else 1.0) * (1 + 0.03 * rng.normal())
    hopper = hj.models.VerticalHopper(k=spring, b=5 * (1 + 0.03 * rng.normal()))
    cycle = hj.find_limit_cycle(hopper)
    strides = int(rng.integers(80, 200))
    force = hj.experiments.random_input(strides, 64, bandwidth=6, rms=0.02, seed=k)
    clean = hj.testing.simulate_recording(
        cycle, force[None], ("yM", "vM"), rate=64, steps=1
    )
    recording = hj.testing.add_artifacts(clean, ("yM", "vM"), noise=5e-4, seed=k)
    data = hj.recordings.sample_sections(
        recording, apex, inputs="u", outputs=("yM", "vM"), n_sections=12
    )
    fits.append(hj.fit_series(data, order=2))
    responses.append(
        hj.recordings.impulse_responses(fits[-1], data, cycles=2, width=0.1)
    )
    true.append(abs(cycle.multipliers[0]))
    table["strides"].append(strides)

# %% [markdown]
# ## The modulus
#
# The forest plot shows each subject with its 95 % interval (square), its prediction, shrunken
# towards the mean of its group (circle), and the means (diamonds).

# %%
people = hj.recordings.Population.from_fits(fits, table)
people.plot("modulus")
people.mean("modulus").T

# %%
test = people.difference("modulus", "old", "young")
print("true difference of the subjects:", np.mean(true[6:]) - np.mean(true[:6]))
test.T

# %%
hj.plot.paired(people, "modulus", "old", "young")
print(test.attrs["methods"])

# %% [markdown]
# ## The response to a push
#
# The map has the phase of the push and the time since then. All 924 divisions into two groups
# count; points are outlined where |t| is larger than the largest |t| of 95 % of these.

# %%
values = np.stack([response.values[:, :, 0, 0] for response in responses])  # of yM
axes = {"phase": responses[0].phase, "lag (cycles)": responses[0].lag}
maps = hj.recordings.PopulationMaps(table, values, axes, unit="m/(N s)")
difference = maps.difference("old", "young")
difference.plot()
difference

# %% [markdown]
# The mean response of the young to a push at the apex, with a band that holds all of it:

# %%
curves = hj.recordings.PopulationMaps(
    table, values[:, 0], {"lag (cycles)": axes["lag (cycles)"]}, unit=maps.unit
)
curves.mean("young").plot()
print(difference.methods)

# %% [markdown]
# ## The next study
#
# Power for a difference of 0.03 between two groups, and the best number of strides if a subject
# costs as much as 500 strides.

# %%
young = hj.recordings.Population.from_fits(
    fits[:6], {"subject": table["subject"][:6], "strides": table["strides"][:6]}
)
print(young.power("modulus", 0.03, (6, 10), draws=100))
print(young.allocation("modulus", subject_cost=5, stride_cost=0.01))
