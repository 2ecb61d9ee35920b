"""Inputs at a part of the cycle only, and the part that is most informative."""

from collections.abc import Mapping
from typing import Annotated

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from .._core.arguments import Numbers
from .._core.boundary.checked import checked, checked_methods
from .._core.boundary.kinds import Count, PeriodCount, Positive
from .._core.boundary.values import Reals
from .._core.progress import working
from .._core.text import fields
from ..errors import DefinitionError
from ..experiments.data import ExperimentData
from ..experiments.design.design import Design
from ..linear.ldtp import LDTP
from .candidates import NoiseLike
from .goals import Multipliers, Order
from .limits import Limits
from .optimal_design import OptimalDesign
from .optimize import optimal_design


# Factor of strides that a shorter window must save for its parts to be tried. Larger: a good part
# of a mediocre window is missed. Smaller: windows are compared whose difference the certificates
# (up to 1.02) leave open.
_BETTER = 1.02


@checked
class Window(eqx.Module):
    r"""Inputs at some sections only: $u[n] = w[n \bmod N]\, s[n]$ with the signal s of a design.

    From s to the outputs the system is periodic as before, with $B[n] w[n]$ and $D[n] w[n]$, so
    that all designs and estimates apply unchanged. Weights are scaled to a mean square of one: then
    s and u have the same rms, and limits of the rms of s are limits of u. (Limits of rates and
    peaks are not.)

    ```python
    window = hj.designs.Window([1, 1, 0, 0, 0, 0, 0, 0])
    plan = hj.optimal_design(window.seen_from_signal(model), usual)
    data = hj.run_experiments(cycle, sections, window.pushes(plan.design), outputs)
    estimate = hj.estimate_htf(window.with_signal(data, plan.design))
    ```

    **Arguments:** `weights` (N,), one for each section; zero where no input acts.

    **Raises:** `DefinitionError` for weights that are all zero.
    """

    weights: Float[np.ndarray, " N"]

    def __init__(self, weights: Annotated[Numbers, Reals("N")]):
        weights = np.asarray(weights, float)
        if not weights.any():
            raise DefinitionError("`weights` of a window must be different from zero somewhere.")
        self.weights = weights / np.sqrt(np.mean(weights**2))

    def seen_from_signal(self, model: LDTP) -> LDTP:
        """Return the system from the signal to the outputs."""
        self._check(model.n_sections, "model")
        w = jnp.asarray(self.weights)[:, None, None]
        return eqx.tree_at(lambda m: (m.B, m.D), model, (model.B * w, model.D * w))

    def pushes(
        self, design: Design, cycles: PeriodCount | None = None
    ) -> Float[np.ndarray, "S n nu"]:
        """Return the inputs of all experiments, for `run_experiments` or hardware.

        **Arguments:** `cycles`: as in `Design.inputs`.
        """
        self._check(design.n_sections, "design")
        s = design.inputs(cycles)
        return s * np.resize(self.weights, s.shape[1])[:, None]

    def with_signal(self, data: ExperimentData, design: Design) -> ExperimentData:
        """Return the data with the signal as input, from which transfer functions are defined."""
        self._check(design.n_sections, "design")
        s = design.inputs(data.u.shape[1] // data.n_sections)
        if s.shape != data.u.shape:
            raise DefinitionError(f"the design has inputs {s.shape}, the data {data.u.shape}.")
        return eqx.tree_at(lambda d: d.u, data, s)

    def _check(self, n_sections: int, owner: str) -> None:
        if n_sections != len(self.weights):
            raise DefinitionError(
                f"the window has {len(self.weights)} sections, the {owner} {n_sections}."
            )

    def __repr__(self) -> str:
        return fields(self)


@checked_methods
class WindowChoice(eqx.Module):
    """Windows that were tried, and the best one.

    **Fields:**

    - `first` (W,), `length` (W,): of each, the first section with an input, and their number; the
      first window is the whole cycle.
    - `criterion` (W,): of its optimal design. `certificate` (W,): e; no design for this window has
      a criterion below 1/e of that.
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
        """Number of strides with inputs in the whole cycle that one with this window replaces."""
        return float(self.criterion[0] / self.plan.criterion)

    def __repr__(self) -> str:
        rows = ["WindowChoice", "  sections          criterion  certificate"]
        columns = self.first, self.length, self.criterion, self.certificate
        for n, k, value, e in zip(*columns, strict=True):
            arc = "all" if k == self.length[0] else f"{k} from {n} on"
            rows.append(f"  {arc:<16}  {value:9.3g}  {e:11.3f}")
        gain = f"one stride does the work of {self.saved:.3g} with inputs in the whole cycle"
        nothing = "nothing is gained by inputs in a part of the cycle only"
        return "\n".join([*rows, f"  {nothing if self.window is None else gain}"])


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
    """Find the arc of the cycle in which inputs estimate a quantity in the fewest strides.

    Arcs of half the length are tried, then arcs of half that length in and around the best one, as
    long as they are better. Each gets its own optimal design, with a certificate; there is no proof
    that no other window is better.

    ```python
    limit = {"yM": 0.01, "vM": 0.05}
    choice = hj.designs.choose_window(model, usual, noise=noise, limit=limit)
    ```

    **Arguments:**

    - `design`, `noise`, `limit`: as in `optimal_design`, but as numbers: limits relative to a
      design would be different for each window. `goal`. Default: all multipliers.
    - `shortest`: the smallest number of sections. Default: 1.

    **Raises:** `DefinitionError` as `optimal_design`, and for a limit of distortion.
    """
    if isinstance(limit, Limits) and (limit.distortion is not None or isinstance(limit.rms, str)):
        raise DefinitionError(
            "`limit` of a window must be numbers, and without distortion, which is known for "
            "inputs at all sections only."
        )
    goal = Multipliers() if goal is None else goal
    N = model.n_sections
    tried: dict[tuple[int, int], OptimalDesign] = {}
    acts = np.any(model.B, axis=(1, 2)) | np.any(model.D, axis=(1, 2))

    def criterion(arc: tuple[int, int]) -> float:
        key = arc[0] % N, arc[1]
        if key not in tried:
            windowed = _window(*key, N).seen_from_signal(model)
            tried[key] = optimal_design(windowed, design, goal=goal, noise=noise, limit=limit)
        return tried[key].criterion

    best = (0, N)
    criterion(best)
    while best[1] // 2 >= shortest:
        length = best[1] // 2
        step = max(length // 2, 1)
        if best[1] == N:
            starts = range(0, N + 1, step)
        else:
            starts = range(best[0] - step, best[0] - step + best[1] + 1, step)
        arcs = [(n, length) for n in starts if acts[(n + np.arange(length)) % N].any()]
        arc = min(arcs, key=criterion)
        if criterion(arc) * _BETTER > criterion(best):
            break
        best = arc[0] % N, length
    first, length = np.array(list(tried)).T
    certificates = np.array([plan.certificate for plan in tried.values()])
    criteria = np.array([plan.criterion for plan in tried.values()])
    window = None if best == (0, N) else _window(*best, N)
    return WindowChoice(first, length, criteria, certificates, tried[best], window)


def _window(first: int, length: int, N: int) -> Window:
    weights = np.zeros(N)
    weights[(first + np.arange(length)) % N] = 1.0
    return Window(weights)
