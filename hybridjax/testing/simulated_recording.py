"""Recordings of simulated systems, whose truth is known."""

from typing import Annotated

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core.arguments import Numbers
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, Positive
from .._core.boundary.values import Reals
from .._core.limits import SECTIONS
from .._core.signal import unit_of
from ..engine.settings import EXPERIMENT
from ..errors import DefinitionError
from ..experiments.response_function import ResponseFunction, response_function
from ..orbits.cycle import LimitCycle
from ..recordings.recording import Recording
from ..sections.families import ClockPhase
from ..systems.output import OutputNames
from ..systems.structure import Structure


@checked
def simulate_recording(
    cycle: LimitCycle,
    force: Annotated[Numbers, Reals("S n nu")],
    outputs: OutputNames,
    *,
    rate: Positive = 500,
    steps: Count = 4,
    accuracy: Positive = EXPERIMENT,
) -> Recording:
    """What instruments would see of a system that is perturbed by a force, given as samples.

    The force is linear between samples. It is applied in steps of equal length, each with the
    value in its middle; the error is of second order in their length.

    **Arguments:**

    - `cycle`: where all trials start. `force`: for S trials of n samples.
    - `outputs`: names or `Output`s to be recorded beside the inputs.
    - `rate`: samples per unit of time, changed a little so that a whole number of them fits into a
      period. `steps`: of the force from sample to sample.
    - `accuracy`: of the simulation, as in `run_experiments`.

    **Returns:** a `Recording` with S trials. A trial that fails ends there.

    **Raises:** `DefinitionError` as `response_function`.
    """
    Structure(cycle.system).resolve_outputs(outputs)
    force = np.asarray(force, float)
    period = float(cycle.period)
    if not 1 <= rate * period * steps <= SECTIONS:
        raise DefinitionError(
            f"`rate` and `steps` give {rate * period * steps:.3g} steps in a period, but they may "
            f"be 1 to {SECTIONS}."
        )
    K = round(rate * period)
    S, n, nu = force.shape
    cycles = -(-(n - 1) // K)
    x = np.concatenate([force, np.zeros((S, cycles * K + 1 - n, nu))], axis=1)
    middle = (np.arange(steps) + 0.5) / steps
    u = x[:, :-1, None] + (x[:, 1:] - x[:, :-1])[:, :, None] * middle[:, None]
    u = u.reshape(S, -1, nu)
    response = response_function(cycle, ClockPhase(K * steps), outputs, accuracy=accuracy)
    y = np.asarray(_respond(response, jnp.asarray(u)))[:, ::steps]
    s = response.placed.structure()
    names = s.inputs + s.resolve_outputs(response.outputs).names
    units = dict(zip(names, map(unit_of, names), strict=True))
    time = np.arange(y.shape[1]) * period / K
    trials = []
    for k in range(S):
        good = slice(0, min(n, int(np.isfinite(y[k]).all(axis=1).sum())))
        signals = dict(zip(names, [*force[k, good].T, *y[k, good].T], strict=True))
        trials.append(Recording(time[good], signals, units=units, name=f"trial {k}"))
    return Recording.join(trials)


@eqx.filter_jit
def _respond(response: ResponseFunction, u: Float[Array, "S n nu"]) -> Float[Array, "S n ny"]:
    return response(u).y
