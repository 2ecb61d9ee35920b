"""Second derivatives of the maps between sections, and of outputs there."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._core.compilation.compile import quick_jit
from .._core.executor import from_host, to_host
from ..engine.replay import replay
from ..linear.quadratic import Quadratic
from ..orbits.cycle import LimitCycle
from ..sections.section_list import FamilyLike
from ..systems.output import Output
from ..systems.structure import Structure
from .linearize import inputs_of
from .outputs import observe
from .place import as_placed
from .placed import PlacedSections


# Second derivatives in units of the states' sizes, relative to the first ones, that are left to
# rounding. A hundred times more: what is nearly linear counts as linear; less: rounding counts.
_ROUNDING = 1e-11


def second_order(
    cycle: LimitCycle, sections: FamilyLike, outputs: tuple[str, ...], inputs: tuple[str, ...]
) -> Quadratic:
    """First and second derivatives by time and state at each section and by the inputs that are
    held from there on: exact, through all events.

    States are (t, q) in full: where a section is curved, no coordinates on it have to be. Without
    a clock time is left out.

    **Raises:** `DefinitionError` for an output that is not defined in a chart where a section
    lies, or an input that does not exist; `ComputationError` as `place_sections`.
    """
    placed = as_placed(cycle, sections)
    s = placed.structure()
    z = s.resolve_outputs(outputs)
    for a in np.unique(placed.lanes.chart):
        z.require(int(a))
    _, columns = inputs_of(s, inputs)
    first, second = to_host(_derivatives(from_host(placed), tuple(z.items)))
    n = 1 + s.d
    kept = np.r_[:n, n + columns]
    size = _sizes(to_host(placed), s, first[:, :n])[:, kept]
    first, second = first[:, :, kept], second[:, :, kept][..., kept]
    if not cycle.clocked:
        first[:, 0], second[:, 0] = 0.0, 0.0
    after = np.roll(size[:, :n], -1, axis=0)
    unit = np.abs(first[:, :n] * size[:, None]).max(axis=2) / after
    own = after * np.maximum(unit.max(axis=1, keepdims=True), 1.0)
    shown = np.abs(first[:, n:] * size[:, None]).max(axis=2)
    least = _ROUNDING * np.concatenate([own, shown], axis=1)
    bend = second * size[:, None, :, None] * size[:, None, None, :]
    second = np.where(np.abs(bend) > least[:, :, None, None], second, 0.0)
    return Quadratic(first[:, :n], second[:, :n], first[:, n:], second[:, n:])


@quick_jit
def _derivatives(placed: PlacedSections, items: tuple[str | Output, ...]):
    """First (N, rows, m) and second derivatives (N, rows, m, m) of (t, q) at the next section and
    of outputs at this one."""
    following, _, target = placed.onwards()
    s: Structure = placed.structure()
    z, lanes, n = s.resolve_outputs(items), placed.lanes, 1 + s.d

    def work(x):
        here = eqx.tree_at(lambda y: (y.t, y.q), lanes, (x[0], x[1:n]))
        t, q = replay(s, here, x[n:], target, placed.tape)
        return jnp.concatenate([t[None], q, observe(s, z, here, x[n:])])

    x = jnp.concatenate([lanes.t[None], lanes.q, jnp.zeros((s.nu, len(following)))])
    m = len(x)

    def along(direction):
        tangent = jnp.broadcast_to(direction[:, None], x.shape)
        return lambda x: jax.jvp(work, (x,), (tangent,))[1]

    def twice(one, other):
        tangent = jnp.broadcast_to(other[:, None], x.shape)
        return jax.jvp(along(one), (x,), (tangent,))

    i, j = np.triu_indices(m)
    first, second = jax.vmap(twice)(jnp.eye(m)[i], jnp.eye(m)[j])
    place = np.zeros((m, m), int)
    place[i, j] = place[j, i] = np.arange(len(i))
    return first[place[:, -1]].transpose(2, 1, 0), second[place].transpose(3, 2, 0, 1)


def _sizes(placed: PlacedSections, s: Structure, step) -> np.ndarray:
    """(N, m): of time, states and inputs at each section; an input of size one moves some state by
    its size."""
    scale = np.asarray(placed.cycle.settings.scale)[placed.lanes.chart]
    own = np.concatenate([np.full((len(scale), 1), placed.cycle.period), scale], axis=1)
    moved = np.abs(step[:, :, own.shape[1] :]) / np.roll(own, -1, axis=0)[:, :, None]
    most = moved.max(axis=(0, 1))
    of_inputs = 1 / np.where(most > 0, most, 1.0)
    return np.concatenate([own, np.broadcast_to(of_inputs, (len(own), s.nu))], axis=1)
