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
# # A sweep, and its best hopper
#
# This notebook sweeps 10 000 hoppers that differ in the stiffness of their leg and the damping of
# their foot. Which of them hop stably, how fast do they recover from a disturbance, and which is
# best among those that hop equally high? The last question is answered twice, by gradient and by
# comparing all of them.

# %%
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib import pyplot
from scipy.optimize import minimize

import hybridjax as hj


hj.enable_x64()  # before any model is built

POINTS = 100  # in each direction

# %% [markdown]
# ## Limit cycles and multipliers of all of them
#
# A single call finds them all. Newton's method starts from the cycle of one hopper, and then from
# those of its neighbors. If it fails, 40 periods of the transient are simulated first. Hoppers
# without such a cycle are listed by index, with the reason.

# %%
cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
k_axis, b_axis = np.linspace(8, 18, POINTS), np.linspace(2.6, 11, POINTS)
k, b = (jnp.asarray(x.ravel()) for x in np.meshgrid(k_axis, b_axis))
hoppers = eqx.filter_vmap(lambda k, b: hj.models.VerticalHopper(k=k, b=b))(k, b)
cycles = hj.orbits.find_limit_cycles(hoppers, guess=cycle)
cycles

# %% [markdown]
# Each hopper has four multipliers, two of which are zero, because touchdown erases the state of the
# foot. The largest modulus determines how fast disturbances decay; below one the hopper is stable.
# The angle of the first multiplier shows how a disturbance changes from period to period: at 0 it
# keeps its sign, at pi it changes its sign, and in between it oscillates. White: no cycle with one
# flight and one stance per period.

# %%
first = cycles.multipliers[:, 0].reshape(POINTS, POINTS)
modulus, angle = np.abs(first), np.abs(np.angle(first))


def label(axes, title):
    axes.set(xlabel="stiffness k (N/m)", ylabel="damping b (N s/m)", title=title)


with hj.plot.style():
    figure, (left, right) = pyplot.subplots(
        1, 2, figsize=(hj.plot.PAGE, 3.0), layout="constrained", sharey=True
    )
    image = left.pcolormesh(
        k_axis, b_axis, modulus, cmap="viridis", vmin=0, rasterized=True
    )
    lines = left.contour(
        k_axis, b_axis, modulus, [0.5, 0.7, 0.9], colors="white", linewidths=0.7
    )
    left.clabel(lines, fontsize=6)
    figure.colorbar(image, ax=left, label="largest modulus of a multiplier")
    label(left, "contraction in one period")
    scale = {"cmap": "cividis", "vmin": 0, "vmax": np.pi}
    image = right.pcolormesh(k_axis, b_axis, angle, rasterized=True, **scale)
    key = figure.colorbar(image, ax=right, label="angle of the first multiplier (rad)")
    key.set_ticks([0, np.pi / 2, np.pi], labels=["0", "π/2", "π"])
    label(right, "oscillation from period to period")
    right.set_ylabel("")

# %% [markdown]
# Two multipliers coincide on the real axis where the angle reaches 0 or pi. The modulus of the
# largest has a kink there, and its derivative grows without bound on one side.
#
# ## The best hopper of a given height
#
# `hj.fitting.spectral_radius` is smooth everywhere, and a little above the true radius: the number
# $r$ with $\sum_j r^{-2j} \lVert\Phi^j\rVert^2 = d/\epsilon$ for the monodromy matrix $\Phi$. Its
# gradient, and that of the apex height, are computed through the limit cycle and its events, in
# forward mode, because there are only two parameters. The optimizer is one of scipy, for losses
# with constraints.

# %%
WANTED = 2.3  # height of the body at the apex, in meters
apex = hj.Crossing("vM", "falling")


@eqx.filter_jit
def look(kb):
    """Height of the apex and logarithm of the smooth radius, and their derivatives."""

    def both(kb):
        system = hj.models.VerticalHopper(k=kb[0], b=kb[1])
        found = hj.find_limit_cycle(system, cycle)
        height = hj.sections.place_sections(found, [apex]).lanes.q[0, 0]
        values = jnp.stack(
            [height, jnp.log(hj.fitting.spectral_radius(found, smoothing=1e-4))]
        )
        return values, values

    slopes, values = jax.jacfwd(both, has_aux=True)(kb)
    return values, slopes


path = [np.array([10.0, 5.0])]
found = minimize(
    lambda x: float(look(jnp.asarray(x))[0][1]),
    path[0],
    jac=lambda x: np.asarray(look(jnp.asarray(x))[1][1]),
    method="SLSQP",
    bounds=[(k_axis[0], k_axis[-1]), (b_axis[0], b_axis[-1])],
    constraints={
        "type": "eq",
        "fun": lambda x: float(look(jnp.asarray(x))[0][0]) - WANTED,
        "jac": lambda x: np.asarray(look(jnp.asarray(x))[1][0]),
    },
    callback=lambda x: path.append(np.array(x)),
    options={"ftol": 1e-12},
)
best = hj.find_limit_cycle(hj.models.VerticalHopper(k=found.x[0], b=found.x[1]), cycle)
print(
    f"{found.message} after {found.nit} steps: k = {found.x[0]:.5f}, b = {found.x[1]:.5f}"
)
print("multipliers at the start:  ", cycle.multipliers)
print("multipliers at the optimum:", best.multipliers)

# %% [markdown]
# ## Comparison with all of them
#
# The heights of all hoppers are computed from the states at the 16 points that each cycle keeps
# (`legs`): a cubic through neighboring points has its maximum where the speed is zero, accurate to
# 0.03 mm. In each of the 100 columns of the sweep, interpolation gives the hopper with the required
# height.

# %%
y, v = np.moveaxis(np.asarray(cycles.pieces.q)[:, :2], 1, 0)
y1, v1, h = (
    np.roll(y, -1, axis=1),
    np.roll(v, -1, axis=1),
    float(cycle.period) / y.shape[1],
)
s = v / (v - v1)
top = (1 + 2 * s) * (1 - s) ** 2 * y + s * (1 - s) ** 2 * h * v
top = top + s**2 * (3 - 2 * s) * y1 - s**2 * (1 - s) * h * v1
rows = np.arange(len(cycles)), np.argmax((v > 0) & (v1 <= 0), axis=1)
heights = np.where(cycles.ok, top[rows], np.nan).reshape(POINTS, POINTS)

line = []
for column in range(POINTS):
    good = np.flatnonzero(~np.isnan(heights[:, column]))[
        ::-1
    ]  # height falls with damping
    if len(good) and heights[good, column].min() < WANTED < heights[good, column].max():
        b_here = np.interp(WANTED, heights[good, column], b_axis[good])
        radius = np.interp(b_here, b_axis[good[::-1]], modulus[good[::-1], column])
        line.append((k_axis[column], b_here, radius))
line = np.array(line)
winner = line[np.argmin(line[:, 2])]
print(
    "best of the sweep at this height: k = {:.3f}, b = {:.3f}, radius {:.5f}".format(
        *winner
    )
)
print(f"by gradient:                      radius {np.abs(best.multipliers).max():.5f}")

# %%
path = np.array(path)
red = hj.plot.COLORS["red"]
with hj.plot.style():
    figure, (left, right) = pyplot.subplots(
        1, 2, figsize=(hj.plot.PAGE, 3.0), layout="constrained"
    )
    image = left.pcolormesh(
        k_axis, b_axis, modulus, cmap="viridis", vmin=0, rasterized=True
    )
    figure.colorbar(image, ax=left, label="largest modulus of a multiplier")
    left.plot(*line[:, :2].T, color="white", lw=1.2, label=f"apex at {WANTED} m")
    left.plot(*path.T, ".-", color=red, label="steps of the optimizer")
    left.plot(*path[-1], "*", ms=11, color=red, mec="white", label="optimum")
    label(left, "where the apex has the wanted height")
    legend = left.legend(
        loc="upper left", frameon=True, framealpha=0.6, facecolor="black"
    )
    for text in legend.get_texts():
        text.set_color("white")
    right.plot(line[:, 0], line[:, 2], ".", ms=3, label="sweep, along the white line")
    right.plot(
        found.x[0],
        np.abs(best.multipliers).max(),
        "*",
        ms=11,
        color=red,
        label="optimum",
    )
    right.set(
        xlabel="stiffness k (N/m)", ylabel="largest modulus", title="along that line"
    )
    right.legend()
