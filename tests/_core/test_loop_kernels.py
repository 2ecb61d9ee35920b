"""Loops as single kernels."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

import hybridjax as hj


# A loop with a branch, and whether it is one kernel.
LOOP = """
import jax, jax.numpy as jnp, json, os, hybridjax as hj
hj.enable_x64()
hj.enable_loop_kernels()
hj.enable_loop_kernels()
def body(i, x):
    return jax.lax.cond(x[0] > 1, lambda x: x / 2, lambda x: x + 0.1 * jnp.sin(i + x), x)
run = jax.jit(lambda x: jax.lax.fori_loop(0, 20, body, x)).lower(jnp.linspace(1, 2, 300)).compile()
x = run(jnp.linspace(1, 2, 300))
print(json.dumps([x.tolist(), run.as_text().count("xla_cpu_small_call"), os.environ["XLA_FLAGS"]]))
"""
LATE = """
import jax, os, hybridjax as hj
from hybridjax._core.compilation.loop_kernels import _in_use
always = _in_use()
try:
    hj.enable_loop_kernels()
    print("done", always)
except hj.ComputationError as error:
    print(os.environ.get("XLA_FLAGS"), error)
"""
EXPERIMENTS = """
import json, numpy as np, hybridjax as hj
hj.enable_loop_kernels()
hj.enable_x64()
cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
u = 0.01 * np.random.default_rng(0).standard_normal((40, 64, 1))
data = hj.run_experiments(cycle, hj.ClockPhase(32), u, ("yM", "vM"), discard=0)
print(json.dumps(data.y.tolist()))
"""


def run(code: str, **environment: str) -> str:
    kept = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    environment = kept | {"JAX_PLATFORMS": "cpu"} | environment
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return done.stdout


def test_a_loop_is_one_kernel():
    """With options that were there before, and with a second call."""
    values, kernels, flags = json.loads(run(LOOP, XLA_FLAGS="--xla_cpu_enable_fast_math=false"))
    assert kernels > 0
    assert flags.startswith("--xla_cpu_enable_fast_math=false --xla_backend_extra_options=")
    assert len(flags.split()) == 2
    x = np.linspace(1, 2, 300)
    for i in range(20):
        x = x / 2 if x[0] > 1 else x + 0.1 * np.sin(i + x)
    np.testing.assert_allclose(values, x, rtol=1e-12)


def test_a_call_that_comes_too_late_is_refused():
    """And leaves the options as they were; unless XLA makes whole loops without being asked."""
    said = run(LATE)
    if said.strip() == "done True":
        pytest.skip("this XLA makes single kernels of loops by itself")
    assert said.startswith("None ") and "before JAX computes anything" in said


@pytest.mark.slow
def test_experiments_are_the_same(hopper_cycle):
    u = 0.01 * np.random.default_rng(0).standard_normal((40, 64, 1))
    data = hj.run_experiments(hopper_cycle, hj.ClockPhase(32), u, ("yM", "vM"), discard=0)
    np.testing.assert_allclose(json.loads(run(EXPERIMENTS)), data.y, rtol=0, atol=1e-12)
