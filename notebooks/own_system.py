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
# # Your own hybrid system
#
# The system is a one-legged hopper without a clock, a mass on a springy leg like Raibert's
# machines. It falls, lands, and compresses the leg. While the leg extends, a cylinder pushes and
# replaces the energy that the damper dissipates.
#
# This notebook defines the system, finds its limit cycle, checks the multiplier by simulation,
# identifies it from experiments, and shows typical errors.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hybridjax as hj


hj.enable_x64()  # before any model is built

# %% [markdown]
# ## Charts, guards, resets
#
# A *chart* is a continuous mode, with named states and a vector field. The vector field is a
# function of one state, and returns the rates of all states. `u` contains the inputs, here a
# vertical force on the body.


# %%
class Flight(hj.Chart):
    states = ("y", "v")
    units = ("m", "m/s")  # for figures and prints
    robot: "Robot"

    def field(self, t, q, u):
        y, v = q
        return v, u[0] / self.robot.m - self.robot.g


class Stance(hj.Chart):
    states = ("y", "v")
    units = ("m", "m/s")
    robot: "Robot"
    thrust: jax.Array

    def field(self, t, q, u):
        p = self.robot
        y, v = q
        return v, (p.k * (p.l0 - y) - p.b * v + self.thrust + u[0]) / p.m - p.g


# %% [markdown]
# The system lists its charts, and the *transitions* between them. A transition happens when its
# guard falls through zero. Its reset maps the state into the new chart (default: the same state).
# Parameters are arrays: they can be differentiated, and new values do not cause another
# compilation.


# %%
class Robot(hj.HybridSystem):
    """Mass on a leg that thrusts while it gets longer. Input `u`: a force on the mass."""

    input_units = ("N",)
    time_unit = "s"

    m: hj.Parameter = hj.parameter(1.0, unit="kg", doc="mass")
    g: hj.Parameter = hj.parameter(9.81, unit="m/s^2", doc="gravity")
    l0: hj.Parameter = hj.parameter(0.5, unit="m", doc="length of the leg")
    k: hj.Parameter = hj.parameter(800.0, unit="N/m", doc="stiffness of the leg")
    b: hj.Parameter = hj.parameter(12.0, unit="N s/m", doc="damping of the leg")
    thrust: hj.Parameter = hj.parameter(30.0, unit="N", doc="force of the cylinder")

    def charts(self):
        return {
            "flight": Flight(self),
            "compression": Stance(self, 0.0 * self.thrust),
            "extension": Stance(self, self.thrust),
        }

    def transitions(self):
        def height(t, q, u):
            return q[0] - self.l0

        return [
            hj.Transition("touchdown", "flight", "compression", guard=height),
            hj.Transition(
                "bottom", "compression", "extension", guard=lambda t, q, u: -q[1]
            ),
            hj.Transition(
                "liftoff", "extension", "flight", guard=lambda t, q, u: -height(t, q, u)
            ),
        ]


robot = Robot()

# %% [markdown]
# ## A trajectory
#
# Dropped from 90 cm, the hopper loses height for some hops, and then hops periodically.

# %%
drop = hj.simulate(robot, "flight", (0.9, 0.0), duration=4.0)
t, y = drop("y")
figure, axes = plt.subplots(figsize=(6, 2.4), layout="constrained")
axes.plot(t, 100 * y, lw=1)
axes.axhline(100 * robot.l0, color="0.6", lw=0.8, zorder=0)
axes.set(xlabel="time (s)", ylabel="height (cm)")
print([event.name for event in drop.events[:6]])

# %% [markdown]
# ## Its limit cycle
#
# The system is autonomous, so that the cycle is a fixed point of the return map of a section: here
# the apex, where the speed falls through zero in flight. Newton's method uses the exact Jacobian of
# one hop, through all three events.

# %%
apex = hj.Crossing("v", "falling", charts=("flight",))
cycle = hj.find_limit_cycle(robot, hj.Guess("flight", (0.6, 0.0)), section=apex)
cycle

# %%
hj.plot.cycle(cycle)
# %% [markdown]
# There is one multiplier, because one of the two dimensions is along the orbit. Each hop removes
# nearly half of a disturbance. To check this, drop the robot a little above the apex, and compare
# the height of the next apex.

# %%
height, nudge = cycle.state["y"], 1e-6


def next_apex(y):
    hop = hj.simulate(robot, "flight", (y, 0.0), duration=1.05 * float(cycle.period))
    liftoff = next(event for event in hop.events if event.name == "liftoff")
    y, v = liftoff.after["y"], liftoff.after["v"]
    return float(y + v**2 / (2 * robot.g))


slope = (next_apex(height + nudge) - next_apex(height - nudge)) / (2 * nudge)
print(f"by hand {slope:.8f}, exactly {cycle.multipliers[0].real:.8f}")

# %% [markdown]
# ## Measure it
#
# Sixteen sections are evenly spaced in the angle of height and speed, because autonomous systems
# need state-based sections. (No section may lie exactly on an event. At the bottom the speed is
# zero, as at the apex, so that the center is moved a little.) Multisine forces are held between
# sections, and the response is recorded.

# %%
_, *orbit = cycle.trajectory()("y", "v")
center = [(np.min(x) + np.max(x)) / 2 + 0.1 * np.ptp(x) for x in orbit]
scale = [(np.max(x) - np.min(x)) / 2 for x in orbit]
phase = hj.KinematicPhase(
    16, position="y", velocity="v", center=center, scale=scale, anchor=apex
)
model = hj.linearize(cycle, phase, outputs=("y", "v"))
design = hj.multisine(n_sections=16, periods=32, lines="odd", seed=0).scaled(
    rms=0.05
)  # N
data = hj.run_experiments(cycle, phase, design, outputs=("y", "v"))
print(data.summary())
estimate = hj.estimate_htf(data, harmonics=(-1, 0, 1))
exact = model.htf(estimate.frequencies, harmonics=(-1, 0, 1))
print("largest error, of max |H_0|:", estimate.error(exact))
hj.plot.bode(estimate, exact)
# %%
fit = hj.fit_multipliers(estimate, order=1)
fit.compare(cycle.multipliers)
# %% [markdown]
# `p` is the share of such experiments whose error would be at least this large by chance if the fit
# is right: here 4.3 %, an error of two standard errors. A value below 1 % would call for an
# explanation, such as an amplitude that is too large.

# %% [markdown]
# ## Which parameter would help?
#
# Everything can be differentiated: here the multiplier, with respect to all parameters at once.


# %%
def multiplier(robot):
    neighbor = hj.find_limit_cycle(robot, guess=cycle)
    return jnp.trace(hj.linearize(neighbor, [apex], outputs="y").monodromy())


slopes = jax.grad(multiplier)(robot)  # without `jit`: that would compile for a minute
for name in ("m", "g", "l0", "k", "b", "thrust"):
    value = getattr(robot, name)
    change = (
        round(float(0.01 * value * getattr(slopes, name)), 12) or 0.0
    )  # less is rounding
    print(f"1 % more {name:6s} changes it by {change:+.1e}")

# %% [markdown]
# ## When something is wrong
#
# Errors are raised at the call that causes them: in a definition, in a design, or in the search for
# the cycle. Failures of experiments are reported for each experiment.


# %%
class Forgetful(Robot):
    def transitions(self):
        return [
            hj.Transition(
                "touchdown", "flight", "squat", guard=lambda t, q, u: q[0] - self.l0
            )
        ]


def attempt(action):
    try:
        action()
    except hj.errors.HybridJaxError as error:
        print(f"{type(error).__name__}: {error}\n")


limp = Robot(thrust=0.0)
clock = hj.ClockPhase(16)
attempt(lambda: hj.simulate(Forgetful(), "flight", (0.9, 0.0), duration=1.0))
attempt(lambda: hj.find_limit_cycle(limp, hj.Guess("flight", (0.6, 0.0)), section=apex))
attempt(lambda: hj.run_experiments(cycle, clock, design, outputs="y"))
attempt(lambda: hj.run_experiments(cycle, phase, design, outputs="z"))
print(hj.run_experiments(cycle, phase, design.scaled(rms=2.5), outputs="y").summary())
