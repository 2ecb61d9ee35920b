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
# # From a recording to Floquet multipliers
#
# A laboratory has sampled signals, a measured perturbation, noise and artifacts. This notebook
# computes multipliers with confidence intervals from such data. The recording is simulated with a
# hopper, so that the true multipliers are known. With your own data, begin at *The five lines* with
# `recording = hj.read_recording("trial1.csv", "trial2.csv")`.

# %%
import tempfile
from pathlib import Path

import numpy as np

import hybridjax as hj


hj.enable_x64()

# %% [markdown]
# ## A recording
#
# The recording has two trials of 250 strides at 200 samples per second: position and velocity of
# the body, and a random force with power up to 8 Hz, independent of the strides. Artifacts are
# added: noise, rounding, 1 % lost samples, and a gap of ten strides.

# %%
cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
force = np.stack(
    [
        hj.experiments.random_input(250, 200, bandwidth=8, rms=0.02, seed=k)
        for k in range(2)
    ]
)
clean = hj.testing.simulate_recording(cycle, force, ("yM", "vM"), rate=200, steps=1)
dirt = {"noise": 1e-4, "quantum": 1e-5, "missing": 0.01, "gap": (100.0, 110.0)}
recording = hj.testing.add_artifacts(clean, ("yM", "vM"), **dirt)
recording

# %% [markdown]
# ## The five lines
#
# Phase is the angle of position and velocity about the center of their loop, which is estimated.
# Each cycle is sampled at 32 phases, and two multipliers are fitted.

# %%
angle = hj.KinematicPhase(32, position="yM", velocity="vM")
phase = hj.recordings.estimate_phase(recording, angle)
data = hj.recordings.sample_sections(recording, phase, inputs="u", outputs=("yM", "vM"))
fit = hj.fit_series(data, order=2)
print(phase)
data

# %%
fit

# %% [markdown]
# The truth lies within the 95 % region.

# %%
fit.compare(cycle.multipliers)

# %%
print("held by the 95 % regions:", fit.contains(cycle.multipliers))

# %% [markdown]
# ## Smaller standard errors: one event in each cycle
#
# At sections defined by this angle, position and velocity contain the same information, and noise
# shifts every crossing. Cycles from apex to apex, with the phase linear in between, use the
# information of both signals. The multipliers are the same, and their standard errors are smaller.

# %%
apex = hj.Crossing("vM", "falling")
strides = hj.recordings.sample_sections(
    recording, apex, inputs="u", outputs=("yM", "vM")
)
surer = hj.fit_series(strides.records, order=2)
print(surer)
print(surer.compare(cycle.multipliers))
print("held by the 95 % regions:", surer.contains(cycle.multipliers))

# %% [markdown]
# ## Look at the data first
#
# The figures show the periods of the cycles, the average cycle, the deviations from it, and the
# spectrum of the force.

# %%
figure = phase.plot()

# %%
figure = data.plot()

# %% [markdown]
# ## How many multipliers, and is the model good?
#
# The order with the best prediction of held-out strides is chosen. Then a model is fitted to the
# first three quarters and simulated on the last. Its residuals are not correlated in time or with
# the input beyond the errors of the numerators (98 at each section, estimated from 360 strides),
# for which both tests allow.

# %%
print("order:", hj.select_order(data).order)
held_out = hj.recordings.hold_out(data, order=2)
held_out.validation

# %%
figure = held_out.validation.plot()

# %% [markdown]
# ## Limits of the data
#
# The advice lists reasons to doubt the fit, the multipliers by plain regression, and predicted
# standard errors for other numbers of strides.

# %%
diagnosis = hj.recordings.diagnose(data, fit)
diagnosis

# %%
for strides, errors in zip(diagnosis.cycles, diagnosis.expected, strict=True):
    print(f"{strides:5d} strides: standard error {errors[0]:.1e}")
axes = hj.plot.multipliers(fit, {"plain regression": diagnosis.plain})

# %% [markdown]
# ## Transfer functions and impulse responses
#
# The figures compare harmonic transfer functions with the exact ones of the linearized hopper, and
# show the response to a brief perturbation at each phase.

# %%
sections = hj.KinematicPhase(
    32,
    position="yM",
    velocity="vM",
    center=(1.9, 0.0),
    scale=(0.3, 1.9),
    anchor=apex,
)
exact = hj.linearize(cycle, sections, outputs=("yM", "vM"))
f = np.arange(1, 161) / 20
figure = hj.plot.bode(fit.htf(f), exact.htf(f))

# %%
figure = hj.recordings.impulse_responses(fit, data).plot()

# %% [markdown]
# ## The next experiment
#
# A multisine is written as a table: by phase, for hardware that triggers on it, or against time.

# %%
design = hj.multisine(periods=64, frequencies=(0, 8.0), lines="odd").scaled(rms=0.02)
with tempfile.TemporaryDirectory() as folder:
    design.write(Path(folder) / "by_phase.csv")
    print((Path(folder) / "by_phase.csv").read_text()[:120])

# %% [markdown]
# ## All of it in one command
#
# ```
# hybridjax identify trial1.csv trial2.csv --inputs force --outputs yM,vM --phase yM,vM --out
# results ```
#
# does the same and writes a report of one page. From Python:

# %%
found = hj.identify_recording(
    recording, angle, inputs="u", outputs=("yM", "vM"), order=2
)
with tempfile.TemporaryDirectory() as folder:
    page = found.write_report(Path(folder) / "results")
    print(
        sorted(path.name for path in page.parent.iterdir()),
        page.stat().st_size // 1000,
        "kB",
    )
