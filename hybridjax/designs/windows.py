"""The part of the cycle in which pushes tell most."""

from collections.abc import Mapping

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from .._core.boundary.checked import checked, checked_methods
from .._core.boundary.kinds import Count, Positive
from .._core.progress import working
from ..errors import DefinitionError
from ..experiments.design.design import Design
from ..linear.ldtp import LDTP
from .goals import Multipliers, Order
from .limits.limits import Limits
from .noise import NoiseLike
from .optimal_design import OptimalDesign
from .optimize import optimal_design
from .window import Window


# A window that saves less than this factor of strides is not worth another look at its parts.
# Closer to 1: more windows are tried.
_BETTER = 1.02


@checked_methods
class WindowChoice(eqx.Module):
    """Windows that were tried, and the best one.

    **Fields:**

    - `first` (W,), `length` (W,): of each, the first section that pushes, and how many do; the
      first window is the whole cycle.
    - `criterion` (W,): of its optimal design. `certificate` (W,): e, with which no design for this
      window has a criterion below 1/e of that.
    - `plan`: the best window's design; `window`: None where the whole cycle is best.
    """

    first: Int[np.ndarray, " W"]
    length: Int[np.ndarray, " W"]
    criterion: Float[np.ndarray, " W"]
    certificate: Float[np.ndarray, " W"]
    plan: OptimalDesign
    window: Window | None

    @property
    def saved(self) -> float:
        """How many strides with pushes in the whole cycle one stride with this window replaces."""
        return float(self.criterion[0] / self.plan.criterion)

    def __repr__(self) -> str:
        rows = ["WindowChoice", "  sections          criterion  certificate"]
        for n, k, value, e in zip(
            self.first, self.length, self.criterion, self.certificate, strict=True
        ):
            where = "all" if k == self.length[0] else f"{k} from {n} on"
            rows.append(f"  {where:<16}  {value:9.3g}  {e:11.3f}")
        gained = f"one stride does the work of {self.saved:.3g} with pushes in the whole cycle"
        nothing = "nothing is gained by pushing in a part of the cycle only"
        return "\n".join([*rows, f"  {nothing if self.window is None else gained}"])


@checked
@working("choose_window")
def choose_window(
    model: LDTP,
    design: Design,
    *,
    noise: NoiseLike,
    limit: Mapping[str, Positive] | Limits,
    goal: Multipliers | Order | None = None,
    shortest: Count = 1,
) -> WindowChoice:
    """The arc of the cycle in which pushes answer the question in the fewest strides.

    Arcs of half the length are tried, then arcs of half that length in and around the best one,
    as long as they are better. Each gets its own optimal design, with a certificate; that no other
    window is better is not proved.

    ```python
    limit = {"yM": 0.01, "vM": 0.05}
    choice = hj.designs.choose_window(model, usual, noise=noise, limit=limit)
    ```

    **Arguments:**

    - `design`, `noise`, `limit`: as for `optimal_design`, but in numbers: what is relative to a
      design is another thing for each window. `goal`: by default all multipliers.
    - `shortest`: the smallest number of sections.

    **Raises:** `DefinitionError` as `optimal_design`.
    """
    if isinstance(limit, Limits) and limit.distortion is not None:
        raise DefinitionError(
            "`limit` limits a distortion, which is known of pushes at all sections only."
        )
    goal = Multipliers() if goal is None else goal
    N = model.n_sections
    tried: dict[tuple[int, int], OptimalDesign] = {}
    acts = np.any(model.B, axis=(1, 2)) | np.any(model.D, axis=(1, 2))

    def attempt(first: int, length: int) -> float:
        key = first % N, length
        if key not in tried:
            seen = _window(*key, N).seen_from_signal(model)
            tried[key] = optimal_design(seen, design, goal=goal, noise=noise, limit=limit)
        return tried[key].criterion

    best = (0, N)
    attempt(*best)
    while best[1] // 2 >= shortest:
        length = best[1] // 2
        step = max(length // 2, 1)
        around = N if best[1] == N else best[1] + length
        begin = 0 if best[1] == N else best[0] - step
        starts = range(begin, begin + around - (best[1] < N) * length + 1, step)
        arcs = [(n, length) for n in starts if acts[(n + np.arange(length)) % N].any()]
        arc = min(arcs, key=lambda one: attempt(*one))
        if attempt(*arc) * _BETTER > attempt(*best):
            break
        best = arc[0] % N, length
    first, length = np.array(list(tried)).T
    certificates = np.array([one.certificate for one in tried.values()])
    criteria = np.array([one.criterion for one in tried.values()])
    window = None if best == (0, N) else _window(*best, N)
    return WindowChoice(first, length, criteria, certificates, tried[best], window)


def _window(first: int, length: int, N: int) -> Window:
    weights = np.zeros(N)
    weights[(first + np.arange(length)) % N] = 1.0
    return Window(weights)
