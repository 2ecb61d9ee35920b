"""Gradients of flows through events by jaxonomy, in the environment of an interpreter that has it.

As a script (`python -m peers.jaxonomy_flows NAME NUMBERS...` in the folder `benchmarks`), this file
prints the gradient of a row of `flows.py` and the CPU seconds of a first and a later call.
"""

import json
import pathlib
import subprocess
import sys

import numpy as np

from . import flows
from .errors import Unavailable
from .jaxonomy_peer import available


def run(name: str, point: tuple, python: str) -> tuple:
    """As `flows.timed`, of the row `name`.

    **Raises:** `Unavailable` without jaxonomy, and for rows that do not end at a time.
    """
    if flows.ROWS[name].until is None:
        raise Unavailable("it is written for rows that end at a time")
    if not available(python):
        raise Unavailable(f"not installed for {python}")
    command = (python, "-m", "peers.jaxonomy_flows", name, *map(str, point))
    folder = pathlib.Path(__file__).parents[1]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
    if done.returncode:
        raise Unavailable(done.stderr.strip().splitlines()[-1])
    gradient, first, later = json.loads(done.stdout.splitlines()[-1])
    return np.array(gradient), first, later


def gradient_of(row: flows.Row, parameters: int):
    """A compiled function of the parameters of a row to its gradient."""
    import jax
    import jax.numpy as jnp
    import jaxonomy

    class Flow(jaxonomy.LeafSystem):
        def __init__(self):
            super().__init__(name="flow")
            self.declare_dynamic_parameter("p", jnp.zeros(parameters))
            start = jnp.array(row.start)
            self.declare_continuous_state(
                len(start), ode=self.rates, default_value=start
            )
            self.declare_discrete_state(default_value=jnp.array(0))
            for k, event in enumerate(row.events):
                self.declare_zero_crossing(
                    self.guard_of(event),
                    self.reset_of(event),
                    name=f"event {k}",
                    direction="positive_then_non_positive",
                )

        def rates(self, t, state, **p):
            q = state.continuous_state
            rates = [
                jnp.stack([x + 0.0 * t for x in f(t, q, p["p"])]) for f in row.fields
            ]
            return jnp.stack(rates)[state.discrete_state]

        def guard_of(self, event):
            def guard(t, state, **p):
                value = event.guard(t, state.continuous_state, p["p"])
                return jnp.where(state.discrete_state == event.source, value, 1.0)

            return guard

        def reset_of(self, event):
            def reset(t, state, **p):
                after = event.reset(t, state.continuous_state, p["p"])
                after = jnp.stack([x + 0.0 * t for x in after])
                state = state.with_continuous_state(after)
                return state.with_discrete_state(jnp.array(event.target))

            return reset

    flow = Flow()
    options = jaxonomy.SimulatorOptions(
        math_backend="jax",
        enable_autodiff=True,
        rtol=1e-11,
        atol=1e-12,
        max_major_steps=40,
        buffer_length=1,
    )
    context = flow.create_context()

    def value(p):
        simulator = jaxonomy.Simulator(flow, options=options)
        end = simulator.advance_to(row.until, context.with_parameter("p", p))
        return end.context.state.continuous_state[0]

    return jax.jit(jax.grad(value))


def main(name: str, *numbers: str) -> None:
    import jax

    jax.config.update("jax_enable_x64", True)
    point = np.array(numbers, float)
    row = flows.ROWS[name]
    gradient, first, later = flows.timed(lambda: gradient_of(row, len(point)), point)
    print(json.dumps([gradient.tolist(), first, later]))


if __name__ == "__main__":
    main(*sys.argv[1:])
