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
# # Fit parameters, and learn a term
#
# This notebook uses experiments on a hopper in two ways. First, its equations are known and its
# parameters are not: `fit_model` estimates the parameters that the data identify, and lists the
# others. Then one force is unknown: a small neural network takes its place, and is trained through
# touchdowns and lift-offs.

# %%
import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from matplotlib import pyplot

import hybridjax as hj


hj.enable_x64()  # before any model is built

SECTIONS, OUTPUTS = 8, ("yM", "vM")

# %% [markdown]
# ## Parameters from harmonic transfer functions
#
# The experiments apply multisines as a force on the body, at a signal-to-noise ratio of 20 dB. The
# design has four realizations of the random phases, from which the variances of the estimate are
# computed.

# %%
truth = hj.models.VerticalHopper()
cycle = hj.find_limit_cycle(truth)
apex = hj.Crossing("vM", "falling")
sections = hj.ClockPhase(SECTIONS, anchor=apex)
design = hj.multisine(
    SECTIONS, periods=16, frequencies=(0, 3.0), amplitude=0.02, seed=0
).realizations(4)
data = hj.run_experiments(cycle, sections, design, OUTPUTS, start="periodic")
data = hj.experiments.add_noise(data, snr=20, seed=0)
estimate = hj.estimate_htf(data, (-1, 0, 1))
estimate

# %% [markdown]
# The fit starts from a hopper all of whose parameters are wrong. The Jacobian is exact, through the
# limit cycle, its events and the sections (which are anchored at the apex and move with it).

# %%
names = ("m", "M", "k", "b", "l0", "a", "g")
wrong = hj.models.VerticalHopper(m=1.15, M=1.8, k=11.0, b=4.3, l0=2.2, a=18.0, g=2.1)
fit = hj.fit_model(
    wrong, hj.fitting.ObservedHTF(estimate, sections), names, guess=cycle, guesses=4
)
fit

# %%
print(fit.identifiability)

# %% [markdown]
# Seven parameters are free, and the data identify five combinations of them. A longer leg shifts
# the body upwards and changes no deviation from the cycle; the actuator's force and gravity enter
# only as their ratio. Combinations that are not identified keep their initial values. The
# identified ones are compared with the truth by their joint 95 % confidence region.

# %%
for name in ("m", "M", "k", "b"):
    print(
        f"{name}: {float(getattr(fit.system, name)):.4f}, true {float(getattr(truth, name)):g}"
    )
print(
    f"a/g: {float(fit.system.a / fit.system.g):.4f}, true {float(truth.a / truth.g):g}"
)
print(
    f"chi square {fit.chi_square(truth):.2f} for 5 combinations;", fit.contains(truth)
)

# %%
f = np.linspace(0.02, 3, 300)
exact = {
    "fitted": hj.linearize(fit.cycle, sections, OUTPUTS).htf(f, (-1, 0, 1)),
    "start": hj.linearize(hj.find_limit_cycle(wrong), sections, OUTPUTS).htf(
        f, (-1, 0, 1)
    ),
}
with hj.plot.style():
    figure, panels = pyplot.subplots(
        2, 3, figsize=(hj.plot.PAGE, 3.6), layout="constrained", sharex=True
    )
    order = np.argsort(np.asarray(estimate.frequencies))
    for row, output in enumerate(OUTPUTS):
        for axes, m in zip(panels[row], (-1, 0, 1), strict=True):
            axes.plot(
                estimate.frequencies[order],
                np.abs(estimate[m][order, row, 0]),
                ".",
                ms=3,
                label="estimate",
                color=hj.plot.COLORS["gray"],
            )
            axes.plot(f, np.abs(exact["start"][m][:, row, 0]), "--", label="start")
            axes.plot(f, np.abs(exact["fitted"][m][:, row, 0]), label="fit")
            axes.set_title(f"$|H_{{{m}}}|$ of {output}")
    for axes in panels[1]:
        axes.set_xlabel("frequency (cycles/period)")
    panels[0, 0].set_ylabel("m/N")
    panels[1, 0].set_ylabel("(m/s)/N")
    panels[0, 0].legend()

# %% [markdown]
# ## An unknown law
#
# Now the damping force of the foot in flight is not proportional to its speed, and the law is
# unknown. The flight chart gets this force from an attribute of the system, which may be a function
# or a neural network.


# %%
class Flight(hj.Chart):
    states = ("yM", "vM", "ym", "vm")
    hopper: "Hopper"

    def field(self, t, q, u):
        p = self.hopper
        yM, vM, ym, vm = q
        leg = p.leg(t, yM, ym)
        return vM, (leg + u[0]) / p.M - p.g, vm, -(leg + p.damping(vm)) / p.m - p.g


class Hopper(hj.models.VerticalHopper):
    damping: object = None

    def charts(self):
        return {"flight": Flight(self), "stance": super().charts()["stance"]}


class Law(eqx.Module):
    """A linear guess, and a network that corrects it."""

    b: jax.Array
    network: eqx.nn.MLP

    def __call__(self, v):
        return self.b * v + 3 * self.network(jnp.array([v / 3]))[0]


def true_law(v):
    return 3 * v + 0.8 * v * jnp.sqrt(1 + v**2)


# %% [markdown]
# Eight experiments of four periods apply random forces. Outputs are recorded eight times per period
# at a signal-to-noise ratio of 40 dB. The experiments begin in stance, where the height and speed
# of the body are the complete state.

# %%
PERIODS = 4
real = hj.find_limit_cycle(Hopper(damping=true_law))
phases = hj.ClockPhase(SECTIONS, anchor=0.5)
force = 0.5 * np.random.default_rng(0).normal(size=(8, PERIODS * SECTIONS, 1))
records = hj.run_experiments(real, phases, force, OUTPUTS, start="cycle", discard=0)
records = hj.experiments.add_noise(records, snr=40, seed=0)
print(records.summary())

measured = jnp.asarray(records.y + np.tile(records.cycle_outputs, (PERIODS, 1)))
scale = jnp.asarray(records.y.std(axis=(0, 1)))
start = (
    jnp.zeros((5, 8)).at[:3].set(jnp.array([[0.5], *records.cycle_outputs[0][:, None]]))
)

# %% [markdown]
# `response_function` computes the same outputs as `run_experiments`, as a differentiable function.
# The eight experiments have a touchdown and a lift-off in each of their four periods. The network
# has few weights, so that forward-mode derivatives are cheap, and Levenberg-Marquardt reaches the
# noise level within 60 steps. (For a larger network, use reverse-mode gradients and an optimizer
# such as those of `optax`; here 400 steps of Adam end at twelve times the variance of the noise.) A
# weak regularization towards zero determines the weights that the data do not identify.

# %%
network = eqx.nn.MLP(
    1, 1, 6, 1, activation=jnp.tanh, key=jax.random.key(0), dtype=float
)
small = eqx.tree_at(
    lambda n: n.layers[-1].weight, network, 0.01 * network.layers[-1].weight
)
law = Law(jnp.asarray(5.0), small)
guess = hj.find_limit_cycle(
    Hopper(damping=law), hj.Guess("stance", (1.965, 1.876), 0.5)
)
response = hj.experiments.response_function(guess, phases, OUTPUTS)
numbers, rest = eqx.partition(law, eqx.is_inexact_array)
begin, back = jax.flatten_util.ravel_pytree(numbers)


def misfit(weights):
    system = eqx.tree_at(
        lambda s: s.damping, guess.system, eqx.combine(back(weights), rest)
    )
    return ((response(force, start, system).y - measured) / scale).ravel()


@jax.jit
def train(weights):
    pulled = lambda w, _: jnp.concatenate([misfit(w), 1e-3 * w])  # noqa: E731
    solver = optx.LevenbergMarquardt(rtol=1e-6, atol=1e-6)
    end = optx.least_squares(pulled, solver, weights, max_steps=60, throw=False).value
    squares = jax.lax.map(lambda w: jnp.mean(misfit(w) ** 2), jnp.stack([weights, end]))
    return end, *squares


weights, first, last = train(begin)  # compiles for half a minute
learned = eqx.combine(back(weights), rest)
print(f"mean square misfit {first:.3g} at first, {last:.3g} at last")
print("noise: 0.0001")

# %% [markdown]
# The next cell compares the learned law with the true one, and the multipliers of the hopper
# with the learned law. The foot was not measured: all information about it comes from the force of
# the leg on the body.

# %%
found = hj.find_limit_cycle(
    eqx.tree_at(lambda s: s.damping, guess.system, learned), guess
)
print("true         ", real.multipliers)
print("linear guess ", guess.multipliers)
print("learned      ", found.multipliers)
print(f"error {np.abs(found.multipliers - real.multipliers).max():.1e},", end=" ")
print(f"of the guess {np.abs(guess.multipliers - real.multipliers).max():.1e}")

# %%
moments = real.trajectory()
t, chart, q = moments.dense()
speeds = np.asarray(q)[np.asarray(chart) == 0, 3]
v = jnp.linspace(speeds.min(), speeds.max(), 200)
with hj.plot.style():
    figure, (left, right) = pyplot.subplots(
        1, 2, figsize=(hj.plot.PAGE, 2.8), layout="constrained"
    )
    left.plot(
        v,
        jax.vmap(true_law)(v),
        color=hj.plot.COLORS["gray"],
        lw=4,
        alpha=0.5,
        label="true",
    )
    left.plot(v, 5 * v, "--", color="C1", label="guess")
    left.plot(v, jax.vmap(learned)(v), color="C2", label="learned")
    left.set(xlabel="speed of the foot (m/s)", ylabel="damping force (N)")
    left.legend()
    right.plot(v, 5 * v - jax.vmap(true_law)(v), "--", color="C1", label="guess")
    right.plot(
        v, jax.vmap(learned)(v) - jax.vmap(true_law)(v), color="C2", label="learned"
    )
    right.axhline(0, color=hj.plot.COLORS["gray"], lw=0.8)
    right.set(xlabel="speed of the foot (m/s)", ylabel="error of the damping force (N)")
    right.legend()
