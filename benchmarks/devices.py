"""The same calls on two devices: run this as it is on a machine with a GPU, and with
`JAX_PLATFORMS=cpu`.

Prints wall-clock seconds of the first and of the second call, and results with which the two runs
can be compared.
"""

import functools as ft
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import hybridjax as hj


hj.enable_x64()


def timed(name, call):
    for which in ("first", "second"):
        begin = time.perf_counter()
        result = call()
        print(f"{name}.{which} {time.perf_counter() - begin:.3g}", flush=True)
    return result


print("device", jax.devices()[0].device_kind, "jax", jax.__version__)
hopper = hj.models.VerticalHopper()
cycle = timed("cycle", lambda: hj.find_limit_cycle(hopper))
apex = hj.Crossing("vM", "falling")
phase = hj.KinematicPhase(
    32, position="yM", velocity="vM", center=(1.9, 0.0), scale=(0.3, 1.9), anchor=apex
)
model = timed("linearize", lambda: hj.linearize(cycle, phase, outputs=("yM", "vM")))
print("multipliers", *np.asarray(model.multipliers))
design = hj.experiments.paper_design(seed=0)
for count in (1, 200):
    large = design.realizations(count) if count > 1 else design
    run = ft.partial(hj.run_experiments, cycle, phase, large, outputs=("yM", "vM"))
    data = timed(f"experiments.{80 * count}", run)
    print("standard deviation of the outputs", np.asarray(data.y).std())
k, b = (
    x.ravel() for x in jnp.meshgrid(jnp.linspace(8, 13, 100), jnp.linspace(3, 7, 100))
)
hoppers = eqx.filter_vmap(lambda k, b: hj.models.VerticalHopper(k=k, b=b))(k, b)
cycles = timed(
    "cycles.10000", lambda: hj.orbits.find_limit_cycles(hoppers, guess=cycle)
)
print("mean modulus", np.abs(np.asarray(cycles.multipliers)).mean())
response = hj.experiments.response_function(cycle, phase, ("yM", "vM"))
u = design.signals(cycles=84)[:1]
gradient = eqx.filter_jit(
    eqx.filter_grad(lambda s: jnp.mean(response(u, system=s).y ** 2))
)
print(
    "gradient by k",
    timed("gradient", lambda: jax.block_until_ready(gradient(hopper)).k),
)
