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
# # The paper, step by step
#
# Ankarali and Cowan identify a rhythmic hybrid system from input-output experiments. This notebook
# does the same with a system that is defined here, and compares every estimate with the exact
# result. Equations and sections refer to *System Identification of Rhythmic Hybrid Dynamical
# Systems via Discrete Time Harmonic Transfer Functions* (CDC 2014).

# %%
import dataclasses

import jax.numpy as jnp
import numpy as np

import hybridjax as hj


hj.enable_x64()  # before any model is built

SECTIONS, EXPERIMENTS, PERIODS, DISCARD = 32, 80, 64, 20  # the paper's numbers

# %% [markdown]
# ## A hybrid system (Sec. II)
#
# Two masses are connected by a leg spring with a sinusoidal actuator. In flight the foot moves too
# and is damped; in stance it rests on the ground, so that the two charts have different dimensions.
# A vector field is a function of one state; the package handles batches, padding and derivatives.


# %%
class Flight(hj.Chart):
    states = ("yM", "vM", "ym", "vm")
    units = ("m", "m/s", "m", "m/s")
    hopper: "Hopper"

    def field(self, t, q, u):
        p = self.hopper
        yM, vM, ym, vm = q
        leg = p.leg(t, yM, ym)
        return vM, (leg + u[0]) / p.M - p.g, vm, -(leg + p.b * vm) / p.m - p.g


class Stance(hj.Chart):
    states = ("yM", "vM")
    units = ("m", "m/s")
    absent = {"ym": 0.0, "vm": 0.0}  # what they are when somebody asks for them here
    hopper: "Hopper"

    def field(self, t, q, u):
        p = self.hopper
        yM, vM = q
        return vM, (p.leg(t, yM, 0.0) + u[0]) / p.M - p.g


class Hopper(hj.HybridSystem):
    input_units = ("N",)
    time_unit = "s"

    m: hj.Parameter = hj.parameter(1.0, unit="kg")
    M: hj.Parameter = hj.parameter(2.0, unit="kg")
    k: hj.Parameter = hj.parameter(10.0, unit="N/m")
    b: hj.Parameter = hj.parameter(5.0, unit="N s/m")
    l0: hj.Parameter = hj.parameter(2.0, unit="m")
    a: hj.Parameter = hj.parameter(20.0, unit="N")
    g: hj.Parameter = hj.parameter(2.0, unit="m/s^2")

    def leg(self, t, yM, ym):
        return self.k * (self.l0 - (yM - ym)) + self.a * jnp.sin(2 * jnp.pi * t)

    def charts(self):
        return {"flight": Flight(self), "stance": Stance(self)}

    def transitions(self):
        return (
            hj.Transition(
                "touchdown",
                "flight",
                "stance",
                guard=lambda t, q, u: q[2],
                reset=lambda t, q, u: q[:2],
            ),
            hj.Transition(
                "liftoff",
                "stance",
                "flight",
                guard=lambda t, q, u: self.leg(t, q[0], 0.0) + self.m * self.g,
                reset=lambda t, q, u: (q[0], q[1], 0.0, 0.0),
            ),
        )

    def period(self):
        return 1.0


hopper = Hopper()

# %% [markdown]
# A trajectory from a rough initial state, with its events:

# %%
trajectory = hj.simulate(hopper, "stance", (2.05, 1.9), duration=10.0, time=0.5)
for event in trajectory.events[:4]:
    print(f"{event.time:.6f}  {event.name:9}  {event.source} -> {event.target}")

# %% [markdown]
# ## The limit cycle
#
# Newton's method is applied to the return map with its exact Jacobian; the paper simulates 60 s of
# transient instead. The multipliers have a negative real part: the sign was lost in print.

# %%
cycle = hj.find_limit_cycle(hopper, hj.Guess("stance", (2.0, 1.9), time=0.5))
cycle

# %% [markdown]
# ## Poincaré sections (Secs. III, VI-B)
#
# Two families of 32 sections, both with section 0 at the apex: isochrons, which for this system are
# phases of its clock, and the kinematic phase, which needs only the body's height and speed.
# A family is a definition; `place_sections` evaluates and checks it on a cycle.

# %%
apex = hj.Crossing("vM", "falling")
families = {
    "isochron": hj.ClockPhase(SECTIONS, anchor=apex),
    "kinematic": hj.KinematicPhase(
        SECTIONS,
        position="yM",
        velocity="vM",
        center=(1.9, 0.0),
        scale=(0.3, 1.9),
        anchor=apex,
    ),
}
placed = {
    name: hj.sections.place_sections(cycle, family) for name, family in families.items()
}
axes = hj.plot.cycle(
    cycle, "yM", "vM", sections=placed["kinematic"], perturbed=trajectory
)

# %% [markdown]
# ## The linear periodic system (eqs. 5 to 7)
#
# The linearization is exact, through the events. Dimensions vary from section to section: on a
# kinematic section the time of crossing `t` is a coordinate, and the state that the section
# determines is left out.

# %%
outputs = ("yM", "vM")
models = {name: hj.linearize(cycle, where, outputs) for name, where in placed.items()}
for name, model in models.items():
    print(name, model)
    print("   dimensions", *np.asarray(model.dims))
    print(
        "   on section 0:",
        model.coordinates[0],
        "rank of the return map:",
        model.rank(),
    )
    print("   multipliers", model.multipliers)

# %% [markdown]
# ## A design (Sec. V)
#
# The design has 620 frequencies in 80 experiments, as in the paper. Every design is checked for the
# rules of Sec. V-B. At least 20 experiments are needed to obey them; `hj.multisine()` makes such a
# design.

# %%
design = hj.experiments.paper_design(SECTIONS, PERIODS, experiments=EXPERIMENTS, seed=0)
print(design)
print(hj.multisine(SECTIONS, PERIODS, seed=0))

# %% [markdown]
# ## Experiments
#
# All experiments run side by side, from the limit cycle; the first 20 cycles are not used for
# estimation.

# %%
data = {
    name: hj.run_experiments(cycle, where, design, outputs, discard=DISCARD)
    for name, where in placed.items()
}
for d in data.values():
    print(d)
figure = data["kinematic"].plot(0)

# %% [markdown]
# ## Harmonic transfer functions
#
# $H_m$ is evaluated at the input frequency $f$; the output frequency is $f + m$ cycles per period.
# The broad pale lines are exact. On kinematic sections $H_{\pm 2}$ is not negligible.

# %%
estimates = {name: hj.estimate_htf(d) for name, d in data.items()}
exact = {
    name: models[name].htf(estimate.frequencies) for name, estimate in estimates.items()
}
for name in families:
    errors = estimates[name].harmonic_errors(exact[name])
    print(f"{name}: error of H_0 (of max|H_0|) {np.asarray(errors[SECTIONS // 2])}")
    size = np.abs(exact[name].select((-2, 0, 2)).H[..., 0]).max(axis=1)
    print(
        f"   max|H_-2|, max|H_2| over max|H_0|: {size[0] / size[1]}, {size[2] / size[1]}"
    )

pairs = {name: (estimates[name], exact[name]) for name in families}
figure = hj.plot.htf(pairs)

# %% [markdown]
# ## Parametric fits (Sec. VI-C3)
#
# The paper's 2 poles and 1 zero for $H_0$, with $\lambda = p^N$ for each pole. Such a fit is biased
# even on exact data, since the true $H_0$ has all $N$-th roots of each multiplier as poles:

# %%
rational = {
    name: hj.identify.fit_rational(estimate) for name, estimate in estimates.items()
}
for name, fit in rational.items():
    biased = hj.identify.fit_rational(exact[name])
    for output in outputs:
        error = fit.compare(cycle.multipliers, output).max_error
        bias = biased.compare(cycle.multipliers, output).max_error
        print(
            f"{name}, {output}: error {error:.1e}; of the same fit to the exact H_0 {bias:.1e}"
        )
figure = hj.plot.bode(pairs, fits=rational)

# %% [markdown]
# All harmonics and outputs together have one denominator in $z^{-N}$, whose roots are the
# multipliers. This structure is exact:

# %%
structured = {
    name: hj.fit_multipliers(e, order=models[name]) for name, e in estimates.items()
}
for name, fit in structured.items():
    print(name)
    print(fit.compare(cycle.multipliers))

# %%
everything = {f"2 poles 1 zero, {name}": fit for name, fit in rational.items()}
everything |= {f"structured, {name}": fit for name, fit in structured.items()}
axes = hj.plot.multipliers(cycle, everything)

# %% [markdown]
# The choice of sections does not change the poles, but it moves the zeros (Sec. VI-C2):

# %%
figure = hj.plot.poles_zeros(rational)

# %% [markdown]
# ## Beyond the paper
#
# Parameters can be differentiated, and a new value does not cause another compilation. The
# multipliers depend on the mass of the body as follows (the search for each cycle starts from the
# previous one):

# %%
neighbor = cycle
for mass in (2.0, 1.9, 1.8):
    neighbor = hj.find_limit_cycle(dataclasses.replace(hopper, M=mass), neighbor)
    print(f"M = {mass} kg: {neighbor.multipliers[0]:.9f}")

# %% [markdown]
# The estimated transfer functions predict the response to another input of the same frequencies:

# %%
estimate, model = estimates["isochron"], models["isochron"]
n = np.arange(PERIODS * SECTIONS)
lines = np.asarray(estimate.frequencies)[[3, 40, 55]]
u = 0.01 * sum(np.cos(2 * np.pi * f * n / SECTIONS + f) for f in lines)[:, None]
predicted = estimate.predict(u)
linear = model.simulate(u, model.periodic_state(u, PERIODS))
size = np.abs(linear).max(axis=0)
print(
    "largest error, of the largest response:",
    abs(predicted - linear).max(axis=0) / size,
)
