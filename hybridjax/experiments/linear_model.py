"""Experiments on a linear periodic model."""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Index
from ..errors import DefinitionError
from ..linear.ldtp import LDTP
from .data import ExperimentData
from .design.design import DISCARD, Design
from .noise import ProcessNoise


@checked
def simulate_experiments(
    ldtp: LDTP,
    design: Design,
    *,
    discard: Index | None = None,
    start: Literal["cycle", "periodic"] = "cycle",
    process_noise: ProcessNoise | None = None,
) -> ExperimentData:
    """Run a design on a linear periodic model, from section 0.

    **Arguments:**

    - `ldtp`: the model. `design`: for the same N and number of inputs.
    - `start`: "cycle" starts at zero, which is the limit cycle, so that a transient decays during
      the first cycles; "periodic" in the periodic response, without a transient.
    - `discard`: cycles run before the window of P periods; by default 20 from the cycle (as in the
      paper), 0 from a periodic start.
    - `process_noise`: a random input beside the excitation, which is not recorded.

    **Returns:** `ExperimentData` with `discard + P` cycles.

    **Raises:** `DefinitionError` if N (also of the process noise) or the number of inputs differ,
    or if a periodic response does not exist (a multiplier that is a P-th root of one).
    """
    if ldtp.n_sections != design.n_sections or len(ldtp.inputs) != len(design.input_names):
        raise DefinitionError(
            f"the design is for N = {design.n_sections} and {len(design.input_names)} inputs, the "
            f"model has N = {ldtp.n_sections} and {len(ldtp.inputs)}."
        )
    if discard is None:
        discard = DISCARD if start == "cycle" else 0
    u = design.inputs(design.periods + discard)
    x0 = ldtp.periodic_states(design.inputs(), design.periods) if start == "periodic" else None
    applied = u
    if process_noise is not None:
        applied = u + process_noise.draw(u.shape, design.n_sections)
    y = _simulate(ldtp, jnp.asarray(applied), x0)
    return ExperimentData(
        u,
        y,
        n_sections=design.n_sections,
        periods=design.periods,
        inputs=ldtp.inputs,
        outputs=ldtp.outputs,
        label="linear model",
    )


@eqx.filter_jit
def _simulate(
    ldtp: LDTP, u: Float[Array, "S n nu"], x0: Float[Array, "S d"] | None
) -> Float[Array, "S n ny"]:
    return jax.vmap(ldtp.simulate)(u, x0)
