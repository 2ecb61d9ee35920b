# %% [markdown]
# # A walker that is not ours
#
# A planar walker in MuJoCo, from its XML to multipliers with confidence regions, and the pushes
# that it stands. Nothing here uses its equations. The notebook needs `pip install
# 'hybridjax[mujoco,scale]'`.
#
# The walker has a torso on two springy legs. Contacts are well damped, and their force begins at
# zero, so that a perturbation changes a return smoothly. A small controller keeps the walker on its
# cycle: the legs swing in turn by a clock, the foot is placed ahead by the speed, and the leg on
# the ground holds the torso upright.

# %%
import math

import jax.numpy as jnp
import matplotlib.pyplot as plt
import mujoco
import numpy as np

import hybridjax as hj


hj.enable_x64()
LEG = """
<body>
  <joint name="{side}" axis="0 -1 0" damping="0.2"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.03" mass="1"/>
  <body>
    <joint name="{side}_leg" type="slide" axis="0 0 -1" stiffness="6000" damping="150"/>
    <geom type="sphere" pos="0 0 -0.95" size="0.05" mass="0.5" contype="1"/>
  </body>
</body>
"""
XML = f"""
<mujoco model="walker">
  <option timestep="0.0005" integrator="implicitfast" cone="elliptic" tolerance="1e-14"/>
  <default>
    <geom solref="0.02 1" solimp="0 0.95 0.02" friction="2 0 0" contype="0" conaffinity="0"/>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="50 2 0.1" conaffinity="1"/>
    <body name="torso">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <joint name="pitch" axis="0 -1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 0.4" size="0.06" mass="10"/>
      {LEG.format(side="left")} {LEG.format(side="right")}
    </body>
  </worldbody>
  <actuator>
    <motor name="left" joint="left"/> <motor name="right" joint="right"/>
    <motor name="left_leg" joint="left_leg"/> <motor name="right_leg" joint="right_leg"/>
    <motor name="push" joint="x"/>
  </actuator>
  <keyframe><key qpos="0 0.97 0 -0.25 0 0.25 0" qvel="0.8 0 0 0 0 0 0"/></keyframe>
</mujoco>
"""
PERIOD = 0.8


def control(model, data):
    _, z, pitch, left, _, right, _ = data.qpos
    speed, _, rate, left_rate, _, right_rate, _ = data.qvel
    if z < 0.7 or abs(pitch) > 1:
        raise hj.errors.ComputationError("fell")
    phase = math.sin(2 * math.pi * data.time / PERIOD)
    swings = 0.5 + 0.5 * math.tanh(4 * phase)  # 1: left, 0: right
    ahead = speed * PERIOD / 4 + 0.3 * (speed - 0.4)
    torso = -150 * pitch - 20 * rate
    swing_left = 60 * (ahead - pitch - left) - 7.5 * (rate + left_rate)
    swing_right = 60 * (ahead - pitch - right) - 7.5 * (rate + right_rate)
    return [
        swings * swing_left - (1 - swings) * (torso + swing_right),
        (1 - swings) * swing_right - swings * (torso + swing_left),
        -480 * max(0.0, phase) ** 2,  # legs shorten while they swing
        -480 * max(0.0, -phase) ** 2,
        0.0,
    ]


model = mujoco.MjModel.from_xml_string(XML)
plant = hj.plants.MuJoCoPlant(
    model, {"push": "N"}, control=control, period=PERIOD, substeps=40
)

# %% [markdown]
# ## Its cycle
#
# `settle` lets the walker walk without pushes until it repeats itself, and finds eight sections at
# equal times.

# %%
cycle = hj.plants.find_cycle(plant, hj.ClockPhase(8), ("x_rate", "pitch"), cycles=40)
print(cycle)


# %%
def draw(z):
    hip = jnp.stack([z["x"], z["z"]])

    def along(angle, length):
        return hip + length * jnp.stack([jnp.sin(angle), -jnp.cos(angle)])

    left, right = (
        hj.systems.Drawing.spring(
            hip, along(z["pitch"] + z[side], 0.95 + z[f"{side}_leg"]), 0.03
        )
        for side in ("left", "right")
    )
    return hj.systems.Drawing(
        {
            "ground": [(-9.0, 0.0), (99.0, 0.0)],
            "left": left,
            "right": right,
            "torso": jnp.stack([hip, along(z["pitch"], -0.4)]),
        },
        circles={"head": jnp.append(along(z["pitch"], -0.45), 0.06)},
        points={"hip": hip},
        body="hip",
    )


motion = cycle.trajectory(draw, np.zeros((16, 1)))
hj.plot.animate(motion, "left", "right", traces=("x_rate", "pitch"))

# %% [markdown]
# ## Multipliers from perturbed returns
#
# The state can be set, so that each of its numbers can be perturbed. The distance walked is left
# out. Steps follow from the scatter of the returns, which comes from contacts that begin within a
# time step.

# %%
coordinates = [name for name in plant.states if name not in ("time", "x")]
returns = cycle.perturbed_returns(coordinates)
print(returns)

# %% [markdown]
# ## Multipliers from experiments
#
# Pushes at the hip are held from section to section, as in a laboratory.

# %%
design = hj.multisine(n_sections=8, periods=16, amplitude=0.1, lines="odd")
data = cycle.run_experiments(design, discard=24)
print(data.summary())
fit = hj.fit_multipliers(hj.estimate_htf(data), order=2)
print(fit)
print(
    "returns lie in the region of the experiments:",
    fit.contains(returns.multipliers[:2]),
)
print(
    "experiments lie in the region of the returns:", returns.contains(fit.multipliers)
)

# %%
figure, ax = plt.subplots(figsize=(4.5, 4))
for estimate, color, name in (
    (returns, "C0", "perturbed returns"),
    (fit, "C1", "experiments"),
):
    border = estimate.ellipse(0)
    ax.fill(border.real, border.imag, color=color, alpha=0.3, label=f"{name}, 95 %")
    ax.plot(
        estimate.multipliers[0].real, estimate.multipliers[0].imag, "+", color=color
    )
ax.set(xlabel="Re λ", ylabel="Im λ")
ax.locator_params(nbins=5)
ax.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, 1.2))
plt.show()

# %% [markdown]
# Both roads agree. A deviation of speed and foot placement turns by 119° in each cycle and shrinks
# to two thirds. Larger pushes give a biased estimate, because the walker is not linear:

# %%
strong = cycle.run_experiments(10 * design.signals(40), discard=24)
print(hj.fit_multipliers(hj.estimate_htf(strong), order=2))

# %% [markdown]
# ## The pushes that it stands
#
# A force at the hip acts for 0.1 s, from a random time in the cycle on. The walker stands it if it
# does not fall within eight cycles; else the time of its fall is recorded.


# %%
def stands(rng):
    begin, force = rng.uniform(0, PERIOD), rng.uniform(-200, 200)
    plant.set_state(cycle.state)
    start, fell = plant.data.time, np.nan
    try:
        for u, duration in ((0.0, begin), (force, 0.1), *[(0.0, PERIOD)] * 8):
            plant.step([u], duration)
    except hj.errors.ComputationError:
        fell = plant.data.time - start - begin
    return {"begin": begin, "force": force, "fell": fell}


draws = hj.scale.monte_carlo(stands, 150, seed=0)
begin, force, fell = draws.begin.values, draws.force.values, draws.fell.values
stood = np.isnan(fell)
print(f"{stood.mean():.0%} of pushes between -200 and 200 N are stood")

# %%
figure, ax = plt.subplots(figsize=(6, 3.2))
ax.plot(begin[stood], force[stood], "o", mfc="none", mec="0.5", label="stood")
points = ax.scatter(
    begin[~stood], force[~stood], c=fell[~stood], cmap="viridis", label="fell"
)
figure.colorbar(points, label="time until the fall (s)")
ax.set(xlabel="time of the push in the cycle (s)", ylabel="force (N)")
ax.legend(fontsize=8, loc="lower right", bbox_to_anchor=(1, 1), ncols=2)
plt.show()

# %% [markdown]
# A push backwards of 200 N, just before the right foot lifts off:

# %%
u = np.zeros((24, 1))
u[3] = -200
fall = cycle.trajectory(draw, u)
print(f"the walker falls after {fall.t[-1]:.2f} s")
hj.plot.animate(fall, "left", "right", traces=("x_rate", "pitch"))
