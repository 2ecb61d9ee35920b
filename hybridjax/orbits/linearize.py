"""From a limit cycle and sections to the linear periodic system between them (paper Sec. III)."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core.errors import DefinitionError
from ..flow.lanes import by_lane, only
from ..periodic.ldtp import LDTP
from ..systems.output import Output
from ..systems.structure import Structure, is_traced
from .cycle import LimitCycle
from .jacobian import flow_jacobian
from .place import PlacedSections, place_sections


def linearize(
    cycle: LimitCycle,
    sections,
    outputs: Sequence[str | Output] | str | Output | None = None,
    inputs: Sequence[str] | str | None = None,
) -> LDTP:
    """The linear discrete-time periodic system between consecutive sections, eqs. (5) and (6).

    A[n] and B[n] map deviations at section n, and the input held until section n+1, to deviations
    at section n+1; exact, through all events in between, also where the interval's end depends
    on the state. C[n] and D[n] give the outputs' deviations at section n.

    The coordinates on a section are deviations of the chart's states; on a state-based section of
    a clocked system the time of crossing comes first. On a section given by a level function, the
    coordinate that the flow changes fastest across it is left out. `ldtp.coordinates` names them.

    **Arguments:** `sections`, a family or `PlacedSections`; `outputs`, names or `Output`s, by
    default all states that every chart defines; `inputs`, by default all.

    **Raises:** `DefinitionError` for an output that is not defined in a chart where a section
    lies, or an input that does not exist; `ComputationError` as `place_sections`.
    """
    placed = sections if isinstance(sections, PlacedSections) else place_sections(cycle, sections)
    s = Structure(cycle.system)
    traced = is_traced(placed)
    if outputs is None:
        outputs = [
            n for n in s.state_names()
            if all(s.state_function(n, a) is not None for a in range(len(s.charts)))
        ]  # fmt: skip
    z = s.resolve_outputs(outputs)
    for a in range(len(s.charts)) if traced else np.unique(placed.lanes.chart):
        z.require(int(a))
    names = cycle.system.inputs if inputs is None else _as_tuple(inputs)
    for name in names:
        if name not in cycle.system.inputs:
            raise DefinitionError(
                f"there is no input '{name}'; inputs are {', '.join(cycle.system.inputs)}."
            )
    columns = np.array([cycle.system.inputs.index(n) for n in names], int)
    A, B, C, D = _linearize(placed, tuple(z.items), cycle.settings)
    d = s.d + 1 if traced else int(np.max(placed.dims))
    return LDTP(
        A[:, :d, :d], B[:, :d, columns], C[:, :, :d], D[..., columns], placed.dims,
        inputs=tuple(names), outputs=z.names,
        coordinates=None if traced else placed.coordinates(),
    )  # fmt: skip


def _as_tuple(names):
    return (names,) if isinstance(names, str) else tuple(names)


@eqx.filter_jit
def _linearize(placed: PlacedSections, outputs, settings):
    system = placed.cycle.system
    s = Structure(system)
    N, n = placed.count, 1 + s.d
    following = (jnp.arange(N) + 1) % N
    turns = jnp.where(following == 0, 1, 0)
    target = placed.target(following, placed.lanes.t, turns)
    h = 0.5 * placed.duration
    jacobian, _, _ = flow_jacobian(system, placed.lanes, target, settings, h)
    embed, select = jax.vmap(_frames, in_axes=(0, 0, 0, 0))(
        placed.normal, placed.drop, placed.dims, placed.time_is_state
    )
    after = select[following]
    A = after @ jacobian[:, :, :n] @ embed
    B = after @ jacobian[:, :, n:]
    CD = _output_jacobian(s, s.resolve_outputs(outputs), placed.lanes)
    return A, B, CD[:, :, :n] @ embed, CD[:, :, n:]


def _frames(
    normal: Float[Array, " 1+d"], drop, dim, with_time
) -> tuple[Float[Array, "1+d d"], Float[Array, "d 1+d"]]:
    """From section coordinates to (t, q), and back.

    Coordinate j is entry k(j) of (t, q), skipping t on clock sections and on autonomous systems,
    and skipping `drop`. A move in coordinate j takes the dropped entry along the section:
    -normal_k / normal_drop.
    """
    n = normal.shape[0]
    k = jnp.arange(n)
    kept = (k != drop) & ((k > 0) | with_time)
    order = jnp.argsort(~kept, stable=True)
    # One column more than a chart has states is never needed: (t, q) less the dropped entry.
    valid = jnp.arange(n) < dim
    select = jnp.where(valid[:, None], jnp.eye(n)[order], 0.0)
    slope = -normal / jnp.where(drop >= 0, normal[drop], 1.0)
    along = jnp.where((k == drop)[:, None], slope[None, :], 0.0)
    embed = (jnp.eye(n) + jnp.where(drop >= 0, along, 0.0)) @ select.T
    return embed, select


def _output_jacobian(s: Structure, z, lanes) -> Float[Array, "N ny 1+d+nu"]:
    N, ny = lanes.t.shape[0], len(z.names)
    out = jnp.zeros((ny, 1 + s.d + s.nu, N))
    for a in range(len(s.charts)):
        if not z.defined(a):
            continue
        here = lanes.chart == a
        n = s.dims[a]

        def jacobian(t, q, a=a, n=n):
            J = jax.jacfwd(lambda t, q, u: z(a, t, q, u), argnums=(0, 1, 2))
            t, q, u = J(t, q, jnp.zeros(s.nu))
            return jnp.concatenate([t[:, None], q, jnp.zeros((ny, s.d - n)), u], axis=1)

        def work(out, here=here, n=n, jacobian=jacobian):
            J = by_lane(jacobian)(only(here, lanes.t), only(here, lanes.q[:n]))
            return jnp.where(here, J, out)

        out = jax.lax.cond(here.any(), work, lambda out: out, out)
    return jnp.moveaxis(out, -1, 0)
