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
# # What a push does: a neuron, a walker, a converter
#
# A brief push, a lasting change of a parameter, noise and a sine each have a response of first
# order, which is computed from the linearized flow of one period, through all events.

# %%
import matplotlib.pyplot as plt
import numpy as np

import hybridjax as hj


hj.enable_x64()

# %% [markdown]
# ## A neuron: phase
#
# A brief current advances or delays all later spikes of the FitzHugh-Nagumo neuron, depending on
# the phase at which it acts. Phase 0 is the crossing of v = 0 during a spike.

# %%
section = hj.Crossing("v", "rising")
neuron = hj.find_limit_cycle(hj.models.FitzHughNagumo(), section=section)
responses = neuron.responses()
figure = hj.plot.phase_response(responses.curve())

# %% [markdown]
# A sinusoidal current of amplitude 0.01 entrains the neuron if its frequency is in this range, in
# percent of that of the neuron:

# %%
sine = responses.coupling(lambda phase: np.sin(2 * np.pi * phase))
print(np.round(100 * 0.01 * np.array(sine.locking) * float(neuron.period), 3))

# %% [markdown]
# ## A walker: timing
#
# The simplest walker on a steeper slope, and under a random torque at the hip. Its period is the
# time from heelstrike to heelstrike.

# %%
walker = hj.find_limit_cycle(hj.models.SimplestWalker())
print(walker.sensitivity("slope"))
print(walker.fluctuations(white={"u": 1e-5}))

# %% [markdown]
# The response jumps at heelstrike (dotted): a push to the swinging leg has another effect when it
# stands.

# %%
figure = hj.plot.phase_response(walker.responses(modes=0).curve())

# %% [markdown]
# ## A converter: sines
#
# The closed loop of a buck converter from the reference voltage to the voltage at the load, up to
# three times the switching frequency. An input at the frequency f causes ripple at f - 1, f and
# f + 1.

# %%
buck = hj.find_limit_cycle(hj.models.BuckConverter())
f = np.arange(1, 300) / 100 + 0.003
htf = buck.htf(f, (-1, 0, 1), "v")
with hj.plot.style():
    figure, panel = plt.subplots(figsize=(5, 3), layout="constrained")
for m in htf.harmonics:
    panel.semilogy(f, abs(htf[m][:, 0, 0]), label=f"m = {m}")
panel.set(xlabel="frequency of the reference (cycles/period)", ylabel="|H| (V/V)")
legend = figure.legend(loc="outside upper right", ncols=3)

# %% [markdown]
# Jitter of 1 µs of the clock, and 1 mV of noise at the comparator, make the voltage uncertain by
# this much (V, after a tick):

# %%
noisy = buck.fluctuations(
    guards={
        "ramp ends (open)": 1e-6,
        "ramp ends": 1e-6,
        "switch on": 1e-3,
        "switch off": 1e-3,
    }
)
print(np.sqrt(noisy.covariance([0.0])[0, 0, 0]))
