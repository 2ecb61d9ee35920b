# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Play
#
# Three machines with a rhythm: a hopper, a wheel without a rim, and a juggler. Watch each of
# them, then move the sliders. Watch the crosses in the circle: inside, the rhythm recovers from a
# small push, the faster, the nearer to the middle; outside, it does not recover.

# %%
import hybridjax as hj


hj.enable_x64()

# %% [markdown]
# ## A hopper
#
# A motor moves the leg up and down. `k` is the stiffness of the leg's spring, `b` its damping.
# Does a soft leg recover faster than a stiff one?

# %%
hopper = hj.find_limit_cycle(hj.models.VerticalHopper())
hj.plot.animate(hopper, speed=0.5)

# %%
hj.explore(hopper, "k", "b")

# %% [markdown]
# ## A wheel without a rim
#
# It rolls down a slope from spoke to spoke, and needs no motor. Make the slope flatter: at which
# slope does it stop? The message above the picture tells.

# %%
wheel = hj.find_limit_cycle(hj.models.RimlessWheel())
hj.plot.animate(wheel)

# %%
hj.explore(wheel, "slope")

# %% [markdown]
# ## A juggler
#
# A paddle moves up and down, and never looks at the ball. Still the ball comes back in time: a
# ball that arrives late meets the paddle at another speed. `A` is the amplitude of the paddle,
# `restitution` the share of its speed that the ball keeps.

# %%
juggler = hj.find_limit_cycle(hj.models.PaddleJuggler())
hj.plot.animate(juggler)

# %%
hj.explore(juggler, "A", "restitution")
