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
# # How many strides are needed, and how precise is the result?
#
# A hopper has a steady rhythm. It is perturbed by small known forces, and its response is measured
# with noise. The goal is to estimate how quickly it recovers from a disturbance: its Floquet
# multipliers, the factors by which a disturbance changes from one stride to the next.
#
# The hopper is a model here, so that every result can be compared with the truth. The analysis uses
# only the records.

# %%
import numpy as np

import hybridjax as hj


hj.enable_x64()
cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
phase = hj.ClockPhase(32, anchor=hj.Crossing("vM", "falling"))  # 32 instants per stride
truth = cycle.multipliers
print("true multipliers", np.round(truth, 4))

# %% [markdown]
# ## An experiment
#
# A *multisine* is a sum of cosines at excited frequencies, called lines. This one has odd lines
# only, so that even-order nonlinear distortion falls between them, where it causes no error.
# Variances will be computed from the scatter over four realizations of the random phases. A printed
# design shows its cost in strides.

# %%
design = hj.multisine(lines="odd", periods=64, seed=1).realizations(4).scaled(rms=0.005)
print(design)

# %%
outputs = ("yM", "vM")
clean = hj.run_experiments(
    cycle, phase, design, outputs
)  # the first 20 strides are discarded
data = hj.experiments.add_noise(clean, snr=20)  # one part in ten of noise
data.plot()
print(data.summary())

# %% [markdown]
# ## The response, with its uncertainty
#
# A rhythmic system responds to one frequency at many: harmonic m of the transfer function is the
# response m cycles per stride above the input frequency. The band, computed from the four
# realizations, contains the true value with a probability of 95 %. It narrows with the number of
# realizations, but does not include errors that all of them share.

# %%
estimate = hj.estimate_htf(data, (-1, 0, 1))
exact = hj.linearize(cycle, phase, outputs).htf(estimate.frequencies, (-1, 0, 1))
hj.plot.bode(exact, estimate)
inside = np.abs(estimate.H - exact.H) <= estimate.confidence_radius(0.95)
print(f"{100 * np.mean(inside):.1f} % of the true values lie inside their 95 % regions")

# %% [markdown]
# ## The number of multipliers that the data support.

# %%
print(hj.select_order(estimate))

# %% [markdown]
# ## The multipliers
#
# All harmonics and outputs are fitted with one denominator, whose roots are the multipliers. The
# regions contain the true multipliers with a probability of 95 %.

# %%
fit = hj.fit_multipliers(estimate, order=2)
fit.compare(truth)

# %%
hj.plot.multipliers(truth, {"20 dB": fit})

# %% [markdown]
# ## How many strides?
#
# With noise, the error is inversely proportional to the square root of the number of strides: twice
# the strides, 0.7 times the error. Each number is the root of the mean square over ten draws of the
# noise.

# %%
for count in (1, 2, 4):
    some = (
        hj.multisine(lines="odd", periods=64, seed=1)
        .realizations(count)
        .scaled(rms=0.005)
    )
    record = hj.run_experiments(cycle, phase, some, outputs)
    errors = []
    for seed in range(10):
        noisy = hj.estimate_htf(
            hj.experiments.add_noise(record, snr=20, seed=seed), (-1, 0, 1)
        )
        errors.append(hj.fit_multipliers(noisy, order=2).multipliers[0] - truth[0])
    rms = np.sqrt(np.mean(np.abs(errors) ** 2))
    print(f"{len(record.y) * 84:5d} strides: error of the multipliers {rms:.1e}")

# %% [markdown]
# ## Fewer strides: any input
#
# The same structure is fitted to a time series, here 300 strides with white-noise forces. Such a
# fit needs neither a steady state nor a periodic input, and it leaves out missing samples.

# %%
rng = np.random.default_rng(0)
pushes = 0.005 * rng.standard_normal((2, 300 * 32, 1))
walk = hj.run_experiments(cycle, phase, pushes, outputs, discard=0)
noisy = hj.experiments.add_noise(walk, snr=20)
y = noisy.y[0].copy()
y[1000:1100] = np.nan  # a hundred samples were lost
series = hj.fit_series(
    hj.experiments.SectionSeries(noisy.u[0], y, n_sections=32, outputs=outputs), order=2
)
series

# %%
print(f"error {np.max(np.abs(series.multipliers - truth)):.2g}")

# %% [markdown]
# ## Is the model good?
#
# The second record was not used for the fit. Noise is a tenth of it, so that no model explains more
# than 90 %.

# %%
test = hj.experiments.SectionSeries(
    noisy.u[1], noisy.y[1], n_sections=32, outputs=outputs
)
report = hj.validate(series.model, test)
report

# %%
report.plot()

# %% [markdown]
# The model explains nearly all of that. Yet its residuals are correlated over fractions of a
# stride, because of errors of the model itself. The multipliers are two numbers, which 300 noisy
# strides determine well, but the response to a force at each of 32 instants of the stride has
# several thousand. With four times the strides this error is half as large. The exact model leaves
# only noise:

# %%
hj.validate(hj.linearize(cycle, phase, outputs), test)
