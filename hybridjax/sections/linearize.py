"""From a limit cycle and sections to the linear periodic system between them (paper Sec. III)."""

import jax
import numpy as np
from jaxtyping import Float

from .._core.boundary.checked import checked
from .._core.boundary.kinds import SignalNames
from .._core.compilation import host_first
from .._core.executor import Array, is_traced, namespace
from .._core.progress import working
from ..engine import kernels
from ..linear.ldtp import LDTP
from ..orbits.checks import check_outputs
from ..orbits.cycle import LimitCycle
from ..orbits.return_map import with_derivatives
from ..systems.system import Output, OutputNames
from .place import as_placed
from .placed import PlacedSections, SectionsLike


@checked
@working("linearize")
def linearize(
    cycle: LimitCycle,
    sections: SectionsLike,
    outputs: OutputNames | None = None,
    inputs: SignalNames | None = None,
) -> LDTP:
    """Linearize the flow between consecutive sections, eqs. (5) and (6).

    A[n] (d', d) and B[n] (d', nu) map deviations at section n, and the constant input until section
    n+1, to deviations at section n+1. They are exact, through all events in between, also if the
    end of the interval depends on the state. C[n] (ny, d) and D[n] (ny, nu) give the deviations of
    the outputs at section n.

    The coordinates on a section are deviations of the chart's states; on a state-based section of a
    clocked system the time of crossing comes first. On a section given by a level function, the
    state that the flow changes fastest across the section is left out. `ldtp.coordinates` lists
    them.

    **Arguments:**

    - `sections`: a family or `PlacedSections`.
    - `outputs`: names or `Output`s. Default: all states that every chart defines.
    - `inputs`: names. Default: all.

    **Raises:** `DefinitionError` for an output that is not defined in a chart where a section
    lies, or uses the time without having the period of a clock, or an input that does not exist;
    `ComputationError` as `place_sections`.
    """
    placed = as_placed(cycle, sections)
    s, traced, charts = placed.structure(), is_traced(placed), range(len(cycle.system.charts()))
    z = check_outputs(cycle, s.states_everywhere() if outputs is None else outputs)
    for a in charts if traced else np.unique(placed.lanes.chart):
        z.require(int(a))
    names, columns = s.inputs_among(inputs)
    A, B = placed.flow_jacobians
    C, D = _output_jacobians(placed, tuple(z.items))
    d = s.d + 1
    if not traced:
        A, B, C, D = jax.device_get((A, B, C, D))
        d = int(np.max(np.asarray(placed.dims)))
    return LDTP(
        A[:, :d, :d], B[:, :d, columns], C[:, :, :d], D[..., columns], placed.dims,
        inputs=names, outputs=z.names,
        coordinates=None if traced else placed.coordinates(),
    )  # fmt: skip


@host_first
def _output_jacobians(
    placed: PlacedSections, outputs: tuple[str | Output, ...]
) -> tuple[Float[Array, "N ny c"], Float[Array, "N ny nu"]]:
    """C and D, padded: derivatives of the outputs with respect to (t, q, u), at u = 0."""
    s, lanes, items = placed.structure(), placed.lanes, tuple(outputs)
    values = lambda a, *point: kernels.outputs(s, a, items, *point)  # noqa: E731
    by = with_derivatives(s, values, lanes.chart, lanes.t, lanes.q, len(items))
    J, n = namespace(by).moveaxis(by[:, 1:], -1, 0), 1 + s.d
    return J[:, :, :n] @ placed.frames()[0], J[:, :, n:]
