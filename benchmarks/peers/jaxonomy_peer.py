"""jaxonomy (a JAX simulator of hybrid block diagrams): one system, guards and sections as
zero crossings, experiments one after the other by one compiled function.

Clock sections are zero crossings, too: a periodic update that changes the input costs accuracy
(version 3.4.1 seems to begin the next step with the field from before the update).

jaxonomy asks for its own versions of JAX and others, so it lives in an environment of its own, and
`python` is the interpreter of that environment: the job goes there and the record comes back in
files. As a script, this file does the work there.
"""

import itertools
import pathlib
import pickle
import subprocess
import sys
import tempfile
import time
from typing import NamedTuple

import numpy as np


# Relative tolerances, coarse to fine; absolute ones are a tenth of them.
SETTINGS = (1e-8, 1e-9, 1e-10, 1e-11)


class Result(NamedTuple):
    """The record (S, n, 2), and seconds of CPU and of the clock: compiling and running."""

    record: np.ndarray
    compile_cpu: float
    compile_wall: float
    run_cpu: float
    run_wall: float


def available(python: str) -> bool:
    """Whether `python` is an interpreter that has jaxonomy."""
    command = (python, "-c", "import jaxonomy")
    try:
        return subprocess.run(command, capture_output=True).returncode == 0
    except OSError:
        return False


def run(job, python: str, rtol: float = 1e-9) -> Result:
    """Do the job in the environment of `python`.

    **Raises:** `Unavailable` without jaxonomy, or for the bar.
    """
    from .errors import Unavailable

    if not available(python):
        raise Unavailable(f"not installed for {python}")
    if job.model != "hopper":
        raise Unavailable("it is written for the hopper only")
    with tempfile.TemporaryDirectory() as folder:
        given, made = (pathlib.Path(folder, name) for name in ("job", "result"))
        given.write_bytes(pickle.dumps((job._asdict(), job.durations, rtol)))
        command = (python, __file__, given, made)
        subprocess.run(command, check=True, capture_output=True, text=True)
        return Result(*pickle.loads(made.read_bytes()))


def simulator(job, durations, rtol):
    """A compiled function of the inputs (n,) of one experiment to its record (n, 2)."""
    import jax
    import jax.numpy as jnp
    import jaxonomy

    p, N, n = job["parameters"], len(job["times"]), job["u"].shape[1]
    # Time counts from section 0.
    phase = p["omega"] * job["times"][0]
    planes = jnp.asarray(job["planes"])

    class State(NamedTuple):
        k: jax.Array
        flight: jax.Array
        record: jax.Array

    class Hopper(jaxonomy.LeafSystem):
        def __init__(self):
            super().__init__(name="hopper")
            record = jnp.zeros((n + 1, 2)).at[0].set(job["states"][0, :2])
            flight = jnp.array(job["charts"][0] == "flight")
            self.declare_dynamic_parameter("u", jnp.zeros(n + 1))
            self.declare_continuous_state(
                4, ode=self.ode, default_value=jnp.array(job["states"][0])
            )
            first = State(jnp.array(0), flight, record)
            self.declare_discrete_state(default_value=first, as_array=False)
            falls = {"direction": "positive_then_non_positive"}
            self.declare_zero_crossing(self.event, self.jump, name="event", **falls)
            self.declare_zero_crossing(
                self.section, self.arrive, name="section", **falls
            )

        def leg(self, t, y, ym):
            return p["k"] * (p["l0"] - (y - ym)) + p["a"] * jnp.sin(
                p["omega"] * t + phase
            )

        def ode(self, t, state, **parameters):
            y, v, ym, vm = state.continuous_state
            now, force = state.discrete_state, self.leg(t, y, ym)
            u = parameters["u"][now.k]
            foot = -(force + p["b"] * vm) / p["m"] - p["g"]
            foot = jnp.where(now.flight, foot, 0.0)
            return jnp.array([v, (force + u) / p["M"] - p["g"], vm, foot])

        def event(self, t, state, **parameters):
            y, _, ym, _ = state.continuous_state
            lifts = self.leg(t, y, 0.0) + p["m"] * p["g"]
            return jnp.where(state.discrete_state.flight, ym, lifts)

        def jump(self, t, state, **parameters):
            y, v, _, _ = state.continuous_state
            now = state.discrete_state
            v = v * jnp.where(now.flight, p["retention"], 1.0)
            state = state.with_continuous_state(jnp.array([y, v, 0.0, 0.0]))
            return state.with_discrete_state(now._replace(flight=~now.flight))

        def section(self, t, state, **parameters):
            y, v, _, _ = state.continuous_state
            plane = planes[(state.discrete_state.k + 1) % N]
            coming = state.discrete_state.k + 1
            if job["family"] == "isochron":
                level = coming * (job["period"] / N) - t
            else:
                plane = planes[coming % N]
                level = plane[0] * y + plane[1] * v + plane[2]
            return jnp.where(state.discrete_state.k < n, level, 1.0)

        def arrive(self, t, state, **parameters):
            now = state.discrete_state
            k = now.k + 1
            record = now.record.at[k].set(state.continuous_state[:2])
            return state.with_discrete_state(now._replace(k=k, record=record))

    hopper = Hopper()
    options = jaxonomy.SimulatorOptions(
        math_backend="jax",
        rtol=rtol,
        atol=rtol / 10,
        max_minor_step_size=2 * float(durations.max()),
        max_major_steps=4 * n,
        buffer_length=1,
    )
    context = hopper.create_context()
    end = job["period"] * n / N + (0.01 * job["period"] / N)

    @jax.jit
    def experiment(u):
        here = context.with_parameter("u", jnp.append(u, 0.0))
        solver = jaxonomy.Simulator(hopper, options=options)
        return solver.advance_to(end, here).context.state.discrete_state.record[:n]

    return experiment


def main(given: str, made: str) -> None:
    import jax

    jax.config.update("jax_enable_x64", True)
    job, durations, rtol = pickle.loads(pathlib.Path(given).read_bytes())
    seconds = [(time.process_time(), time.perf_counter())]
    experiment = simulator(job, durations, rtol)
    compiled = experiment.lower(job["u"][0]).compile()
    seconds.append((time.process_time(), time.perf_counter()))
    record = np.stack([np.asarray(compiled(u)) for u in job["u"]])
    seconds.append((time.process_time(), time.perf_counter()))
    compiling, running = (
        tuple(b - a for a, b in zip(*pair, strict=True))
        for pair in itertools.pairwise(seconds)
    )
    pathlib.Path(made).write_bytes(pickle.dumps((record, *compiling, *running)))


if __name__ == "__main__":
    main(*sys.argv[1:])
