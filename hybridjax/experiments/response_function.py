"""The response to inputs as a function that can be differentiated."""

import dataclasses
from typing import Annotated

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core.boundary.checked import checked, checked_methods
from .._core.boundary.kinds import Numbers
from .._core.boundary.values import Reals
from .._core.precision import require_x64
from .._core.text import listed
from ..engine.settings import EXPERIMENT
from ..orbits.cycle import LimitCycle
from ..sections.place import as_placed
from ..sections.placed import PlacedSections, SectionsLike
from ..systems.output import Output, OutputNames
from ..systems.system import HybridSystem
from .flow_batch import Response, course, flow_batch, require_shape
from .plan import Accuracy, Stepping, plan_flow


# Steps that a derivative may use between two of as many sections, and its square in a period of the
# cycle. Fewer: experiments far from the cycle fail at the limit on steps. More: derivatives need
# more memory.
_STEPS = 32


@checked_methods
class ResponseFunction(eqx.Module):
    """A map from inputs that are held between sections to outputs at the sections; see
    `response_function`.

    **Fields:** `placed`: the sections. `stepping`: tolerances and step schedule. `outputs`.
    """

    placed: PlacedSections
    stepping: Stepping
    outputs: tuple[str | Output, ...]

    def __repr__(self):
        s = self.placed.structure()
        names = s.resolve_outputs(self.outputs).names
        return (
            f"ResponseFunction({type(s.system).__name__}: {listed(s.inputs)} -> {listed(names)}; "
            f"{self.placed.n_sections} sections; accuracy {self.stepping.accuracy:g})"
        )

    def __call__(
        self,
        u: Annotated[Numbers, Reals("S n nu")],
        start: Float[Array, "m S"] | None = None,
        system: HybridSystem | None = None,
    ) -> Response:
        """Return the response of S experiments.

        **Arguments:**

        - `u`: inputs, held from sample to sample, with n a multiple of the N sections.
        - `start`: times and states (padded with zeros) on section 0. Default: those of the cycle.
        - `system`: a system with other parameter values. The sections do not move with it.

        **Returns:** a `Response`: outputs `y` (S, n, ny) (not deviations), `result` (S,) codes,
        `failed_at` (S,), error estimates `error` (S,), and final states `end` (S, m). Experiments
        that fail raise no error.

        **Raises:** `DefinitionError` for inputs of another shape.
        """
        require_x64(system)
        u, placed = jnp.asarray(u, float), self.placed
        require_shape(u.shape, placed.n_sections, len(placed.cycle.system.inputs))
        if system is not None:
            placed = eqx.tree_at(lambda x: x.cycle.system, placed, system)
        if start is None:
            start = jnp.tile(placed.section_zero[:, None], len(u))
        return flow_batch(
            course(placed, self.outputs), self.stepping.plan, start, u, self.stepping.settings
        )


@checked
def response_function(
    cycle: LimitCycle,
    sections: SectionsLike,
    outputs: OutputNames,
    *,
    accuracy: Accuracy = EXPERIMENT,
) -> ResponseFunction:
    """Return the computation of `run_experiments` as a function for `jit`, `vmap`, `grad` and
    `jacfwd`.

    ```python
    response = hj.response_function(cycle, sections, ("yM", "vM"))

    @eqx.filter_jit
    @eqx.filter_grad
    def gradient(system):
        return jnp.sum((response(u, system=system).y - measured) ** 2)
    ```

    It has exact derivatives with respect to inputs, start and parameters, in both modes. Reverse
    mode stores the states at the sections and recomputes the flow between them, so its memory grows
    by a few hundred bytes per sample. Outputs of an experiment are NaN after it failed: select
    experiments by `result` before you average.

    **Arguments:** as for `run_experiments`. The cycle may be unstable if experiments are short.

    **Raises:** `DefinitionError` for outputs or sections that do not exist, or an accuracy out of
    range.
    """
    placed = as_placed(cycle, sections)
    z = placed.structure().resolve_outputs(outputs)
    stepping = plan_flow(placed, accuracy)
    steps = max(_STEPS, _STEPS**2 // placed.n_sections)
    settings = dataclasses.replace(stepping.settings, max_steps=steps)
    stepping = dataclasses.replace(stepping, settings=settings)
    return ResponseFunction(placed, stepping, tuple(z.items))
