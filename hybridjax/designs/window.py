"""When in the cycle to push."""

from typing import Annotated

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._core.arguments import Numbers
from .._core.boundary.checked import checked
from .._core.boundary.kinds import PeriodCount
from .._core.boundary.values import Reals
from .._core.text import fields
from ..errors import DefinitionError
from ..experiments.data import ExperimentData
from ..experiments.design.design import Design
from ..linear.ldtp import LDTP


@checked
class Window(eqx.Module):
    r"""Pushes at some sections only: $u[n] = w[n \bmod N]\, s[n]$ with the signal s of a design.

    From s to the outputs the system is periodic as before, with $B[n] w[n]$ and $D[n] w[n]$, so
    that all designs and estimates go on as they are. Weights are scaled to a mean square of one:
    then s and the pushes have the same rms, and limits of the input are limits of the pushes. (Of
    rates and peaks they are not.)

    ```python
    window = hj.designs.Window([1, 1, 0, 0, 0, 0, 0, 0])
    plan = hj.optimal_design(window.seen_from_signal(model), usual)
    data = hj.run_experiments(cycle, sections, window.pushes(plan.design), outputs)
    estimate = hj.estimate_htf(window.with_signal(data, plan.design))
    ```

    **Arguments:** `weights` (N,), one for each section; zero where nothing pushes.

    **Raises:** `DefinitionError` for weights that are all zero.
    """

    weights: Float[np.ndarray, " N"]

    def __init__(self, weights: Annotated[Numbers, Reals("N")]):
        weights = np.asarray(weights, float)
        if not weights.any():
            raise DefinitionError("`weights` of a window must be different from zero somewhere.")
        self.weights = weights / np.sqrt(np.mean(weights**2))

    def seen_from_signal(self, model: LDTP) -> LDTP:
        """The system from the signal to the outputs."""
        self._check(model.n_sections, "model")
        w = jnp.asarray(self.weights)[:, None, None]
        return eqx.tree_at(lambda m: (m.B, m.D), model, (model.B * w, model.D * w))

    def pushes(
        self, design: Design, cycles: PeriodCount | None = None
    ) -> Float[np.ndarray, "S n nu"]:
        """The inputs of all experiments, for `run_experiments` or hardware.

        **Arguments:** `cycles`, as of `Design.inputs`.
        """
        self._check(design.n_sections, "design")
        s = design.inputs(cycles)
        return s * np.resize(self.weights, s.shape[1])[:, None]

    def with_signal(self, data: ExperimentData, design: Design) -> ExperimentData:
        """The data with the signal as input, which is what transfer functions are from."""
        self._check(design.n_sections, "design")
        cycles = data.u.shape[1] // data.n_sections
        s = design.inputs(cycles)
        if s.shape != data.u.shape:
            raise DefinitionError(
                f"the design makes inputs {s.shape}, the data have {data.u.shape}."
            )
        return eqx.tree_at(lambda d: d.u, data, s)

    def _check(self, n_sections: int, what: str) -> None:
        if n_sections != len(self.weights):
            raise DefinitionError(
                f"the window has {len(self.weights)} sections, the {what} {n_sections}."
            )

    def __repr__(self) -> str:
        return fields(self)
