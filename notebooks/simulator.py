# %% [markdown]
# # A hopper that is not ours
#
# A hopper in MuJoCo, from its XML to multipliers with confidence regions, and the pushes that it
# stands. It has the masses, spring and motor of the paper's hopper, but its foot lands on soft
# ground. Nothing of this notebook uses its equations. It needs `pip install
# 'hybridjax[mujoco,scale]'`.

# %%
import math

import matplotlib.pyplot as plt
import mujoco
import numpy as np

import hybridjax as hj


hj.enable_x64()
XML = """
<mujoco model="hopper">
  <option timestep="0.0005" gravity="0 0 -2"/>
  <default><geom solref="0.02 1" solimp="0 0.95 0.05" friction="0 0 0"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="2 2 0.1"/>
    <body name="trunk" pos="0 0 0.1">
      <joint name="yM" type="slide" axis="0 0 1"/>
      <geom type="box" size="0.2 0.2 0.1" mass="2" contype="0" conaffinity="0"/>
    </body>
    <body name="foot" pos="0 0 0.1">
      <joint name="ym" type="slide" axis="0 0 1" damping="5"/>
      <geom type="sphere" size="0.1" mass="1"/>
    </body>
  </worldbody>
  <tendon>
    <fixed name="leg" stiffness="10" springlength="2">
      <joint joint="yM" coef="1"/> <joint joint="ym" coef="-1"/>
    </fixed>
  </tendon>
  <actuator><motor name="drive" tendon="leg"/> <motor name="push" joint="yM"/></actuator>
  <keyframe><key qpos="2.2 0.3" qvel="-0.5 -0.5"/></keyframe>
</mujoco>
"""


def drive(model, data):
    """The motor in the leg follows a clock."""
    return [20 * math.sin(2 * math.pi * data.time), 0.0]


model = mujoco.MjModel.from_xml_string(XML)
plant = hj.plants.MuJoCoPlant(model, {"push": "N"}, control=drive, period=1.0, substeps=20)

# %% [markdown]
# ## Its cycle
#
# `settle` lets the hopper run without pushes until it repeats itself, and finds ten sections at
# equal times.

# %%
cycle = hj.plants.settle(plant, hj.ClockPhase(10, anchor=0.7), ("yM", "yM_rate"))
print(cycle)

# %%
plant.set_state(cycle.state)
frames = [plant.step([0.0], 0.1) for _ in range(10)]
figure, ax = plt.subplots(figsize=(8, 3))
for k, z in enumerate(frames):
    ax.plot([k, k], [z["ym"], z["yM"]], "0.6", lw=2)
    ax.plot(k, z["ym"], "o", color="C1", ms=7)
    ax.plot(k, z["yM"], "s", color="C0", ms=16)
ax.axhline(-0.06, color="k", lw=1)
ax.set(xlabel="tenths of a cycle", ylabel="height (m)", ylim=(-0.3, 2.6))
plt.show()

# %% [markdown]
# ## Multipliers from perturbed returns
#
# The state can be set, so that each of its numbers can be perturbed. The scatter of returns from
# nearly equal states comes from contacts that begin in one time step or the next.

# %%
returns = cycle.perturbed_returns()
print(returns)
print("scatter of returns:", dict(zip(returns.coordinates, returns.noise.tolist(), strict=True)))
hard = hj.find_limit_cycle(hj.models.VerticalHopper())
print(returns.compare(hard.multipliers))

# %% [markdown]
# On hard ground the paper's hopper has two multipliers, because the foot's height and velocity
# are zero in stance. On soft ground they are not: a third, small multiplier appears, and the
# fourth cannot be told from 0.
#
# ## Multipliers from experiments
#
# Pushes are held from section to section, as in a laboratory.

# %%
design = hj.multisine(n_sections=10, periods=16, amplitude=0.02)
data = cycle.run_experiments(design)
print(data.summary())
fit = hj.fit_multipliers(hj.estimate_htf(data), order=2)
print(fit)
print("returns lie in the region of the experiments:", fit.contains(returns.multipliers))
print("experiments lie in the region of the returns:", returns.contains(fit.multipliers))

# %%
figure, ax = plt.subplots(figsize=(4.5, 4))
for estimate, color, name in ((returns, "C0", "perturbed returns"), (fit, "C1", "experiments")):
    border = estimate.ellipse(0)
    ax.fill(border.real, border.imag, color=color, alpha=0.3, label=f"{name}, 95 %")
    ax.plot(estimate.multipliers[0].real, estimate.multipliers[0].imag, "+", color=color)
true = hard.multipliers[0]
ax.plot(true.real, abs(true.imag), "kx", label="hard ground, exact")
ax.set(xlabel="Re λ", ylabel="Im λ")
ax.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, 1.25))
plt.show()

# %% [markdown]
# ## The pushes that it stands
#
# The trunk gets a random velocity at the apex. The hopper stands the push if it is within
# 2 cm of its cycle after 20 periods.

# %%
start = cycle.state
names = plant.states


def stands(rng):
    push = rng.uniform(-12, 12)
    state = start.copy()
    state[names.index("yM_rate")] += push
    plant.set_state(state)
    for _ in range(20):
        z = plant.step([0.0], 1.0)
    away = abs(z["yM"] - cycle.cycle_outputs[0, 0])
    return {"push": push, "away": away}


draws = hj.monte_carlo(stands, 40, seed=0)
push, away = draws.push.values, draws.away.values
print(f"{(away < 0.02).mean():.0%} of pushes between -12 and 12 m/s are stood")

# %%
figure, ax = plt.subplots(figsize=(6, 3))
ax.semilogy(push, np.maximum(away, 1e-7), ".")
ax.set(xlabel="change of the trunk's velocity (m/s)", ylabel="distance after 20 cycles (m)")
plt.show()
